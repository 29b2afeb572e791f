"""The loop over steps as machine code: lanes of a batch side by side, each replaced by the next one when it has ended, in several threads.

A call is given two arrays with one row per lane: the rows of `Layout.given`, and the times to save at. It returns the states there, and the rows of the
progress at the end with the number of times that were reached one after the other. Where inputs are given by samples, their tables and knots come first
(`samples.py`).
"""

import math

from jourdain_jax.motion.integrators.event_search import LOCATING, RUNNING
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.native import samples
from jourdain_jax.motion.native.functions import Form, write_events, write_projection, write_rates, write_relations
from jourdain_jax.motion.native.layout import Lanes
from jourdain_jax.motion.native.step import IDLE, write_step
from jourdain_jax.motion.native.taylor import TaylorSteps
from jourdain_jax.native.ffi import Given, last_size, next_lane, product, share, start_counting, write_handler
from jourdain_jax.native.ir import Value, Writer

# words of a job, shared by all threads: the number of lanes, of times, and of the next lane, of doubles of a kernel's own memory (`ffi.py`), those of
# samples, then pointers to the arrays
COUNT, TIMES, NEXT, OWN, FIRST_OF_SAMPLES = range(5)
FIRST_ARRAY = FIRST_OF_SAMPLES + samples.WORDS
_STARTS, _GOALS, _STATES, _ENDS = range(FIRST_ARRAY, FIRST_ARRAY + 4)


def write(w: Writer, form: Form, method: Method | TaylorSteps) -> None:
    """The module."""
    write_functions(w, form, method)
    _write_begin(w, form)
    _write_serve(w, form)
    if isinstance(method, TaylorSteps):
        _write_save_within(w, form, method)
    _write_loop(w, form, method)
    write_handler(w, 2 + samples.arguments(form.layout), 2, lambda arguments, results: write_job(w, form, arguments, results))


def write_functions(w: Writer, form: Form, method: Method | TaylorSteps) -> None:
    """`step`, and what it calls."""
    if form.sampled:
        samples.write_inputs(w, form.layout, form.time_moves)
    write_rates(w, form)
    if form.projects:
        write_projection(w, form)
    if form.has_events:
        write_events(w, form)
    if form.relations:
        write_relations(w, form)
    write_step(w, form, method)


def write_job(w: Writer, form: Form, arguments: list[Given], results: list[Value]) -> None:
    """All lanes, by this thread and by others that it starts and waits for; the last of the arguments is an array of lanes and times."""
    of_samples, arguments, times = arguments[: samples.arguments(form.layout)], arguments[samples.arguments(form.layout) :], arguments[-1]
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
        samples.store_words(w, w.at(job, FIRST_OF_SAMPLES, "i64"), of_samples)
    share(w, job, w.load(count, type="i64"))


def _write_loop(w: Writer, form: Form, method: Method | TaylorSteps) -> None:
    """`loop(job)`: lanes side by side until none is left."""
    with w.function("loop", "ptr", {"job": "ptr"}, attributes="noinline") as (job,):
        _write_lanes(w, form, method, job)
        w.give(Value(w, "ptr", "null"))


def _write_lanes(w: Writer, form: Form, method: Method | TaylorSteps, job: Value) -> None:
    # of each place, which lane is there and how many of its times are saved; after them, at how many places there is one
    state, who, k = w.room(form.layout.all), w.room(2 * w.lanes + 1, "i64"), w.room(form.layout.integrated * method.needed)
    w.store(w.literal(w.lanes, "i64"), who, 2 * w.lanes)
    with w.counted(0, form.layout.all) as row:
        w.store(1.0, state, row)
    lanes = Lanes(w, form.layout, state)
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


def _write_begin(w: Writer, form: Form) -> None:
    """`begin(job, state, who, lane)`: the next lane of the batch takes this place; where there is none, it is idle."""
    with w.procedure("begin", "job state who lane:i64") as (job, state, who, lane):
        lanes, given = Lanes(w, form.layout, state), form.layout.given
        number = next_lane(w, job, NEXT)
        there = number < w.load(job, COUNT, "i64")
        with w.when(there):
            w.store(number, who, lane)
            w.store(w.literal(0, "i64"), who, lane + w.lanes)
            starts = w.load(job, _STARTS, "ptr")
            with w.counted(0, given) as row:
                w.store(w.load(starts, number * given + row, "double"), lanes.place(row, lane))
            goal = w.load(w.load(job, _GOALS, "ptr"), number * w.load(job, TIMES, "i64"), "double")
            if form.sampled:
                samples.begin(w, form.layout, w.at(job, FIRST_OF_SAMPLES, "i64"), w.load(job, COUNT, "i64"), lanes, lane, number)
                goal = samples.nearer(w, lanes, lane, goal)
            lanes.set("goal", lane, goal)
            lanes.set("bound", lane, math.inf)
            if form.has_events:
                lanes.set("search_left", lane, 0.0)
        with w.when(~there):
            lanes.set("code", lane, IDLE)
            w.store(w.load(who, 2 * w.lanes, "i64") - 1, who, 2 * w.lanes)
            if form.sampled:  # rates are worked out there too
                samples.begin(w, form.layout, w.at(job, FIRST_OF_SAMPLES, "i64"), w.load(job, COUNT, "i64"), lanes, lane, w.literal(0, "i64"))


def _write_serve(w: Writer, form: Form) -> None:
    """`serve(job, state, who, lane)`: saves what is due, and where the lane has ended, hands it back and begins with the next one."""
    with w.procedure("serve", "job state who lane:i64") as (job, state, who, lane):
        lanes = Lanes(w, form.layout, state)
        with w.repeated() as leave:
            code, t, goal = (lanes.of(name, lane) for name in ("code", "t", "goal"))
            runs = code.equals(RUNNING)
            leave(code.equals(IDLE) | code.equals(LOCATING) | (runs & t.differs(goal)))
            if form.sampled:
                place = w.load(who, lane, "i64") * w.load(job, TIMES, "i64") + w.load(who, lane + w.lanes, "i64")
                next_time = w.load(w.load(job, _GOALS, "ptr"), place, "double")
                at_knot = runs & t.differs(next_time)
                with w.when(at_knot):
                    samples.pass_knot(w, lanes, lane)
                    lanes.set("goal", lane, samples.nearer(w, lanes, lane, next_time))
                with w.when(~at_knot):
                    _save(w, form, job, who, lanes, lane, runs)
            else:
                _save(w, form, job, who, lanes, lane, runs)


def _write_save_within(w: Writer, form: Form, method: TaylorSteps) -> None:
    """`save_within(job, state, who, k)`: saves what is due before the end of a step, by the Taylor coefficients `k` of its start."""
    with w.procedure("save_within", "job state who k") as (job, state, who, k):
        layout, lanes = form.layout, Lanes(w, form.layout, state)
        every, flags, y = layout.integrated, w.room(), w.room(layout.integrated)
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
                with w.counted(0, every) as row:
                    w.store(w.load(y, row * w.lanes + lane, "double"), states, place * every + row)
                w.store(saved + 1, who, lane + w.lanes)
                lanes.set("goal", lane, lanes.of("direction", lane) * math.inf)  # where an event was found a rounding beyond the last time
                with w.when((saved + 1) < times):
                    lanes.set("goal", lane, w.load(goals, place + 1, "double"))


def _save(w: Writer, form: Form, job: Value, who: Value, lanes: Lanes, lane: Value, runs: Value) -> None:
    """The state of a lane at a time to save at; or at the end, where it stands for all that is left, and the next lane begins."""
    layout, times = form.layout, w.load(job, TIMES, "i64")
    goals, states, ends = (w.load(job, word, "ptr") for word in (_GOALS, _STATES, _ENDS))
    number, saved = w.load(who, lane, "i64"), w.load(who, lane + w.lanes, "i64")
    last = w.where(runs, saved + 1, times)
    with w.counted(saved, last) as k, w.counted(0, layout.integrated) as row:
        w.store(w.load(lanes.place(row, lane), type="double"), states, (number * times + k) * layout.integrated + row)
    w.store(last, who, lane + w.lanes)
    with w.when(last < times):
        goal = w.load(goals, number * times + last, "double")
        lanes.set("goal", lane, samples.nearer(w, lanes, lane, goal) if form.sampled else goal)
    with w.when(last >= times):
        each = layout.returned + 1
        with w.counted(0, layout.returned) as row:
            w.store(w.load(lanes.place(row, lane), type="double"), ends, number * each + row)
        reached = w.where(runs, times, saved)
        w.store(w.converted("sitofp", reached, "double"), ends, number * each + layout.returned)
        w.run("begin", job, lanes.pointer, who, lane)
