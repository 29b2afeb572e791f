"""The integration problem of a motion, and the results of an integrator.

Time counts from the start, tau = t - t0: far from zero a clock has few digits, and what does not depend on it is to be as right there as at t0 = 0.
Rates, projection and events are given tau, and the scene and its inputs t0 + tau.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.build.structure import Reference
from jourdain_jax.calculus.reals import Entries, Flag, PerLane, Scalar, array_module, eps_of
from jourdain_jax.motion.inputs import knots_between
from jourdain_jax.motion.integrators.explicit_steps import Method, diffrax
from jourdain_jax.motion.integrators.implicit_steps import ImplicitMethod
from jourdain_jax.motion.put_on_rows import State, Usual
from jourdain_jax.motion.vector_fields.field import Integrated, VectorField
from jourdain_jax.scene.scene import Scene

MEMORY = 2**32  # bytes, where no model states others
LONGEST = 1 / 16  # of the span: the longest step, by default


class Passed(eqx.Module):
    """The events after which a motion continued."""

    ts: Float[Entries, "transitions *lanes"]  # since the start; infinite beyond the last one
    events: Int[Entries, "transitions *lanes"]
    lost: Float[Entries, "transitions *lanes"]  # J, by which the energy fell
    modes: Float[Entries, "modes transitions *lanes"]  # after each

    def times(
        self, origin: Scalar, ts: Float[Array, "times"], goals: Float[Array, "times"], direction: Scalar
    ) -> Float[Array, "transitions"]:
        """Return the times of transitions, rounded consistently: a transition before a goal (measured from
        the start) is also before the saved time in `ts` that belongs to the goal.

        Adding the `origin` to a time since the start may round it onto the wrong side.
        """
        if not len(self.ts):
            return jnp.asarray(self.ts)
        found = origin + self.ts
        known = jax.lax.stop_gradient((ts, origin + goals, self.ts, goals, found))
        ts, also, tau, goals, now = (direction * x for x in known)
        number = jnp.searchsorted(goals, tau)  # of saved states that are before it
        least = jnp.append(-jnp.inf, jnp.nextafter(jnp.maximum(ts, also), jnp.inf))[number]
        most = jnp.append(jnp.minimum(ts, also), jnp.inf)[number]
        return found + direction * (jnp.clip(now, least, most) - now)


NONE_PASSED = Passed(np.zeros(0), np.zeros(0, np.int32), np.zeros(0), np.zeros((0, 0)))


class Solved(eqx.Module):
    """The result of an integrator."""

    ts: Float[Array, "times *lanes"]  # as t_end, since the start
    ys: PyTree
    reached: Bool[Array, "times *lanes"]
    t_end: PerLane
    y_end: PyTree
    code: Int[Array, "*lanes"]
    event: Int[Array, "*lanes"]  # index of the event that ended the motion, -1: none
    accepted: Int[Array, "*lanes"]
    rejected: Int[Array, "*lanes"]
    last_step: PerLane  # s, that the step-size control would take next; NaN where it keeps that to itself
    pivot: PerLane  # smallest magnitude of a pivot in any step, negative where one changed its sign; infinite: none was monitored
    crossings: Int[Array, "*lanes"]  # as in `Trajectory`
    passed: Passed


class Integrator(abc.ABC):
    """The integrator of a motion: our own steps (`motion/own_steps.py`) or diffrax
    (`motion/diffrax_steps.py`).

    Numbers that change with every call are in the `Setup`.
    """

    max_steps: int
    event_names: tuple[str, ...]
    solver: "diffrax.AbstractSolver | Method | ImplicitMethod"
    own: ClassVar[bool]  # whether steps end at relations, and states are projected onto the constraints

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """The solver, as shown in a trajectory."""

    @abc.abstractmethod
    def reason_against_machine_code(self, setup: "Setup") -> str:
        """Return in words why XLA compiles the loop over steps, in place of our machine code; empty if
        machine code runs it.
        """

    @abc.abstractmethod
    def solved(self, setup: "Setup", begun: "Begun") -> Solved:
        """One motion."""

    def lanes_solved(self, setups: "Setup", begun: "Begun") -> Solved:
        """Lanes; all arrays have a leading axis of lanes."""
        # lanes often share their times: what XLA knows to be the same in all of them it moves through diffrax's `nextafter`, one operation per pass
        times = jax.lax.optimization_barrier((setups.t0, setups.t1, setups.dt0))
        timed = eqx.tree_at(lambda s: (s.t0, s.t1, s.dt0), setups, times)
        return eqx.filter_vmap(self.solved)(timed, begun)


class Setup(NamedTuple):  # an Equinox module takes 50 us to make
    """A motion to be integrated; in a batch all arrays have a leading axis of lanes."""

    scene: Scene
    start: State
    inputs: PyTree
    t0: Float[Entries, "*lanes"]
    t1: Float[Entries, "*lanes"]
    ts: Float[Entries, "*lanes times"]
    field: VectorField
    tolerances: tuple  # rtol, atol
    dt0: Float[Entries, "*lanes"] | float
    longest: Float[Entries, "*lanes"] | float  # step, s
    integrator: Integrator
    usual: Usual | None  # sizes by which the start is projected; None where it is on its constraints
    judged: bool  # whether parameters were known where the scene was probed, and so judged there, at many states
    reference: Reference | None = None  # of a model: what is compiled for one serves those that decide alike

    def fitting(self) -> "Setup":
        """Return the setup with times that any loop accepts. No time lies beyond the end by round-off, and
        inconsistent times are replaced by times of a short span.
        """
        ts, t0, t1 = self.ts, self.t0, self.t1
        fits, direction = times_fit(ts, t0, t1), jnp.sign(t1 - t0)
        inside = jnp.where((t1 - ts) * direction < 0, t1, jnp.where((ts - t0) * direction < 0, t0, ts))
        shares = {"ts": jnp.linspace(0.0, 1.0, len(ts), dtype=ts.dtype), "t0": 0.0, "t1": 1.0, "dt0": 0.1, "longest": 1.0}
        # 1e-9 s: of motions that are not requested
        return self._replace(**{name: jnp.where(fits, inside if name == "ts" else getattr(self, name), 1e-9 * x) for name, x in shares.items()})

    @property
    def reason_against_machine_code(self) -> str:
        """Return in words why XLA compiles the loop over steps, in place of our machine code; empty if
        machine code runs it.
        """
        return self.integrator.reason_against_machine_code(self)

    def most_steps(self, knots: Float[Array, "knots"] | None) -> int:
        """Return the largest number of steps; those that end at knots do not count."""
        return self.integrator.max_steps + (0 if knots is None else len(knots))

    def goals(self, ts) -> Float[Array, "times *lanes"]:
        """Return times since the start to reach: the saved times, and the end."""
        return jnp.concatenate([ts, self.t1[None]]) - self.t0

    @property
    def shortest(self) -> PerLane:
        """The shortest step, s."""
        return 1e-14 * jnp.abs(self.t1 - self.t0)

    @property
    def knots(self) -> Float[Array, "knots"] | None:
        """Times since the start at which steps must end for the inputs' sake."""
        return knots_between((self.inputs, self.scene), self.tolerances[0], self.t0, self.t1, self.ts)


class Plain(NamedTuple):
    """Numbers of a motion as given: without derivatives, and without lanes where all samples of a batch share
    them.
    """

    times: dict  # as of a `Setup`
    known: tuple  # `native_motion.known_of`


class Begun(eqx.Module):
    """The start of the integration, marked for the adjoint."""

    right: Flag  # whether all parameters are, and the masses and inertias that they make
    timely: Flag | np.bool_  # whether the times go together
    start: State
    args: tuple  # vector field, scene, inputs, what the rates need of the scene, the time from which times count
    y0: Integrated
    plain: Plain | None = None  # where kernels of a GPU are given numbers once


def times_fit(ts, t0, t1) -> "Bool[Array, ''] | np.bool_":
    """Return whether the span is finite and not empty, and the saved times lie in it in order; also for
    traced times.
    """
    xp = array_module((ts, t0, t1))
    direction = xp.sign(t1 - t0)
    # times at an end of the span may lie beyond it by four units in the last place
    slack = 4 * eps_of(ts) * xp.maximum(xp.abs(t0), xp.abs(t1))
    from_start, to_end = (ts[0] - t0) * direction, (t1 - ts[-1]) * direction
    return (direction != 0) & xp.isfinite(t1 - t0) & xp.all((ts[1:] - ts[:-1]) * direction > 0) & (from_start >= -slack) & (to_end >= -slack)
