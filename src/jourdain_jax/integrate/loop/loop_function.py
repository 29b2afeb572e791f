"""The loop of `loop.py` as a differentiable JAX function.

The derivative of a motion is a motion whose state includes tangents. The loop itself computes the tangent of
an event's time; all other times are constant here (`own_steps.py`). Tolerances, the first step and
samples have no derivatives.

`Start` and `Found` are the input and output of a loop, in machine code and in JAX.

Inputs that are functions of time become part of the scalar program, which then depends on time and the
numbers in these functions instead of the inputs.

    u_i = f_i(t, c_i),   y' = F(t, y, u) = F(t, y, f(t, c))         c_i: constants and captured numbers of f_i
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.derivative_errors import DifferentiationModeError
from jourdain_jax.calculus.derivatives import filled, is_zero
from jourdain_jax.calculus.markers import entries_of
from jourdain_jax.calculus.reals import Indices, PerLane, PerTime, Scalar, real_type
from jourdain_jax.integrate.event_search import RUNNING
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.inputs import Constant, FunctionOfTime, Inputs, Mode, Sampled
from jourdain_jax.integrate.loop.form import PROGRESS, Form
from jourdain_jax.integrate.loop.lanes import arguments_of_samples
from jourdain_jax.integrate.loop.loop import write_loop
from jourdain_jax.integrate.loop.rate_functions import check_derivatives
from jourdain_jax.integrate.loop.taylor import TaylorSteps, products
from jourdain_jax.integrate.loop.time_functions import with_functions
from jourdain_jax.integrate.loop.value_kernels import called
from jourdain_jax.integrate.setup import NONE_PASSED, Begun, Passed, Setup, Solved
from jourdain_jax.integrate.vector_fields.field import ByProgram, Integrated, VectorField
from jourdain_jax.lowering.lowered_equations import Lowered

Numbers = tuple[PerLane, ...]  # one number per row


def constant_rows(form: Form) -> dict[int, tuple[float, ...]]:
    """Return the rows that are equal at the start of every motion: values by the index of the first row."""
    rows, begun = form.rows, [0.0] * form.returned
    for name, x in (("event", -1.0), ("pivot", math.inf)):
        begun[rows[name].start] = x
    first = rows["accepted"].start
    return {rows["t"].start: (0.0,), first: tuple(begun[first:])}


class Start(NamedTuple):
    """Input of the loop for one motion. The state and the known numbers are followed by their tangents
    (`Form`).
    """

    of_samples: tuple[Array, ...]  # tables and knots (`samples.py`); for a loop in JAX, only the knots
    control: Numbers  # rtol, atol, longest and first step, maximum number of steps
    goals: Float[Array, "times *lanes"]  # measured from the start
    origin: PerLane  # the time of the start
    y: tuple[Float[Array, "y *lanes"], ...]
    # known numbers; for a loop in JAX, the arrays among the arguments of the rates, with the batch axis first
    known: tuple[tuple[Array, ...], ...]
    modes: Numbers = ()
    plain: tuple[Array, ...] = ()  # `known`; arrays that all samples share have no batch axis
    tables: tuple[Array, ...] = ()  # of sampled inputs; machine code refuses their derivatives
    code: Int[Array, "*lanes"] = RUNNING  # result code of an invalid start; RUNNING for any other

    def numbers(self) -> Numbers:
        """Return the rows after the state at the start, except `constant_rows`. Rows that all lanes share
        have no batch axis.
        """
        rtol, atol, longest, first, most = self.control
        return (
            jnp.minimum(jnp.abs(first), longest),
            jnp.asarray(self.code, self.goals.dtype),
            *(rtol, atol, longest, most, self.origin),
            *self.modes,
            *(x for part in (self.plain or self.known[0], *self.known[1:]) for x in part),
        )


class Found(NamedTuple):
    """Output of the loop: a motion. Each part is followed by its tangents."""

    y: tuple[Float[Array, "times y *lanes"], ...]  # at the goals
    end: tuple[Float[Array, "y *lanes"], ...]
    t: Numbers  # time of the end, measured from the start
    log: tuple[Float[Array, "transitions *lanes"], ...]  # times of transitions
    # rows of the progress except its time; the number of goals reached; then the number, the events, the
    # modes and the energy losses of transitions; unused entries of a log may hold any number
    rest: Float[Array, "rest *lanes"]

    @staticmethod
    def of(
        form: Form,
        states: Float[Array, "times y *lanes"],
        end: Float[Array, "returned *lanes"],
        count: Float[Array, "one *lanes"],
    ) -> "Found":
        """Return a motion from its states at the goals, its final rows, and the number of goals reached."""
        rows, parts = form.rows, range(1 + len(form.moving))
        every = [slice(k * form.y, (k + 1) * form.y) for k in parts]

        log: list[Array] = [jnp.zeros((0, *end.shape[1:]), end.dtype) for _ in parts]
        more = []
        if form.transitions:
            times = rows["log_t"].start - form.all
            log = jnp.split(end[times:], len(parts))
            more = [end[rows["passed"].start][None], end[form.returned : times]]
        progress = end[rows[PROGRESS[1]].start : rows[PROGRESS[-1]].stop]
        return Found(
            tuple(states[:, part] for part in every),
            tuple(end[part] for part in every),
            tuple(end[row] for row in (rows["t"].start, *rows["dt"])),
            tuple(log),
            jnp.concatenate([progress, count, *more]),
        )

    def shared(self, given: Start) -> tuple["Found", "Found"]:
        """Remove the batch axis from those results of `vmap` that do not need it. Also return for each part
        whether it keeps the axis. `given`: for each part of the start, whether it has the axis.

        A tangent has a batch axis if any quantity on which it depends has one. If only directions are
        batched, they share the values of one motion.
        """
        parts = range(len(self.y))
        base = any(jax.tree.leaves(given._replace(y=(), known=())))
        own = [any(jax.tree.leaves((given.y[k], given.known[k]))) for k in parts]
        of_parts = tuple(
            base or any(own[other] for other in range(k + 1) if other & k == other) for k in parts
        )
        lanes = Found(of_parts, of_parts, of_parts, of_parts, of_parts[0])
        return jax.tree.map(lambda x, has_lanes: x if has_lanes else x[0], self, lanes), lanes


Loop = Callable[[Start], Found]
MOST_KERNELS = 64  # tuning: number of cached kernels; their machine code lives as long as the process


@lru_cache(maxsize=MOST_KERNELS)
def kernel(form: Form, method: Method, order: int | None = None) -> Loop:
    """Return the kernel for a form, by a tableau, or by Taylor series if an `order` is given."""
    steps = method if order is None else TaylorSteps(order)

    def shapes(*arguments):
        return (arguments[-1].shape[-1], form.integrated), (form.returned + len(form.log) + 1,)

    run = called(
        lambda w: write_loop(w, form, steps), shapes, arguments_of_samples(form), constant=constant_rows(form)
    )

    @jax.custom_batching.custom_vmap
    def motion(start: Start) -> Found:
        states, end = run(*start.of_samples, (*start.y, *start.numbers()), start.goals)
        return Found.of(form, states, end[:-1], end[-1:])

    @motion.def_vmap
    def motions(count, batched: Sequence, start: Start):
        (given,) = batched
        found = jax.vmap(
            motion.fun, [jax.tree.map(lambda has_axis: 0 if has_axis else None, given)], axis_size=count
        )(start)
        return found.shared(given)

    return motion


OF_SAMPLES = (
    "machine code does not differentiate with respect to samples of an input; use `jj.simulate(...,"
    ' backend="xla")`'
)


def flow(form: Form, method: Method, order: int | None) -> Loop:
    """Return the motion as a function of its start. `order`: order of Taylor series, used in place of the
    tableau.
    """

    def motion(form: Form) -> Loop:
        # for second derivatives, the tableau replaces Taylor series of more than 36_000 products
        too_many = order is not None and len(form.moving) > 1 and products(form, order) > 36_000
        return kernel(form, method, None if too_many else order)

    def check(form: Form, along: Start) -> None:
        if not all(map(is_zero, along.tables)):
            raise DifferentiationModeError(OF_SAMPLES)
        check_derivatives(replace(form, moving=(), time_moves=False), (len(form.moving) + 1).bit_length())

    return differentiated(motion, form, check)


def differentiated(motion: Callable[[Form], Loop], form: Form, check: Callable[[Form, Start], None]) -> Loop:
    """Return the motion of a form as a differentiable function. Its derivative is the motion of a form with
    more tangents; `check` raises an error if that form is not supported.
    """
    own = jax.custom_jvp(motion(form))

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (start,), (along,) = primals, tangents
        check(form, along)
        raised, more = with_tangents(form, start, along)
        both = differentiated(
            motion, replace(raised, time_moves=form.has_events and len(start.y) > 1), check
        )(more)
        found, d = (
            Found(*(part[half] for part in both[:4]), both.rest)
            for half in (slice(len(start.y)), slice(len(start.y), None))
        )
        return found, d._replace(rest=jnp.zeros_like(found.rest))

    return own


def with_tangents(form: Form, start: Start, along: Start) -> tuple[Form, Start]:
    """Return the form and the start, with the tangents `along` added."""
    every = (tuple(range(len(start.known[0]))), *form.moving)
    moves = [[not is_zero(dx) for dx in part] for part in along.known]
    moving = tuple(
        tuple(i for i, does in zip(of, part, strict=True) if does)
        for of, part in zip(every, moves, strict=True)
    )
    known = tuple(tuple(dx for dx in part if not is_zero(dx)) for part in along.known)
    more = start._replace(y=(*start.y, *map(filled, along.y)), known=(*start.known, *known))
    return replace(form, moving=(*form.moving, *moving)), more


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


def driven(program: Lowered, inputs: Inputs) -> Lowered | str:
    """Return the program with functions of time substituted for inputs, or why that is not possible."""
    channels = inputs.channels
    functions = tuple(x.program if isinstance(x, FunctionOfTime) else None for x in channels)
    return with_functions(program, functions) if any(functions) else program


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


def numbers_of(channel: FunctionOfTime) -> list:
    """Return all numbers of a function of time as a flat list."""
    parts = [jnp.reshape(part, -1) for part in (channel.numbers, *channel.held)]
    return [x for part in parts if len(part) for x in entries_of(part)]
