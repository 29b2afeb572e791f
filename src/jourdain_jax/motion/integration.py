"""One motion from start to end as one compiled program: our explicit Runge-Kutta loop for the default options, diffrax for all others.

Both give states at the saved times, which of those were reached, and where and why the motion ended; then speeds are worked out, and all is put into a
`Trajectory`.

Time counts from the start, tau = t - t0: far from zero a clock has few digits, and what does not depend on it is to be as right there as at t0 = 0.
Rates, projection and events are given tau, and the scene and its inputs t0 + tau.
"""

from functools import partial
from operator import attrgetter
from typing import Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.build.plausibility import body_faults
from jourdain_jax.calculus.differentiated_as import differentiated_as
from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.motion.batches.lockstep import in_blocks, width
from jourdain_jax.motion.input_programs import by_itself, for_programs
from jourdain_jax.motion.integrators import erk_loop, integrands
from jourdain_jax.motion.integrators.event_location import Remembering, locate, with_tolerances
from jourdain_jax.motion.integrators.event_search import no_event
from jourdain_jax.motion.integrators.guarded_solver import GuardedSolver
from jourdain_jax.motion.integrators.knots import knots_between
from jourdain_jax.motion.integrators.solver_choice import controller_of, marked_inputs, marked_outputs, since, steps_are_given, time_origin
from jourdain_jax.motion.integrators.step_to_times import merged, step_to_times
from jourdain_jax.motion.integrators.wrapping_solver import for_adjoint
from jourdain_jax.motion.integrators.zero_tangents import ZeroTangentIfNonfinite
from jourdain_jax.motion.native import native_motion
from jourdain_jax.motion.quick_compilation import quickly_compiled
from jourdain_jax.motion.span import fitting_times, times_fit
from jourdain_jax.motion.start import State
from jourdain_jax.motion.state_form import Integrated, StateForm
from jourdain_jax.motion.trajectories import results
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.parameters import parameter_faults
from jourdain_jax.scene.scene import Scene

OWN_SOLVERS = (diffrax.Tsit5, diffrax.Dopri5, diffrax.Dopri8)
OWN_ADJOINTS = (diffrax.RecursiveCheckpointAdjoint, diffrax.ForwardMode)


class Options(eqx.Module):
    """How to integrate."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None  # None: the default one
    tolerances: tuple  # rtol, atol
    dt0: Float[Array, ""] | float
    adjoint: diffrax.AbstractAdjoint
    max_steps: int = eqx.field(static=True)
    land: bool = eqx.field(static=True)  # whether a step ends at every saved time
    saveat: diffrax.SaveAt | None  # None: at the times asked for
    event_names: tuple[str, ...] = eqx.field(static=True)
    native: bool = eqx.field(static=True, default=True)  # whether machine code of our own may integrate it

    @property
    def by_erk_loop(self) -> bool:
        """Whether our own explicit Runge-Kutta loop integrates it: it has a solver, a controller and an adjoint of its own, and nothing else was stated."""
        plain = self.controller is None and self.saveat is None and self.land
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


class Setup(eqx.Module):
    """A motion to be integrated; in a batch all arrays have a leading axis of lanes."""

    scene: Scene
    start: State
    inputs: PyTree
    t0: Float[Array, "*lanes"]
    t1: Float[Array, "*lanes"]
    ts: Float[Array, "*lanes times"]
    form: StateForm
    options: Options

    @property
    def not_native(self) -> str:
        """Why the loop over steps is one of XLA's and not machine code of our own, in words; empty where it is."""
        if not self.options.native:
            return "native=False"
        if not self.options.by_erk_loop:
            return "a solver, a controller or an adjoint of diffrax was asked for"
        return native_motion.reason_against(self.form, self.inputs, self.scene, bool(self.options.event_names), self.start.q.dtype)

    @property
    def is_native(self) -> bool:
        """Whether machine code of our own integrates it, where it is not differentiated."""
        return not self.not_native

    def fitting(self) -> "Setup":
        """The setup with times that serve any loop, also where its own do not go together."""
        of = attrgetter("ts", "t0", "t1", "options.dt0")
        return eqx.tree_at(of, self, fitting_times(*of(self)))


class Begun(eqx.Module):
    """The start of the integration, marked for the adjoint."""

    right: Bool[Array, ""]  # whether all parameters are, and the masses and inertias that they make
    timely: Bool[Array, ""]  # whether the times go together
    start: State
    args: tuple  # form, scene, inputs, what the rates need of the scene, the time from which times count
    y0: Integrated


def integrate(setup: Setup) -> Trajectory:
    """The motion of one setup."""
    return (_integrate_dense if setup.form.lowered is None else _integrate_lowered)(setup.inputs.programs)(setup)


def _one_motion(setup: Setup) -> Trajectory:
    begun, fitting = _begin(setup), setup.fitting()
    return _finish(setup, fitting, begun, _solved(fitting, begun))


_integrate_dense, _integrate_lowered = (for_programs(_one_motion, compiled_by) for compiled_by in (by_itself, quickly_compiled))


def integrate_lanes(setups: Setup) -> Trajectory:
    """The motions of all lanes: `lockstep.width` lanes at a time where the rates are a scalar program, otherwise under `vmap`."""
    begun, fitting = eqx.filter_vmap(_begin)(setups), eqx.filter_vmap(Setup.fitting)(setups)
    program = setups.form.lowered
    if setups.options.by_erk_loop and program is not None:
        blocks = partial(in_blocks, _lanes_by_erk_loop, width(program))
        solved = (differentiated_as(blocks, eqx.filter_vmap(_by_machine_code), setups.options.kind) if setups.is_native else blocks)(fitting, begun)
    else:
        # lanes often share their times: what XLA knows to be the same in all of them it moves through diffrax's `nextafter`, one operation per pass
        times = jax.lax.optimization_barrier((fitting.t0, fitting.t1, fitting.options.dt0))
        timed = eqx.tree_at(lambda s: (s.t0, s.t1, s.options.dt0), fitting, times)
        solved = eqx.filter_vmap(_solved)(timed, begun)
    return eqx.filter_vmap(_finish)(setups, fitting, begun, solved)


def _begin(setup: Setup) -> Begun:
    timely = times_fit(setup.ts, setup.t0, setup.t1)
    right, start = _without_faults(setup.scene, setup.t0, setup.start)
    scene, start, inputs = marked_inputs(setup.options.adjoint, (setup.scene, start, setup.inputs))
    form = setup.form
    args = form, scene, inputs, form.fixed(scene), time_origin(setup.options.controller, setup.t0)
    return Begun(right, timely, start, args, form.pack(start.q, start.u))


def _solved(setup: Setup, begun: Begun) -> Solved:
    if setup.is_native:
        return differentiated_as(_by_erk_loop, _by_machine_code, setup.options.kind)(setup, begun)
    return (_by_erk_loop if setup.options.by_erk_loop else _by_diffrax)(setup, begun)


def _finish(given: Setup, setup: Setup, begun: Begun, solved: Solved) -> Trajectory:
    t0, form, options, adjoint = setup.t0, setup.form, setup.options, setup.options.adjoint
    start, args = begun.start, begun.args
    _, scene, inputs, fixed, origin = args
    solved = eqx.tree_at(lambda s: (s.ys, s.y_end), solved, marked_outputs(adjoint, (solved.ys, solved.y_end)))
    moving = form.projects_positions or form.projects_speeds
    stored_first = form.stored(scene, t0, start.q, inputs(t0))
    direction = jnp.sign(setup.t1 - t0)
    valid = solved.reached & (solved.ts * direction <= solved.t_end * direction) & begun.timely

    def saved_state(tau, y, valid):
        # what was never reached holds anything: compute at the end state instead, then mark
        tau, y = jnp.where(valid, tau, solved.t_end), jax.tree.map(lambda a, b: jnp.where(valid, a, b), y, solved.y_end)
        y = integrands.project(tau, y, args) if moving and not options.by_erk_loop else y
        t = origin + tau
        q, u = form.unpack(scene, fixed, t, y, inputs(t))
        work = None if y.work is None else y.work + form.stored(scene, t, q, inputs(t)) - stored_first
        return jax.tree.map(lambda x: jnp.where(valid, x, jnp.nan), (q, u, work)), form.pivot(scene, fixed, t, y, inputs(t))

    # the end state as one more saved one, so that all this is compiled once
    end = solved.t_end, solved.y_end, begun.timely
    with_end = jax.tree.map(lambda saved, last: jnp.concatenate([saved, last[None]]), (solved.ts, solved.ys, valid), end)
    (q, u, work), pivots = jax.vmap(saved_state)(*with_end)
    # negative where A_z was singular on the way; fmin passes over NaN, which stands for an end that is lost already
    pivot = jax.lax.reduce(pivots * jnp.sign(pivots[0]), jnp.asarray(jnp.inf, pivots.dtype), jnp.fmin, (0,))
    pivot = jnp.fmin(pivot, jnp.asarray(solved.pivot, pivots.dtype))
    return Trajectory(
        scene=setup.scene,
        ts=given.ts if options.saveat is None else origin + solved.ts,
        q=q[:-1],
        u=u[:-1],
        work=None if work is None else work[:-1],
        t_end=jnp.where(begun.timely, jnp.where(solved.t_end == setup.t1 - origin, setup.t1, origin + solved.t_end), given.t0),
        q_end=q[-1],
        u_end=u[-1],
        result=results.with_causes(
            _result(solved.code, solved.y_end, start, pivot if form.needs_pivot else jnp.inf),
            parameters=begun.right,
            times=begun.timely,
            start=jnp.all(jnp.isfinite(start.q)) & jnp.all(jnp.isfinite(start.u)),
            moved=solved.accepted > 0,
        ),
        event=solved.event,
        accepted=solved.accepted,
        rejected=solved.rejected,
        last_step=solved.last_step,
        fallback=jnp.zeros((), jnp.int32) + results.AS_ASKED,
        moved_q=start.moved_q,
        moved_u=start.moved_u,
        smallest_pivot=pivot,
        inputs=inputs,
        state_form=form.name,
        reduction=form.reduction_name,
        solver=type(options.solver).__name__,
        projected=moving,
        event_names=options.event_names,
    )


def _without_faults(scene: Scene, t0, start: State):
    """Whether all parameters are right, and the bodies they make; and the start: NaN where they are not, so that such a lane ends at once."""
    right = ~jnp.any(jnp.stack([jnp.array(False), *parameter_faults(scene).values(), *body_faults(scene, t0, start.q).values()]))
    return right, eqx.tree_at(lambda s: (s.q, s.u), start, tuple(jnp.where(right, x, jnp.nan) for x in (start.q, start.u)))


def _by_erk_loop(setup: Setup, begun: Begun) -> Solved:
    form, options = setup.form, setup.options
    moving = form.projects_positions or form.projects_speeds
    events = integrands.events if options.event_names else None
    functions = integrands.rates, integrands.rates_and_pivots, integrands.project if moving else None, events
    return _lean(setup, begun.y0, begun.args, setup.ts, _knots(setup), *functions)


def _by_machine_code(setup: Setup, begun: Begun) -> Solved:
    options = setup.options
    goals = _goals(setup)
    rtol, atol = options.tolerances
    control = native_motion.Control(rtol, atol, _shortest(setup.t1 - setup.t0), options.dt0, options.max_steps)
    ys, reached, end = native_motion.integrate(begun.args, type(options.solver), bool(options.event_names), begun.y0, goals, control)
    return _as_solved(goals, ys, reached, end)


def _lanes_by_erk_loop(setups: Setup, begun: Begun) -> Solved:
    """Lanes in lockstep: their axis comes first outside and last inside."""
    form, options = setups.form, setups.options
    moving = form.projects_positions or form.projects_speeds
    events = integrands.events_of_lanes if options.event_names else None
    y0, ts, knots = _lanes_last((begun.y0, setups.ts, eqx.filter_vmap(_knots)(setups)))
    functions = integrands.rates_of_lanes, integrands.rates_and_pivots_of_lanes, integrands.project_of_lanes if moving else None, events
    solved = _lean(setups, y0, begun.args, ts, knots, *functions)
    return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), solved)


def _lean(setup: Setup, y0, args, ts, knots, rates, rates_and_pivots, project, events) -> Solved:
    options = setup.options
    goals = _goals(setup, ts)
    problem = erk_loop.Problem(
        rates=rates,
        args=args,
        project=project,
        events=events,
        norm=integrands.state_norm,
        rtol=jnp.broadcast_to(options.tolerances[0], setup.t0.shape),
        atol=jnp.broadcast_to(options.tolerances[1], setup.t0.shape),
        shortest=_shortest(setup.t1 - setup.t0),
        max_steps=options.max_steps + (0 if knots is None else len(knots)),
        knots=knots,
        rates_and_pivots=rates_and_pivots if setup.form.has_pivots else None,
    )
    ys, reached, end = erk_loop.integrate(problem, erk_loop.method_of(options.solver), y0, jnp.zeros_like(setup.t0), goals, options.dt0, options.kind)
    return _as_solved(goals, ys, reached, end)


def _goals(setup: Setup, ts=None) -> Float[Array, "times *lanes"]:
    """Times since the start to go to; `ts`: those of the setup with lanes last."""
    return jnp.concatenate([setup.ts if ts is None else ts, setup.t1[None]]) - setup.t0


def _as_solved(goals, ys: PyTree, reached, end: erk_loop.Progress) -> Solved:
    ys = jax.tree.map(lambda x: x[:-1], ys)
    return Solved(goals[:-1], ys, reached[:-1], end.t, end.y, end.code, end.event, end.accepted, end.rejected, end.h, end.pivot)


def _knots(setup: Setup) -> Float[Array, "knots"] | None:
    """Times since the start at which steps must end for the inputs' sake."""
    if steps_are_given(setup.options.controller):
        return None
    return knots_between((setup.inputs, setup.scene), setup.options.tolerances[0], setup.t0, setup.t1, setup.ts)


def _lanes_last(tree):
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), tree)


def _by_diffrax(setup: Setup, begun: Begun) -> Solved:
    form, options, args, y0 = setup.form, setup.options, begun.args, begun.y0
    origin = args[4]
    t0, t1, ts, knots = setup.t0 - origin, setup.t1 - origin, setup.ts - origin, _knots(setup)
    names, (rtol, atol) = options.event_names, options.tolerances
    landings = jnp.append(ts if options.land else ts[:0], t1)
    landings = landings if knots is None else merged(landings, knots + t0, jnp.sign(t1 - t0))
    controller = controller_of(options.solver, options.controller, landings)
    land = (options.land or knots is not None) and controller is None
    controller = options.controller if controller is None else controller
    if controller is None:
        controller = diffrax.PIDController(rtol=rtol, atol=atol, norm=integrands.state_norm, dtmin=_shortest(t1 - t0), force_dtmin=False)
    saveat = diffrax.SaveAt(ts=ts) if options.saveat is None else since(options.saveat, origin)
    moving = form.projects_positions or form.projects_speeds
    solver = for_adjoint(options.solver, options.adjoint)
    implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
    rates, project = (ZeroTangentIfNonfinite(f, t0, y0) if implicit else f for f in (integrands.rates, integrands.project))
    solver = GuardedSolver(with_tolerances(solver, controller), project if moving else None, integrands.pivots if form.has_pivots else None)
    term = diffrax.ODETerm(rates)
    solution = diffrax.diffeqsolve(
        term,
        Remembering(solver, integrands.events) if names else solver,
        t0,
        t1,
        options.dt0,
        y0,
        args,
        saveat=diffrax.SaveAt(subs=[saveat.subs, diffrax.SubSaveAt(t1=True)], solver_state=True),
        stepsize_controller=step_to_times(landings, controller) if land else controller,
        adjoint=options.adjoint,
        event=diffrax.Event(_an_event) if names else None,
        max_steps=options.max_steps + (0 if knots is None else len(knots)),
        throw=False,
    )
    t_end, y_end = solution.ts[1][0], jax.tree.map(lambda x: x[0], solution.ys[1])
    code = jnp.where(solution.result == diffrax.RESULTS.max_steps_reached, results.MAX_STEPS, results.STEP_TOO_SMALL)
    code = jnp.where(solution.result == diffrax.RESULTS.successful, results.SUCCESS, code)
    unsolved = (solution.result == diffrax.RESULTS.nonlinear_divergence) | (solution.result == diffrax.RESULTS.nonlinear_max_steps_reached)
    # a step that was not solved is no step: the times at its end were not reached
    reached = jnp.isfinite(solution.ts[0]) & ~(unsolved & ((solution.ts[0] - t_end) * jnp.sign(t1 - t0) >= 0))
    seen = (solution.solver_state[2] if names else solution.solver_state)[1]
    if not isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):  # others cannot reject a step
        code = jnp.where((seen.projected > results.MOST_PROJECTED) & (code == results.SUCCESS), results.OFF_CONSTRAINTS, code)
    code, event = jnp.where(unsolved, results.UNSOLVED_STEP, code), jnp.full_like(code, -1, jnp.int32)
    if names:
        happened = solution.event_mask
        t_last, y_last, _ = solution.solver_state
        located = locate(solver, term, integrands.events, (t_last * jnp.sign(t1 - t0), y_last), t_end, y_end, args, happened)
        t_end, y_end, event = located.t, located.y, located.event
        code = jnp.where(happened, jnp.where(located.solved, results.EVENT, results.UNSOLVED_STEP), code)
    return Solved(
        ts=solution.ts[0],
        ys=solution.ys[0],
        reached=reached,
        t_end=t_end,
        y_end=y_end,
        code=code,
        event=event,
        accepted=solution.stats["num_accepted_steps"],
        rejected=solution.stats["num_rejected_steps"],
        last_step=jnp.full_like(t_end, jnp.nan),
        pivot=seen.pivot,
    )


def _an_event(t, y, args, *, terms, **kwargs) -> Bool[Array, ""]:
    """Whether any event has happened, in the signature of diffrax; a state that is lost is none."""
    direction = terms.contr(0.0, 1.0)  # diffrax counts time along the direction of the motion
    known = jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in jax.tree.leaves((y.q, y.v))]))
    return known & ~no_event(integrands.events(t * direction, y, args))


def _shortest(span) -> Float[Array, "*lanes"]:
    return 1e-14 * jnp.abs(span)


def _result(code, y_end: Integrated, start: State, pivot):
    """The result code, with what the end state says."""
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in jax.tree.leaves((y_end.q, y_end.v))]))
    code = jnp.where(finite, code, results.NOT_FINITE)
    # a change of sign, or so small, means that the partition into privileged and dependent speeds was lost
    code = jnp.where(pivot < SMALLEST_PIVOT, results.SINGULAR_PARTITION, code)
    tolerance = 1e3 * jnp.sqrt(jnp.finfo(start.q.dtype).eps)
    return jnp.where(start.residual <= tolerance, code, results.INCONSISTENT_START).astype(jnp.int32)
