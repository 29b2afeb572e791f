"""Reverse mode of events: convert cotangents at the time and state of an event to cotangents at a fixed time.

A motion that ends at a stop event has the end time t_e = t - c(t, y)/cdot and the final state y - f c/cdot.
Hence

    s = -(g_t + g_y . f)/cdot,   g_y += s dc/dy,   g_p += s dc/dp

c: value of the event; f: rates; g: cotangents. For transitions see `transitions.py: reset_back`.
"""

import math

from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.event_search import slope_is_flat
from jourdain_jax.integrate.event_values import chosen
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, MachineWriter, Number, StepWriter, copied, each_row
from jourdain_jax.integrate.loop.loop import of_job
from jourdain_jax.integrate.loop.record import TO_ENDS
from jourdain_jax.integrate.loop.transitions import is_noted, reset_back
from jourdain_jax.kernels.ffi import taken_in


def write_event_back(w: MachineWriter, form: Form, asked: int) -> None:
    """Write the function `event_back(job, state, who, g, by_known)` of machine code. It takes the cotangents
    of the end time from the job.
    """
    with w.procedure("event_back", "job state who g by_known") as (job, state, who, g, by_known):
        located = is_located(w, Lanes(w, form, state))
        with w.when(w.any(located)):
            g_t = w.room(1 + len(form.moving))
            with w.each_lane() as lane:
                number = w.load(who, lane, "i64")
                end = of_job(w, job, TO_ENDS, form.ends, w.where(number >= 0, number, 0))
                taken_in(w, 1 + len(form.moving), end.after(form.integrated), g_t, lane)
            event_back(w, form, asked, state, located, g_t, g, by_known)


def write_transition_back(w: MachineWriter, form: Form, asked: int) -> None:
    """Write the function `reset_back(job, state, who, left, g, by_known)` of machine code. It takes the
    cotangents of the transition's time from the job.
    """
    with w.procedure("reset_back", "job state who left g by_known") as (job, state, who, left, g, by_known):
        lanes, g_t, numbers = Lanes(w, form, state), w.room(1 + len(form.moving)), w.room()
        w.store(w.where(is_noted(w, form, w.load(left)), w.load(left), 0.0), numbers)
        each_row(w, 1 + len(form.moving), g_t, lambda i: 0.0)
        with w.each_lane() as lane:
            number = w.load(who, lane, "i64")
            with w.when(w.load(numbers, lane, "double").differs(0.0) & (number >= 0)):
                passed = lanes.of("passed", lane) - 1.0
                lanes.set("passed", lane, passed)
                with w.when(passed < float(form.transitions)):
                    end = of_job(w, job, TO_ENDS, form.ends, number)
                    first = w.converted("fptosi", passed, "i64") + (form.integrated + 1 + len(form.moving))
                    for part in range(1 + len(form.moving)):
                        g_of = w.load(end.place(first + part * form.transitions), type="double")
                        w.store(g_of, w.at(g_t, part * w.lanes + lane, "double"))
        reset_back(w, form, asked, state, left, g_t, g, by_known)


def is_located(w: StepWriter, lanes: Lanes) -> Number:
    """Return which lanes ended at an event located by a search."""
    return w.equal(lanes["code"], result_codes.EVENT) & (lanes["accepted"] > 0.0)


def event_back(
    w: StepWriter,
    form: Form,
    asked: int,
    state: Number,
    located: Number,
    g_t: Number,
    g: Number,
    by_known: Number,
) -> None:
    """Convert cotangents of the state and time of an event to cotangents of the state at a fixed time."""
    lanes, count = Lanes(w, form, state), form.integrated
    f, out, pivots, added = (w.room(max(n, 1)) for n in (count, count, len(form.monitored), asked + 1))
    values, rates, weights = (w.room(form.events) for _ in range(3))
    t = lanes["t"]
    w.run("rates", state, t, state, f, pivots)
    if form.moving:  # compute the tangent and its rates at a fixed time
        dy, dt = w.at(state, form.y), lanes["dt"]
        each_row(w, form.y, dy, lambda i: w.load(dy, i) - w.where(w.differs(dt, 0.0), dt * w.load(f, i), 0.0))
        lanes["dt"] = w.number(0.0)
        w.run("rates", state, t, state, f, pivots)
    w.run("events", state, t, state, f, values, rates)
    rate = chosen(w, lanes["event"], [w.load(rates, i) for i in range(form.events)])
    usable = located & w.differs(rate, 0.0) & (w.magnitude(rate) < math.inf)
    each_row(w, asked + 1, added, lambda i: 0.0)
    total = w.load(g_t)
    if form.moving:
        total = total + _moved_back(w, form, lanes, usable, (g, w.load(g_t, 1)), (out, added), asked)
    for i in range(count):
        total = w.fma(w.load(g, i), w.load(f, i), total)
    flat = located & slope_is_flat(w, lanes, rate) & w.differs(total, 0.0)
    by_value = w.where(usable & ~flat, -total / rate, 0.0)
    for i in range(form.events):
        w.store(w.where(w.equal(lanes["event"], i), by_value, 0.0), weights, i)
    w.run("pull_events", state, t, state, weights, out, added)

    def with_event(before: Number, more: Number) -> Number:
        return before + w.where(flat, math.nan, w.where(usable, more, 0.0))

    each_row(w, count, g, lambda i: with_event(w.load(g, i), w.load(out, i)))
    each_row(w, asked, by_known, lambda i: with_event(w.load(by_known, i), w.load(added, i)))


def _moved_back(
    w: StepWriter, form: Form, lanes: Lanes, usable: Number, cotangents: tuple, rooms: tuple, asked: int
) -> Number:
    """Pull cotangents back through the effect of an event on a tangent: update the cotangents `g` of the
    state, and add to those of the known numbers. Return the derivative with respect to time.
    """
    (g, g_dt), (out, added) = cotangents, rooms
    given, count = w.room(form.integrated + 2), form.integrated
    copied(w, count, g, given)
    w.store(g_dt, given, count)
    w.store(lanes["event"], given, count + 1)
    w.run("pull_moved", lanes.pointer, lanes["t"], lanes.pointer, given, out, added)
    each_row(w, count, g, lambda i: w.load(given, i) + w.where(usable, w.load(out, i), 0.0))
    return w.load(added, asked)
