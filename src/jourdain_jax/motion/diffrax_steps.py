"""Integration by `diffrax.diffeqsolve`, with diffrax's step-size control, events and adjoints (`ForwardMode`,
`RecursiveCheckpointAdjoint`).

Steps end at the saved times (`step_ts`) and at sample times of the inputs (`jump_ts`), and are no longer than
`max_step` (`dtmax`). Only saved states are projected onto the constraints. If a projection moves the state
further than step errors can explain, the motion gets a result code. A stop event is detected only if its
value is negative at the end of a step; dense output then locates it. A value that falls and rises again
within one step is missed.
"""

from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, PyTree

from jourdain_jax.calculus.derivative_errors import SECOND_ORDER_MESSAGE
from jourdain_jax.calculus.derivatives import by_modes
from jourdain_jax.calculus.reals import at_index, static
from jourdain_jax.integrate import event_values, integrands, result_codes
from jourdain_jax.integrate.arrays.array_writer import ArrayWriter
from jourdain_jax.integrate.event_search import RUNNING
from jourdain_jax.integrate.explicit_steps import shortest
from jourdain_jax.integrate.inputs import as_inputs
from jourdain_jax.integrate.own_steps import reason_against_watching
from jourdain_jax.integrate.setup import NONE_PASSED, Begun, Integrator, Setup, Solved, Times
from jourdain_jax.integrate.vector_fields.field import Formulation, Integrated
from jourdain_jax.motion.model import modelled
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines, warn
from jourdain_jax.scene.scene import Scene


def _rates(known: tuple, t, y: tuple, args) -> tuple:
    """Return the rates of coordinates and all speeds. `known`: arguments as in `integrands.py`."""
    found = integrands.rates(t, Integrated(y[0], y[1], None), known)
    return found.q, found.v


@shown_from_users_lines
def diffrax_term(scene: Scene | BuiltFor, inputs: Any = None) -> "diffrax.ODETerm[Any]":
    """Return the rates of a scene as a term for `diffrax.diffeqsolve`. Its state is (q, u): coordinates and
    all speeds.

    Use it for features of diffrax that `simulate` lacks: step-size control, saving, adjoints and events. The
    constraints are enforced only through the accelerations, so the state drifts; `jj.consistent` projects it
    back onto them. `inputs`: as for `simulate`. Differentiable in the scene and its inputs.

    **Examples**

        import diffrax
        disc = jj.models.TiltingDisc()
        start = jj.start(disc, lean=0.3, spin_rate=-3.0)
        control = diffrax.PIDController(rtol=1e-8, atol=1e-8)
        found = diffrax.diffeqsolve(
            jj.diffrax_term(disc),
            diffrax.Tsit5(),
            0.0,
            2.0,
            None,
            (start.q, start.u),
            stepsize_controller=control,
            adjoint=diffrax.ForwardMode(),
        )
        q, u = found.ys
    """
    model, scene = modelled(scene, Formulation("full")), as_scene(scene)
    inputs = as_inputs(scene, inputs)
    field = model.field(inputs.constant, work=False)
    return diffrax.ODETerm(eqx.Partial(_rates, (field, scene, inputs, field.fixed(scene), 0.0)))


class Diffrax(eqx.Module, Integrator):
    """Integrator that calls `diffrax.diffeqsolve`."""

    solver: diffrax.AbstractSolver
    tried: bool = static()
    max_steps: int = static()
    event_names: tuple[str, ...] = static()
    own: ClassVar[bool] = False

    @property
    def name(self) -> str:
        return type(self.solver).__name__

    def reason_against_machine_code(self, setup: Setup) -> str:
        """Return why machine code does not apply."""
        return "the solver is a diffrax solver"

    def solved(self, setup: Setup, begun: Begun) -> Solved:
        forward, reverse = (
            partial(self._solved, adjoint)
            for adjoint in (diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint())
        )
        run = forward if self.tried else by_modes(forward, reverse, SECOND_ORDER_MESSAGE)
        # a state that is NaN ends the motion at once; a span of 1e-9 s stands for times that may not fit
        begins = begun.code == RUNNING
        y0 = jax.tree.map(lambda x: jnp.where(begins, x, jnp.nan), begun.y0)
        short = Times(np.linspace(0.0, 1e-9, len(setup.ts)), 0.0, 1e-9, 1e-10, 1e-9)
        times = (jnp.where(begins, x, y) for x, y in zip(setup.times, short, strict=True))
        found = run(setup.at(Times(*times)), replace(begun, y0=y0))
        finite = jnp.all(jnp.isfinite(jnp.concatenate([found.y_end.q, found.y_end.v])))
        code = jnp.where(finite, found.code, result_codes.NOT_FINITE)
        return replace(found, code=jnp.where(begins, code, begun.code))

    def _solved(self, adjoint: diffrax.AbstractAdjoint, setup: Setup, begun: Begun) -> Solved:
        origin, knots = begun.args[4], setup.knots
        t0, t1, ts = setup.t0 - origin, setup.t1 - origin, setup.ts - origin
        rtol, atol = setup.tolerances
        control = diffrax.PIDController(
            rtol=rtol,
            atol=atol,
            norm=integrands.state_norm,
            dtmin=shortest(jnp.abs(t1 - t0)),
            dtmax=setup.longest,
            force_dtmin=False,
        )
        control = diffrax.ClipStepSizeController(
            control, step_ts=ts, jump_ts=None if knots is None else knots
        )
        # `flip`: event values fall; without it, samples that meet no event would raise an error
        search = optx.Bisection(rtol=1e-14, atol=1e-14 * jnp.abs(t1 - t0), flip=True)
        event = diffrax.Event(_lowest, search, direction=False)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(integrands.rates),
            self.solver,
            t0,
            t1,
            setup.dt0,
            begun.y0,
            begun.args,
            saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)]),
            stepsize_controller=control,
            adjoint=adjoint,
            event=event if self.event_names else None,
            max_steps=setup.most_steps(knots),
            throw=False,
        )
        (found_ts, (t_end,)), (ys, last) = solution.ts, solution.ys
        y_end = at_index(last, 0)
        code = jnp.asarray(result_codes.STEP_TOO_SMALL)
        for told, own in (
            (diffrax.RESULTS.successful, result_codes.SUCCESS),
            (diffrax.RESULTS.event_occurred, result_codes.EVENT),
            (diffrax.RESULTS.max_steps_reached, result_codes.MAX_STEPS),
            (diffrax.RESULTS.nonlinear_divergence, result_codes.UNSOLVED_STEP),
            (diffrax.RESULTS.nonlinear_max_steps_reached, result_codes.UNSOLVED_STEP),
        ):
            code = jnp.where(solution.result == told, own, code)
        code, event_index = code.astype(jnp.int32), jnp.asarray(-1, jnp.int32)
        reached = jnp.isfinite(found_ts)
        if self.event_names:
            first = jnp.argmin(integrands.events(t_end, y_end, begun.args)).astype(jnp.int32)
            event_index = jnp.where(code == result_codes.EVENT, first, event_index)
            over = _over_at_start(begun, t0, t1)
            happened = jnp.any(over)
            t_end, y_end = jax.tree.map(
                lambda first, last: jnp.where(happened, first, last), (t0, begun.y0), (t_end, y_end)
            )
            reached = reached & (~happened | (found_ts == t0))
            code = jnp.where(happened, result_codes.EVENT, code)
            event_index = jnp.where(happened, jnp.argmax(over).astype(jnp.int32), event_index)
        return Solved(
            ts=found_ts,
            ys=ys,
            reached=reached,
            t_end=t_end,
            y_end=y_end,
            code=code,
            event=event_index,
            accepted=solution.stats["num_accepted_steps"],
            rejected=solution.stats["num_rejected_steps"],
            last_step=jnp.full_like(t_end, jnp.nan),
            pivot=jnp.full_like(t_end, jnp.inf),
            crossings=jnp.zeros_like(event_index),
            passed=NONE_PASSED,
        )


def check(setup: Setup) -> None:
    """Raise ValueError if the scene needs integrated work or continues after events; warn if it has
    relations. diffrax supports none of these.
    """
    name, solver = type(setup.scene).__name__, setup.integrator.name
    if not all(setup.field.stops):
        raise ValueError(f"solver=diffrax.{solver}() cannot continue after events of `{name}`; omit `solver`")
    if setup.field.with_work:
        raise ValueError(
            f"solver=diffrax.{solver}() cannot integrate the work of loads of `{name}` that have no "
            "potential; pass work=False or omit `solver`"
        )
    if reason_against_watching(setup):
        text = (
            f"diffrax.{solver} may step over jumps and kinks in loads or events of `{name}`; omit `solver` to"
            " end steps there"
        )
        warn(text)


def _over_at_start(begun: Begun, t0, t1) -> Bool[Array, "events"]:
    """Return which events occur at the start, from their values there and after two short midpoint steps.
    diffrax itself does not check the start.
    """

    def moved(h):
        ahead = lambda y, h, f: jax.tree.map(lambda y, f: y + h * f, y, f)
        y = begun.y0
        for t in (t0, t0 + h):
            middle = integrands.rates(
                t + h / 2, ahead(y, h / 2, integrands.rates(t, y, begun.args)), begun.args
            )
            y = ahead(y, h, middle)
        return integrands.events(t0 + 2 * h, y, begun.args)

    w = ArrayWriter(t0)
    step = w.eps**0.25 * (t1 - t0)
    values, along = jax.jvp(moved, (jnp.zeros_like(t0),), (jnp.full_like(t0, 0.5),))
    sunk, sinks = event_values.at_start(w, values, along, moved(step / 2), step, jnp.sign(t1 - t0), t1 - t0)
    each = zip(sunk, sinks, along, strict=True)
    return jnp.stack([below | (falls & ~(rate * step > 0.0)) for below, falls, rate in each])


def _lowest(t, y: PyTree, args, *, terms, **kwargs):
    """Return the lowest value of all stop events, as a single event. Of several events in one step, diffrax
    would report the first in the list, not the earliest.
    """
    direction = terms.contr(0.0, 1.0)  # in diffrax, time increases even in a backward motion
    return jnp.min(integrands.events(t * direction, y, args))
