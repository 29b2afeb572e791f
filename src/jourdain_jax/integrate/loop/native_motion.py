"""Integrate one motion by machine code: decide whether machine code applies, make the arguments of the
kernel, and read its results.

Inputs that are functions of time become part of the scalar program, which then depends on time and the
numbers in these functions instead of the inputs. `adjoint.py` has the derivatives with respect to times.

    u_i = f_i(t, c_i),   y' = F(t, y, u) = F(t, y, f(t, c))         c_i: constants and captured numbers of f_i
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jourdain_jax.calculus.markers import entries_of, stopped
from jourdain_jax.calculus.reals import Indices, PerTime, Scalar, real_type
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.inputs import Constant, FunctionOfTime, Inputs, Mode, Sampled, samples_in
from jourdain_jax.integrate.loop import taylor
from jourdain_jax.integrate.loop.adjoint import flow_back, moved, rates_of_all
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.loop_function import Found, Start
from jourdain_jax.integrate.loop.rate_functions import check_derivatives, event_program
from jourdain_jax.integrate.loop.time_functions import with_functions
from jourdain_jax.integrate.setup import NONE_PASSED, Begun, Passed, Setup, Solved
from jourdain_jax.integrate.vector_fields.field import ByProgram, Integrated, VectorField
from jourdain_jax.kernels import ffi
from jourdain_jax.kernels.scalar_program import unsupported
from jourdain_jax.lowering.lowered_equations import Lowered
from jourdain_jax.program.graph import Unsupported


def numbers_of(channel: FunctionOfTime) -> list:
    """Return all numbers of a function of time as a flat list."""
    parts = [jnp.reshape(part, -1) for part in (channel.numbers, *channel.held)]
    return [x for part in parts if len(part) for x in entries_of(part)]


# Limit on the number of operations. Measured compile times: 15,000 operations of a chain of 128 trailers take
# 2.8 s (XLA: 40 s), 18,000 operations of a chain of 23 joint angles take 1.2 s.
LARGEST_PROGRAM = 60_000  # tuning
MOST_PRODUCTS = 12_000  # tuning: limit on products of coefficients in a Taylor step, whose code has no loops


def reason_against(
    field: VectorField, scene: PyTree, inputs: Inputs, has_events: bool, order: int | None = None
) -> str:
    """Return why machine code cannot integrate a scene (by Taylor series if an `order` is given); empty if it
    can.
    """
    if not isinstance(field, ByProgram):
        return "the scene has no scalar program"
    if reason := ffi.reason_against():
        return reason
    if samples_in(scene):
        return "the scene itself has a sampled input"
    if not all(
        isinstance(channel, Constant | Sampled | FunctionOfTime | Mode) for channel in inputs.channels
    ):
        return "an input is a function of time that captures arrays"
    if isinstance(reason := driven(field.program, inputs), str):
        return reason
    if has_events and not field.lowers_events:
        return "a stop event is not part of the scalar program"
    return _reason_against_program(form_of(field, inputs, has_events, 1, True), order)


def driven(program: Lowered, inputs: Inputs) -> Lowered | str:
    """Return the program with functions of time substituted for inputs, or why that is not possible."""
    channels = inputs.channels
    functions = tuple(x.program if isinstance(x, FunctionOfTime) else None for x in channels)
    return with_functions(program, functions) if any(functions) else program


@lru_cache(maxsize=64)
def _reason_against_program(form: Form, order: int | None) -> str:
    """Return why machine code cannot evaluate the program of a form; empty if it can."""
    program, graph = form.program, form.program.graph
    operations = graph.operations(form.nodes)
    if operations > LARGEST_PROGRAM:
        return f"the scalar program has {operations} operations, more than {LARGEST_PROGRAM}"
    if reason := unsupported(graph, form.nodes):
        return reason
    if form.has_events and form.sampled:
        sampled = {program.variables[len(program.variables) - len(program.inputs) + i] for i in form.sampled}
        if sampled & set(graph.reachable(program.events)):
            return "a stop event depends on an input that changes with time"
    if form.has_events:
        try:
            event_program(form)
        except Unsupported as error:
            return f"the rate of a stop event has no scalar form ({error})"
    return "" if order is None else _reason_against_series(form, order)


def _reason_against_series(form: Form, order: int) -> str:
    if form.sampled:
        return "an input is given by samples"
    if reason := taylor.reason_against(form.program.graph, form.rates):
        return reason
    count = taylor.products(form, order)
    return f"Taylor series take {count} products, more than {MOST_PRODUCTS}" if count > MOST_PRODUCTS else ""


def form_of(field: VectorField, inputs: Inputs, has_events: bool, most: int, stopping: bool) -> Form:
    """Return the form for machine code. `most`: maximum number of transitions of a motion; `stopping`:
    whether stop events end it.
    """
    assert isinstance(field, ByProgram)
    sampled = tuple(i for i, channel in enumerate(others_of(inputs)) if isinstance(channel, Sampled))
    program = driven(field.program, inputs)
    assert not isinstance(program, str), program
    switched, goes_on = modes_among(inputs), has_events and not all(program.stops)
    of_events: dict[str, Any] = {}
    if goes_on:
        of_events = {"stops": program.stops, "most": most, "stopping": stopping, "sides": program.sides}
    of_field = field.with_work, field.projects, field.affine, has_events, field.pivots
    return Form(program, *of_field, sampled=sampled, switched=switched, **of_events)


def modes_among(inputs: Inputs) -> Indices:
    """Return the indices of modes among the inputs that are not functions of time."""
    return tuple(i for i, channel in enumerate(others_of(inputs)) if isinstance(channel, Mode))


def cotangents(
    form: Form, method: Method, memory: int, asked: Indices, start: Start, found: Found, g: Found
) -> tuple[Array, tuple[Scalar, ...]]:
    """Return the cotangents of the initial state and of the known numbers with the indices `asked`, from a
    motion and its cotangents `g`.

    `memory`: limit in bytes for records of steps.
    """
    check_derivatives(form, 1)
    accepted, rejected, _, _, crossings, _, *passed = found.rest[2:9]
    tries = accepted + rejected
    if form.has_events:  # trial steps that locate an event are not counted; few events need as many as eight
        tries += 8 * (1 + crossings + sum(passed))
    ends = jnp.hstack([g.end[0], g.t[0], g.log[0]])
    back = flow_back(form, method, asked, memory)(start, g.y[0], ends, tries)
    return back[: form.y], entries_of(back[form.y :])


def mover(args: tuple, shared: tuple, form: Form) -> Callable[[Integrated, Array, Array], Integrated]:
    """Return a function of a state, its time t and a shift d, which shifts the state along its rates by d.
    The value of d is zero: it only carries derivatives. `shared`: as in `Begun`.
    """
    others, fixed, along_rates = others_of(args[2]), len(form.program.fixed), moved(rates_of_all(form))

    def moved_by(y, t, d):
        known, slopes = known_of(args), []
        for i in form.sampled:
            known[fixed + i], slope = jax.jvp(others[i], (t,), (jnp.ones_like(t),))
            slopes.append(slope)
        for i in form.switched:
            known[fixed + i] = others[i](t)
        z = jnp.concatenate([y.rows, jnp.stack([jnp.asarray(x, real_type()) for x in (t, *known, *slopes)])])
        plain = [own if x is None else x for own, x in zip(known, known_of(shared), strict=True)]
        return Integrated.of(along_rates(stopped((y.rows, t, plain, slopes)), z, d)[: form.y], form)

    return moved_by


def start_of(setup: Setup, begun: Begun) -> Start:
    """Return the arguments of the kernel for a motion."""
    args, goals = begun.shared, setup.times.goals
    knots = setup._replace(inputs=args[2]).knots
    # zeros stand for sampled inputs, which the kernel interpolates
    known, plain = (
        tuple(jnp.asarray(0.0 if x is None else x, real_type()) for x in known_of(part))
        for part in (begun.args, args)
    )
    origin, modes = jnp.asarray(begun.args[-1], real_type()), modes_at_start(begun.args[2])
    samples, control = _samples(args, goals, knots), control_of(setup, knots)
    tables = tuple(jax.tree.leaves([x for x in begun.args[2].channels if isinstance(x, Sampled)]))
    y = (begun.y0.rows,)
    return Start(samples, control, goals, origin, y, (known,), modes, plain, tables, begun.code)


def modes_at_start(inputs: Inputs) -> tuple[Array, ...]:
    """Return the modes at the start, as indices of their values."""
    return tuple(
        jax.lax.stop_gradient(jnp.asarray(channel.value, real_type()))
        for channel in inputs.channels
        if isinstance(channel, Mode)
    )


def control_of(setup: Setup, knots: Float[Array, "knots"] | None) -> tuple[Scalar, ...]:
    """Return tolerances and limits of steps in the order of `Start.control`."""
    control = *setup.tolerances, setup.longest, setup.dt0, setup.most_steps(knots)
    return tuple(jnp.asarray(x, real_type()) for x in control)


def known_of(args: tuple) -> list:
    """Return the known numbers of the rates: numbers that depend only on parameters, numbers of functions of
    time, and constant inputs. Entries of sampled inputs are None.
    """
    _, _, inputs, fixed, _ = args
    functions = [
        x for channel in inputs.channels if isinstance(channel, FunctionOfTime) for x in numbers_of(channel)
    ]
    return [
        *fixed,
        *functions,
        *(channel.value if isinstance(channel, Constant) else None for channel in others_of(inputs)),
    ]


def others_of(inputs: Inputs) -> list[Callable]:
    """Return the inputs that are not functions of time."""
    return [channel for channel in inputs.channels if not isinstance(channel, FunctionOfTime)]


def _samples(args: tuple, goals: PerTime, knots: Float[Array, "knots"] | None) -> tuple[Array, ...]:
    """Return the tables and knots of sampled inputs, as arguments of the kernel; empty if there are none."""
    _, _, inputs, _, origin = args
    origin = jax.lax.stop_gradient(origin)  # samples are interpolated at fixed times since the start
    channels = [channel for channel in inputs.channels if isinstance(channel, Sampled)]
    if not channels:
        return ()
    count = max(2, *(len(channel.ts) for channel in channels))

    def padded(x: Array, with_what) -> Array:
        return jnp.concatenate([x, jnp.full(count - len(x), with_what, x.dtype)])

    tables = jnp.stack(
        [
            jnp.stack([padded(channel.ts - origin, jnp.inf), padded(channel.values, channel.values[-1])])
            for channel in channels
        ]
    )
    return tables, jnp.full(1, jnp.sign(goals[-1]) * jnp.inf) if knots is None else knots


def solved(form: Form, goals: PerTime, found: Found) -> Solved:
    """Return the result of a loop as a `Solved`."""
    h, pivot, count = (found.rest[i] for i in (0, 5, 7))
    (states,), (end,), (t,), (log,) = found[:4]
    code, accepted, rejected, event, _, crossings = found.rest.astype(jnp.int32)[1:7]
    reached = (jnp.arange(len(goals)) < count) | (goals == t)
    ys = jax.vmap(lambda rows: Integrated.of(rows, form))(states[:-1])
    most = form.transitions
    passed = NONE_PASSED
    if most:
        there = jnp.arange(most) < found.rest[8]
        more = jnp.where(there, jnp.reshape(found.rest[9:], (2 + form.modes, most)), 0.0)
        times = jnp.where(there, log, jnp.inf)
        passed = Passed(times, more[0].astype(jnp.int32), more[-1], more[1:-1])
    y_end, of_steps = Integrated.of(end, form), (accepted, rejected, h, pivot, crossings)
    return Solved(goals[:-1], ys, reached[:-1], t, y_end, code, event, *of_steps, passed)
