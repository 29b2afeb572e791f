"""The loop over steps in machine code.

Samples run in the lanes of the widest registers, in several threads. When a sample has ended, the next sample
begins in its lane. A single motion runs in narrow registers, whose instructions are faster; results do not
depend on the width. A call has two arguments with one row per sample: the rows of `Form.given`, and the times
to save. It returns the states at these times, and the rows of the final progress with the number of times
reached. If inputs are sampled, their tables and knots are the first arguments (`samples.py`).
"""

import math
from contextlib import nullcontext

from jourdain_jax.integrate.event_search import LOCATING, RUNNING
from jourdain_jax.integrate.explicit_steps import Method, code_at_end
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import (
    Lanes,
    MachineWriter,
    arguments_of_samples,
    room_of_lanes,
    set_goal,
)
from jourdain_jax.integrate.loop.rate_functions import write_events, write_projection, write_rates
from jourdain_jax.integrate.loop.samples import (
    WORDS_OF_SAMPLES,
    begin_samples,
    pass_knot,
    store_samples,
    write_sampled_inputs,
)
from jourdain_jax.integrate.loop.step import IDLE, write_step
from jourdain_jax.integrate.loop.taylor import TaylorSteps
from jourdain_jax.integrate.loop.transitions import write_reset
from jourdain_jax.kernels.ffi import (
    Given,
    OfLane,
    handed_out,
    last_size,
    next_lane,
    of_lane,
    product,
    share,
    sources,
    start_counting,
    taken_in,
    write_handler,
)
from jourdain_jax.kernels.ir import Value

# Words of a job, which all threads share: number of samples, number of times, index of the next sample; on a
# GPU also the pointer to the record of steps, its number of slots per thread, the pointer to the shared rows,
# and the number of rows of times (one, or one per sample); then the words of samples, and pointers to the
# arrays
COUNT, TIMES, NEXT, RECORD, SLOTS, COMMON, ROWS_OF_TIMES, FIRST_OF_SAMPLES = range(8)
FIRST_ARRAY = FIRST_OF_SAMPLES + WORDS_OF_SAMPLES
STARTS, _GOALS, _STATES, _ENDS = range(FIRST_ARRAY, FIRST_ARRAY + 4)


def write_loop(w: MachineWriter, form: Form, method: Method | TaylorSteps) -> None:
    """Write the module of the loop."""
    write_functions(w, form, method)
    _write_begin(w, form)
    _write_serve(w, form)
    if isinstance(method, TaylorSteps):
        _write_save_within(w, form, method)
    with w.function("loop", "ptr", {"job": "ptr"}, attributes="noinline") as (job,):
        _write_lanes(w, form, method, job)
        w.give(w.null)
    write_handler(
        w,
        2 + arguments_of_samples(form) + w.device,
        2,
        lambda arguments, results: write_job(w, form, arguments, results),
    )


def write_functions(w: MachineWriter, form: Form, method: Method | TaylorSteps) -> None:
    """Write `step` and the functions that it calls."""
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


def write_job(w: MachineWriter, form: Form, arguments: list[Given], results: list[Given]) -> None:
    """Write code that computes all samples, in the calling thread and in threads that it starts and joins.
    The last of the arguments contains the times of each sample.
    """
    common = arguments.pop(arguments_of_samples(form) + 1) if w.device else None
    first = arguments_of_samples(form)
    of_samples, arguments, times = arguments[:first], arguments[first:], arguments[-1]
    arrays = [x.data for x in (*arguments, *results)]
    job = w.room(FIRST_ARRAY + len(arrays), "i64")
    for word, pointer in enumerate(arrays):
        w.store(pointer, job, FIRST_ARRAY + word)
    count = product(w, results[-1], 1)
    w.store(count, job, COUNT)
    w.store(last_size(w, times), job, TIMES)
    start_counting(w, job, NEXT)
    if common:
        own = *w.own[1:], common.data, product(w, times, 1)
        for word, value in zip((RECORD, SLOTS, COMMON, ROWS_OF_TIMES), own, strict=True):
            w.store(value, job, word)
    if form.sampled:
        store_samples(w, w.at(job, FIRST_OF_SAMPLES, "i64"), of_samples)
    share(w, job, count)


def _write_lanes(w: MachineWriter, form: Form, method: Method | TaylorSteps, job: Value) -> None:
    """Write code that runs all lanes until no sample is left."""
    # `who`: for each lane the index of its sample, then for each the number of saved times; the number of
    # busy lanes
    state = room_of_lanes(w, form)
    who = w.room(2 * w.lanes + 1, "i64")
    k = w.room(form.integrated * method.needed)
    w.store(w.literal(w.lanes, "i64"), who, 2 * w.lanes)
    with w.counted(form.all) as row:
        w.store(1.0, state, row)
    lanes = Lanes(w, form, state)
    with w.each_lane() as lane:
        w.run("begin", job, state, who, lane)
        w.run("serve", job, state, who, lane)
    with w.repeated() as leave:
        leave(~w.together(w.load(who, 2 * w.lanes, "i64").differs(0)))
        w.run("step", state, k)
        if isinstance(method, TaylorSteps):
            w.run("save_within", job, state, who, k)
        code = lanes["code"]
        on_its_way = (
            (code.equals(RUNNING) & lanes["t"].differs(lanes["goal"]))
            | code.equals(LOCATING)
            | code.equals(IDLE)
        )
        with w.when(w.any(~on_its_way)), w.each_lane() as lane:
            w.run("serve", job, state, who, lane)


def begin_lane(
    w: MachineWriter,
    form: Form,
    job: Value,
    goals: Value,
    lanes: Lanes,
    lane: Value,
    number: Value,
    there: Value,
) -> None:
    """Begin the sample with the index `number` in a lane. If there is no such sample (not `there`), the lane
    is idle and uses the sampled inputs of the first sample.
    """
    if form.sampled:
        begin_samples(
            w,
            form,
            w.at(job, FIRST_OF_SAMPLES, "i64"),
            w.load(job, COUNT, "i64"),
            lanes,
            lane,
            w.where(there, number, 0),
        )
    if w.device:
        w.store(w.load(job, COMMON, "ptr"), lanes.pointer, form.all)
    with w.when(there):
        for rows, numbers in _starts(w, form, job, number):
            taken_in(w, len(rows), numbers, w.at(lanes.pointer, rows.start), lane)
        last = goal_of(w, job, goals, number, w.load(job, TIMES, "i64") - 1)
        lanes.set("last_goal", lane, last)
        lanes.set("direction", lane, w.where(last < 0.0, w.literal(-1.0, "double"), 1.0))
        set_goal(w, lanes, lane, goal_of(w, job, goals, number, 0))
    with w.when(~there):
        lanes.set("code", lane, IDLE)
    lanes.set("taken", lane, 0.0)
    lanes.set("bound", lane, math.inf)
    if form.has_events:
        lanes.set("search_left", lane, 0.0)
    for row in (row for name in ("begun", "disarmed", "left") for row in form.rows.get(name, ())):
        w.store(w.literal(0.0, "double"), w.at(lanes.pointer, lane + row * w.lanes, "double"))


def _starts(w: MachineWriter, form: Form, job: Value, lane: Value) -> list[tuple[range, OfLane]]:
    """Return the rows of a lane's start as contiguous ranges, each with its source in memory.

    On a GPU, numbers that all samples share and no step changes are read in place, so they are omitted.
    """
    known, own = form.rows["known"].start, of_job(w, job, STARTS, form.given, lane)
    common = w.load(job, COMMON, "ptr") if w.device else w.null
    return [
        (rows, numbers)
        for rows, is_shared, numbers in sources(w, form.given, own, common, known)
        if not (is_shared and rows.start >= known)
    ]


def of_job(w: MachineWriter, job: Value, word: int, numbers: Value | int, lane: Value) -> OfLane:
    """Return the `numbers` of a sample in the array to which a word of the job points."""
    return of_lane(w, w.load(job, word, "ptr"), w.load(job, COUNT, "i64"), numbers, lane)


def goal_of(w: MachineWriter, job: Value, goals: Value, lane: Value, number: Value | int) -> Value:
    """Return the saved time with the index `number` of a sample."""
    rows = w.load(job, ROWS_OF_TIMES if w.device else COUNT, "i64")
    if w.device:
        lane = w.where(lane < rows, lane, 0)
    return w.load(of_lane(w, goals, rows, w.load(job, TIMES, "i64"), lane).place(number), type="double")


def _write_begin(w: MachineWriter, form: Form) -> None:
    """Write `begin(job, state, who, lane)`, which begins the next sample of the batch in a lane."""
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
    """Write `serve(job, state, who, lane)`, which saves due states. If the sample has ended, it stores the
    results and begins the next sample.
    """
    with w.procedure("serve", "job state who lane:i64") as (job, state, who, lane):
        lanes = Lanes(w, form, state)
        with w.repeated() as leave:
            code, t, goal = (lanes.of(name, lane) for name in ("code", "t", "goal"))
            runs = code.equals(RUNNING)
            leave(code.equals(IDLE) | code.equals(LOCATING) | (runs & t.differs(goal)))
            if form.sampled:
                number, saved = w.load(who, lane, "i64"), w.load(who, lane + w.lanes, "i64")
                next_time = goal_of(w, job, w.load(job, _GOALS, "ptr"), number, saved)
                at_knot = runs & t.differs(next_time)
                with w.when(at_knot):
                    pass_knot(w, lanes, lane)
                    set_goal(w, lanes, lane, next_time)
            with w.when(~at_knot) if form.sampled else nullcontext():
                _save(w, form, job, who, lanes, lane, runs)


def _write_save_within(w: MachineWriter, form: Form, method: TaylorSteps) -> None:
    """Write `save_within(job, state, who, k)`, which saves the states that are due before the end of a step,
    from the Taylor coefficients `k` at its start.
    """
    with w.procedure("save_within", "job state who k") as (job, state, who, k):
        lanes = Lanes(w, form, state)
        every, flags, y = form.integrated, w.room(), w.room(form.integrated)
        times = w.load(job, TIMES, "i64")
        goals = w.load(job, _GOALS, "ptr")
        with w.repeated() as leave:
            goal = lanes["goal"]
            due = ((goal - lanes["t"]) * lanes["direction"] < 0.0) & lanes["code"].differs(IDLE)
            leave(~w.any(due))
            s = goal - lanes["before"]
            with w.counted(every) as row:
                total = w.load(k, row + method.order * every)
                for j in reversed(range(method.order)):
                    total = w.fma(total, s, w.load(k, row + j * every))
                w.store(total, y, row)
            if form.projects:
                w.run("project", state, goal, y)
            w.store(w.where(due, 1.0, 0.0), flags)
            with w.each_lane() as lane, w.when(w.load(flags, lane, "double") > 0.0):
                saved = w.load(who, lane + w.lanes, "i64")
                number = w.load(who, lane, "i64")
                due_now = of_job(w, job, _STATES, times * every, number).after(saved * every)
                handed_out(w, every, y, lane, due_now)
                w.store(saved + 1, who, lane + w.lanes)
                # after the last time no state is due, even if rounding puts an event just beyond that time
                lanes.set("goal", lane, lanes.of("direction", lane) * math.inf)
                with w.when((saved + 1) < times):
                    lanes.set("goal", lane, goal_of(w, job, goals, number, saved + 1))


def _save(
    w: MachineWriter, form: Form, job: Value, who: Value, lanes: Lanes, lane: Value, runs: Value
) -> None:
    """Save the state of a lane at a due time. When the sample has ended, save its state for all remaining
    times and begin the next sample.
    """
    times, goals, every = w.load(job, TIMES, "i64"), w.load(job, _GOALS, "ptr"), form.integrated
    number, saved = w.load(who, lane, "i64"), w.load(who, lane + w.lanes, "i64")
    states = of_job(w, job, _STATES, times * every, number)
    last = w.where(runs, saved + 1, times)
    with w.counted(last, first=saved) as k:
        handed_out(w, every, lanes.pointer, lane, states.after(k * every))
    w.store(last, who, lane + w.lanes)
    with w.when(last < times):
        set_goal(w, lanes, lane, goal_of(w, job, goals, number, last))
    with w.when(last >= times):
        codes = w.room()
        w.store(code_at_end(w, form, lanes), codes)
        lanes.set("code", lane, w.load(codes, lane, "double"))
        end = of_job(w, job, _ENDS, form.returned + len(form.log) + 1, number)
        handed_out(w, form.returned, lanes.pointer, lane, end)
        if most := form.transitions:
            noted = w.converted("fptosi", w.smaller(lanes.of("passed", lane), float(most)), "i64")
            for k in range(0, len(form.log), most):
                log = w.at(lanes.pointer, form.log.start + k)
                handed_out(w, noted, log, lane, end.after(form.returned + k))
        reached = w.converted("sitofp", w.where(runs, times, saved), "double")
        w.store(reached, end.place(form.returned + len(form.log)))
        w.run("begin", job, lanes.pointer, who, lane)
