"""Rates of states at times, as machine code: what a motion's derivatives with respect to its times are made of.

A call is given rows as the loop over steps is (`loop.py`), each with its state and its time in place of those of a start, and returns the rates there; or it
is given cotangents of the rates as well, and returns those of the state and of numbers that the rates are given.
"""

from collections.abc import Callable, Sequence

from jourdain_jax.motion.native import samples
from jourdain_jax.motion.native.functions import Form, write_rates
from jourdain_jax.motion.native.layout import Lanes
from jourdain_jax.motion.native.loop import COUNT, FIRST_ARRAY, FIRST_OF_SAMPLES, NEXT, write_job
from jourdain_jax.motion.native.pulled import write_pulled_rates
from jourdain_jax.motion.native.step import each_row
from jourdain_jax.native.ffi import write_handler
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.threads import lanes_taken, next_lane

_STARTS, _OTHERS, _FOUND = range(FIRST_ARRAY, FIRST_ARRAY + 3)  # what lies between the rows and what is found also says how many rows there are


def write(w: Writer, form: Form) -> None:
    """The module for rates."""
    layout = form.layout
    _write_inputs(w, form)
    write_rates(w, form)

    def rates(state: Value, _: Value, found: Value) -> None:
        w.call("rates", "void", state, Lanes(w, layout, state)["t"], state, found, w.room(w.real, max(len(form.monitored), 1)))

    _write(w, form, layout.integrated, rates)


def write_back(w: Writer, form: Form, asked: Sequence[int]) -> None:
    """The module for cotangents of the state and of what is `asked` for of the numbers known, from those of the rates."""
    layout = form.layout
    _write_inputs(w, form)
    write_pulled_rates(w, form, asked)

    def pulled(state: Value, g: Value, found: Value) -> None:
        to_known = w.at(found, layout.y, w.real)
        each_row(w, range(len(asked)), to_known, lambda i: w.number(0.0))
        w.call("pull_rates", "void", state, Lanes(w, layout, state)["t"], state, g, found, to_known)

    _write(w, form, layout.y + len(asked), pulled, layout.y)


def _write_inputs(w: Writer, form: Form) -> None:
    if form.sampled:
        samples.write_inputs(w, form.layout, form.time_moves)


def _write(w: Writer, form: Form, count: int, evaluate: Callable[[Value, Value, Value], None], others: int = 0) -> None:
    """`evaluate(state, others, found)`: so many numbers for each row, and for so many others that are given with it."""
    with w.function("loop", "ptr", {"job": "ptr"}, attributes="noinline") as (job,):
        _write_rows(w, form, job, count, evaluate, others)
        w.give(Value(w, "ptr", "null"))
    write_handler(w, 2 + samples.arguments(form.layout), 1, lambda arguments, results: write_job(w, form, arguments, results))


def _write_rows(w: Writer, form: Form, job: Value, count: int, evaluate: Callable[[Value, Value, Value], None], others: int) -> None:
    """Rows side by side, until none is left."""
    layout = form.layout
    state, who = w.room(w.real, layout.all), w.room("i64", w.lanes)
    found, more = w.room(w.real, count), w.room(w.real, max(others, 1))
    lanes = Lanes(w, layout, state)
    starts, given, results = (w.load("ptr", job, word) for word in (_STARTS, _OTHERS, _FOUND))
    each_row(w, range(others), more, lambda i: w.number(0.0))
    with w.repeated() as leave:
        leave(~w.together(lanes_taken(w, job, NEXT) < w.load("i64", job, COUNT)))
        with w.counted(0, layout.all) as row:
            w.store(w.number(1.0), state, row)
        with w.counted(0, w.lanes) as lane:
            number = next_lane(w, job, NEXT)
            there = number < w.load("i64", job, COUNT)
            w.store(w.where(there, number, -1), who, lane)
            with w.when(there):
                with w.counted(0, layout.given) as row:
                    w.store(w.load("double", starts, number * layout.given + row), lanes.place(row, lane))
                with w.counted(0, others) as row:
                    w.store(w.load("double", given, number * others + row), w.at(more, row * w.lanes + lane, "double"))
            if form.sampled:  # places without a row are worked out too
                words = w.at(job, FIRST_OF_SAMPLES, "i64")
                samples.begin(w, layout, words, w.load("i64", job, COUNT), lanes, lane, w.where(there, number, 0))
        evaluate(state, more, found)
        with w.counted(0, w.lanes) as lane:
            number = w.load("i64", who, lane)
            with w.when(number >= 0), w.counted(0, count) as row:
                w.store(w.load("double", found, row * w.lanes + lane), results, number * count + row)
