"""One step of lanes side by side, as in `motion/integrators/erk_step.py`, which says what it does and why."""

import math
import operator
from collections.abc import Callable
from functools import partial, reduce
from typing import NamedTuple

import numpy as np

from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.motion.integrators.erk_step import AMPLIFIED, LARGEST_FACTOR, LEAST_FACTOR, LOCATING, NEAR_SINE, NOISE, RUNNING, SAFETY, Method
from jourdain_jax.motion.integrators.event_search import DIFFERENTIABLE
from jourdain_jax.motion.native import crossings, search
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.layout import Lanes, Layout
from jourdain_jax.motion.native.taylor import TaylorSteps, at_time, jet, monitored_at, radius, slope
from jourdain_jax.motion.trajectories import results
from jourdain_jax.native.exponentials import power
from jourdain_jax.native.ir import Value, Writer

IDLE = -9.0  # code of a place that has no lane


class Trial(NamedTuple):
    """A step that is tried by all lanes."""

    t1: Value
    step: Value
    y1: Value  # pointer: the state after it
    accept: Value
    next_h: Value  # positive
    pivot: Value | None  # the smallest magnitude of a pivot that is monitored


def write_step(w: Writer, form: Form, method: Method | TaylorSteps) -> None:
    """`step(state, k)`: one step, tried by all lanes that are on their way; `k`: room for the slopes of its stages, or for Taylor coefficients."""
    with w.function("step", "void", {"state": "ptr noalias", "k": "ptr noalias"}, attributes="noinline") as (state, k):
        lanes = Lanes(w, form.layout, state)
        if form.relations:
            crossings.write_begin(w, form, lanes)
        if isinstance(method, TaylorSteps):
            _take(w, form, method, lanes, w.at(k, form.layout.integrated, w.real), _tried_by_series(w, form, method, lanes, k))
        else:
            _take(w, form, method, lanes, k, _tried_by_stages(w, form, method, lanes, k))
        w.give()


def _tried_by_stages(w: Writer, form: Form, method: Method, p: Lanes, k: Value) -> Trial:
    """A step of a Runge-Kutta method, which ends at the next time to save at, if not before."""
    layout, y = form.layout, p.pointer  # the state comes first in the rows of a lane
    t, h, goal, direction = p["t"], p["h"], p["goal"], p["direction"]
    locating = p["code"].equals(float(LOCATING))
    rest = w.magnitude(goal - t)
    reach = crossings.reach(w, form, p, h)
    lands = ~locating & (reach >= 0.999 * rest)
    size = w.where(lands, rest, w.where(2.0 * reach > rest, 0.5 * rest, reach))
    shortened = size < h
    step = w.where(locating, p["search_shift"], direction * size) if form.has_events else direction * size
    t1 = w.where(lands, goal, t + step)
    step = t1 - t
    smallest, changed_sign, rank = _stages(w, form, method, p, k, t, step)
    y1, error = w.room(w.real, layout.integrated), w.room(w.real, layout.y)
    each_row(w, range(layout.integrated), y1, lambda i: w.fma(step, weighted(w, method.b, k, layout, i), w.load(w.real, y, i)))
    each_row(w, range(layout.y), error, lambda i: step * weighted(w, method.b_error, k, layout, i))
    if form.projects:
        _project(w, layout, p, t1, y1, error, rank)
    size_of_error = _norm(w, layout, p, error, y1)
    if form.pivots or form.directions:
        size_of_error = w.where(changed_sign & ~locating, math.inf, size_of_error)
    accept = locating | (size_of_error <= 1.0)
    factor = SAFETY * power(w, w.where(size_of_error > 0.0, size_of_error, 1e-30), -1 / method.order)
    factor = w.larger(w.where(size_of_error < math.inf, factor, 0.0), LEAST_FACTOR)
    factor = w.smaller(factor, w.where(accept, LARGEST_FACTOR, w.number(1.0)))
    proposed = w.smaller(size * factor, p["longest"])
    next_h = w.where(accept & shortened, w.larger(proposed, h), proposed)
    return Trial(t1, step, y1, accept, next_h, smallest if form.pivots else None)


def _tried_by_series(w: Writer, form: Form, method: TaylorSteps, p: Lanes, k: Value) -> Trial:
    """A step by Taylor series, which goes over the times to save at; puts the coefficients into `k`, and after them the slope at the end of the step."""
    layout, count = form.layout, form.layout.integrated
    t, last_goal, direction = p["t"], p["last_goal"], p["direction"]
    locating = p["code"].equals(float(LOCATING))
    rows, at_start = jet(w, form, p, t, method.order)
    for row, series in enumerate(rows):
        for j, x in enumerate(series):
            w.store(w.number(0.0) if x is None else x, k, j * count + row)
    length = w.smaller(radius(w, layout, p, rows), p["longest"])
    size = crossings.reach(w, form, p, w.smaller(length, p["bound"]))
    rest = w.magnitude(last_goal - t)
    lands = ~locating & (size >= 0.999 * rest)
    size = w.where(lands, rest, size)
    step = w.where(locating, p["search_shift"], direction * size) if form.has_events else direction * size
    t1 = w.where(lands, last_goal, t + step)
    step = t1 - t
    y1, pivot, accept = w.room(w.real, count), None, size > 0.0
    for row, series in enumerate(rows):
        w.store(at_time(w, series, step), y1, row)
        if form.has_events:
            w.store(at_time(w, slope(series), step), k, (method.order + 1) * count + row)
    at_end = monitored_at(w, form, p, t1, y1)
    holds = at_start.holds & at_end.holds
    w.store(w.where(holds, w.load(w.real, y1), math.nan), y1)
    accept, length = accept & holds, w.where(at_start.holds, length, 0.0)
    for a, b in zip(at_start.values[: form.pivots], at_end.values, strict=False):
        least = w.smaller(w.magnitude(a), w.magnitude(b))
        pivot = least if pivot is None else w.smaller(pivot, least)
        accept = accept & ~(((a < 0.0) & (b > 0.0)) | ((a > 0.0) & (b < 0.0)))
    accept = accept & ~_turns_round(w, form, at_start.values, at_end.values)
    if form.projects:
        error = w.room(w.real, layout.y)
        each_row(w, range(layout.y), error, lambda i: w.number(0.0))
        _project(w, layout, p, t1, y1, error)
        accept = accept & (_norm(w, layout, p, error, y1) <= 1.0)
    accept = locating | accept
    p["bound"] = w.where(accept, math.inf, 0.5 * size)
    p["before"] = t
    return Trial(t1, step, y1, accept, w.where(accept, length, w.smaller(length, 0.5 * size)), pivot)


def _take(w: Writer, form: Form, method: Method | TaylorSteps, p: Lanes, k: Value, trial: Trial) -> None:
    """What becomes of the lanes after a step that was tried; `k`: slopes, the one at the start first."""
    layout, y = form.layout, p.pointer
    rows = range(layout.integrated)
    t, code, direction = p["t"], p["code"], p["direction"]
    locating = code.equals(float(LOCATING))
    watched = crossings.watched(w, form, p, trial.t1, trial.step, trial.y1, trial.accept & ~locating) if form.relations else None
    if watched is not None:
        trial = trial._replace(
            accept=trial.accept & ~watched.refused, next_h=w.where(watched.refused, w.where(watched.falls, watched.to_event, p["h"]), trial.next_h)
        )
    t1, step, y1, accept, next_h, _ = trial
    accepted = p["accepted"] + _count(w, accept & ~locating)
    rejected = p["rejected"] + _count(w, ~accept)
    too_short = (next_h < p["shortest"]) | (t1 + direction * next_h).equals(t1)
    arrived = accept & t1.equals(p["last_goal"])
    new_code = w.where(((accepted + rejected) >= p["max_steps"]) & ~arrived, float(results.MAX_STEPS), float(RUNNING))
    new_code = w.where(too_short, float(results.STEP_TOO_SMALL), new_code)
    new = {"t": w.where(accept, t1, t), "h": next_h, "code": new_code, "accepted": accepted, "rejected": rejected}
    new["taken"] = w.where(accept, step, 0.0)  # by how far the state has gone on
    each_row(w, rows, y1, lambda i: w.where(accept, w.load(w.real, y1, i), w.load(w.real, y, i)))
    if form.has_events:
        new = _monitored(w, form, method, p, k, trial, new)
    if trial.pivot is not None:
        counts = accept & ~locating & new["code"].equals(float(RUNNING)) & new["t"].equals(t1)
        pivot = w.where(counts, w.smaller(p["pivot"], trial.pivot), p["pivot"])
        new |= {"pivot": pivot, "code": w.where(counts & (pivot < SMALLEST_PIVOT), float(results.SINGULAR_PARTITION), new["code"])}
    moving = locating | code.equals(float(RUNNING))
    if watched is not None:
        stays = accept & ~locating & new["code"].equals(float(RUNNING)) & new["t"].equals(t1)
        crossings.note(w, p, watched, t1, moving, stays | (locating & new["code"].equals(float(results.EVENT))))
    each_row(w, rows, y, lambda i: w.where(moving, w.load(w.real, y1, i), w.load(w.real, y, i)))
    for name, value in new.items():
        p[name] = w.where(moving, value, w.number(0.0) if name == "taken" else p[name])


def for_rows(w: Writer, rows: range, body: Callable[[int | Value], object]) -> None:
    """`body` for the number of every row."""
    # 12 numbers of a state; more are gone through by loops, whose code is short
    if len(rows) <= 12:
        for i in rows:
            body(i)
    else:
        with w.counted(rows.start, rows.stop) as i:
            body(i)


def each_row(w: Writer, rows: range, into: Value, value: Callable[[int | Value], Value]) -> None:
    """Sets rows of a state in memory."""
    for_rows(w, rows, lambda i: w.store(value(i), into, i))


def over_rows(w: Writer, rows: range, start: float, added: Callable[[Value, int | Value], Value]) -> Value:
    """What `added(total, i)` makes of all rows one after the other."""
    total = w.room(w.real)
    w.store(w.number(start), total)
    for_rows(w, rows, lambda i: w.store(added(w.load(w.real, total), i), total))
    return w.load(w.real, total)


class Rank(NamedTuple):
    """How near to a loss of rank the rows are in a step."""

    near: Value  # at its start
    square: Value  # the smallest squared sine between a row and those before it, of all stages


def _stages(w: Writer, form: Form, method: Method, p: Lanes, k: Value, t: Value, step: Value) -> tuple[Value, Value, Rank | None]:
    """The smallest magnitude of a pivot, whether any changed its sign, and how near rows are to losing rank; puts the slopes of all stages into `k`."""
    layout, count = form.layout, form.pivots
    every, turned = layout.integrated, w.literal(0, w.truth)
    first: list[Value] = []
    at, pivots = w.room(w.real, every), w.room(w.real, max(len(form.monitored), 1))
    rank, square = None, w.room(w.real)
    low, high = [w.number(math.inf)] * count, [w.number(-math.inf)] * count

    def next_state(i: int, row: int | Value) -> Value:
        start = w.load(w.real, p.pointer, row)
        return w.fma(step, weighted(w, method.A[i], k, layout, row), start) if i else start

    for i in range(method.needed):
        time = w.fma(step, float(method.c[i]), t)
        each_row(w, range(every), at, partial(next_state, i))
        if rank is not None:
            put_near_rows(w, layout, p.pointer, rank.near, time, at)
        w.call("rates", "void", p.pointer, time, at, w.at(k, i * every, w.real), pivots)
        now = [w.load(w.real, pivots, j) for j in range(len(form.monitored) - len(form.squares))]
        if form.squares:
            by_rows = squares_of(w, form, pivots)
            if rank is None:
                rank = Rank(near_rank_loss(by_rows), square)
                w.store(w.number(math.inf), square)
            with w.when(w.any(rank.near)):
                w.store(reduce(w.smaller, [left / size for left, size in by_rows], w.load(w.real, square)), square)
        first = first or now
        turned = turned | _turns_round(w, form, first, now)
        low, high = [w.smaller(a, b) for a, b in zip(low, now, strict=False)], [w.larger(a, b) for a, b in zip(high, now, strict=False)]
    smallest, changed = w.number(math.inf), turned
    for a, b in zip(low, high, strict=True):
        smallest = w.smaller(smallest, w.smaller(w.magnitude(a), w.magnitude(b)))
        changed = changed | ((a < 0.0) & (b > 0.0))
    return smallest, changed, rank if rank is None else rank._replace(square=w.load(w.real, square))


def squares_of(w: Writer, form: Form, monitored: Value) -> list[tuple[Value, Value]]:
    """What is left of each row beside those before it, and its size, squared."""
    found = [w.load(w.real, monitored, j) for j in range(len(form.monitored) - len(form.squares), len(form.monitored))]
    return list(zip(found[::2], found[1::2], strict=True))


def near_rank_loss(squares: list[tuple[Value, Value]]) -> Value:
    """Whether some row is nearly one of those before it."""
    return any_of([left < NEAR_SINE**2 * size for left, size in squares])


def put_near_rows(w: Writer, layout: Layout, state: Value, near: Value, t: Value, y: Value) -> None:
    """Puts the state `y` of a stage back onto the rows in lanes that are `near` a loss of rank."""
    with w.when(w.any(near)):
        put = w.room(w.real, layout.integrated)
        each_row(w, range(layout.integrated), put, lambda i: w.load(w.real, y, i))
        w.call("project", "void", state, t, put)
        each_row(w, range(layout.integrated), y, lambda i: w.where(near, w.load(w.real, put, i), w.load(w.real, y, i)))


def _turns_round(w: Writer, form: Form, first: list[Value], now: list[Value]) -> Value:
    """Return whether the angle between a direction of a row and its first direction is not acute."""
    acute = [reduce(operator.add, (first[k] * now[k] for k in row)) > 0.0 for row in form.directions]
    return ~reduce(operator.and_, acute) if acute else w.literal(0, w.truth)


def weighted(w: Writer, weights: np.ndarray, k: Value, layout: Layout, row: int | Value) -> Value:
    """sum_j w_j k_j of one number of the state."""
    used = [j for j in range(len(weights)) if weights[j] != 0]
    total = w.load(w.real, k, used[0] * layout.integrated + row) * float(weights[used[0]])
    for j in used[1:]:
        total = w.fma(w.load(w.real, k, j * layout.integrated + row), float(weights[j]), total)
    return total


def _project(w: Writer, layout: Layout, p: Lanes, t1: Value, y1: Value, error: Value, rank: Rank | None = None) -> None:
    """Puts `y1` back onto the rows; the error is no smaller than how far that moved it, beyond noise."""
    free = w.room(w.real, layout.y)
    each_row(w, range(layout.y), free, lambda i: w.load(w.real, y1, i))
    w.call("project", "void", p.pointer, t1, y1)
    amplified = None if rank is None else w.where(rank.near, w.smaller(AMPLIFIED * search.EPS / rank.square, search.EPS ** (1 - NOISE)), 0.0)
    if rank is not None:
        with w.when(w.any(rank.near)):
            both = w.room(w.real, 2 * layout.y)
            each_row(w, range(layout.y), both, lambda i: w.load(w.real, y1, i))
            each_row(w, range(layout.y), w.at(both, layout.y, w.real), lambda i: w.load(w.real, error, i))
            w.call("along", "void", p.pointer, t1, both)
            each_row(w, range(layout.y), error, lambda i: w.where(rank.near, w.load(w.real, both, i + layout.y), w.load(w.real, error, i)))
    for part in layout.parts:
        largest = over_rows(w, part, 0.0, lambda largest, i: w.larger(largest, w.magnitude(w.load(w.real, y1, i))))
        noise = (search.EPS**NOISE if amplified is None else w.larger(amplified, search.EPS**NOISE)) * largest
        by_rows = None if amplified is None else amplified * amplified * largest

        def larger_error(i: int | Value, noise: Value = noise, by_rows: Value | None = by_rows) -> Value:
            moved = w.magnitude(w.load(w.real, y1, i) - w.load(w.real, free, i)) - noise
            along = w.magnitude(w.load(w.real, error, i))
            return w.larger(along if by_rows is None else along - by_rows, w.larger(moved, 0.0))

        each_row(w, part, error, larger_error)


def _norm(w: Writer, layout: Layout, p: Lanes, error: Value, y1: Value) -> Value:
    """Root mean square of the errors of coordinates and speeds, relative to what is allowed; infinite where one is no number."""
    rtol, atol, count = p["rtol"], p["atol"], layout.coordinates + layout.speeds

    def added(total: Value, i: int | Value) -> Value:
        size = w.larger(w.magnitude(w.load(w.real, p.pointer, i)), w.magnitude(w.load(w.real, y1, i)))
        relative = w.load(w.real, error, i) / w.fma(rtol, size, atol)
        return w.fma(relative, relative, total)

    total = over_rows(w, range(count), 0.0, added) / float(count)
    return w.root(w.where(w.is_nan(total), math.inf, total))


def _count(w: Writer, happens: Value) -> Value:
    return w.where(happens, 1.0, w.number(0.0))


def _monitored(w: Writer, form: Form, method: Method | TaylorSteps, p: Lanes, k: Value, trial: Trial, new: dict[str, Value]) -> dict[str, Value]:
    """The step in which an event may have happened or is being located, or before which one has; changes the state after it."""
    layout, count, y, y1, step = form.layout, form.layout.events, p.pointer, trial.y1, trial.step
    t, code, rows = p["t"], p["code"], range(layout.integrated)
    locating, fresh = code.equals(float(LOCATING)), (p["accepted"] + p["rejected"]).equals(0.0)
    accept = trial.accept & ~locating & new["code"].equals(float(RUNNING))

    def events(t: Value, y: Value, stage: int) -> tuple[list[Value], list[Value]]:
        values, rates = w.room(w.real, count), w.room(w.real, count)
        w.call("events", "void", p.pointer, t, y, w.at(k, stage * layout.integrated, w.real), values, rates)
        return [w.load(w.real, values, i) for i in range(count)], [w.load(w.real, rates, i) for i in range(count)]

    c_0, rate_0 = events(t, y, 0)
    c_1, rate_1 = events(new["t"], y1, method.at_the_end)
    dips, share = search.dip(w, step, c_0, rate_0, c_1, rate_1)
    sunk, sinks = search.at_start(w, p, c_0, rate_0, c_1)
    again = any_of(sinks) & (w.magnitude(step) > search.reach_of_noise(w, p))
    dips, share = accept & (dips | again), w.where(again, 0.5, share)
    happened = accept & ~dips & ~search.no_event(w, c_1)
    was_trying = p["search_left"] > DIFFERENTIABLE + 1.0
    changes, first = happened | locating, w.room(w.real)
    w.store(p["event"], first)
    with w.when(w.any(changes)):
        w.store(search.advance(w, p, happened, was_trying, locating, (t, c_0, rate_0), (new["t"], c_1)), first)
    left, shift = p["search_left"], p["search_shift"]
    found, back = locating & left.equals(0.0), changes & (left > DIFFERENTIABLE + 1.0)
    # a motion that starts beyond an event has no motion at all
    finite = over_rows(w, range(layout.y), 0.0, lambda total, i: total + 0.0 * w.load(w.real, y, i)).equals(0.0)
    over = (fresh & finite & any_of(sunk)) | (accept & ~again & any_of(sinks))
    which = w.number(float(count - 1))
    for i in reversed(range(count - 1)):
        which = w.where(sunk[i] | sinks[i], float(i), which)
    stays = back | dips | over

    def state(i: int | Value) -> Value:
        after = w.load(w.real, y1, i)
        return w.where(stays, w.load(w.real, y, i), w.where(found, w.fma(shift, w.load(w.real, k, i), after), after))

    each_row(w, rows, y1, state)
    if form.moving:
        _put_tangents_at_event(w, form, p, k, found, new["t"], rate_0, y1)
    tried = _count(w, dips)
    now = w.where(found, float(results.EVENT), w.where(locating, float(LOCATING), new["code"]))
    new = {
        "t": w.where(found, new["t"] + shift, w.where(stays, t, new["t"])),
        "taken": w.where(stays, 0.0, new["taken"]),
        "h": w.where(dips, share * w.magnitude(step), w.where(locating, p["h"], new["h"])),
        "code": w.where(happened, float(LOCATING), now),
        "accepted": new["accepted"] - tried,
        "rejected": new["rejected"] + tried,
        "event": w.where(happened | (locating & was_trying), w.load(w.real, first), p["event"]),
    }
    begun = {"h": p["h"], "code": w.number(float(results.EVENT)), "accepted": p["accepted"], "rejected": p["rejected"], "event": which}
    return new | {name: w.where(over, value, new[name]) for name, value in begun.items()}


def any_of(found: list[Value]) -> Value:
    """Whether any holds."""
    return reduce(operator.or_, found)


def _put_tangents_at_event(w: Writer, form: Form, p: Lanes, k: Value, found: Value, t: Value, rate: list[Value], y1: Value) -> None:
    """Where an event is found at the time t in the state `y1`, the tangents of that time, and those of the state there; `k`: the rates.

    Each tangent of time is found in turn, the state being moved by it, with e the directions taken together in it,

        dt = -(dc/dt dt + dc/dy dy + dc/dp dp)/cdot,   y <- y + e dt f(t, y),   t <- t + e dt,   e^2 = 0

    where values, tangents and rates are those before; dt is NaN where c has no slope there.
    """
    layout, count, times = form.layout, form.layout.events, form.layout.rows["dt"]
    with w.when(w.any(found)):
        values, pivots = w.room(w.real, count * len(times)), w.room(w.real, max(len(form.monitored), 1))
        slope = search.chosen(w, p["event"], rate)
        usable = found & slope.differs(0.0) & (w.magnitude(slope) < math.inf)
        flat = found & search.is_flat(w, p, slope)
        for part, row in enumerate(times, 1):
            if part > 1:  # what is known of the rates is of the state as it was
                k = w.room(w.real, layout.integrated)
                w.call("rates", "void", p.pointer, t, y1, k, pivots)
            w.call("event_tangents", "void", p.pointer, t, y1, values)
            dc = search.chosen(w, p["event"], [w.load(w.real, values, (part - 1) * count + i) for i in range(count)])
            dt = w.where(flat, math.nan, w.where(usable, -dc / slope, 0.0))
            w.store(w.where(found, dt, w.load(w.real, p.pointer, row)), p.pointer, row)
            for other in range(len(times) + 1):
                if not other & part:
                    _move_rows(w, layout, y1, k, (other | part) * layout.y, other * layout.y, dt, usable | flat)


def _move_rows(w: Writer, layout: Layout, y: Value, k: Value, rows: int, rates: int, dt: Value, moves: Value) -> None:
    """Adds the rates that begin with row `rates` of `k`, times `dt`, to those that begin with row `rows` of `y`."""

    def moved(i: int | Value) -> Value:
        before = w.load(w.real, y, i + rows)
        return w.where(moves, w.fma(w.load(w.real, k, i + rates), dt, before), before)

    for_rows(w, range(layout.y), lambda i: w.store(moved(i), y, i + rows))
