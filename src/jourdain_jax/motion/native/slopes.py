"""Rates of states at times, as machine code: what a motion's derivatives with respect to its times are made of.

A call is given rows as the loop over steps is (`loop.py`), each with its state and its time in place of those of a start, and returns the rates there.
"""

from jourdain_jax.motion.native import samples
from jourdain_jax.motion.native.functions import Form, write_rates
from jourdain_jax.motion.native.layout import Lanes
from jourdain_jax.motion.native.loop import COUNT, FIRST_ARRAY, FIRST_OF_SAMPLES, NEXT, write_job
from jourdain_jax.native.ffi import write_handler
from jourdain_jax.native.ir import Value, Writer

_STARTS, _FOUND = FIRST_ARRAY, FIRST_ARRAY + 2  # the times between them only say how many rows there are


def written(form: Form, lanes: int, fused: bool, threads: int) -> str:
    """The module of LLVM IR."""
    w = Writer(lanes, fused)
    if form.sampled:
        samples.write_inputs(w, form.layout, form.time_moves)
    write_rates(w, form)
    with w.function("loop", "ptr", {"job": "ptr"}, attributes="noinline") as (job,):
        _write_rows(w, form, job)
        w.give(Value(w, "ptr", "null"))
    write_handler(w, 2 + samples.arguments(form.layout), 1, lambda arguments, results: write_job(w, form, arguments, results, threads))
    return w.text


def _write_rows(w: Writer, form: Form, job: Value) -> None:
    """Rows side by side, until none is left."""
    layout, count = form.layout, form.layout.integrated
    state, who = w.room(w.real, layout.all), w.room("i64", w.lanes)
    found, pivots = w.room(w.real, count), w.room(w.real, max(form.pivots, 1))
    lanes = Lanes(w, layout, state)
    starts, rates = w.load("ptr", job, _STARTS), w.load("ptr", job, _FOUND)
    with w.repeated() as leave:
        leave(w.load("i64", job, NEXT) >= w.load("i64", job, COUNT))
        with w.counted(0, layout.all) as row:
            w.store(w.number(1.0), state, row)
        with w.counted(0, w.lanes) as lane:
            number = w.counted_up(job, NEXT)
            there = number < w.load("i64", job, COUNT)
            w.store(w.where(there, number, -1), who, lane)
            with w.when(there), w.counted(0, layout.given) as row:
                w.store(w.load("double", starts, number * layout.given + row), lanes.place(row, lane))
            if form.sampled:  # places without a row are worked out too
                words = w.at(job, FIRST_OF_SAMPLES, "i64")
                samples.begin(w, layout, words, w.load("i64", job, COUNT), lanes, lane, w.where(there, number, 0))
        w.call("rates", "void", state, lanes["t"], state, found, pivots)
        with w.counted(0, w.lanes) as lane:
            number = w.load("i64", who, lane)
            with w.when(number >= 0), w.counted(0, count) as row:
                w.store(w.load("double", found, row * w.lanes + lane), rates, number * count + row)
