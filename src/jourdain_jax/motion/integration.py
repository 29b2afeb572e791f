"""Compute one motion from start to end in one compiled program.

The integrator, this package's loop over steps or diffrax, returns the states at the saved times, which times
were reached, and where and why the motion ended. Dependent speeds are then computed, and all results are
returned as a `Trajectory`. Drift of energy or constraints sets further result codes, even inside `jit` and
for each sample of a batch.

*Energy.* If all work comes from a potential, T + V is constant. Step-size control leaves an error of about
`atol + rtol |y|` per step in each entry y of the state. If errors of this size in all entries change the
energy by dE, then N steps change it by about N dE, and round-off changes it by about N eps of its value. Over
all models, at tolerances from 1e-4 to 1e-11, no drift exceeded half of N dE. A drift of more than ten times
N dE and more than 1 % of the varying energy therefore indicates an error, such as an undetected singular
position.

*Constraints.* Redundant constraints that the start satisfies may contradict each other later, unless
phi_0 = 0:

    A u + phi_0 = 0,   rank A < number of rows

An omitted constraint then holds only if phi_0 is in the range of A.
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import RUN_SELDOM
from jourdain_jax.calculus.derivatives import with_derivatives_of
from jourdain_jax.calculus.markers import entered, lanes_first, left, stopped
from jourdain_jax.calculus.reals import Count, Flag, PerTime, Scalar, eps_of, in_default_precision
from jourdain_jax.equations.projection import linearised_rows
from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.integrate import integrands, result_codes
from jourdain_jax.integrate.constraint_projection import projected
from jourdain_jax.integrate.event_search import RUNNING
from jourdain_jax.integrate.explicit_steps import off
from jourdain_jax.integrate.implicit_steps import FixedStepMethod
from jourdain_jax.integrate.inputs import Constant, Inputs, Mode, for_programs, in_phases
from jourdain_jax.integrate.loop.value_kernels import beside
from jourdain_jax.integrate.own_steps import reason_against_watching
from jourdain_jax.integrate.setup import Begun, Passed, Plain, Setup, Solved, code_at_start
from jourdain_jax.integrate.vector_fields.field import ByProgram, Instant, Integrated
from jourdain_jax.motion.trajectories import diagnostics
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.trajectories.values_in_time import Phases
from jourdain_jax.scene.modes import Modes

MOST_STEP_ERRORS = 10  # numerics: largest drift, as a multiple of the errors of N steps at the tolerance


def integrate(setup: Setup) -> Trajectory:
    """Return the motion of one setup."""
    return _compiled(setup.inputs.programs)(setup)


def _one_motion(setup: Setup) -> Trajectory:
    given, fitting, asked, begun = _started(setup)
    return _finish(given, fitting, asked, begun, setup.integrator.solved(fitting, begun))


def _started(setup: Setup) -> tuple[Setup, Setup, Scalar, Begun]:
    """Return the setup in the modes of its contacts, both results of `_entered` for it, and the start."""
    numbers = {name: getattr(setup, name) for name in ("scene", "start", "inputs", "t0", "t1", "ts")}
    # derivatives keep the original types
    given = setup._replace(**in_default_precision(numbers))
    if isinstance(given.field, ByProgram) and not given.reason_against_machine_code:
        given = given._replace(field=replace(given.field, native=beside(given.field.program)))
    given = _in_contact(given)
    timely, (setup, asked) = given.timely, _entered(given)
    if setup.reason_against_machine_code:
        return given, setup.at(setup.times.clipped), asked, _begin(setup, timely)
    plain = _plain(given)
    times, fixed, _ = lanes_first((plain.times, plain.args[3], asked))
    times = with_derivatives_of(lambda _, times: times.clipped, times, setup.times)
    of = setup.field, setup.scene, plain.args[1]
    fixed = with_derivatives_of(lambda _, field, *of: field.fixed(*of), fixed, *of)
    return given, setup.at(times), asked, _begin(setup, timely, fixed, plain)


# These options minimise XLA's compile time and do not affect steps in machine code. Processor time of a first
# motion: 0.9 s instead of 1.8 (disc), 1.1 instead of 1.8 (bicycle). A motion with 201 saved times takes
# 0.34 ms instead of 0.27 (disc), 2.10 instead of 2.05 (bicycle).
_compiled = for_programs(_one_motion, lambda setup: None if setup.reason_against_machine_code else RUN_SELDOM)


def integrate_lanes(lane: Callable[..., Setup], varied: tuple) -> Trajectory:
    """Return the motions of a batch. A scalar program advances `own_steps.width` samples at a time; other
    setups run under `vmap`.

    `lane`: makes the setup of one sample from its part of `varied`. On a GPU, constant numbers get no batch
    axis, so that kernels receive them once.
    """
    setups = eqx.filter_vmap(lane)(*varied)
    if jax.default_backend() != "cpu" and not setups.reason_against_machine_code:
        return eqx.filter_vmap(lambda *own: _one_motion(lane(*own)))(*varied)
    given, fitting, asked, begun = eqx.filter_vmap(_started)(setups)
    # hide the times that all samples share from XLA, which would otherwise propagate them through diffrax's
    # `nextafter`, one operation per pass
    times = {name: jax.lax.optimization_barrier(getattr(fitting, name)) for name in ("t0", "t1", "dt0")}
    solved = eqx.filter_vmap(setups.integrator.solved)(fitting._replace(**times), begun)
    return eqx.filter_vmap(_finish)(given, fitting, asked, begun, solved)


def _entered(setup: Setup) -> tuple[Setup, Scalar]:
    """Mark the numbers of a setup (`calculus/markers.py`). Return the marked setup, and the zero that
    `_finish` passes to `left`. Derivatives of the setup are then zero if the motion is not used, and NaN if
    it failed.
    """
    place = lambda s: (s.scene, s.start.q, s.start.u, s.inputs, s.t0, s.t1, s.ts)
    numbers, rest = eqx.partition(place(setup), eqx.is_inexact_array)
    leaves, treedef = jax.tree.flatten(numbers)
    each, asked = entered(*lanes_first(leaves))  # includes numbers that all motions share
    return eqx.tree_at(place, setup, eqx.combine(jax.tree.unflatten(treedef, each), rest)), asked


def _plain(setup: Setup) -> Plain:
    """Return the numbers of a setup before `_entered` marks them. Shared numbers have no batch axis."""
    setup = stopped(setup)
    fixed = setup.field.fixed(setup.scene)
    return Plain(setup.times.clipped, (None, setup.scene, setup.inputs, fixed, setup.t0))


def _in_contact(setup: Setup) -> Setup:
    """Return the setup with each switching contact in its mode at the start. Bodies that touch the ground are
    projected onto it.
    """
    scene, t0, start = setup.scene, setup.t0, setup.start
    if not scene.switching.contacts:
        return setup
    count = len(scene.switching.contacts)
    found = setup.field.at_start(scene, t0, start.q, start.u, setup.inputs(t0))
    numbers, below, q, u = jnp.split(found, (count, count + 1, count + 1 + len(start.q)))
    residual = jnp.maximum(start.residual, jax.lax.stop_gradient(below[0]))
    modes = tuple(Mode(jax.lax.stop_gradient(number)) for number in numbers)
    # errors of speeds by slow slip are of the order of its square
    slow = Constant(jnp.sqrt(jax.lax.stop_gradient(setup.tolerances[1])))
    channels = setup.inputs.channels[1 : len(setup.inputs.channels) - count]
    return setup._replace(
        start=eqx.tree_at(lambda s: (s.q, s.u, s.residual), start, (q, u, residual)),
        inputs=Inputs((slow, *channels, *modes)),
    )


def _begin(
    setup: Setup, timely: Flag | np.bool_, fixed: tuple | None = None, plain: Plain | None = None
) -> Begun:
    field, scene, start = setup.field, setup.scene, setup.start
    if setup.usual is not None:
        usual = replace(setup.usual, plain=plain.args[1:2] if plain else ())
        start = projected(scene, setup.t0, start, setup.inputs(setup.t0), usual)
    args = field, scene, setup.inputs, field.fixed(scene) if fixed is None else fixed, setup.t0
    code = code_at_start(setup._replace(scene=plain.args[1] if plain else scene), start, timely)
    return Begun(code, start, args, field.pack(start.q, start.u), plain)


def _finish(given: Setup, setup: Setup, asked: Scalar, begun: Begun, solved: Solved) -> Trajectory:
    t0, field, integrator = setup.t0, setup.field, setup.integrator
    start = begun.start
    _, scene, inputs, fixed, origin = begun.args
    direction = jnp.sign(setup.t1 - t0)
    transitions = solved.passed.times(origin, setup.ts, solved.ts, direction)
    inputs = in_phases(inputs, transitions, solved.passed.modes, direction)
    args, plain = (field, scene, inputs, fixed, origin), begun.shared
    stores = field.with_work and field.of_inputs
    stored_first = field.stored(scene, t0, start.q, inputs(t0)) if stores else None
    puts_back = field.projects and not integrator.own
    sound = begun.code == RUNNING  # whether the motion began
    saved = sound & solved.reached & (solved.ts * direction <= solved.t_end * direction)
    # unreached times may hold any value: compute at the end state, then mark as NaN
    first, last, ys = begun.y0.rows, solved.y_end.rows, jax.vmap(lambda y: y.rows)(solved.ys)
    ts = jnp.hstack([0.0, jnp.where(saved, solved.ts, solved.t_end), solved.t_end])
    rows = jnp.vstack([first, jnp.where(saved[:, None], ys, stopped(last)), last])

    def at_state(tau, rows):
        y = begun.y0.with_rows(rows)
        free, y = y, integrands.project(tau, y, args) if puts_back else y
        at = Instant(scene, fixed, origin + tau, y, inputs(origin + tau))
        u, pivot = field.speeds_and_pivot(at, plain[3])
        work = y.work
        if stored_first is not None:
            work = work + field.stored(scene, at.t, y.q, at.inputs) - stored_first
        state = at.t, y.rows if puts_back else rows, at.inputs
        return (y.q, u, work), pivot, state, _step_errors(setup, free, y) if puts_back else None

    found, pivots, states, moved_by = jax.vmap(at_state)(ts, rows)
    # negative if A_z was singular along the motion; NaN marks an unknown end state and is ignored
    pivot = jnp.minimum(1.0, solved.pivot)
    if pivots is not None:
        pivots = jnp.append(pivots * jnp.sign(pivots[0]), pivot)
        pivot = jnp.min(jnp.where(jnp.isnan(pivots), jnp.inf, pivots))
    causes = []
    if puts_back:
        drifted = jnp.nanmax(moved_by) > MOST_STEP_ERRORS * (1 + solved.accepted)
        causes.append((drifted, result_codes.OFF_CONSTRAINTS))
    if _conserves(setup):
        near = _energies_near(setup, plain, states, begun.y0.with_rows)
        causes.append((_energy_lost(*near, solved.accepted), result_codes.ENERGY_LOST))
    if field.rows_may_contradict:
        violated = _rows_violated(setup, states[0], *found[:2])
        causes.append((violated, result_codes.CONTRADICTORY_ROWS))
    unwatched = reason_against_watching(setup)
    result = _result(setup, sound, solved, pivot, causes)
    failed = result > result_codes.EVENT
    # the time of a failure is unknown if no step detected it
    over = (result == result_codes.SINGULAR_PARTITION) & (pivot > 0) & (solved.code > result_codes.EVENT)
    noticed = over | (result == solved.code) | (result == result_codes.NOT_FINITE)
    # for the saved states and the end; concatenations, which XLA does not repeat for each use
    known, beyond = jnp.append(saved, sound), jnp.append(failed & ~(noticed & saved), failed)

    t_end = jnp.where(solved.t_end == setup.t1 - origin, setup.t1, origin + solved.t_end)
    t_end = jnp.where(sound, t_end, given.t0)
    every = [
        jnp.where(jnp.reshape(known, (-1, *[1] * (x.ndim - 1))), x[1:], jnp.nan)
        for x in found
        if x is not None
    ]
    marked = [t_end, start.moved_q, start.moved_u, pivot, transitions, *every]
    marked = left(asked, [failed] * 4 + [jnp.zeros_like(failed)] + [beyond] * len(every), marked)
    t_end, moved_q, moved_u, pivot, passed, q, u, *work = marked
    return Trajectory(
        scene=given.scene,
        ts=given.ts,
        q=q[:-1],
        u=u[:-1],
        work=work[0][:-1] if work else None,
        t_end=t_end,
        q_end=q[-1],
        u_end=u[-1],
        result=result,
        event=solved.event,
        accepted=solved.accepted,
        rejected=solved.rejected,
        last_step=solved.last_step,
        crossings=jnp.full_like(solved.crossings, -1) if unwatched else solved.crossings,
        fallback=jnp.asarray(result_codes.AS_ASKED, jnp.int32),
        moved_q=moved_q,
        moved_u=moved_u,
        smallest_pivot=pivot,
        inputs=in_phases(given.inputs, transitions, solved.passed.modes, direction),
        phases=_phases(given.inputs, passed, solved.passed, integrator.event_names, given.scene.modes),
        state_form=field.name,
        reduction=field.reduction_name + ("" if setup.reason_against_machine_code else " to machine code"),
        solver=integrator.name,
        projected=field.projects,
        unwatched=unwatched,
        event_names=integrator.event_names,
    )


def _phases(
    inputs: Inputs, ts: Float[Array, "transitions"], passed: Passed, names: tuple[str, ...], named: Modes
) -> Phases:
    """Return the phases of a motion between the events at times `ts` (infinite after the last event)."""
    first = [jnp.asarray(channel.value) for channel in inputs.channels if isinstance(channel, Mode)]
    modes = passed.modes if len(ts) else np.zeros((len(first), 0))
    before = jnp.stack(first)[:, None] if first else jnp.zeros((0, 1))
    there = jnp.isfinite(ts)
    modes = jnp.concatenate([before, jnp.where(there, modes, jnp.nan)], axis=1)
    events, lost = jnp.where(there, passed.events, -1), jnp.where(there, passed.lost, 0.0)
    return Phases(jnp.where(there, ts, jnp.nan), events, modes, lost, names, named)


def _result(setup: Setup, sound: Flag, solved: Solved, pivot, of_drift: list[tuple[Flag, int]]) -> Count:
    """Return the result code: the integrator's, or that of a condition found after it. `sound`: whether the
    start is valid; `of_drift`: conditions for motions that reached their end, with their codes.
    """
    code, eps = solved.code, eps_of(setup.start.q)
    # if no step succeeds, however short, the accelerations themselves are wrong
    short = jnp.where(solved.accepted == 0, result_codes.NOT_FINITE, code)
    short = jnp.where(setup.tolerances[0] >= eps, short, result_codes.UNRESOLVED)
    code = jnp.where(code == result_codes.STEP_TOO_SMALL, short, code)
    for is_so, cause in of_drift[::-1]:
        code = jnp.where((solved.code <= result_codes.EVENT) & is_so, cause, code)
    # if a pivot changed sign or is this small, the independent speeds no longer determine the others
    if setup.field.needs_pivot:
        code = jnp.where(sound & (pivot < SMALLEST_PIVOT), result_codes.SINGULAR_PARTITION, code)
    return code


def _step_errors(setup: Setup, free: Integrated, y: Integrated) -> Scalar:
    """Return how far a projection moved a state from `free` to `y`, in units of the step tolerance."""
    rtol, atol = setup.tolerances
    parts = jax.lax.stop_gradient(((free.q, y.q), (free.v, y.v)))
    return jnp.max(
        jnp.stack([jnp.max(jnp.abs(a - b) / (atol + rtol * jnp.abs(b)), initial=0.0) for a, b in parts])
    )


def _conserves(setup: Setup) -> bool:
    """Return whether T + V is constant along a motion with step-size control.

    False if work is integrated: work may be a small difference of large powers, so that step-size control
    does not bound its error.
    """
    return (
        setup.field.conserves
        and all(setup.field.stops)
        and not isinstance(setup.integrator.solver, FixedStepMethod)
    )


def _energies_near(
    setup: Setup,
    args,
    states: tuple[PerTime, Float[Array, "times rows"], Float[Array, "times inputs"]],
    of_rows: Callable[[Array], Integrated],
) -> tuple[Float[Array, "times 2"], Float[Array, "times 2"]]:
    """Return T and V (J) at the states, and again with each coordinate and speed increased by its tolerance.

    `states`: times, state vectors, inputs; `of_rows` unpacks a state vector.
    """
    field, fixed = setup.field, args[3]

    def at(state):
        t, rows, inputs = state
        here = Instant(setup.scene, fixed, t, of_rows(rows), inputs)
        if isinstance(field, ByProgram) and field.native:
            return field.native.energies(*here.of_program, *setup.tolerances).reshape(2, 2)
        both = jnp.stack([rows, off(jnp.where, jnp.abs, rows, *setup.tolerances)])
        return jax.lax.map(lambda rows: field.energies(here._replace(y=of_rows(rows))), both)

    # loads in dense matrices may be callbacks that cannot be batched
    states = stopped(states)
    found = jax.lax.map(at, states) if field.lowered is None else jax.vmap(at)(states)
    return found[:, 0], found[:, 1]


def _energy_lost(at: Float[Array, "times 2"], near: Float[Array, "times 2"], steps) -> Flag:
    """Return whether T + V changed by more than the errors of `steps` steps can explain. `at`, `near`: the
    two results of `_energies_near`.
    """
    errors = jnp.abs(near - at) + eps_of(at) * jnp.abs(at)
    energy, error = at[:, :1] + at[:, 1:], errors[:, :1] + errors[:, 1:]
    every = jnp.concatenate([at, -at, energy, -energy, error], axis=1)
    most = jnp.max(jnp.where(jnp.isnan(every), -jnp.inf, every), axis=0)
    of_potential, of_energy = most[1] + most[3], most[4] + most[5]  # ranges
    allowed = diagnostics.DRIFTED * (most[0] + of_potential), MOST_STEP_ERRORS * steps * most[6]
    return of_energy > jnp.maximum(*allowed)


def _rows_violated(
    setup: Setup, t: PerTime, q: Float[Array, "times coordinates"], u: Float[Array, "times speeds"]
) -> Flag:
    """Return whether any constraint is violated at any of these states. Unreached states (NaN) are ignored.

    violated: |phi| > 1 % of the maximum over time of (|phi - A u| + |A| |u|)
    """
    scene, inputs, states = jax.lax.stop_gradient((setup.scene, setup.inputs, (t, q, u)))

    def left_and_size(state):
        phi, A = linearised_rows(scene, *state, inputs(state[0]))
        return jnp.abs(phi), jnp.abs(phi - A @ state[2]) + jnp.abs(A) @ jnp.abs(state[2])

    left, size = jax.lax.map(left_and_size, states)  # constraints may be callbacks that cannot be batched
    # 1 % is far above the residual that steps at loose tolerances leave
    return jnp.any(left > 1e-2 * jnp.nanmax(size, axis=0))
