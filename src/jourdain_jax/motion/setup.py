"""What is to be integrated and how, and what an integrator finds.

Time counts from the start, tau = t - t0: far from zero a clock has few digits, and what does not depend on it is to be as right there as at t0 = 0.
Rates, projection and events are given tau, and the scene and its inputs t0 + tau.
"""

from operator import attrgetter
from typing import Literal, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.motion.arguments import fitting_times
from jourdain_jax.motion.integrators.knots import knots_between
from jourdain_jax.motion.integrators.solver_choice import steps_are_given
from jourdain_jax.motion.start import State, Usual
from jourdain_jax.motion.vector_fields.field import Integrated, VectorField
from jourdain_jax.scene.scene import Scene

TOLERANCE, MOST_STEPS = 1e-8, 100_000  # of `simulate`, where nothing else is asked for
OWN_SOLVERS = (diffrax.Tsit5, diffrax.Dopri5, diffrax.Dopri8)


class Alongside(diffrax.ForwardMode):
    """Forward mode for first derivatives that are asked for together with the values: our own loop gives both in one run."""


OWN_ADJOINTS = (diffrax.RecursiveCheckpointAdjoint, diffrax.ForwardMode, Alongside)


class Options(eqx.Module):
    """How to integrate; what is a number of its own in every call stands in the `Setup`."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None  # None: the default one
    adjoint: diffrax.AbstractAdjoint
    max_steps: int = eqx.field(static=True)
    saveat: diffrax.SaveAt | None  # None: at the times asked for, at each of which a step ends
    event_names: tuple[str, ...] = eqx.field(static=True)
    native: bool = eqx.field(static=True, default=True)  # whether machine code of our own may integrate it
    order: int | None = eqx.field(static=True, default=None)  # of Taylor series, by which machine code steps in place of the solver's tableau

    @property
    def by_own_steps(self) -> bool:
        """Whether our own explicit Runge-Kutta loop integrates it: it has a solver, a controller and an adjoint of its own, and nothing else was stated."""
        plain = self.controller is None and self.saveat is None
        checkpoints = isinstance(self.adjoint, diffrax.RecursiveCheckpointAdjoint) and self.adjoint.checkpoints is not None
        return plain and not checkpoints and type(self.solver) in OWN_SOLVERS and type(self.adjoint) in OWN_ADJOINTS

    @property
    def kind(self) -> Literal["forward", "reverse"]:
        """The mode of differentiation of our own loop."""
        return "forward" if isinstance(self.adjoint, diffrax.ForwardMode) else "reverse"


class Solved(eqx.Module):
    """What either loop finds."""

    ts: Float[Array, "times *lanes"]  # as t_end, since the start
    ys: PyTree
    reached: Bool[Array, "times *lanes"]
    t_end: Float[Array, "*lanes"]
    y_end: PyTree
    code: Int[Array, "*lanes"]
    event: Int[Array, "*lanes"]  # index of the event that ended the motion, -1: none
    accepted: Int[Array, "*lanes"]
    rejected: Int[Array, "*lanes"]
    last_step: Float[Array, "*lanes"]  # s, that the step-size control would take next; NaN where it keeps that to itself
    pivot: Float[Array, "*lanes"]  # smallest magnitude of a pivot in any step, negative where one changed its sign; infinite: none was watched


class Setup(NamedTuple):  # an Equinox module takes 50 us to make
    """A motion to be integrated; in a batch all arrays have a leading axis of lanes."""

    scene: Scene
    start: State
    inputs: PyTree
    t0: Float[Array | np.ndarray, "*lanes"]
    t1: Float[Array | np.ndarray, "*lanes"]
    ts: Float[Array | np.ndarray, "*lanes times"]
    field: VectorField
    tolerances: tuple  # rtol, atol
    dt0: Float[Array | np.ndarray, "*lanes"] | float
    options: Options
    usual: Usual | None = None  # by which the start is yet to be put onto the rows, in the program that integrates; None: it is on them

    def fitting(self) -> "Setup":
        """The setup with times that serve any loop, also where its own do not go together."""
        of = attrgetter("ts", "t0", "t1", "dt0")
        return eqx.tree_at(of, self, fitting_times(*of(self)))

    @property
    def shortest(self) -> Float[Array, "*lanes"]:
        """The shortest step, s."""
        return 1e-14 * jnp.abs(self.t1 - self.t0)

    @property
    def knots(self) -> Float[Array, "knots"] | None:
        """Times since the start at which steps must end for the inputs' sake."""
        if steps_are_given(self.options.controller):
            return None
        return knots_between((self.inputs, self.scene), self.tolerances[0], self.t0, self.t1, self.ts)


class Begun(eqx.Module):
    """The start of the integration, marked for the adjoint."""

    right: Bool[Array, ""]  # whether all parameters are, and the masses and inertias that they make
    timely: Bool[Array, ""]  # whether the times go together
    start: State
    args: tuple  # vector field, scene, inputs, what the rates need of the scene, the time from which times count
    y0: Integrated
