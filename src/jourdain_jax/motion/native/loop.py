"""The loop over steps as machine code, and as a function of JAX: from starts and times to save, to states and
ends.

Lanes of a batch run side by side in several threads, in the widest registers, each replaced by the next one when it has ended. One motion by itself runs in
narrow registers, in which an instruction takes less time. Results of a lane do not depend on the width. A call is given two arrays with one row per
lane: the rows of `Form.given`, and the times to save at. It returns the states there, and the rows of the progress at the end with the number of times that
were reached one after the other. Where inputs are given by samples, their tables and knots come first (`layout.py`).

The derivative of a motion is a motion, of states with their tangents. A time of an event has a tangent, which the loop itself finds; all other times are
numbers (`native_motion.py`). Tolerances and the first step change nothing, and what samples say is a number at each time.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.derivatives import DifferentiationModeError, filled, is_zero
from jourdain_jax.motion.integrators.event_search import LOCATING, RUNNING
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.native.functions import check_derivatives, write_events, write_projection, write_rates
from jourdain_jax.motion.native.layout import (
    CONTROL,
    PROGRESS,
    Form,
    Lanes,
    MachineWriter,
    arguments_of_samples,
    set_goal,
)
from jourdain_jax.motion.native.samples import WORDS_OF_SAMPLES, begin_samples, pass_knot, store_samples, write_sampled_inputs
from jourdain_jax.motion.native.step import IDLE, write_step
from jourdain_jax.motion.native.taylor import TaylorSteps, products
from jourdain_jax.motion.native.transitions import write_reset
from jourdain_jax.motion.native.values import called
from jourdain_jax.native.ffi import Given, handed_out, last_size, next_lane, product, share, start_counting, taken_in, write_handler
from jourdain_jax.native.ir import Value

# words of a job, shared by all threads: the number of lanes, of times, and of the next lane, of doubles of a kernel's own memory (`ffi.py`), those of
# samples, then pointers to the arrays
COUNT, TIMES, NEXT, OWN, FIRST_OF_SAMPLES = range(5)
FIRST_ARRAY = FIRST_OF_SAMPLES + WORDS_OF_SAMPLES
STARTS, _GOALS, _STATES, _ENDS = range(FIRST_ARRAY, FIRST_ARRAY + 4)


def write_loop(w: MachineWriter, form: Form, method: Method | TaylorSteps) -> None:
    """The module."""
    write_functions(w, form, method)
    _write_begin(w, form)
    _write_serve(w, form)
    if isinstance(method, TaylorSteps):
        _write_save_within(w, form, method)
    _write_loop(w, form, method)
    write_handler(w, 2 + arguments_of_samples(form), 2, lambda arguments, results: write_job(w, form, arguments, results))


def write_functions(w: MachineWriter, form: Form, method: Method | TaylorSteps) -> None:
    """Write `step`, and its callees."""
    if form.sampled:
        write_sampled_inputs(w, form, form.time_moves)
    write_rates(w, form)
    if form.projects:
        write_projection(w, form)
    if form.has_events:
        write_events(w, form)
    if form.goes_on:
        write_reset(w, form)
    write_step(w, form, method)


def write_job(w: MachineWriter, form: Form, arguments: list[Given], results: list[Value]) -> None:
    """All lanes, by this thread and by others that it starts and waits for; the last of the arguments is an array of lanes and times."""
    of_samples, arguments, times = arguments[: arguments_of_samples(form)], arguments[arguments_of_samples(form) :], arguments[-1]
    arrays = [*(x.data for x in arguments), *results]
    job = w.room(FIRST_ARRAY + len(arrays), "i64")
    for word, pointer in enumerate(arrays):
        w.store(pointer, job, FIRST_ARRAY + word)
    count = w.room(type="i64")
    w.store(product(w, times, 1), count)
    w.store(w.load(count, type="i64"), job, COUNT)
    w.store(last_size(w, times), job, TIMES)
    start_counting(w, job, NEXT)
    if w.device:
        w.store(w.own[1], job, OWN)
    if form.sampled:
        store_samples(w, w.at(job, FIRST_OF_SAMPLES, "i64"), of_samples)
    share(w, job, w.load(count, type="i64"))


def _write_loop(w: MachineWriter, form: Form, method: Method | TaylorSteps) -> None:
    """`loop(job)`: lanes side by side until none is left."""
    with w.function("loop", "ptr", {"job": "ptr"}, attributes="noinline") as (job,):
        _write_lanes(w, form, method, job)
        w.give(Value(w, "ptr", "null"))


def _write_lanes(w: MachineWriter, form: Form, method: Method | TaylorSteps, job: Value) -> None:
    # of each place, which lane is there and how many of its times are saved; after them, at how many places there is one
    state, who, k = w.room(form.all), w.room(2 * w.lanes + 1, "i64"), w.room(form.integrated * method.needed)
    w.store(w.literal(w.lanes, "i64"), who, 2 * w.lanes)
    with w.counted(0, form.all) as row:
        w.store(1.0, state, row)
    lanes = Lanes(w, form, state)
    with w.counted(0, w.lanes) as lane:
        w.run("begin", job, state, who, lane)
        w.run("serve", job, state, who, lane)
    with w.repeated() as leave:
        leave(~w.together(w.load(who, 2 * w.lanes, "i64").differs(0)))
        w.run("step", state, k)
        if isinstance(method, TaylorSteps):
            w.run("save_within", job, state, who, k)
        code = lanes["code"]
        on_its_way = (code.equals(RUNNING) & lanes["t"].differs(lanes["goal"])) | code.equals(LOCATING) | code.equals(IDLE)
        with w.when(w.any(~on_its_way)), w.counted(0, w.lanes) as lane:
            w.run("serve", job, state, who, lane)


def begin_lane(w: MachineWriter, form: Form, job: Value, goals: Value, lanes: Lanes, lane: Value, number: Value, there: Value) -> None:
    """Assign the sample with this number to a place; if it does not exist, the place is idle, with samples of
    the first one.
    """
    if form.sampled:
        begin_samples(w, form, w.at(job, FIRST_OF_SAMPLES, "i64"), w.load(job, COUNT, "i64"), lanes, lane, w.where(there, number, 0))
    with w.when(there):
        given = form.given
        taken_in(w, given, w.at(w.load(job, STARTS, "ptr"), number * given, "double"), lanes.pointer, lane)
        set_goal(w, lanes, lane, w.load(goals, number * w.load(job, TIMES, "i64"), "double"))
    with w.when(~there):
        lanes.set("code", lane, IDLE)
    lanes.set("taken", lane, 0.0)
    lanes.set("bound", lane, math.inf)
    if form.has_events:
        lanes.set("search_left", lane, 0.0)
    for row in (row for name in ("begun", "disarmed", "left") for row in form.rows.get(name, ())):
        w.store(w.literal(0.0, "double"), w.at(lanes.pointer, lane + row * w.lanes, "double"))


def _write_begin(w: MachineWriter, form: Form) -> None:
    """`begin(job, state, who, lane)`: the next lane of the batch takes this place."""
    with w.procedure("begin", "job state who lane:i64") as (job, state, who, lane):
        number = next_lane(w, job, NEXT)
        there = number < w.load(job, COUNT, "i64")
        begin_lane(w, form, job, w.load(job, _GOALS, "ptr"), Lanes(w, form, state), lane, number, there)
        with w.when(there):
            w.store(number, who, lane)
            w.store(w.literal(0, "i64"), who, lane + w.lanes)
        with w.when(~there):
            w.store(w.load(who, 2 * w.lanes, "i64") - 1, who, 2 * w.lanes)


def _write_serve(w: MachineWriter, form: Form) -> None:
    """Write `serve(job, state, who, lane)`: saves due states, and if the sample has ended, returns it and
    begins the next one.
    """
    with w.procedure("serve", "job state who lane:i64") as (job, state, who, lane):
        lanes = Lanes(w, form, state)
        with w.repeated() as leave:
            code, t, goal = (lanes.of(name, lane) for name in ("code", "t", "goal"))
            runs = code.equals(RUNNING)
            leave(code.equals(IDLE) | code.equals(LOCATING) | (runs & t.differs(goal)))
            if form.sampled:
                place = w.load(who, lane, "i64") * w.load(job, TIMES, "i64") + w.load(who, lane + w.lanes, "i64")
                next_time = w.load(w.load(job, _GOALS, "ptr"), place, "double")
                at_knot = runs & t.differs(next_time)
                with w.when(at_knot):
                    pass_knot(w, lanes, lane)
                    set_goal(w, lanes, lane, next_time)
                with w.when(~at_knot):
                    _save(w, form, job, who, lanes, lane, runs)
            else:
                _save(w, form, job, who, lanes, lane, runs)


def _write_save_within(w: MachineWriter, form: Form, method: TaylorSteps) -> None:
    """Write `save_within(job, state, who, k)`: saves due states before the end of a step, by the Taylor
    coefficients `k` of its start.
    """
    with w.procedure("save_within", "job state who k") as (job, state, who, k):
        lanes = Lanes(w, form, state)
        every, flags, y = form.integrated, w.room(), w.room(form.integrated)
        times, goals, states = (w.load(job, TIMES, "i64"), *(w.load(job, word, "ptr") for word in (_GOALS, _STATES)))
        with w.repeated() as leave:
            goal = lanes["goal"]
            due = ((goal - lanes["t"]) * lanes["direction"] < 0.0) & lanes["code"].differs(IDLE)
            leave(~w.any(due))
            s = goal - lanes["before"]
            with w.counted(0, every) as row:
                total = w.load(k, row + method.order * every)
                for j in reversed(range(method.order)):
                    total = w.fma(total, s, w.load(k, row + j * every))
                w.store(total, y, row)
            if form.projects:
                w.run("project", state, goal, y)
            w.store(w.where(due, 1.0, 0.0), flags)
            with w.counted(0, w.lanes) as lane, w.when(w.load(flags, lane, "double") > 0.0):
                saved = w.load(who, lane + w.lanes, "i64")
                place = w.load(who, lane, "i64") * times + saved
                handed_out(w, every, y, lane, w.at(states, place * every, "double"))
                w.store(saved + 1, who, lane + w.lanes)
                lanes.set("goal", lane, lanes.of("direction", lane) * math.inf)  # where an event was found a rounding beyond the last time
                with w.when((saved + 1) < times):
                    lanes.set("goal", lane, w.load(goals, place + 1, "double"))


def _save(w: MachineWriter, form: Form, job: Value, who: Value, lanes: Lanes, lane: Value, runs: Value) -> None:
    """The state of a lane at a time to save at; or at the end, where it stands for all that is left, and the next lane begins."""
    times = w.load(job, TIMES, "i64")
    goals, states, ends = (w.load(job, word, "ptr") for word in (_GOALS, _STATES, _ENDS))
    number, saved = w.load(who, lane, "i64"), w.load(who, lane + w.lanes, "i64")
    last = w.where(runs, saved + 1, times)
    with w.counted(saved, last) as k:
        handed_out(w, form.integrated, lanes.pointer, lane, w.at(states, (number * times + k) * form.integrated, "double"))
    w.store(last, who, lane + w.lanes)
    with w.when(last < times):
        set_goal(w, lanes, lane, w.load(goals, number * times + last, "double"))
    with w.when(last >= times):
        end = w.at(ends, number * (form.returned + 1), "double")
        handed_out(w, form.returned, lanes.pointer, lane, end)
        w.store(w.converted("sitofp", w.where(runs, times, saved), "double"), end, form.returned)
        w.run("begin", job, lanes.pointer, who, lane)


MOST_KERNELS = 64  # whose names are kept; machine code lives as long as the process


class Start(NamedTuple):
    """Arguments of a loop for a motion; the state and the known numbers are followed by their tangents
    (`Form`).
    """

    of_samples: tuple[Array, ...]  # as `layout.py` has them; of a loop on arrays the knots alone
    control: tuple[Float[Array, "*lanes"], ...]  # rtol, atol, shortest, longest and first step, most steps
    goals: Float[Array, "times *lanes"]  # since the start
    origin: Float[Array, "*lanes"]  # the time of the start
    y: tuple[Float[Array, "y *lanes"], ...]
    known: tuple[tuple[Array, ...], ...]  # numbers; of a loop on arrays those in which the arguments of rates are stored, with their lanes first
    modes: tuple[Float[Array, "*lanes"], ...] = ()

    def rows(self, form: Form) -> Float[Array, "given *lanes"]:
        """Return the rows of a lane at the start."""
        rtol, atol, shortest, longest, first, most = self.control
        zero, one = jnp.zeros_like(self.goals[0]), jnp.ones_like(self.goals[0])
        progress = [zero, jnp.minimum(jnp.abs(first), longest), RUNNING * one, zero, zero, -one, jnp.inf * one, zero]
        progress += [zero] * (form.rows[CONTROL[0]].start - form.integrated - len(progress))
        limits = [jnp.sign(self.goals[-1]), self.goals[-1], rtol, atol, shortest, longest, most, self.origin]
        known = [jnp.stack(part) for part in self.known if part]  # each tangent by itself: values may have no lanes where tangents have
        return jnp.concatenate([*self.y, jnp.stack(progress), jnp.stack([*limits, *(mode * one for mode in self.modes)]), *known])


class Found(NamedTuple):
    """A motion as a loop returns it; each with its tangents."""

    y: tuple[Float[Array, "times y *lanes"], ...]  # at the goals
    end: tuple[Float[Array, "y *lanes"], ...]
    t: tuple[Float[Array, "*lanes"], ...]  # of the end, since the start
    log: tuple[Float[Array, "transitions *lanes"], ...]  # times of transitions
    rest: Float[Array, "rest *lanes"]  # rows of the progress after its time, the number of goals that were reached one after the other, and of transitions
    # their number, events, energies lost and modes

    @staticmethod
    def of(form: Form, states: Float[Array, "times y *lanes"], end: Float[Array, "returned *lanes"], count: Float[Array, "one *lanes"]) -> "Found":
        """Put a motion together from its states, its rows at the end, and the number of goals that were reached."""
        rows, parts = form.rows, range(1 + len(form.moving))
        every = [slice(k * form.y, (k + 1) * form.y) for k in parts]

        def named(name: str) -> Array:
            return end[rows[name].start : rows[name].stop]

        log: list[Array] = [jnp.zeros((0, *end.shape[1:]), end.dtype) for _ in parts]
        more = []
        if form.transitions:
            log = jnp.split(named("log_t"), len(parts))
            more = [named(name) for name in ("passed", "log_event", "log_lost", "log_mode") if rows[name]]
        progress = end[rows[PROGRESS[1]].start : rows[PROGRESS[-1]].stop]
        return Found(
            tuple(states[:, part] for part in every),
            tuple(end[part] for part in every),
            tuple(end[row] for row in (rows["t"].start, *rows["dt"])),
            tuple(log),
            jnp.concatenate([progress, count, *more]),
        )

    def shared(self, given: Start) -> tuple["Found", "Found"]:
        """Return the result of `vmap`, without batch axes for shared parts, and marks of batched ones;
        `given`: the parts of the start that have one.

        A tangent has lanes where anything has that it depends on: all directions share the values of one motion.
        """
        parts = range(len(self.y))
        base = any(jax.tree.leaves(given._replace(y=(), known=())))
        own = [any(jax.tree.leaves((given.y[k], given.known[k]))) for k in parts]
        of_parts = tuple(base or any(own[other] for other in range(k + 1) if other & k == other) for k in parts)
        lanes = Found(of_parts, of_parts, of_parts, of_parts, of_parts[0])
        return jax.tree.map(lambda x, has_lanes: x if has_lanes else x[0], self, lanes), lanes


@lru_cache(maxsize=MOST_KERNELS)
def kernel(form: Form, method: Method, order: int | None = None) -> Callable[[Start], Found]:
    """Return the kernel of the integrated form, by a tableau, or by Taylor series up to an order."""
    steps = method if order is None else TaylorSteps(order)

    def shapes(*arguments):
        return (arguments[-1].shape[-1], form.integrated), (form.returned + 1,)

    run = called(lambda w: write_loop(w, form, steps), shapes, arguments_of_samples(form))

    @jax.custom_batching.custom_vmap
    def motion(start: Start) -> Found:
        states, end = run(*start.of_samples, start.rows(form), start.goals)
        return Found.of(form, states, end[:-1], end[-1:])

    @motion.def_vmap
    def motions(count, batched: Sequence, start: Start):
        (given,) = batched
        found = jax.vmap(motion.fun, [jax.tree.map(lambda has_axis: 0 if has_axis else None, given)], axis_size=count)(start)
        return found.shared(given)

    return motion


OF_SAMPLES = 'machine code does not differentiate with respect to samples of an input; `jj.simulate(..., backend="xla")` does'


def flow(form: Form, method: Method, order: int | None) -> Callable[[Start], Found]:
    """Return the motion by a kernel; `order`: of Taylor series, in place of the tableau."""

    def motion(form: Form) -> Callable[[Start], Found]:
        # 36_000 of coefficients in a step by Taylor series of second derivatives; where there are more, steps are those of the tableau
        too_many = order is not None and len(form.moving) > 1 and products(form, order) > 36_000
        return kernel(form, method, None if too_many else order)

    def check(form: Form, along: Start) -> None:
        if not all(map(is_zero, along.of_samples[:1])):
            raise DifferentiationModeError(OF_SAMPLES)
        check_derivatives(replace(form, moving=(), time_moves=False), (len(form.moving) + 1).bit_length())

    return differentiated(motion, form, check)


def differentiated(motion: Callable[[Form], Callable[[Start], Found]], form: Form, check: Callable[[Form, Start], None]) -> Callable[[Start], Found]:
    """Return the motion of a form, whose derivative is the motion of the state with one more tangent of each
    part; `check`: whether there is such a one.
    """
    own = jax.custom_jvp(motion(form))

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (start,), (along,) = primals, tangents
        check(form, along)
        raised, more = with_tangents(form, start, along)
        both = differentiated(motion, replace(raised, time_moves=form.has_events and len(start.y) > 1), check)(more)
        found, d = (Found(*(part[half] for part in both[:4]), both.rest) for half in (slice(len(start.y)), slice(len(start.y), None)))
        return found, d._replace(rest=jnp.zeros_like(found.rest))

    return own


def with_tangents(form: Form, start: Start, along: Start) -> tuple[Form, Start]:
    """Return the form and the start that have these tangents too."""
    every = (tuple(range(len(start.known[0]))), *form.moving)
    moves = [[not is_zero(dx) for dx in part] for part in along.known]
    moving = tuple(tuple(i for i, does in zip(of, part, strict=True) if does) for of, part in zip(every, moves, strict=True))
    known = tuple(tuple(dx for dx in part if not is_zero(dx)) for part in along.known)
    more = start._replace(y=(*start.y, *map(filled, along.y)), known=(*start.known, *known))
    return replace(form, moving=(*form.moving, *moving)), more
