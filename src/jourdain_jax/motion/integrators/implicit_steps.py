"""Implicit methods of our own loop, with the equations of a step solved by Newton's method.

Each takes steps of one motion; lanes of a batch run under `vmap`. Structure-preserving methods keep something exactly or nearly so (an energy, a quadratic
integral, a symmetry under reversed time) as long as their steps do not change, and have no error estimate: they carry their step. Between two times at
which a step must end they take the fewest equal ones no longer than that.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jourdain_jax.calculus.reals import Flag, Number, Scalar, checked_unless_traced
from jourdain_jax.motion.vector_fields.field import VectorField
from jourdain_jax.scene.scene import Scene


class Solution(NamedTuple):
    """The changes by a step."""

    change: PyTree  # of the state; zero where the equations of the step were not solved
    error: PyTree | None  # None: the method has no estimate
    solved: Flag  # whether they were


class ImplicitMethod(eqx.Module):
    """A method of our own loop whose steps are equations."""

    order: ClassVar[int]  # a step of h has an error of about h^order
    even: ClassVar[bool] = False  # whether it takes steps of one length
    needed: ClassVar[int] = 3  # slopes that are kept of a step: at its start, its middle and its end
    at_the_end: ClassVar[int] = 2

    @property
    def name(self) -> str:
        """The name of the method, as shown in a trajectory."""
        return type(self).__name__

    @abc.abstractmethod
    def solve(self, args: tuple, t: Scalar, y: PyTree, h: Scalar) -> Solution:
        """Return the change of the state by a step from `y` at `t` by `h` (s, negative backwards); `args`: as in `integrands.py`."""

    def fitted(self, scene: Scene, field: VectorField, asked: str) -> VectorField:
        """Return the form of the state that is integrated in place of `field`.

        Raises ValueError where the method does not apply to the `scene`, or to the state that its
        `Formulation` requests (`asked`).
        """
        return field


class FixedStepMethod(ImplicitMethod):
    """Base of the structure-preserving methods."""

    step: Number | None = eqx.field(kw_only=True)  # s, the longest; None where a program is given it as a number of its own
    order: ClassVar[int] = 2
    even: ClassVar[bool] = True

    def __check_init__(self):
        step = checked_unless_traced(self.step, f"`step` of `{self.name}`", (), advice="give the length of "
            "steps in s")
        if isinstance(step, np.ndarray) and not 0 < float(step) < np.inf:
            raise ValueError(f"`step` of `{self.name}` is {float(step):g}, expected a positive finite length "
                "of steps in s")


def sizes(unknowns: int, x: Float[Array, "numbers"], change: Float[Array, "numbers"]) -> Float[Array, "unknowns"]:
    """Return the size of each unknown, relative to which round-off is judged: the larger of the state x and
    of its change; 1 where both are zero.
    """
    size = jnp.max(jnp.abs(x)) + jnp.max(jnp.abs(change))
    return jax.lax.stop_gradient(jnp.full(unknowns, jnp.where(size == 0, 1.0, size)))


def even_step(longest: Scalar, rest: Scalar) -> Scalar:
    """Return the length of the fewest equal steps, none longer than `longest`, that cover a `rest`. A ratio
    1e-9 above a whole number counts as that number.
    """
    return rest / jnp.maximum(jnp.ceil(rest / longest - 1e-9), 1)
