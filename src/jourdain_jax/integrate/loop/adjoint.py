"""Reverse mode of the loop over steps: cotangents of the start from the cotangents of the states and the end.

Here, all lanes of a block begin and end together. In the forward pass, every trial step is recorded in a slot
(`record.py`): the state before the step, the slopes of its stages, its length, and the number of times saved
before. The length is zero if the step was rejected or the lane had ended. In the backward pass, the length is
treated as constant:

    Y_i = y_0 + h sum_j a_ij k_j,   v_i = b_i g_1 + sum_l a_li G_l
    (G_i, g_p) = (df/dy, df/dp)'(Y_i) h v_i,   g_0 = g_1 + sum_i G_i

k_j: slopes of the stages; g_1, g_0: cotangents of the state after and before the step; g_p: cotangent of the
known numbers p. If the motion ended at a stop event, the backward pass begins with the event
(`event_adjoint.py`).

The same code computes reverse mode in JAX (`integrate/arrays/array_loop.py`). The derivative of the
cotangents along a tangent consists of cotangents of the motion with that tangent: let S be the sum of all
states times their cotangents g, and let g' be the change of g along the tangent. Reverse mode returns dS/dx,
where x is the initial state and the known numbers. Its change is d(dS)/dx, where dS is the sum of states
times g' and of their tangents times g. So the cotangents are g' for the states and g for their tangents.

Derivatives with respect to times are added outside the loop. Machine code integrates between constant times.
The start is shifted along its rates from the differentiable time t_0 to a constant time, t_0 - d, and the
results are shifted back to differentiable times. Let z be the state and all arguments of its rates, and G the
rate of z. A shift of z by a time d, whose value is zero, has the derivative

    dz_1 = (1 + G' d)(dz + G dd),   G' = dG/dz,   to second order
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jourdain_jax.calculus.derivative_errors import DifferentiationModeError
from jourdain_jax.calculus.derivatives import Rules, filled, is_zero, with_rules
from jourdain_jax.calculus.reals import Indices, Scalar
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.event_search import RUNNING
from jourdain_jax.integrate.explicit_steps import Method
from jourdain_jax.integrate.loop.event_adjoint import write_event_back, write_transition_back
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import (
    Lanes,
    MachineWriter,
    Number,
    StepWriter,
    arguments_of_samples,
    copied,
    each_row,
    set_goal,
)
from jourdain_jax.integrate.loop.loop import TIMES, begin_lane, goal_of, of_job, write_functions, write_job
from jourdain_jax.integrate.loop.loop_function import MOST_KERNELS, Start, constant_rows, with_tangents
from jourdain_jax.integrate.loop.rate_functions import write_pulled
from jourdain_jax.integrate.loop.record import GOALS, TO_STATES, Slot, prepare, write_record
from jourdain_jax.integrate.loop.samples import pass_knot
from jourdain_jax.integrate.loop.step import near_rank_loss, put_near_rows, squares_of, weighted
from jourdain_jax.integrate.loop.transitions import write_reset_back
from jourdain_jax.integrate.loop.value_kernels import called, values_of_nodes
from jourdain_jax.kernels.ffi import write_handler
from jourdain_jax.program.derivative import on_its_own


def write_back(w: MachineWriter, form: Form, method: Method, asked: Sequence[int], memory: int) -> None:
    """Write the module of reverse mode. `asked`: indices of the numbers whose cotangents are needed;
    `memory`: bytes for the records of all threads.
    """
    write_functions(w, form, method)
    write_pulled(w, form, asked)
    prepare(w, form, method, memory)
    _write_begin(w, form)
    _write_note(w, form)
    _write_added(w, form)
    if form.projects:
        _write_project_back(w, form)
    with w.procedure("step_back", "state here g by_known") as (state, here, g, by_known):
        step_back(w, form, method, len(asked), state, here, g, by_known)
    if form.has_events:
        write_event_back(w, form, len(asked))
    if form.goes_on:
        write_reset_back(w, form, asked)
        write_transition_back(w, form, len(asked))
    with w.function("loop", "ptr", {"job": "ptr"}, attributes="noinline") as (job,):
        write_record(w, form, method, len(asked), memory, job)
        w.give(w.null)
    write_handler(
        w,
        4 + arguments_of_samples(form) + 2 * w.device,
        1,
        lambda arguments, results: write_job(w, form, arguments[: len(arguments) - w.device], results),
    )


def _write_begin(w: MachineWriter, form: Form) -> None:
    """Write `begin(job, state, who, lane)`, which begins a sample in a lane; `who` holds its index."""
    with w.procedure("begin", "job state who lane:i64") as (job, state, who, lane):
        number = w.load(who, lane, "i64")
        begin_lane(w, form, job, w.load(job, GOALS, "ptr"), Lanes(w, form, state), lane, number, number >= 0)


def _write_note(w: MachineWriter, form: Form) -> None:
    """Write `note(job, state, who, saved)`, which counts the times reached, sets the next one, and ends lanes
    that have reached all.
    """
    with w.procedure("note", "job state who saved") as (job, state, who, saved):
        lanes = Lanes(w, form, state)
        with (
            w.when(w.any(lanes["code"].equals(RUNNING) & lanes["t"].equals(lanes["goal"]))),
            w.each_lane() as lane,
        ):
            times, number = w.load(job, TIMES, "i64"), w.load(who, lane, "i64")
            with w.repeated() as leave:
                leave(
                    ~(
                        lanes.of("code", lane).equals(RUNNING)
                        & lanes.of("t", lane).equals(lanes.of("goal", lane))
                    )
                )
                before = w.converted("fptosi", w.load(saved, lane, "double"), "i64")
                goals = w.load(job, GOALS, "ptr")
                if form.sampled:
                    at_knot = lanes.of("t", lane).differs(goal_of(w, job, goals, number, before))
                    with w.when(at_knot):
                        pass_knot(w, lanes, lane)
                    reached = before + w.where(at_knot, w.literal(0, "i64"), 1)
                else:
                    reached = before + 1
                w.store(w.converted("sitofp", reached, "double"), w.at(saved, lane, "double"))
                with w.when(reached >= times):
                    lanes.set("code", lane, result_codes.SUCCESS)
                with w.when(reached < times):
                    set_goal(w, lanes, lane, goal_of(w, job, goals, number, reached))


def _write_added(w: MachineWriter, form: Form) -> None:
    """Write `added(job, who, first, end, g)`, which adds to `g` the cotangents of the states saved at the
    times with indices `first` to `end - 1`.
    """
    count = form.integrated
    with w.procedure("added", "job who first:real end:real g") as (job, who, first, end, g):
        firsts, ends = w.room(), w.room()
        w.store(first, firsts)
        w.store(end, ends)
        with w.when(w.any(first < end)), w.each_lane() as lane:
            number, times = w.load(who, lane, "i64"), w.load(job, TIMES, "i64")
            with w.when(number >= 0):
                a, b = (w.converted("fptosi", w.load(x, lane, "double"), "i64") for x in (firsts, ends))
                states = of_job(w, job, TO_STATES, times * count, number)
                with w.counted(b, first=a) as k, w.counted(count) as row:
                    more = w.load(states.place(k * count + row), type="double")
                    place = w.at(g, row * w.lanes + lane, "double")
                    w.store(w.load(place, type="double") + more, place)


def _used(method: Method) -> list[int]:
    """Return the stages on which the end of a step depends, the last stage first."""
    found: list[int] = []
    for stage in reversed(range(method.needed)):
        if method.b[stage] != 0 or any(method.A[j][stage] != 0 for j in found):
            found.append(stage)
    return found


def step_back(
    w: StepWriter,
    form: Form,
    method: Method,
    asked: int,
    state: Number,
    here: Number,
    g: Number,
    by_known: Number,
) -> None:
    """Pull cotangents back through the step in the slot `here`, in lanes that advanced in it."""
    slot, count, used, n = Slot.of(form, method), form.integrated, _used(method), method.needed
    h, t = w.load(here, slot.taken), w.load(here, slot.t)
    took, k = w.differs(h, 0.0), w.at(here, slot.y)
    w.in_step(t, h)
    g1, v, at, G, added = (w.room(n) for n in (count, count, count, count * n, max(asked, 1)))
    copied(w, count, g, g1)
    each_row(w, asked, added, lambda i: 0.0)
    if form.projects:
        each_row(w, count, at, lambda i: w.fma(h, weighted(w, method.b, k, form, i), w.load(here, i)))
        w.run("project_back", state, t + h, at, g1, added)
    A, columns, b, c, order = (
        w.table(x) for x in (method.A[:n, :n], method.A[:n, :n].T, method.b[:n], method.c[:n], used)
    )
    near = None
    if form.squares:
        pivots = w.room(len(form.monitored))
        w.run("rates", state, t, here, v, pivots)
        near = near_rank_loss(squares_of(w, form, pivots))

    def stage(number, _: tuple) -> tuple:
        stage = order[number]
        of_stage, time = w.at(G, stage * count), w.fma(h, c[stage], t)

        def state_at(row: int | Number) -> Number:
            start = w.load(here, row)
            return start if w.is_first(stage) else w.fma(h, weighted(w, A[stage], k, form, row), start)

        def cotangent(i: int | Number) -> Number:
            total = w.load(g1, i) * b[stage]
            for j in used:
                if w.may_count(columns[stage], j):
                    total = w.fma(w.load(G, i + j * count), columns[stage][j], total)
            return h * total

        def put_back(near) -> None:
            each_row(w, count, at, state_at)
            pulled, more = w.room(count), w.room(max(asked, 1))
            copied(w, count, of_stage, pulled)
            copied(w, asked, added, more)
            w.run("project_back", state, time, at, pulled, more)
            copied(w, count, pulled, of_stage, near)
            copied(w, asked, more, added, near)

        each_row(w, count, at, state_at)
        each_row(w, count, v, cotangent)
        is_near = (
            None if near is None or w.is_first(stage) else w.at_first(stage, w.literal(0, w.truth), near)
        )
        if is_near is not None:
            put_near_rows(w, form, state, is_near, time, at)
        w.run("pull_rates", state, time, at, v, of_stage, added)
        if is_near is not None:
            w.if_any(is_near, lambda: put_back(is_near))
        return ()

    w.over_stages(len(used), stage, ())

    def total(i: int | Number) -> Number:
        found = w.load(g1, i)
        for stage in used:
            found = found + w.load(G, i + stage * count)
        return w.where(took, found, w.load(g, i))

    each_row(w, count, g, total)
    each_row(w, asked, by_known, lambda i: w.load(by_known, i) + w.where(took, w.load(added, i), 0.0))


def _write_project_back(w: MachineWriter, form: Form) -> None:
    """Write `project_back(state, t, free, g, added)`, which pulls cotangents of a projected state back to the
    state `free` before the projection.
    """
    moves, count = form.moves, form.integrated
    with w.procedure("project_back", "state t1:real free g added") as (state, t1, free, g, added):
        before = w.room(count * len(moves))
        for number, q_moves in enumerate(moves):
            copied(w, count, free, w.at(before, number * count))
            w.run("projected_once", state, t1, free, w.literal(q_moves, "i1"))
        out = w.room(count)
        for number, q_moves in reversed(list(enumerate(moves))):
            w.run("pull_q" if q_moves else "pull_u", state, t1, w.at(before, number * count), g, out, added)
            copied(w, count, out, g)


@lru_cache(maxsize=MOST_KERNELS)
def kernel_back(form: Form, method: Method, asked: Indices, memory: int) -> Callable:
    """Return a function that computes cotangents of the initial state and of the requested known numbers
    (`asked`).

    Its arguments are: samples; the rows of a start; cotangents of the states at the goals, and of the end
    with its time last; the goals; the number of trial steps. Each state is followed by its tangent.
    """
    return called(
        lambda w: write_back(w, form, method, asked, memory),
        lambda *_: ((form.integrated + len(asked),),),
        arguments_of_samples(form),
        constant=constant_rows(form),
        counted=True,
    )


def flow_back(
    form: Form, method: Method, asked: Indices, memory: int
) -> Callable[..., Float[Array, "found"]]:
    """Return a function that computes cotangents of the start's state and of the requested known numbers
    (`asked`), and that can itself be differentiated. Its arguments are the start, the cotangents of the
    states at the goals, the cotangents of the end and its time, and the number of trial steps.
    """
    n = form.y

    @jax.custom_jvp
    def own(start: Start, g: Float[Array, "times y"], ends: Float[Array, "ends"], tries: Scalar):
        return _pulled(kernel_back(form, method, asked, memory), start, g, ends, tries)

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (start, g, ends, tries), (along, dg, dends, _) = primals, tangents
        dg, dends = filled(dg), filled(dends)
        raised, more = with_tangents(form, start, along)
        # cotangents of each quantity and its tangent: the final state, its time, and the times of transitions
        parts = [x for a, b in pairwise((0, n, n + 1, len(ends))) for x in (dends[a:b], ends[a:b])]
        both = jnp.concatenate([dg, g], axis=1), jnp.concatenate(parts)
        # events need the slopes of samples
        raised = replace(raised, time_moves=form.has_events and bool(form.sampled))
        d = _pulled(kernel_back(raised, method, asked, memory), more, *both, tries)
        return own(*primals), jnp.concatenate([d[:n], d[2 * n :]])

    return own


def _pulled(kernel: Callable, start: Start, g, ends, tries) -> Float[Array, "found"]:
    return kernel(*start.of_samples, (*start.y, *start.numbers()), g, ends, start.goals, tries)[0]


Unknowns = Float[Array, "z"]


@jax.custom_jvp
def _to_second_order(d: Scalar, dz: Unknowns) -> Unknowns:
    """Return `dz`, and raise an error if JAX differentiates it with respect to the time `d`."""
    return dz


@partial(_to_second_order.defjvp, symbolic_zeros=True)
def _no_third(at, tangents):
    if not is_zero(tangents[0]):
        raise DifferentiationModeError(
            "motions have no third derivatives with respect to times; take first or second ones, or higher "
            "ones at fixed times"
        )
    return _to_second_order(*at), filled(tangents[1])


def moved(rates: Callable[[PyTree, Unknowns], Unknowns]) -> Callable[[PyTree, Unknowns, Scalar], Unknowns]:
    """Return a function of `plain`, z and a time d that shifts z along its `rates`, a function of `plain` and
    z, by d. The value of d is zero: it only carries derivatives. `plain` has none.
    """

    def moving_with_time(slope: Callable) -> Callable:
        @jax.custom_jvp
        def same(plain, z, d, v):
            return v

        @partial(same.defjvp, symbolic_zeros=True)
        def rule(at, tangents):
            (plain, z, d, v), (*_, dd, dv) = at, tangents
            dv = filled(dv) if is_zero(dd) else filled(dv) + scaled(slope(plain, z, v), dd)
            return same(*at), _to_second_order(d, dv)

        return same

    along = moving_with_time(lambda plain, z, v: jax.jvp(partial(rates, plain), (z,), (v,))[1])
    back = moving_with_time(lambda plain, z, g: jax.vjp(partial(rates, plain), z)[1](g)[0])

    def push(arguments, tangents):
        (plain, z, d), (_, dz, dd) = arguments, tangents
        dz = jnp.zeros_like(z) if dz is None else dz
        return z, along(plain, z, d, dz if dd is None else dz + scaled(rates(plain, z), dd))

    def pull(perturbed, arguments, found, g):
        (plain, z, d), (*_, varies) = arguments, perturbed
        g = back(plain, z, d, g)
        return plain, g, jnp.sum(scaled(rates(plain, z), g)) if varies else None

    return with_rules(lambda plain, z, d: z, Rules(push, pull))


def rates_of_all(form: Form) -> Callable[[PyTree, Unknowns], Unknowns]:
    """Return the rates of z, which consists of the state, time, the known numbers, and the slopes of sampled
    inputs. The rates of known numbers are zero. `plain`: z in parts, some of which lanes may share.
    """
    graph, rates, variables = on_its_own(form.program.graph, form.rates, form.program.variables)
    fixed, t, y, inputs = form.split(variables)
    work = [graph.input("work", True)] if form.with_work else []
    slopes = [graph.input(f"slope of input {i}", True) for i in form.sampled]
    z = [*y, *work, t, *fixed, *inputs, *slopes]
    of_inputs = dict(zip(form.sampled, slopes, strict=True))
    known = [graph.zero] * len(fixed) + [of_inputs.get(i, graph.zero) for i in range(len(inputs))]
    found = values_of_nodes(graph, [*rates, graph.one, *known, *[graph.zero] * len(slopes)], z)
    return lambda plain, z: found((z, plain))


@jax.custom_jvp
def scaled(slope: Float[Array, "y"], by: Float[Array, "..."]) -> Float[Array, "y"]:
    """Return the product `slope * by`; zero if `by` is zero, even if the slope is not finite."""
    return jnp.where(by == 0.0, 0.0, slope * by)


@scaled.defjvp
def _scaled_jvp(primals, tangents):
    return scaled(*primals), scaled(tangents[0], primals[1]) + scaled(primals[0], tangents[1])
