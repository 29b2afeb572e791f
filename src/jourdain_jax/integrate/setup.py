"""Setup of a motion for an integrator, the check of its start, and the results of an integrator.

Integrators use the time since the start, tau = t - t0, because a time far from zero has few digits after the
point. Scenes that do not depend on time are therefore equally accurate at any t0. Rates, projection and
events receive tau; the scene and its inputs receive t0 + tau.
"""

import abc
from collections.abc import Callable
from functools import lru_cache
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.calculus.markers import stopped
from jourdain_jax.calculus.reals import Count, Entries, Flag, PerLane, PerTime, Scalar, eps_of
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.constraint_projection import Usual, coordinates_elsewhere
from jourdain_jax.integrate.event_search import RUNNING
from jourdain_jax.integrate.explicit_steps import Method, diffrax
from jourdain_jax.integrate.implicit_steps import ImplicitMethod
from jourdain_jax.integrate.input_knots import knots_between
from jourdain_jax.integrate.inputs import samples_in
from jourdain_jax.integrate.loop.value_kernels import entries, nodes_called
from jourdain_jax.integrate.state import State
from jourdain_jax.integrate.vector_fields.field import ByProgram, Integrated, VectorField
from jourdain_jax.kernels.scalar_program import unsupported
from jourdain_jax.scene.coordinates import parameter_faults
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.plausibility import faults_at
from jourdain_jax.structure.row_program import RowProgram, row_program
from jourdain_jax.structure.structure import Reference

MEMORY = 2**32  # tuning: bytes, unless a model sets a limit
LONGEST = 1 / 14  # numerics: default of the longest step, relative to the span


class Passed(eqx.Module):
    """Events after which a motion continued."""

    ts: Float[Entries, "transitions *lanes"]  # since the start; infinite after the last one
    events: Int[Entries, "transitions *lanes"]
    lost: Float[Entries, "transitions *lanes"]  # loss of energy, J
    modes: Float[Entries, "modes transitions *lanes"]  # after each event

    def times(
        self, origin: Scalar, ts: PerTime, goals: PerTime, direction: Scalar
    ) -> Float[Array, "transitions"]:
        """Return the times of transitions, rounded consistently with the saved times `ts`.

        `goals`: the saved times measured from the start. A transition before a goal must also precede its
        saved time, but adding the `origin` may round it to the wrong side.
        """
        if not len(self.ts):
            return jnp.asarray(self.ts)
        found = origin + self.ts
        known = jax.lax.stop_gradient((ts, origin + goals, self.ts, goals, found))
        ts, also, tau, goals, now = (direction * x for x in known)
        number = jnp.searchsorted(goals, tau)  # number of saved states before each transition
        least = jnp.append(-jnp.inf, jnp.nextafter(jnp.maximum(ts, also), jnp.inf))[number]
        most = jnp.append(jnp.minimum(ts, also), jnp.inf)[number]
        return found + direction * (jnp.clip(now, least, most) - now)


NONE_PASSED = Passed(np.zeros(0), np.zeros(0, np.int32), np.zeros(0), np.zeros((0, 0)))


class Solved(eqx.Module):
    """Result of an integrator."""

    ts: Float[Array, "times *lanes"]  # measured from the start, like t_end
    ys: PyTree
    reached: Bool[Array, "times *lanes"]
    t_end: PerLane
    y_end: PyTree
    code: Int[Array, "*lanes"]
    event: Int[Array, "*lanes"]  # index of the event that ended the motion, -1: none
    accepted: Int[Array, "*lanes"]
    rejected: Int[Array, "*lanes"]
    last_step: PerLane  # s, proposed by step-size control for the next step; NaN if unknown
    # smallest magnitude of pivots over all steps, negative after a change of sign; infinite if not monitored
    pivot: PerLane
    crossings: Int[Array, "*lanes"]  # as in `Trajectory`
    passed: Passed


class Integrator(abc.ABC):
    """Integrator of a motion: this package's loop (`integrate/own_steps.py`) or diffrax
    (`motion/diffrax_steps.py`).

    It has static settings only; numbers that change with each call are in the `Setup`.
    """

    max_steps: int
    event_names: tuple[str, ...]
    tried: bool  # as in `AllOptions`
    solver: "diffrax.AbstractSolver | Method | ImplicitMethod"
    own: ClassVar[bool]  # whether steps end at relations, and states are projected onto the constraints

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Return the name of the solver, as shown in a trajectory."""

    @abc.abstractmethod
    def reason_against_machine_code(self, setup: "Setup") -> str:
        """Return why XLA, not machine code, runs the loop over steps; empty if machine code runs it."""

    @abc.abstractmethod
    def solved(self, setup: "Setup", begun: "Begun") -> Solved:
        """Return one motion."""


class Times(NamedTuple):
    """Saved times, start and end of a motion, its first and its longest step."""

    ts: Float[Entries, "*lanes times"]
    t0: Float[Entries, "*lanes"]
    t1: Float[Entries, "*lanes"]
    dt0: Float[Entries, "*lanes"] | float
    longest: Float[Entries, "*lanes"] | float

    @property
    def clipped(self) -> "Times":
        """Return times whose saved times are clipped to the span, against round-off."""
        ts, low, high = self.ts, jnp.minimum(self.t0, self.t1), jnp.maximum(self.t0, self.t1)
        return self._replace(ts=jnp.where(ts < low, low, jnp.where(ts > high, high, ts)))

    @property
    def goals(self) -> Float[Array, "times *lanes"]:
        """Return the times since the start at which steps must end: the saved times and the end."""
        return jnp.concatenate([self.ts, self.t1[None]]) - self.t0


class Setup(NamedTuple):  # a NamedTuple, because making an Equinox module takes 50 us
    """Motion to be integrated. In a batch, all arrays have a leading batch axis."""

    scene: Scene
    start: State
    inputs: PyTree
    t0: Float[Entries, "*lanes"]
    t1: Float[Entries, "*lanes"]
    ts: Float[Entries, "*lanes times"]
    field: VectorField
    tolerances: tuple  # rtol, atol
    dt0: Float[Entries, "*lanes"] | float
    longest: Float[Entries, "*lanes"] | float  # longest step, s
    integrator: Integrator
    usual: Usual | None  # typical sizes for projecting the start; None if it is on its constraints
    judged: bool  # whether probing has already checked these parameters at many states
    fits: bool = False  # whether times are concrete and known to be consistent
    reference: Reference | None = None  # of a model; models with equal decisions share programs

    @property
    def timely(self) -> "Flag | np.bool_":
        """Return whether the times are consistent."""
        if self.fits:
            return np.True_
        (ts, t0, t1), eps = self.times[:3], float(eps_of(self.ts))
        in_order = jnp.all((ts[1:] - ts[:-1]) * jnp.sign(t1 - t0) > 0)
        # motions with slip, impact or rest cannot be reversed in time
        forwards = (t1 > t0) | (not self.scene.switching.contacts)
        return ends_fit(ts[0], ts[-1], t0, t1, eps) & in_order & forwards

    def at(self, times: Times) -> "Setup":
        """Return the setup with other times."""
        return self._replace(**times._asdict())

    @property
    def reason_against_machine_code(self) -> str:
        """Return why XLA, not machine code, runs the loop over steps; empty if machine code runs it."""
        return self.integrator.reason_against_machine_code(self)

    def most_steps(self, knots: Float[Array, "knots"] | None) -> int:
        """Return the maximum number of steps, including those forced by sample times of inputs."""
        return self.integrator.max_steps + (0 if knots is None else len(knots))

    @property
    def times(self) -> Times:
        """Return the times of the motion."""
        return Times(self.ts, self.t0, self.t1, self.dt0, self.longest)

    @property
    def knots(self) -> Float[Array, "knots"] | None:
        """Return the sample times at which steps must end, measured from the start."""
        samples = [x for x in samples_in((self.inputs, self.scene)) if len(x.ts) > 1]
        times = self.t0, self.t1, self.ts
        return knots_between(samples, self.tolerances[0], *times) if samples else None


class Plain(NamedTuple):
    """Numbers of a motion without derivatives. Those that all samples share have no batch axis."""

    times: Times
    args: tuple  # as in `Begun`, without the vector field


class Begun(eqx.Module):
    """Start of the integration."""

    code: Count  # result code of an invalid start; RUNNING for any other
    start: State
    args: tuple  # vector field, scene, inputs, the scene's fixed values, origin of time
    y0: Integrated
    plain: Plain | None = None  # for machine code, which receives shared numbers once

    @property
    def shared(self) -> tuple:
        """Return the arguments without derivatives and without unneeded batch axes, if they are known."""
        return self.plain.args if self.plain else self.args


def ends_fit(first, last, t0, t1, eps: float) -> "Flag | bool":
    """Return whether the span is finite and not empty, and encloses the first and the last saved time in its
    direction. Times may be floats or traced.
    """
    direction, span = (t1 > t0) * 2.0 - 1.0, abs(t1 - t0)
    fits = (span > 0) & (span < np.inf) & ((last - first) * direction >= 0)
    # times at an end of the span may lie beyond it by four units in the last place
    for inside in ((first - t0) * direction, (t1 - last) * direction):
        fits = fits & ((inside >= -4 * eps * abs(t0)) | (inside >= -4 * eps * abs(t1)))
    return fits


def code_at_start(setup: Setup, start: State, timely: Flag | np.bool_) -> Count:
    """Check parameters, bodies, contacts, times and the start. Return RUNNING, or the code of the first
    fault.
    """
    scene, field, at = setup.scene, setup.field, (setup.t0, start.q, start.u, setup.inputs(setup.t0))
    program = row_program(scene) if isinstance(field, ByProgram) and field.native else None
    valid = None if program is None else _validity(program)
    unneeded = setup.judged or (valid is not None and not valid.others)
    others = np.zeros((0, len(start.q))) if unneeded else coordinates_elsewhere(scene, valid is not None)
    if valid is None:
        faults = faults_at(scene, *at, others, not setup.integrator.tried)
        right = ~jnp.any(jnp.stack([jnp.array(False), *parameter_faults(scene).values(), *faults.values()]))
        finite = jnp.all(jnp.isfinite(jnp.concatenate([start.q, start.u])))
    else:
        nowhere = np.full(valid.others, jnp.nan)
        right, possible, finite = valid.at(scene, *at, nowhere if unneeded else others.ravel())
        right = right & (possible | setup.integrator.tried)
    fits = start.residual <= 1e3 * np.sqrt(eps_of(start.q))
    code = jnp.where(fits, RUNNING, result_codes.INCONSISTENT_START)
    worst = jnp.min(at[-1][len(at[-1]) - len(scene.switching.contacts) :], initial=0.0)
    why = result_codes.IMPACT_GAINS_ENERGY - 1 - worst  # negative modes are codes
    code = jnp.where(worst < 0, why.astype(code.dtype), code)
    code = jnp.where(finite, code, result_codes.BAD_START)
    if timely is not np.True_:
        code = jnp.where(timely, code, result_codes.BAD_TIMES)
    return jnp.where(right, code, result_codes.BAD_PARAMETER)


class _Validity(NamedTuple):
    """The truth values `RowProgram.right`, by machine code."""

    others: int  # number of coordinates of other states
    at: Callable[..., Bool[Array, "3"]]  # function of the scene, t, q, u, inputs and these coordinates


@lru_cache(maxsize=64)
def _validity(program: RowProgram) -> _Validity | None:
    """Return the validity of a start; None if machine code cannot evaluate it."""
    if unsupported(program.graph, program.right):
        return None
    given = [*program.entries, program.t, *program.q, *program.u, *program.inputs, *program.others]
    values = nodes_called(program.graph, program.right, given)
    return _Validity(
        len(program.others),
        lambda scene, *state: values(*stopped((*entries(scene, program.parameters), *state))) > 0,
    )
