"""One motion from start to end as one compiled program: the lean loop for the default options, diffrax for all others.

Both give states at the saved times, which of those were reached, and where and why the motion ended; events are then located, speeds worked
out, and all is put into a `Trajectory`.
"""

from typing import Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.calculus.guards import forward_only, reverse_only
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.motion import lean_loop, results
from jourdain_jax.motion.event_location import Located, locate
from jourdain_jax.motion.land_on import land_on
from jourdain_jax.motion.projected_solver import ProjectedSolver, for_adjoint
from jourdain_jax.motion.start import State
from jourdain_jax.motion.state_form import Integrated, StateForm
from jourdain_jax.motion.trajectory import Trajectory
from jourdain_jax.scene.answers import events_of
from jourdain_jax.scene.parameters import parameter_faults
from jourdain_jax.scene.scene import Scene

LEAN_SOLVERS = (diffrax.Tsit5, diffrax.Dopri5, diffrax.Dopri8)


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

    @property
    def lean(self) -> bool:
        """Whether the lean loop serves."""
        plain = self.controller is None and self.saveat is None and self.land
        return plain and type(self.solver) in LEAN_SOLVERS and type(self.adjoint) in (diffrax.RecursiveCheckpointAdjoint, diffrax.ForwardMode)


class Solved(eqx.Module):
    """What either loop finds."""

    ts: Float[Array, "times"]
    ys: PyTree
    reached: Bool[Array, "times"]
    t_end: Float[Array, ""]
    y_end: PyTree
    code: Int[Array, ""]
    event: Int[Array, ""]  # index of the event that ended the motion, -1: none
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]


@eqx.filter_jit
def integrate(original: Scene, start: State, inputs, t0, t1, ts, form: StateForm, options: Options) -> Trajectory:
    """The motion from `start`."""
    adjoint = options.adjoint
    right, start = _without_faults(original, start)
    scene, start, inputs = _mark_inputs(adjoint, (original, start, inputs))
    args = (form, scene, inputs, form.fixed(scene))
    y0 = form.pack(start.q, start.u)
    solved = (_by_lean_loop if options.lean else _by_diffrax)(form, y0, t0, t1, ts, args, options)
    solved = eqx.tree_at(lambda s: (s.ys, s.y_end), solved, _mark_outputs(adjoint, (solved.ys, solved.y_end)))
    end = _located_end(solved, args, t0, options.event_names)
    moving = form.projects_positions or form.projects_speeds
    stored_first = form.stored(scene, t0, start.q, inputs(t0))
    before_end = (solved.ts - t0) * jnp.sign(t1 - t0) <= (end.t - t0) * jnp.sign(t1 - t0)
    valid = solved.reached & before_end

    def saved_state(t, y, valid):
        # what was never reached holds anything: compute at the end state instead, then mark
        t, y = jnp.where(valid, t, end.t), jax.tree.map(lambda a, b: jnp.where(valid, a, b), y, end.y)
        y = _project(t, y, args) if moving and not options.lean else y
        q, u = form.unpack(scene, args[3], t, y, inputs(t))
        work = None if y.work is None else y.work + form.stored(scene, t, q, inputs(t)) - stored_first
        return jax.tree.map(lambda x: jnp.where(valid, x, jnp.nan), (q, u, work)), form.pivot(scene, args[3], t, y, inputs(t))

    # the end state as one more saved one, so that all this is compiled once
    with_end = jax.tree.map(lambda saved, last: jnp.concatenate([saved, last[None]]), (solved.ts, solved.ys, valid), (end.t, end.y, jnp.array(True)))
    (q, u, work), pivots = jax.vmap(saved_state)(*with_end)
    # negative where A_z was singular on the way; fmin passes over NaN, which stands for an end that is lost already
    pivot = jax.lax.reduce(pivots * jnp.sign(pivots[0]), jnp.asarray(jnp.inf, pivots.dtype), jnp.fmin, (0,))
    return Trajectory(
        scene=original,
        ts=solved.ts,
        q=q[:-1],
        u=u[:-1],
        work=None if work is None else work[:-1],
        t_end=end.t,
        q_end=q[-1],
        u_end=u[-1],
        result=results.with_causes(
            _result(solved.code, end.y, start, pivot),
            parameters=right,
            start=jnp.all(jnp.isfinite(start.q)) & jnp.all(jnp.isfinite(start.u)),
            moved=solved.accepted > 0,
        ),
        event=solved.event,
        accepted=solved.accepted,
        rejected=solved.rejected,
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


def _without_faults(scene: Scene, start: State):
    """Whether all parameters are right, and the start: NaN where they are not, so that such a lane ends at once."""
    right = ~jnp.any(jnp.stack([jnp.array(False), *parameter_faults(scene).values()]))
    return right, eqx.tree_at(lambda s: (s.q, s.u), start, tuple(jnp.where(right, x, jnp.nan) for x in (start.q, start.u)))


def _by_lean_loop(form: StateForm, y0, t0, t1, ts, args, options: Options) -> Solved:
    method = lean_loop.method_of(options.solver)
    names = options.event_names
    problem = lean_loop.Problem(
        rates=_rates,
        args=args,
        project=_project if form.projects_positions or form.projects_speeds else None,
        events=_stacked_events if names else None,
        norm=_StateNorm(),
        rtol=jnp.asarray(options.tolerances[0]),
        atol=jnp.asarray(options.tolerances[1]),
        shortest=_shortest(t0, t1),
        max_steps=options.max_steps,
    )
    kind: Literal["lax", "checkpointed"] = "lax" if isinstance(options.adjoint, diffrax.ForwardMode) else "checkpointed"
    ys, reached, end = lean_loop.integrate(problem, method, y0, t0, jnp.concatenate([ts, t1[None]]), options.dt0, kind)
    return Solved(ts, jax.tree.map(lambda x: x[:-1], ys), reached[:-1], end.t, end.y, end.code, end.event, end.accepted, end.rejected)


def _by_diffrax(form: StateForm, y0, t0, t1, ts, args, options: Options) -> Solved:
    names, (rtol, atol) = options.event_names, options.tolerances
    controller = options.controller
    if controller is None:
        controller = diffrax.PIDController(rtol=rtol, atol=atol, norm=_StateNorm(), dtmin=_shortest(t0, t1), force_dtmin=False)
    saveat = diffrax.SaveAt(ts=ts) if options.saveat is None else options.saveat
    moving = form.projects_positions or form.projects_speeds
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(_rates),
        ProjectedSolver(for_adjoint(options.solver, options.adjoint), _project) if moving else options.solver,
        t0,
        t1,
        options.dt0,
        y0,
        args,
        saveat=diffrax.SaveAt(subs=[saveat.subs, diffrax.SubSaveAt(t1=True)]),
        stepsize_controller=land_on(ts, controller) if options.land else controller,
        adjoint=options.adjoint,
        event=diffrax.Event({name: _EventValue(name) for name in names}, direction=False) if names else None,
        max_steps=options.max_steps,
        throw=False,
    )
    happened = jnp.stack([solution.event_mask[name] for name in names]) if names else jnp.zeros(1, bool)
    code = jnp.where(solution.result == diffrax.RESULTS.max_steps_reached, results.MAX_STEPS, results.STEP_TOO_SMALL)
    code = jnp.where(solution.result == diffrax.RESULTS.successful, results.SUCCESS, code)
    return Solved(
        ts=solution.ts[0],
        ys=solution.ys[0],
        reached=jnp.isfinite(solution.ts[0]),
        t_end=solution.ts[1][0],
        y_end=jax.tree.map(lambda x: x[0], solution.ys[1]),
        code=jnp.where(jnp.any(happened), results.EVENT, code),
        event=jnp.where(jnp.any(happened), jnp.argmax(happened), -1).astype(jnp.int32),
        accepted=solution.stats["num_accepted_steps"],
        rejected=solution.stats["num_rejected_steps"],
    )


def _shortest(t0, t1) -> Float[Array, ""]:
    return 1e-14 * jnp.maximum(jnp.abs(t1 - t0), jnp.maximum(jnp.abs(t0), jnp.abs(t1)))


def _located_end(solved: Solved, args, t0, names) -> Located:
    """Time and state at the end of the motion: at the event, where one ended it."""
    if not names:
        return Located(solved.t_end, solved.y_end)
    happened = solved.event >= 0

    def value(t, y, args):
        return _stacked_events(t, y, args)[solved.event]

    # a motion that starts beyond an event has no motion at all
    return locate(_rates, value, solved.t_end, solved.y_end, args, happened & (solved.t_end != t0), solved.t_end - t0)


def _result(code, y_end: Integrated, start: State, pivot):
    """The result code, with what the end state says."""
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in jax.tree.leaves((y_end.q, y_end.v))]))
    code = jnp.where(finite, code, results.NOT_FINITE)
    # a change of sign, or so small, means that the partition into privileged and dependent speeds was lost
    code = jnp.where(pivot < SMALLEST_PIVOT, results.SINGULAR_PARTITION, code)
    tolerance = 1e3 * jnp.sqrt(jnp.finfo(start.q.dtype).eps)
    return jnp.where(start.residual <= tolerance, code, results.INCONSISTENT_START).astype(jnp.int32)


class _StateNorm(eqx.Module):
    """Root mean square over coordinates and speeds; the work that rides along does not decide the step size.

    What is not a number counts as infinite: the step shrinks and the motion ends, where NaN would be tried until the last allowed step.
    """

    def __call__(self, y: Integrated) -> Float[Array, ""]:
        parts = jax.tree.leaves((y.q, y.v))
        squared = sum(jnp.sum(part**2) for part in parts) / sum(part.size for part in parts)
        squared = jnp.where(jnp.isnan(squared), jnp.inf, squared)
        return jnp.where(squared == 0, 0.0, jnp.sqrt(jnp.where(squared == 0, 1.0, squared)))


@eqx.filter_jit  # traced once, not once per stage and derivative
def _rates(t, y, args):
    form, scene, inputs, fixed = args
    return form.rates(scene, fixed, t, y, inputs(t))


@eqx.filter_jit  # traced once, not once per stage and derivative
def _project(t, y, args):
    form, scene, inputs, _ = args
    return form.project(scene, t, y, inputs(t))


@eqx.filter_jit
def _event_values(t, y, args):
    form, scene, inputs, fixed = args
    return events_of(scene, motion_at(scene, t, *form.unpack(scene, fixed, t, y, inputs(t)), inputs(t)))


def _stacked_events(t, y, args) -> Float[Array, "events"]:
    return jnp.stack(list(_event_values(t, y, args).values()))


class _EventValue(eqx.Module):
    """Value of one named event of the scene, in the signature of diffrax."""

    name: str = eqx.field(static=True)

    def __call__(self, t, y, args, **kwargs):
        return _event_values(t, y, args)[self.name]


def _mark_inputs(adjoint, tree):
    """Inputs of the integration: forward mode through a reverse-only adjoint raises our own error."""
    return reverse_only(tree) if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint) else tree


def _mark_outputs(adjoint, tree):
    """Outputs of the integration: reverse mode, which comes to them first, through a forward-only adjoint raises our own error."""
    return forward_only(tree) if isinstance(adjoint, diffrax.ForwardMode) else tree
