"""One motion from start to end as one compiled program, by this package's loop over steps or by diffrax.

Both return the states at the saved times, which of them were reached, and where and why the motion ended.
Speeds are then computed, and everything is returned as a `Trajectory`.
Drift of energy and constraints sets further result codes (`drift.py`).
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import RUN_SELDOM
from jourdain_jax.calculus.markers import entered, lanes_first, left
from jourdain_jax.calculus.reals import Count, Flag, Scalar, at_index, eps_of, in_default_precision
from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.integrate import integrands, result_codes
from jourdain_jax.integrate.inputs import Inputs, Mode, in_phases
from jourdain_jax.integrate.loop import value_kernels
from jourdain_jax.integrate.own_steps import reason_against_watching
from jourdain_jax.integrate.setup import Begun, Passed, Plain, Setup, Solved
from jourdain_jax.integrate.state_projection import State, coordinates_elsewhere, projected
from jourdain_jax.integrate.time_programs import for_programs
from jourdain_jax.integrate.vector_fields.field import ByProgram
from jourdain_jax.kernels.scalar_program import unsupported
from jourdain_jax.motion.drift import (
    MOST_STEP_ERRORS,
    conserves,
    energies_near,
    energy_lost,
    rows_violated,
    step_errors,
)
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.trajectories.values_in_time import Phases
from jourdain_jax.scene.modes import Modes
from jourdain_jax.scene.parameter_fields import parameter_faults
from jourdain_jax.structure.plausibility import faults_at
from jourdain_jax.structure.row_program import row_program


def integrate(setup: Setup) -> Trajectory:
    """Return the motion of one setup."""
    return _compiled(setup.inputs.programs)(setup)


def _one_motion(setup: Setup) -> Trajectory:
    given = _in_contact(_with_machine_code(_prepared(setup)))
    setup, asked = _entered(given)
    timely = given.timely
    begun, fitting = _begin(setup, timely), setup.fitting(timely)
    if not setup.reason_against_machine_code:
        begun = replace(begun, plain=_plain(given, timely))
    return _finish(given, fitting, asked, begun, setup.integrator.solved(fitting, begun))


# The options minimise compile time; steps in machine code are not affected. A first motion of a disc takes
# 0.9 s of processor time instead of 1.8, of a bicycle 1.1 instead of 1.8. A motion with 201 saved times takes
# 0.34 ms instead of 0.27 (bicycle: 2.10 instead of 2.05).
_compiled = for_programs(_one_motion, lambda setup: None if setup.reason_against_machine_code else RUN_SELDOM)


def _numbers(setup: Setup) -> dict:
    """Return the numbers with respect to which a motion can be differentiated."""
    return {name: getattr(setup, name) for name in ("scene", "start", "inputs", "t0", "t1", "ts")}


def _prepared(setup: Setup) -> Setup:
    """Return the setup with all numbers in the default precision; their derivatives keep their own type."""
    return setup._replace(**in_default_precision(_numbers(setup)))


def _with_machine_code(setup: Setup) -> Setup:
    """Return the setup, with machine code for quantities at saved times if machine code integrates it."""
    field = setup.field
    if setup.reason_against_machine_code or not isinstance(field, ByProgram):
        return setup
    return setup._replace(field=replace(field, native=value_kernels.beside(field.program)))


def integrate_lanes(lane: Callable[..., Setup], varied: tuple) -> Trajectory:
    """Return the motions of a batch. A scalar program runs `own_steps.width` samples at a time;
    otherwise they run under `vmap`.

    `lane`: the varying part of the setup. On a GPU constant numbers have no batch axis,
    so kernels receive them once.
    """
    setups = eqx.filter_vmap(lane)(*varied)
    if jax.default_backend() != "cpu" and not setups.reason_against_machine_code:
        return eqx.filter_vmap(lambda *own: _one_motion(lane(*own)))(*varied)
    given = eqx.filter_vmap(_in_contact)(_with_machine_code(_prepared(setups)))
    setups, asked = eqx.filter_vmap(_entered)(given)
    timely = eqx.filter_vmap(lambda setup: setup.timely)(given)
    begun, fitting = eqx.filter_vmap(_begin)(setups, timely), eqx.filter_vmap(Setup.fitting)(setups, timely)
    solved = setups.integrator.lanes_solved(fitting, begun)
    return eqx.filter_vmap(_finish)(given, fitting, asked, begun, solved)


def _entered(setup: Setup) -> tuple[Setup, Scalar]:
    """Return the setup and a zero by which `_finish` recognises whether a motion failed
    (`calculus/markers.py`). Derivatives of the setup are zero if its motion is not
    used, and NaN after a failure.
    """
    place = lambda s: (s.scene, s.start.q, s.start.u, s.inputs, s.t0, s.t1, s.ts)
    numbers, rest = eqx.partition(place(setup), eqx.is_inexact_array)
    leaves, treedef = jax.tree.flatten(numbers)
    each, asked = entered(*lanes_first(leaves))  # also numbers that all motions share
    return eqx.tree_at(place, setup, eqx.combine(jax.tree.unflatten(treedef, each), rest)), asked


def _plain(setup: Setup, timely: Flag) -> Plain:
    """Return the numbers of a setup before `_entered`; numbers shared by all motions have no batch axis."""
    setup = jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, setup)
    own = setup.fitting(timely)
    times = {name: getattr(own, name) for name in ("ts", "t0", "t1", "dt0", "longest")}
    return Plain(times, (None, None, setup.inputs, setup.field.fixed(setup.scene), setup.t0))


def _in_contact(setup: Setup) -> Setup:
    """Return the setup with switching contacts in their modes at the start. Bodies that then touch the
    ground are projected onto it.
    """
    scene, t0, start = setup.scene, setup.t0, setup.start
    if not scene.switching.contacts:
        return setup
    count = len(scene.switching.contacts)
    found = setup.field.at_start(scene, t0, start.q, start.u, setup.inputs(t0))
    numbers, below, q, u = jnp.split(found, (count, count + 1, count + 1 + len(start.q)))
    residual = jnp.maximum(start.residual, jax.lax.stop_gradient(below[0]))
    modes = tuple(Mode(jax.lax.stop_gradient(number)) for number in numbers)
    channels = setup.inputs.channels[: len(setup.inputs.channels) - count]
    return setup._replace(
        start=eqx.tree_at(lambda s: (s.q, s.u, s.residual), start, (q, u, residual)),
        inputs=Inputs((*channels, *modes)),
    )


def _begin(setup: Setup, timely: Flag) -> Begun:
    field, scene, start = setup.field, setup.scene, setup.start
    if setup.usual is not None:
        start = projected(scene, setup.t0, start, setup.inputs(setup.t0), setup.usual)
    right, start = _without_faults(setup, start)
    args = field, scene, setup.inputs, field.fixed(scene), setup.t0
    return Begun(right, timely, start, args, field.pack(start.q, start.u))


def _finish(given: Setup, setup: Setup, asked: Scalar, begun: Begun, solved: Solved) -> Trajectory:
    t0, field, integrator = setup.t0, setup.field, setup.integrator
    start = begun.start
    _, scene, inputs, fixed, origin = begun.args
    direction = jnp.sign(setup.t1 - t0)
    transitions = solved.passed.times(origin, setup.ts, solved.ts, direction)
    inputs = in_phases(inputs, transitions, solved.passed.modes, direction)
    args = field, scene, inputs, fixed, origin
    puts_back = field.projects and not integrator.own
    stored_first = field.stored(scene, t0, start.q, inputs(t0))
    sound = begun.timely & begun.right
    valid = solved.reached & (solved.ts * direction <= solved.t_end * direction) & sound

    def saved_state(tau, y, valid):
        # unreached times may hold any value: compute at the end state, then mark as NaN
        tau = jnp.where(valid, tau, solved.t_end)
        y = jax.tree.map(lambda a, b: jnp.where(valid, a, b), y, solved.y_end)
        free, y = y, integrands.project(tau, y, args) if puts_back else y
        _, at = integrands.at_time(tau, y, args)
        u, pivot = field.speeds_and_pivot(at)
        work = None if y.work is None else y.work + field.stored(scene, at.t, y.q, at.inputs) - stored_first
        return (
            jax.tree.map(lambda x: jnp.where(valid, x, jnp.nan), (y.q, u, work)),
            pivot,
            (at.t, y),
            step_errors(setup, free, y) if puts_back else None,
        )

    # append start and end to the saved states, so that this is compiled once
    start_and_end = ((jnp.zeros_like(solved.t_end), begun.y0, sound), (solved.t_end, solved.y_end, sound))
    all_states = jax.tree.map(
        lambda saved, first, last: jnp.concatenate([first[None], saved, last[None]]),
        (solved.ts, solved.ys, valid),
        *start_and_end,
    )
    found, pivots, states, moved_by = jax.vmap(saved_state)(*all_states)
    # Negative if A_z was singular along the motion; fmin ignores NaN, which marks a lost end. The
    # barrier hides from XLA that all pivots are one without constraints, which it would otherwise
    # evaluate for seconds while compiling.
    pivots = jax.lax.optimization_barrier(pivots)
    pivot = jax.lax.reduce(pivots * jnp.sign(pivots[0]), jnp.inf, jnp.fmin, (0,))
    pivot = jnp.fmin(pivot, jnp.asarray(solved.pivot, pivots.dtype))
    plain = begun.plain.args if begun.plain else args
    lost = energy_lost(energies_near(setup, plain, *states), solved.accepted) if conserves(setup) else False
    violated = rows_violated(setup, states[0], *found[:2]) if field.rows_may_contradict else False
    drifted = jnp.nanmax(moved_by) > MOST_STEP_ERRORS * (1 + solved.accepted) if puts_back else False
    code = solved.code
    for found_out, cause in (
        (drifted, result_codes.OFF_CONSTRAINTS),
        (lost, result_codes.ENERGY_LOST),
        (violated, result_codes.CONTRADICTORY_ROWS),
    ):
        code = jnp.where((code <= result_codes.EVENT) & found_out, cause, code)
    unwatched = reason_against_watching(setup)
    result = _result(setup, begun, solved, code, pivot if field.needs_pivot else jnp.inf)
    failed = result > result_codes.EVENT
    # a failure that no step detected happened at an unknown time
    over = (result == result_codes.SINGULAR_PARTITION) & (pivot > 0) & (solved.code > result_codes.EVENT)
    noticed = over | (result == solved.code) | (result == result_codes.NOT_FINITE)
    beyond = failed & ~(noticed & jnp.append(valid, False))  # of the saved states and of the end

    t_end = jnp.where(solved.t_end == setup.t1 - origin, setup.t1, origin + solved.t_end)
    saved, treedef = jax.tree.flatten(at_index(found, slice(1, None)))
    passed = jnp.where(jnp.isfinite(transitions), transitions, jnp.nan)
    whole = jnp.where(begun.timely, t_end, given.t0), start.moved_q, start.moved_u, pivot, passed
    marked = left(asked, [beyond] * len(saved) + [failed] * 4 + [jnp.zeros_like(failed)], [*saved, *whole])
    q, u, work = jax.tree.unflatten(treedef, marked[: len(saved)])
    t_end, moved_q, moved_u, pivot, passed = marked[len(saved) :]
    return Trajectory(
        scene=given.scene,
        ts=given.ts,
        q=q[:-1],
        u=u[:-1],
        work=None if work is None else work[:-1],
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
    """Return the phases of a motion, which events at the times `ts` end."""
    there = jnp.isfinite(ts)
    first = [jnp.asarray(channel.value) for channel in inputs.channels if isinstance(channel, Mode)]
    modes = passed.modes if len(passed.modes) == len(first) else jnp.zeros((len(first), 0))
    before = jnp.stack(first)[:, None] if first else jnp.zeros((0, 1))
    modes = jnp.concatenate([before, jnp.where(there, modes, jnp.nan)], axis=1)
    events, lost = jnp.where(there, passed.events, -1), jnp.where(there, passed.lost, 0.0)
    return Phases(ts, events, modes, lost, names, named)


def _without_faults(setup: Setup, start: State) -> tuple[Flag, State]:
    """Check parameters, bodies, contacts and the start. A faulty sample gets a NaN
    start, so that it ends at once.
    """
    scene, field, at = setup.scene, setup.field, (setup.t0, start.q, start.u, setup.inputs(setup.t0))
    program = row_program(scene) if isinstance(field, ByProgram) and field.native else None
    program = None if program is None or unsupported(program.graph, [program.right]) else program
    unneeded = setup.judged or (program is not None and not program.others)
    others = jnp.zeros((0, len(start.q))) if unneeded else coordinates_elsewhere(scene, program is not None)
    if program is None:
        faults = faults_at(scene, *at, others)
        right = ~jnp.any(jnp.stack([jnp.array(False), *parameter_faults(scene).values(), *faults.values()]))
    else:
        nowhere = jnp.full(len(program.others), jnp.nan)
        right = value_kernels.is_right(program, scene, *at, nowhere if unneeded else others.ravel())
    return right, eqx.tree_at(
        lambda s: (s.q, s.u), start, tuple(jnp.where(right, x, jnp.nan) for x in (start.q, start.u))
    )


def _result(setup: Setup, begun: Begun, solved: Solved, code, pivot) -> Count:
    """Return the result code, with the cause if known; earlier conditions take precedence."""
    start, end = begun.start, solved.y_end
    eps, finite = eps_of(start.q), lambda *parts: jnp.all(jnp.isfinite(jnp.concatenate(parts)))
    short = code == result_codes.STEP_TOO_SMALL
    causes = (
        (~begun.right, result_codes.BAD_PARAMETER),
        (~jnp.asarray(begun.timely), result_codes.BAD_TIMES),
        (~finite(start.q, start.u), result_codes.BAD_START),
        (~(start.residual <= 1e3 * jnp.sqrt(eps)), result_codes.INCONSISTENT_START),
        # a pivot that changed sign or is this small: independent speeds no longer determine the others
        (jnp.asarray(pivot < SMALLEST_PIVOT), result_codes.SINGULAR_PARTITION),
        (~finite(end.q, end.v), result_codes.NOT_FINITE),
        (short & ~(setup.tolerances[0] >= eps), result_codes.UNRESOLVED),
        # if no step succeeds, however short, the accelerations themselves are at fault
        (short & (solved.accepted == 0), result_codes.NOT_FINITE),
    )
    # XLA repeats a chain of `where` in each derivative that is NaN after a failure, but not a reduction
    noted = jnp.stack([is_so for is_so, _ in causes])
    first = jnp.min(jnp.where(noted, jnp.arange(len(causes)), len(causes)))
    return jnp.append(jnp.array([cause for _, cause in causes], jnp.int32), code.astype(jnp.int32))[first]
