"""What the structure-preserving solvers share: one step at a time, of one length, by a nonlinear system that is solved to round-off.

Such a method keeps something exactly or nearly so (an energy, a quadratic integral, a symmetry under reversed time) as long as its steps do
not change, and has no error estimate: it takes a constant `dt0`. A step whose equations could not be solved ends the motion with a result code.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jourdain_jax.motion.vector_fields.field import VectorField
from jourdain_jax.scene.scene import Scene


class Step(eqx.Module):
    """One step: from t (s) over h (s, negative backwards), of `rates(t, y)`; `args` as `integrate` hands them to the rates.

    Times are those of the rates, which count from `args[4]`.
    """

    t: Float[Array, ""]
    h: Float[Array, ""]
    rates: Callable
    args: PyTree


class FixedStepSolver(diffrax.AbstractSolver):
    """Base of the structure-preserving solvers: subclasses say what one step is, and of which form of the state."""

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation  # states are saved at ends of steps only

    @abc.abstractmethod
    def fitted(self, scene: Scene, field: VectorField, asked: str) -> VectorField:
        """The form of the state that this method integrates; `asked`: the `state` of the `Formulation`. ValueError where it does not apply."""

    @abc.abstractmethod
    def stepped(self, step: Step, y: PyTree) -> tuple[PyTree, Bool[Array, ""]]:
        """The state `y` after one `step`, and whether the equations of the step were solved."""

    def order(self, terms):
        """Two: all of these are symmetric methods of second order. `terms` as in diffrax."""
        return 2

    def init(self, terms, t0, t1, y0, args):
        """Nothing is carried from step to step. `terms`, `t0`, `t1`, `y0`, `args`: as in diffrax."""
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step; where its equations were not solved, the state stays and the result says so.

        `terms`, `t0`, `t1`, `y0`, `args`, `solver_state`, `made_jump`: as in diffrax.
        """
        h = terms.contr(t0, t1)  # signed; diffrax itself counts time along the direction of the motion
        direction = jnp.sign(h)
        y1, solved = self.stepped(Step(t0 * direction, h, lambda t, y: terms.vf(t * direction, y, args), args), y0)
        y1 = jax.tree.map(lambda new, old: jnp.where(solved, new, old), y1, y0)
        result = diffrax.RESULTS.where(solved, diffrax.RESULTS.successful, diffrax.RESULTS.nonlinear_divergence)
        return y1, None, {"y0": y0, "y1": y1}, None, result

    def func(self, terms, t0, y0, args):
        """The rates at a state. `terms`, `t0`, `y0`, `args`: as in diffrax."""
        return terms.vf(t0, y0, args)
