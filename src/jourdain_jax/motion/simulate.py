"""Simulation: a scene and a start in, a `Trajectory` out, by any diffrax solver.

The default state is the minimal one (coordinates and privileged speeds) where the privileged velocities are well conditioned over the scene's
domain and the rows are linear or affine; otherwise the full one (coordinates and all speeds), projected after every step.
"""

import warnings

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.guards import forward_only, reverse_only
from jourdain_jax.equations.accelerations import Baumgarte, as_reduction
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.power import needs_work
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.equations.structure import Structure, structure_of
from jourdain_jax.motion import results
from jourdain_jax.motion.event_location import Located, locate
from jourdain_jax.motion.inputs import as_inputs
from jourdain_jax.motion.projected_solver import ProjectedSolver, for_adjoint
from jourdain_jax.motion.start import State, consistent
from jourdain_jax.motion.start import start as consistent_start
from jourdain_jax.motion.state_form import Integrated, StateForm, default_reduction
from jourdain_jax.motion.trajectory import Trajectory
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.parameters import parameter_faults
from jourdain_jax.scene.scene import Scene

DEFAULT_SAMPLES = 201
_STATE_FORMS = ("auto", "minimal", "full")


def simulate(
    scene: Scene,
    start=None,
    *,
    t0: float | Float[Array, ""] = 0.0,
    t1: float | Float[Array, ""] | None = None,
    ts=None,
    saveat: diffrax.SaveAt | None = None,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    solver: diffrax.AbstractSolver | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0: float | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = 100_000,
    state: str = "auto",
    reduction=None,
    stabilisation: Baumgarte | None = None,
    projection: bool = True,
    inputs=None,
    events: bool = True,
    work: bool = True,
    land_on_ts: bool = True,
) -> Trajectory:
    """Integrate a scene's equations of motion from `start` over [t0, t1].

        motion = simulate(disc, {"lean": 0.3, "spin_rate": -3.0}, t1=5.0)

    **Arguments**
    - `start`: a `State`, a dictionary of named values (the rest is solved for, as by `jj.start`), or None for the scene's example.
    - `t0`, `t1`: ends of the span (s; defaults: 0 and the scene's `example_span` after it); `ts`: times to save at (default: 201 even ones), which
      alone set the span. `saveat`: a `diffrax.SaveAt` instead.
    - `rtol`, `atol`, `solver`, `stepsize_controller`, `dt0` (default: 1e-4 of the span), `adjoint`, `max_steps`: as in
      `diffrax.diffeqsolve`. Default solver: Tsit5 for
      rtol >= 1e-6, Dopri8 below. Default adjoint: `diffrax.RecursiveCheckpointAdjoint()` (reverse mode, first order); `diffrax.ForwardMode()`
      for forward mode of any order; `diffrax.DirectAdjoint()` for all.
    - `state`: "minimal" (q and privileged speeds), "full" (q and u) or "auto"; `reduction`: as in `accelerations`.
    - `projection`: put the state back onto the constraints after each step, where the state form does not keep them by itself.
    - `stabilisation`: Baumgarte terms, for comparison; `inputs`: name -> number, function of time, or `Sampled`.
    - `land_on_ts`: end a step at every saved time. With False, values between steps come from the solver's dense output: fewer steps, but
      its error can be far above the tolerance where steps are long (Dopri8 on a pendulum: 100 times at 1e-12; on a sleigh at 1e-11: 1e-6).
    - `events`: stop where an event value of the scene falls through zero. `work`: integrate the work that no potential accounts for.

    **Returns** a `Trajectory`, with a result code instead of an exception; `trajectory.raise_if_failed()` raises `SimulationError`.

    **Raises** ValueError for bad arguments or a start that contradicts the constraints, `DifferentiationModeError` where the adjoint does not
    support the mode of differentiation.
    """
    start, t0, ts, t1 = _span_and_start(scene, start, t0, t1, ts)
    structure = structure_of(scene)
    form = state_form(scene, structure, state, reduction, stabilisation, projection, work)
    _warn_float32(start.q.dtype, rtol)
    controller = _controller(rtol, atol, t0, t1) if stepsize_controller is None else stepsize_controller
    controller = diffrax.ClipStepSizeController(controller, step_ts=ts) if land_on_ts else controller
    solver = (diffrax.Tsit5() if rtol >= 1e-6 else diffrax.Dopri8()) if solver is None else solver
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    saved = diffrax.SaveAt(ts=ts) if saveat is None else _checked_saveat(saveat)
    names = _event_names(scene) if events else ()
    dt0 = 1e-4 * (t1 - t0) if dt0 is None else dt0  # diffrax's own guess costs two more copies of the vector field to compile
    inputs = as_inputs(scene, inputs)
    start = consistent(scene, t0, start.q, start.u, inputs(t0)) if projection else start
    arguments = (inputs, t0, t1, saved)
    options = (solver, controller, dt0, adjoint, max_steps, names)
    motion = _integrate(scene, start, *arguments, form, *options)
    if state == "auto" and not isinstance(motion.result, jax.core.Tracer) and int(motion.result) == results.SINGULAR_PARTITION:
        # the motion left the domain in which the partition was found to serve
        form = state_form(scene, structure, "full", reduction, stabilisation, projection, work)
        motion = _integrate(scene, start, *arguments, form, *options)
    return motion


def _span_and_start(scene, start, t0, t1, ts):
    real = jnp.result_type(float)
    if ts is not None:
        ts = saved_times(ts)
        t1 = ts[-1] if t1 is None else t1
    elif t1 is None:
        t1 = t0 + scene.example_span
    if start is None:
        start = dict(scene.example)
    if isinstance(start, dict):
        start = consistent_start(scene, t0=t0, **start)
    if not isinstance(start, State):
        raise ValueError(f"`start` is a {type(start).__name__}, expected a State (from `jj.start` or `jj.consistent`), a dictionary of named values, or None")
    if start.q.ndim != 1:
        raise ValueError(f"`start` holds a batch of shape {start.q.shape[:-1]}; use `jj.rollout` or `jax.vmap` for many starts")
    t0, t1 = jnp.asarray(t0, real), jnp.asarray(t1, real)
    known = not isinstance(t0, jax.core.Tracer) and not isinstance(t1, jax.core.Tracer)
    if known and (not (np.isfinite(t0) and np.isfinite(t1)) or t0 == t1):
        raise ValueError(f"the span from t0 = {t0} to t1 = {t1} s is empty or not finite; give a finite `t1` different from `t0`")
    ts = t0 + (t1 - t0) * jnp.linspace(0.0, 1.0, DEFAULT_SAMPLES) if ts is None else ts
    return start, t0, ts, t1


def saved_times(ts) -> Float[Array, "times"]:
    """Times to save at, as an array; a ValueError where they are no monotonic vector of finite numbers."""
    ts = jnp.asarray(ts, jnp.result_type(float))
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"`ts` has shape {ts.shape}, expected a vector of at least one time in s")
    if not isinstance(ts, jax.core.Tracer):
        steps = np.diff(np.asarray(ts))
        if not np.all(np.isfinite(np.asarray(ts))) or not (np.all(steps > 0) or np.all(steps < 0)):
            raise ValueError("`ts` must be finite and strictly increasing (or decreasing, for reversed time); sort it and drop repeated times")
    return ts


def _checked_saveat(saveat: diffrax.SaveAt) -> diffrax.SaveAt:
    if not isinstance(saveat.subs, diffrax.SubSaveAt) or saveat.subs.fn is not diffrax.SubSaveAt(t1=True).fn or saveat.dense:
        raise ValueError("`saveat` must be a plain `diffrax.SaveAt(t0=, t1=, ts=, steps=)`: a trajectory holds whole states; take what you need from it")
    return saveat


def _warn_float32(dtype, rtol) -> None:
    if dtype == jnp.float32 and not isinstance(rtol, jax.core.Tracer) and rtol < 1e-5:
        warnings.warn(
            f"rtol = {rtol} asks for more digits than float32 has; set jax.config.update('jax_enable_x64', True), or loosen rtol and atol to 1e-5",
            stacklevel=3,
        )


def state_form(scene: Scene, structure: Structure, state="auto", reduction=None, stabilisation=None, projection=True, work=True) -> StateForm:
    """How the scene's state is integrated, given what was asked."""
    if state not in _STATE_FORMS:
        raise ValueError(f"unknown state form `{state}`; {nearest(state, _STATE_FORMS)}")
    if state == "minimal" and not structure.affine:
        raise ValueError(f"the rows of `{type(scene).__name__}` are nonlinear in the speeds and have no minimal state; use state='full'")
    minimal = state == "minimal" or (state == "auto" and structure.affine and structure.well_conditioned)
    independent = structure.independent if minimal else None
    reduction = as_reduction(scene, default_reduction(independent) if reduction is None else reduction)
    closed = jax.eval_shape(lambda s: closure_residual(s, 0.0, s.named()[0]), scene).shape[0] > 0
    return StateForm(
        independent=independent,
        reduction=reduction,
        stabilisation=stabilisation,
        with_work=work and needs_work(scene, structure),
        projects_positions=projection and closed,
        projects_speeds=projection and not minimal and bool(structure.row_names),
    )


def _controller(rtol, atol, t0, t1) -> diffrax.PIDController:
    shortest = 1e-14 * jnp.maximum(jnp.abs(t1 - t0), jnp.maximum(jnp.abs(t0), jnp.abs(t1)))
    return diffrax.PIDController(rtol=rtol, atol=atol, norm=_StateNorm(), dtmin=shortest, force_dtmin=False)


class _StateNorm(eqx.Module):
    """Root mean square over coordinates and speeds; the work that rides along does not decide the step size.

    What is not a number counts as infinite: the step shrinks and the motion ends, where NaN would be tried until the last allowed step.
    """

    def __call__(self, y: Integrated) -> Float[Array, ""]:
        squared = jnp.mean(jnp.concatenate([y.q, y.v]) ** 2)
        squared = jnp.where(jnp.isnan(squared), jnp.inf, squared)
        return jnp.where(squared == 0, 0.0, jnp.sqrt(jnp.where(squared == 0, 1.0, squared)))


@eqx.filter_jit  # traced once, not once per stage and derivative
def _rates(t, y, args):
    form, scene, inputs = args
    return form.rates(scene, t, y, inputs(t))


@eqx.filter_jit  # traced once, not once per stage and derivative
def _project(t, y, args):
    form, scene, inputs = args
    return form.project(scene, t, y, inputs(t))


@eqx.filter_jit
def _event_values(t, y, args):
    form, scene, inputs = args
    values = scene.events(motion_at(scene, t, y.q, form.unpack(scene, t, y, inputs(t)), inputs(t)))
    return {name: jnp.asarray(value) for name, value in values.items()}


class _EventValue(eqx.Module):
    """Value of one named event of the scene, in the signature of diffrax."""

    name: str = eqx.field(static=True)

    def __call__(self, t, y, args, **kwargs):
        return _event_values(t, y, args)[self.name]


def _event_names(scene: Scene) -> tuple[str, ...]:
    q, u, _ = scene.named()
    return tuple(jax.eval_shape(lambda s: s.events(motion_at(s, 0.0, q, u)), scene))


def _mark_inputs(adjoint, tree):
    """Inputs of the integration: forward mode through a reverse-only adjoint raises our own error."""
    return reverse_only(tree) if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint) else tree


def _mark_outputs(adjoint, tree):
    """Outputs of the integration: reverse mode, which comes to them first, through a forward-only adjoint raises our own error."""
    return forward_only(tree) if isinstance(adjoint, diffrax.ForwardMode) else tree


@eqx.filter_jit
def _integrate(original, start, inputs, t0, t1, saved, form, solver, controller, dt0, adjoint, max_steps, names) -> Trajectory:
    right, start = _without_faults(original, start)
    scene, start, inputs = _mark_inputs(adjoint, (original, start, inputs))
    args = (form, scene, inputs)
    moving = form.projects_positions or form.projects_speeds
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(_rates),
        ProjectedSolver(for_adjoint(solver, adjoint), _project) if moving else solver,
        t0,
        t1,
        dt0,
        form.pack(start.q, start.u),
        args,
        saveat=diffrax.SaveAt(subs=[saved.subs, diffrax.SubSaveAt(t1=True)]),
        stepsize_controller=controller,
        adjoint=adjoint,
        event=diffrax.Event({name: _EventValue(name) for name in names}, direction=False) if names else None,
        max_steps=max_steps,
        throw=False,
    )
    solution = eqx.tree_at(lambda s: s.ys, solution, _mark_outputs(adjoint, solution.ys))
    end, event = _end(solution, args, t0, form.pack(start.q, start.u), names)
    ts = solution.ts[0]
    valid = (ts - t0) * jnp.sign(t1 - t0) <= (end.t - t0) * jnp.sign(t1 - t0)

    def saved_state(t, y, valid):
        # times never reached hold infinities: compute at the end state instead, then mark
        t, y = jnp.where(valid, t, end.t), jax.tree.map(lambda a, b: jnp.where(valid, a, b), y, end.y)
        y = _project(t, y, args) if moving else y
        u, pivot = form.unpack_with_pivot(scene, t, y, inputs(t))
        return jax.tree.map(lambda x: jnp.where(valid, x, jnp.nan), (y.q, u, y.work)), pivot

    # the end state as one more saved one, so that all this is compiled once
    with_end = jax.tree.map(lambda saved, last: jnp.concatenate([saved, last[None]]), (ts, solution.ys[0], valid), (end.t, end.y, jnp.array(True)))
    (q, u, work), pivots = jax.vmap(saved_state)(*with_end)
    # negative where A_z was singular on the way; fmin passes over NaN, which stands for an end that is lost already
    pivot = jax.lax.reduce(pivots * jnp.sign(pivots[0]), jnp.inf, jnp.fmin, (0,))
    return Trajectory(
        scene=original,
        ts=ts,
        q=q[:-1],
        u=u[:-1],
        work=None if work is None else work[:-1],
        t_end=end.t,
        q_end=q[-1],
        u_end=u[-1],
        result=results.with_causes(
            _result(solution.result, event, end.y, start, pivot),
            parameters=right,
            start=jnp.all(jnp.isfinite(start.q)) & jnp.all(jnp.isfinite(start.u)),
            moved=solution.stats["num_accepted_steps"] > 0,
        ),
        event=event,
        accepted=solution.stats["num_accepted_steps"],
        rejected=solution.stats["num_rejected_steps"],
        moved_q=start.moved_q,
        moved_u=start.moved_u,
        smallest_pivot=pivot,
        inputs=inputs,
        state_form=form.name,
        reduction=form.reduction.name,
        solver=type(solver).__name__,
        projected=moving,
        event_names=names,
    )


def _without_faults(scene: Scene, start: State):
    """Whether all parameters are right, and the start: NaN where they are not, so that such a lane ends at once."""
    right = ~jnp.any(jnp.stack([jnp.array(False), *parameter_faults(scene).values()]))
    return right, eqx.tree_at(lambda s: (s.q, s.u), start, tuple(jnp.where(right, x, jnp.nan) for x in (start.q, start.u)))


def _end(solution, args, t0, y0, names):
    """Time and state at the end of the motion, and the index of the event that ended it (-1: none)."""
    t_f, y_f = solution.ts[1][0], jax.tree.map(lambda x: x[0], solution.ys[1])
    if not names:
        return Located(t_f, y_f), jnp.full((), -1, jnp.int32)
    happened = jnp.stack([solution.event_mask[name] for name in names])
    values = _event_values(t0, y0, args)
    at_start = jnp.stack([values[name] <= 0 for name in names])
    index = jnp.argmax(happened | at_start)
    event = jnp.where(jnp.any(happened | at_start), index, -1).astype(jnp.int32)

    def value(t, y, args):
        values = _event_values(t, y, args)
        return jnp.stack([values[name] for name in names])[index]

    located = locate(_rates, value, t_f, y_f, args, jnp.any(happened), t_f - t0)
    # a motion that starts beyond an event has no motion at all
    none = jnp.any(at_start)
    return Located(jnp.where(none, t0, located.t), jax.tree.map(lambda a, b: jnp.where(none, a, b), y0, located.y)), event


def _result(outcome, event, y_end: Integrated, start: State, pivot):
    """Our result code from diffrax's."""
    finite = jnp.all(jnp.isfinite(y_end.q)) & jnp.all(jnp.isfinite(y_end.v))
    code = jnp.where(outcome == diffrax.RESULTS.max_steps_reached, results.MAX_STEPS, results.STEP_TOO_SMALL)
    code = jnp.where(outcome == diffrax.RESULTS.successful, results.SUCCESS, code)
    code = jnp.where(event >= 0, results.EVENT, code)
    code = jnp.where(finite, code, results.NOT_FINITE)
    # a change of sign, or so small, means that the partition into privileged and dependent speeds was lost
    code = jnp.where(pivot < SMALLEST_PIVOT, results.SINGULAR_PARTITION, code)
    tolerance = 1e3 * jnp.sqrt(jnp.finfo(start.q.dtype).eps)
    return jnp.where(start.residual <= tolerance, code, results.INCONSISTENT_START).astype(jnp.int32)
