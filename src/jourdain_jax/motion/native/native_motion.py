"""One motion by machine code, and when: the rows of its lane from what `erk_loop.integrate` is given, and what that returns from the rows of the end."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jourdain_jax.calculus.reals import real_type
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.motion.input_programs import FunctionOfTime
from jourdain_jax.motion.inputs import Constant, Inputs, Sampled
from jourdain_jax.motion.integrators.erk_loop import ended
from jourdain_jax.motion.integrators.erk_step import RUNNING, Progress
from jourdain_jax.motion.integrators.tableaus import Method
from jourdain_jax.motion.native.functions import Form, event_program, outputs_of
from jourdain_jax.motion.native.functions_of_time import numbers_of, parts_from, with_functions
from jourdain_jax.motion.native.kernel import MOST_KERNELS, kernel, kernel_back, kernel_of_rates
from jourdain_jax.motion.native.layout import Layout
from jourdain_jax.motion.native.pulled import pulled_program, steps_of
from jourdain_jax.motion.native.taylor import rates_of
from jourdain_jax.motion.trajectories import results
from jourdain_jax.motion.vector_fields.by_program import ByProgram
from jourdain_jax.motion.vector_fields.field import Integrated, VectorField
from jourdain_jax.native import ffi, series
from jourdain_jax.native.scalar_program import unsupported
from jourdain_jax.program.graph import Unsupported

# Operations of all that is evaluated. Measured: they are compiled in a time that grows with them, 15,000 of a chain of 128 trailers in 2.8 s (XLA: 40 s),
# 18,000 of a chain of 23 joint angles in 1.2 s.
LARGEST_PROGRAM = 60_000
LARGEST_DERIVATIVE = 10_000  # operations of one; what reverse mode keeps of them lies on the stack

MOST_PRODUCTS = 12_000  # of coefficients in a step by Taylor series, which is written out


class Control(NamedTuple):
    """How well and how far to integrate."""

    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    shortest: Float[Array, ""]
    dt0: Float[Array, ""]
    max_steps: int


class Motion(NamedTuple):
    """What is integrated from where, to which times since the start, and how well."""

    args: tuple  # as rates take them
    method: Method
    order: int | None  # of Taylor series, in place of the tableau
    has_events: bool
    y0: Integrated
    goals: Float[Array, "times"]
    knots: Float[Array, "knots"] | None  # times since the start at which steps must end
    control: Control


def reason_against(field: VectorField, scene: PyTree, inputs: Inputs, has_events: bool) -> str:
    """Why machine code cannot integrate a scene, in words; empty where it can."""
    if not isinstance(field, ByProgram):
        return "the scene has no scalar program"
    if reason := ffi.reason_against():
        return reason
    if any(isinstance(x, Sampled) for x in jax.tree.leaves(scene, is_leaf=lambda x: isinstance(x, Sampled))):
        return "the scene itself holds samples"
    if not all(isinstance(channel, Constant | Sampled | FunctionOfTime) for channel in inputs.channels):
        return "an input is a function of time that holds arrays of its own"
    if isinstance(reason := _driven(field.program, inputs), str):
        return reason
    if has_events and not field.lowers_events:
        return "a stop event is no part of the scalar program"
    return _reason_against_program(_form(field, inputs, has_events))


@lru_cache(maxsize=MOST_KERNELS)
def _reason_against_program(form: Form) -> str:
    """Why machine code cannot evaluate the program of a form, in words; empty where it can."""
    program, graph = form.program, form.program.graph
    operations = graph.operations(form.nodes)
    if operations > LARGEST_PROGRAM:
        return f"the scalar program has {operations} operations, more than {LARGEST_PROGRAM}"
    reason = unsupported(graph, form.nodes)
    if not reason and form.has_events and form.sampled:
        sampled = {program.variables[len(program.variables) - len(program.inputs) + i] for i in form.sampled}
        if sampled & set(graph.reachable(program.events)):
            return "a stop event depends on an input that changes with time"
    if not reason and form.has_events:
        try:
            event_program(form)
        except Unsupported as error:
            return f"a stop event has no rate on the graph ({error})"
    return reason


def reason_against_series(field: VectorField, inputs: Inputs, has_events: bool, order: int) -> str:
    """Why machine code that integrates a scene cannot do so by Taylor series, in words; empty where it can."""
    assert isinstance(field, ByProgram)
    return _reason_against_series(_form(field, inputs, has_events), order)


@lru_cache(maxsize=MOST_KERNELS)
def _reason_against_series(form: Form, order: int) -> str:
    if form.sampled:
        return "an input is given by samples"
    graph, rates = form.program.graph, rates_of(form)
    if reason := series.reason_against(graph, rates):
        return reason
    count = series.products(graph, rates, order)
    return f"its series take {count} products, more than {MOST_PRODUCTS}" if count > MOST_PRODUCTS else ""


def reason_against_derivatives(field: VectorField, inputs: Inputs, has_events: bool) -> str:
    """Why machine code that integrates a scene cannot differentiate it, in words; empty where it can."""
    assert isinstance(field, ByProgram)
    return _reason_against_derivatives(_form(field, inputs, has_events))


@lru_cache(maxsize=MOST_KERNELS)
def _reason_against_derivatives(form: Form) -> str:
    for nodes in steps_of(form).values():
        along = outputs_of(replace(form, moving=()), nodes, len(nodes))
        graph, back, *_ = pulled_program(form, nodes, ())
        if reason := unsupported(along.graph, along.tangents) or unsupported(graph, back):
            return reason
        operations = max(along.graph.operations([*along.values, *along.tangents]), graph.operations(back))
        if operations > LARGEST_DERIVATIVE:
            return f"a derivative of a part of it takes {operations} operations, more than {LARGEST_DERIVATIVE}"
    return ""


def _driven(program: Lowered, inputs: Inputs) -> Lowered | str:
    """The program that takes numbers and samples alone, or why there is none."""
    if not inputs.programs:
        return program
    return with_functions(program, tuple(channel.program if isinstance(channel, FunctionOfTime) else None for channel in inputs.channels))


def _form(field: ByProgram, inputs: Inputs, has_events: bool, moving: tuple[int, ...] | None = None) -> Form:
    sampled = tuple(i for i, channel in enumerate(_others(inputs)) if isinstance(channel, Sampled))
    program = _driven(field.program, inputs)
    assert not isinstance(program, str), program
    return Form(program, field.with_work, field.projects, field.affine, has_events, field.has_pivots, moving, sampled)


def _form_of(motion: Motion, moving: tuple[int, ...] | None = None) -> Form:
    field, _, inputs, *_ = motion.args
    return _form(field, inputs, motion.has_events, moving)


def integrate(motion: Motion) -> tuple[Integrated, Bool[Array, "times"], Progress]:
    """As `erk_loop.integrate`, of one motion from time zero."""
    own = kernel(_form_of(motion), motion.method, motion.order)
    return _unpacked(own.layout, motion.goals, *own.run(*_samples(motion), jnp.concatenate([_packed(motion.y0), *_rows(motion)]), motion.goals))


class Stopped(NamedTuple):
    """A motion as its derivatives with respect to times see it."""

    ys: Integrated  # at the goals, the last of which is the end
    reached: Bool[Array, "times"]
    t: Float[Array, ""]  # of the end
    event: Bool[Array, ""]  # whether a stop event ended it on its way


class AlongTimes(NamedTuple):
    """Of what the times of a motion depend on: tangents or cotangents."""

    goals: Float[Array, "times"]  # times since the start
    origin: Float[Array, ""]  # the start


def tangents(motion: Motion, dy0: Integrated, dknown: Sequence, times: AlongTimes | None, of: Callable) -> tuple[PyTree, PyTree]:
    """`of` the goals and what `integrate` returns, and its tangents; one run gives both.

    `dy0`, `dknown`: of the state, and of each of the numbers that the rates are given, None: zero; `times`: of the times, None where none varies.
    """
    moving = tuple(i for i, d in enumerate(dknown) if d is not None)
    own, d_start = kernel(_form_of(motion, moving), motion.method, motion.order), _packed(dy0)
    if times is not None:
        d_start = d_start - _scaled(_rates(motion, motion.y0, jnp.zeros(())), times.origin)
    layout, (progress, limits, known) = own.layout, _rows(motion)
    more = [jnp.asarray(dknown[i], real_type())[None] for i in moving]
    plain = replace(layout, moving=None)
    starts = jnp.concatenate([_packed(motion.y0), progress, limits, known])
    states, end, d_states, d_y, d_t = own.along(*_samples(motion), starts, motion.goals, jnp.concatenate([d_start, *more]))
    primals, d_goals = (motion.goals, states, end), jnp.zeros_like(motion.goals)
    if times is not None:
        d_goals = times.goals
        ys, reached, last = _unpacked(plain, *primals)
        at = _on_times(motion, Stopped(ys, reached, last.t, (last.code == results.EVENT) & (last.accepted > 0)))
        absolute = jnp.where(at.by_goal, times.goals + times.origin, jnp.where(at.event, 0.0, times.origin))
        d_states = d_states + jax.vmap(_scaled)(at.slopes, absolute)
        d_y = d_y + _scaled(at.slopes[-1], absolute[-1])
        d_t = jnp.where(at.event, d_t - times.origin, jnp.where(at.by_goal[-1], times.goals[-1], 0.0))
    along = jnp.zeros_like(end).at[: layout.y].set(d_y).at[plain.rows["t"].start].set(d_t)
    return jax.jvp(lambda goals, *found: of(goals, *_unpacked(plain, goals, *found)), primals, (d_goals, d_states, along))


def cotangents(motion: Motion, asked: Sequence[bool], ys: Integrated, y_end: Integrated, t_end: Float[Array, ""]) -> tuple[Integrated, list]:
    """Cotangents of the start, and of each of the numbers that the rates are given, where it is `asked` for, from those of the states and of the end."""
    which = tuple(i for i, is_asked in enumerate(asked) if is_asked)
    form = _form_of(motion)
    starts, ends = jnp.concatenate([_packed(motion.y0), *_rows(motion)]), jnp.concatenate([_packed(y_end), t_end[None]])
    found = kernel_back(form, motion.method, which)(*_samples(motion), starts, jax.vmap(_packed)(ys), ends, motion.goals)
    known = dict(zip(which, found[form.layout.y :], strict=True))
    return _state(form.layout, found[: form.layout.y]), [known.get(i) for i in range(len(asked))]


def cotangents_of_times(motion: Motion, found: Stopped, by_start: Integrated, ys: Integrated, y_end: Integrated, t_end: Float[Array, ""]) -> AlongTimes:
    """Cotangents of the times, from those of the start (as `cotangents` has it), of the states and of the end; `found`: the motion."""
    at = _on_times(motion, found)
    by_states = jnp.sum(jax.vmap(_scaled)(at.slopes, jax.vmap(_packed)(ys)), axis=1)
    by_end = jnp.sum(_scaled(at.slopes[-1], _packed(y_end)))
    goals = jnp.where(at.by_goal, by_states, 0.0).at[-1].add(jnp.where(at.by_goal[-1], by_end + t_end, 0.0))
    of_event = jnp.sum(jnp.where(at.by_goal, by_states, 0.0)) - t_end
    origin = jnp.where(at.event, of_event, jnp.sum(by_states) + by_end)
    return AlongTimes(goals, origin - jnp.sum(_scaled(_rates(motion, motion.y0, jnp.zeros(())), _packed(by_start))))


class _OnTimes(NamedTuple):
    """How the states at the goals, the last of which is the end, depend on times.

    In absolute time, with f the rates and Phi the derivative of the flow, a state changes by `Phi (dy_0 - f_0 dt_0) + f dt`. Its time t is the goal where
    that was reached, is found by the loop itself where a stop event ended the motion before, and lies at a number after the start otherwise.
    """

    slopes: Float[Array, "times y"]
    by_goal: Bool[Array, "times"]  # whether the time is the goal
    event: Bool[Array, ""]


def _on_times(motion: Motion, found: Stopped) -> _OnTimes:
    by_goal = found.reached & ~(found.event & (motion.goals == found.t))
    at = jnp.where(by_goal, motion.goals, found.t)
    return _OnTimes(jax.vmap(partial(_rates, motion))(found.ys, at), by_goal, found.event)


def _rates(motion: Motion, y: Integrated, t: Float[Array, ""]) -> Float[Array, "y"]:
    progress, limits, known = _rows(motion)
    return kernel_of_rates(_form_of(motion))(*_samples(motion), jnp.concatenate([_packed(y), progress.at[0].set(t), limits, known]), t[None])


def _scaled(slope: Float[Array, "y"], by: Float[Array, "..."]) -> Float[Array, "y"]:
    """Their product; zero, whatever the slope, where it is multiplied by zero."""
    return jnp.where(by == 0.0, 0.0, slope * by)


def _rows(motion: Motion) -> tuple[Array, Array, Array]:
    """Progress, control and what is known, as a lane is given them."""
    origin, goals, control = motion.args[-1], motion.goals, motion.control
    zero, one = jnp.zeros(()), jnp.ones(())
    t, h, code, event = zero, jnp.abs(control.dt0), RUNNING * one, -one
    progress = [t, h, code, zero, zero, event, jnp.inf * one]
    limits = [jnp.sign(goals[-1]), goals[-1], control.rtol, control.atol, control.shortest, control.max_steps * one, origin]
    known = [zero if x is None else jnp.asarray(x, real_type()) for x in known_of(motion.args)]  # what samples say is looked up
    return jnp.stack(progress), jnp.stack(limits), jnp.stack(known) if known else jnp.zeros(0)


def known_of(args: tuple) -> list:
    """Of each number that the rates are given: what depends on parameters alone, the numbers of functions of time, and constant inputs; None of samples."""
    _, _, inputs, fixed, _ = args
    functions = [x for channel in inputs.channels if isinstance(channel, FunctionOfTime) for x in numbers_of(channel)]
    return [*fixed, *functions, *(channel.value if isinstance(channel, Constant) else None for channel in _others(inputs))]


def with_known(inputs: Inputs, known: Sequence) -> Inputs:
    """Inputs with what stands for their numbers, in the order of `known_of` and without what is fixed, in the place of these."""
    each = iter(known)
    new = [x for channel in inputs.channels if isinstance(channel, FunctionOfTime) for x in parts_from(channel, each)]
    new += [x for channel, x in zip(_others(inputs), each, strict=True) if isinstance(channel, Constant)]

    def places(x: Inputs) -> list:
        both: list[tuple[Any, Callable]] = list(zip(x.channels, inputs.channels, strict=True))
        functions = [part for channel, own in both if isinstance(own, FunctionOfTime) for part in (channel.numbers, *(channel.held if own.held else ()))]
        return [*functions, *(channel.value for channel, own in both if isinstance(own, Constant))]

    return eqx.tree_at(places, inputs, new, is_leaf=lambda x: x is None) if new else inputs


def _others(inputs: Inputs) -> list[Callable]:
    """The channels that are no functions of time."""
    return [channel for channel in inputs.channels if not isinstance(channel, FunctionOfTime)]


def _samples(motion: Motion) -> tuple[Array, ...]:
    """Tables of the inputs that are given by samples, and the knots, as the kernel takes them; nothing where there are none."""
    _, _, inputs, _, origin = motion.args
    channels = [channel for channel in inputs.channels if isinstance(channel, Sampled)]
    if not channels:
        return ()
    count = max(2, *(len(channel.ts) for channel in channels))

    def padded(x: Array, with_what) -> Array:
        return jnp.concatenate([x, jnp.full(count - len(x), with_what, x.dtype)])

    tables = jnp.stack([jnp.stack([padded(channel.ts - origin, jnp.inf), padded(channel.values, channel.values[-1])]) for channel in channels])
    never = jnp.sign(motion.goals[-1]) * jnp.inf
    return tables, jnp.full(1, never) if motion.knots is None else motion.knots


def _packed(y: Integrated) -> Float[Array, "y"]:
    return jnp.concatenate([y.q, y.v, *([] if y.work is None else [y.work[None]])])


def _unpacked(layout: Layout, goals, states: Float[Array, "times y"], end: Float[Array, "ends"]) -> tuple[Integrated, Bool[Array, "times"], Progress]:
    t, h, code, accepted, rejected, event, pivot, count = end[layout.y :]
    reached = (jnp.arange(len(goals)) < count) | (goals == t)
    numbers = [x.astype(jnp.int32) for x in (code, accepted, rejected, event)]
    code, accepted, rejected, event = numbers
    last = Progress(t, _state(layout, end[: layout.y]), h, code, jnp.zeros((), jnp.int32), accepted, rejected, event, None, pivot, None)
    return jax.vmap(lambda y: _state(layout, y))(states), reached, ended(last, 0.0)


def _state(layout: Layout, y: Float[Array, "y"]) -> Integrated:
    n = layout.coordinates
    return Integrated(y[:n], y[n : n + layout.speeds], y[-1] if layout.with_work else None)
