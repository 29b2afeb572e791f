"""diffrax as an integrator: for every solver, controller and adjoint but those of our own loop.

An implicit solver tries steps into states where rates are not numbers: beyond a stop event, or out of the domain of a program. The step is refused and its
derivative dropped; but the derivative of its inner solve would have been an error, or 0 * NaN in reverse mode. Where a value f is not finite,

    df := 0,   linearised at a reference state instead, so that no NaN arises on the way back either

and f itself stays as it is, so that what fails shows.
"""

from collections.abc import Callable
from typing import ClassVar, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jourdain_jax.motion.integrators import event_search, integrands
from jourdain_jax.motion.integrators.event_location import Remembering, locate, with_tolerances
from jourdain_jax.motion.integrators.guarded_solver import GuardedSolver
from jourdain_jax.motion.integrators.step_to_times import merged, step_to_times
from jourdain_jax.motion.integrators.wrapping_solver import for_adjoint
from jourdain_jax.motion.setup import Begun, Integrator, Setup, Solved
from jourdain_jax.motion.trajectories import results


class Diffrax(Integrator):
    """`diffrax.diffeqsolve`."""

    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None
    adjoint: diffrax.AbstractAdjoint
    saveat: diffrax.SaveAt | None
    max_steps: int = eqx.field(static=True)
    event_names: tuple[str, ...] = eqx.field(static=True)
    projects_saved: ClassVar[bool] = False
    watches: ClassVar[bool] = False

    @property
    def name(self) -> str:
        return type(self.solver).__name__

    def mode(self, setup: Setup) -> Literal["forward", "reverse", "any"]:
        if isinstance(self.adjoint, diffrax.RecursiveCheckpointAdjoint):
            return "reverse"
        return "forward" if isinstance(self.adjoint, diffrax.ForwardMode) else "any"

    def reason_against_machine_code(self, setup: Setup) -> str:
        """It has none."""
        return "a solver, a controller or an adjoint of diffrax was asked for"

    def solved(self, setup: Setup, begun: Begun) -> Solved:
        field, args, y0 = setup.field, begun.args, begun.y0
        origin = args[4]
        t0, t1, ts, knots = setup.t0 - origin, setup.t1 - origin, setup.ts - origin, setup.knots
        names, (rtol, atol) = self.event_names, setup.tolerances
        landings = jnp.append(ts if self.saveat is None else ts[:0], t1)
        landings = landings if knots is None else merged(landings, knots + t0, jnp.sign(t1 - t0))
        by_tolerance = diffrax.PIDController(rtol=rtol, atol=atol, norm=integrands.state_norm, dtmin=setup.shortest, dtmax=setup.longest, force_dtmin=False)
        controller = by_tolerance if self.controller is None else self.controller
        to_times = step_to_times(landings, controller) if self.saveat is None or knots is not None else controller
        saveat = diffrax.SaveAt(ts=ts) if self.saveat is None else self.saveat
        if self.saveat is not None and saveat.subs.ts is not None:
            saveat = eqx.tree_at(lambda saveat: saveat.subs.ts, saveat, saveat.subs.ts - origin)
        solver = for_adjoint(self.solver, self.adjoint)
        implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
        rates, project = (ZeroTangentIfNonfinite(f, t0, y0) if implicit else f for f in (integrands.rates, integrands.project))
        args, within = (args, None) if knots is None else (integrands.within(jnp.inf, args), integrands.within)
        pivots = integrands.pivots if field.has_pivots else None
        solver = GuardedSolver(with_tolerances(solver, controller), project if field.projects else None, pivots, within)
        term = diffrax.ODETerm(rates)
        solution = diffrax.diffeqsolve(
            term,
            Remembering(solver, integrands.events) if names else solver,
            t0,
            t1,
            setup.dt0,
            y0,
            args,
            saveat=diffrax.SaveAt(subs=[saveat.subs, diffrax.SubSaveAt(t1=True)], solver_state=True),
            stepsize_controller=to_times,
            adjoint=self.adjoint,
            event=diffrax.Event(_an_event) if names else None,
            max_steps=setup.most_steps(knots),
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
            crossings=jnp.zeros_like(event),
            together=jnp.full_like(t_end, jnp.inf),
        )


def _an_event(t, y, args, *, terms, t0, t1, **kwargs) -> Bool[Array, ""]:
    """Whether any event has happened, in the signature of diffrax; a state that is lost is none, nor is at the start a value that rises from zero."""
    direction = terms.contr(0.0, 1.0)  # diffrax counts time along the direction of the motion
    known = jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in jax.tree.leaves((y.q, y.v))]))

    def at_start():
        along = direction, jax.tree.map(lambda f: direction * f, integrands.rates(t * direction, y, args))
        values, rates = jax.jvp(lambda t, y: integrands.events(t, y, args), (t * direction, y), along)
        return jnp.any(event_search.at_start(values, rates, values, jnp.abs(t1 - t0))[0])

    return known & jax.lax.cond(t == t0, at_start, lambda: ~event_search.no_event(integrands.events(t * direction, y, args)))


class ZeroTangentIfNonfinite(eqx.Module):
    """`function(t, y, args)`, with derivative zero where its value is not finite; `t`, `y`: a state at which it is."""

    function: Callable
    t: Float[Array, ""]
    y: PyTree

    def __call__(self, t, y, args):
        return _flat(t, y, args, jax.lax.stop_gradient((self.t, self.y)), self.function)


@eqx.filter_custom_jvp
def _flat(t, y, args, reference, function):
    return function(t, y, args)


@_flat.def_jvp
def _flat_jvp(primals, tangents):
    t, y, args, reference, function = primals
    value = function(t, y, args)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(value)]))
    at = jax.tree.map(lambda x, safe: jnp.where(finite, x, safe), (t, y), reference)
    _, slope = eqx.filter_jvp(function, (*at, args), tangents[:3])
    return value, jax.tree.map(lambda d: jnp.where(finite, d, jnp.zeros_like(d)), slope)
