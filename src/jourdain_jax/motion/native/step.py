"""One step of lanes side by side, as in `motion/integrators/erk_step.py`, which says what it does and why; relations whose signs are watched
(`motion/integrators/crossings.py`), stop events and the search for one (`motion/integrators/event_search.py`) by the formulas there.
"""

import math
import operator
from functools import reduce
from typing import NamedTuple

import numpy as np

from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.motion.integrators.crossings import Crossings, Watched, noted, reach, unless_zero
from jourdain_jax.motion.integrators.crossings import watched as watched_by
from jourdain_jax.motion.integrators.erk_step import AMPLIFIED, LEAST_SHARE, NEAR_SINE, NOISE
from jourdain_jax.motion.integrators.event_search import LOCATING, RUNNING, Search, advanced, any_of, chosen, decided
from jourdain_jax.motion.integrators.explicit_steps import Aim, Method, aimed, judged, taken
from jourdain_jax.motion.native.functions import put_tangents
from jourdain_jax.motion.native.layout import Form, Lanes, MachineWriter, copied, each_row
from jourdain_jax.motion.native.taylor import TaylorSteps, at_time, jet, monitored_at, radius, slope
from jourdain_jax.motion.trajectories import results
from jourdain_jax.native.ir import Value


def _crossings_of(p: Lanes) -> Crossings:
    """The signs so far."""
    return Crossings(tuple(p.every("last")), p["crossing_by"], p["crossings"], p["together"])


def _write_first_signs(w: MachineWriter, form: Form, p: Lanes) -> None:
    """The signs at the start of a motion, in lanes that have tried no step."""
    fresh = w.equal(p["accepted"] + p["rejected"], 0.0)

    def begin() -> None:
        now = unless_zero(w, _relations(w, form, p, p["t"], p.pointer), [w.number(0.0)] * len(form.watched))
        p.put("last", [w.where(fresh, new, old) for new, old in zip(now, p.every("last"), strict=True)])
        p["crossing_by"] = w.where(fresh, p["direction"] * math.inf, p["crossing_by"])

    w.if_any(fresh, begin)


def _relations(w: MachineWriter, form: Form, p: Lanes, t: Value, y: Value) -> list[Value]:
    values = w.room(len(form.watched))
    w.run("relations", p.pointer, t, y, values)
    return [w.load(values, i) for i in range(len(form.watched))]


def _watched(w: MachineWriter, form: Form, p: Lanes, t1: Value, step: Value, y1: Value, fits: Value) -> Watched:
    """What a step to the state `y1` crosses; `fits`: it would be accepted."""

    def between(once: Value, share: Value, now: tuple[Value, ...]) -> list[Value]:
        found = w.room(len(now))
        for i, x in enumerate(now):
            w.store(x, found, i)

        def look() -> None:
            y, part = w.room(form.integrated), w.where(once, share, 0.0)
            for i in range(form.q_and_v):
                start = w.load(p.pointer, i)
                w.store(w.fma(part, w.load(y1, i) - start, start), y, i)
            for i, x in enumerate(unless_zero(w, _relations(w, form, p, w.fma(part, step, p["t"]), y), now)):
                w.store(x, found, i)

        w.if_any(once, look)
        return [w.load(found, i) for i in range(len(now))]

    return watched_by(w, _crossings_of(p), _relations(w, form, p, t1, y1), len(form.relations), between, fits, step, p["last_goal"])


def _note_signs(w: MachineWriter, p: Lanes, step: Watched, t1: Value, moving: Value, counts: Value) -> None:
    """The signs after a step to `t1`, in lanes that are `moving`, and in which it `counts` or not."""
    old, new = _crossings_of(p), noted(w, _crossings_of(p), step, t1, p["direction"], counts)
    p.put("last", [w.where(moving, *pair) for pair in zip(new.last, old.last, strict=True)])
    for name, *pair in (("crossing_by", new.by, old.by), ("crossings", new.count, old.count), ("together", new.together, old.together)):
        p[name] = w.where(moving, *pair)


def _search_of(p: Lanes, count: int) -> Search:
    """The search in the rows of lanes, for one of so many events."""
    values = p.every("search_c")
    c = tuple(tuple(values[i * count : (i + 1) * count]) for i in range(3))
    step, left, shift = (p[f"search_{name}"] for name in ("step", "left", "shift"))
    return Search(tuple(p.every("search_t")), c, step, left, shift, tuple(p.every("search_slope")))


def _monitored(w: MachineWriter, form: Form, p: Lanes, k: tuple[Value, Value], y1: Value, new: dict[str, Value], h: Value, accept: Value) -> dict[str, Value]:
    """The step in which an event may have happened or is being located, or before which one has; changes the state `y1` after it.

    `k`: slopes at its ends; `accept`: it is a step of the motion.
    """
    count, y, t = form.events, p.pointer, p["t"]

    def events(t: Value, y: Value, slope: Value) -> list[list[Value]]:
        values, rates = w.room(count), w.room(count)
        w.run("events", p.pointer, t, y, slope, values, rates)
        return [[w.load(place, i) for i in range(count)] for place in (values, rates)]

    c_0, rate_0 = events(t, y, k[0])
    c_1, rate_1 = events(new["t"], y1, k[1])

    def advance(begins: Value, changes: Value) -> tuple[Search, Value]:
        first = w.room()
        w.store(p["event"], first)

        def follow() -> None:
            old = _search_of(p, count)
            found, event = advanced(w, old, begins, (t, c_0, rate_0), (new["t"], c_1))
            newton = w.where(event.usable & ~event.beyond, -chosen(w, event.first, c_1) / chosen(w, event.first, rate_0), 0.0)
            rows = {"t": found.t, "c": [x for part in found.c for x in part], "step": [found.step], "left": [found.left], "slope": found.slope}
            rows["shift"] = [w.where(event.trying, found.shift, newton)]
            for name, values in rows.items():
                p.put(f"search_{name}", [w.where(changes, a, b) for a, b in zip(values, p.every(f"search_{name}"), strict=True)])
            w.store(w.literal(event.first, w.real), first)

        w.if_any(changes, follow)
        return _search_of(p, count), w.load(first)

    # a motion that starts beyond an event has no motion at all
    sound = w.equal(w.sum_of_squares(range(form.y), lambda i: 0.0 * w.load(y, i)), 0.0)
    found = decided(w, p, new, h, (c_0, rate_0, c_1, rate_1), accept, sound, (_search_of(p, count), advance))

    def state(i: int | Value) -> Value:
        after = w.load(y1, i)
        return w.where(found.stays, w.load(y, i), w.where(found.found, w.fma(found.search.shift, w.load(k[0], i), after), after))

    each_row(w, form.integrated, y1, state)
    if form.moving:
        put_tangents(w, form, p, k[0], found.found, new["t"], rate_0, y1)
    return new | found.new | {"taken": w.where(found.stays, 0.0, new["taken"])}


IDLE = -9.0  # code of a place that has no lane


class Trial(NamedTuple):
    """A step that is tried by all lanes."""

    aim: Aim
    y1: Value  # pointer: the state after it
    accept: Value
    next_h: Value  # positive
    pivot: Value | None  # the smallest magnitude of a pivot that is monitored


def write_step(w: MachineWriter, form: Form, method: Method | TaylorSteps) -> None:
    """`step(state, k)`: one step, tried by all lanes that are on their way; `k`: room for the slopes of its stages, or for Taylor coefficients."""
    with w.procedure("step", "state:noalias k:noalias") as (state, k):
        step(w, form, method, state, k)


def step(w: MachineWriter, form: Form, method: Method | TaylorSteps, state, k) -> None:
    """Try one step of all lanes that are on their way."""
    lanes = Lanes(w, form, state)
    if form.relations:
        _write_first_signs(w, form, lanes)
    if isinstance(method, TaylorSteps):
        _take(w, form, method, lanes, w.at(k, form.integrated), _tried_by_series(w, form, method, lanes, k))
    else:
        _take(w, form, method, lanes, k, _tried_by_stages(w, form, method, lanes, k))


def _tried_by_stages(w: MachineWriter, form: Form, method: Method, p: Lanes, k: Value) -> Trial:
    """A step of a Runge-Kutta method, which ends at the next time to save at, if not before."""
    aim = aimed(w, p, p["goal"], _reach(w, form, p, p["h"]), p["search_shift"] if form.has_events else None)
    t1, step = aim.t_1, aim.h
    y1, error = w.room(form.integrated), w.room(form.y)
    smallest, changed_sign, rank = stages(w, form, method, p, k, p["t"], step, y1)
    each_row(w, form.y, error, lambda i: step * weighted(w, method.b_error, k, form, i))
    if form.projects:
        _project(w, form, p, t1, y1, error, rank)
    size_of_error = _norm(w, form, p, error, y1)
    if form.pivots or form.turning:
        size_of_error = w.where(changed_sign & ~aim.locating, math.inf, size_of_error)
    accept, next_h = judged(w, w.power, p, aim, size_of_error, method.order)
    return Trial(aim, y1, accept, next_h, smallest if form.pivots else None)


def _reach(w: MachineWriter, form: Form, p: Lanes, h: Value) -> Value:
    """The step `h`, or as far as relations let one go."""
    return w.smaller(h, reach(w, _crossings_of(p), p["t"], p["direction"], p["last_goal"])) if form.relations else h


def _tried_by_series(w: MachineWriter, form: Form, method: TaylorSteps, p: Lanes, k: Value) -> Trial:
    """A step by Taylor series, which goes over the times to save at; puts the coefficients into `k`, and after them the slope at the end of the step."""
    count = form.integrated
    t, last_goal, direction = p["t"], p["last_goal"], p["direction"]
    locating = w.equal(p["code"], LOCATING)
    rows, at_start = jet(w, form, p, t, method.order)
    for row, series in enumerate(rows):
        for j, x in enumerate(series):
            w.store(x, k, j * count + row)
    length = w.smaller(radius(w, form, p, rows), p["longest"])
    size = _reach(w, form, p, w.smaller(length, p["bound"]))
    rest = w.magnitude(last_goal - t)
    lands = ~locating & (size >= 0.999 * rest)
    size = w.where(lands, rest, size)
    step = w.where(locating, p["search_shift"], direction * size) if form.has_events else direction * size
    t1 = w.where(lands, last_goal, t + step)
    step = t1 - t
    y1, pivot, accept = w.room(count), None, size > 0.0
    for row, series in enumerate(rows):
        w.store(at_time(w, series, step), y1, row)
        if form.has_events:
            w.store(at_time(w, slope(series), step), k, (method.order + 1) * count + row)
    at_end = monitored_at(w, form, p, t1, y1)
    holds = at_start.holds & at_end.holds
    w.store(w.where(holds, w.load(y1), math.nan), y1)
    accept, length = accept & holds, w.where(at_start.holds, length, 0.0)
    for a, b in zip(at_start.values[: form.pivots], at_end.values, strict=False):
        least = w.smaller(w.magnitude(a), w.magnitude(b))
        pivot = least if pivot is None else w.smaller(pivot, least)
        accept = accept & ~(((a < 0.0) & (b > 0.0)) | ((a > 0.0) & (b < 0.0)))
    accept = accept & ~turns_round(w, form, *(x.values[form.pivots : form.pivots + form.turning] for x in (at_start, at_end)))
    if form.projects:
        error = w.room(form.y)
        each_row(w, form.y, error, lambda i: 0.0)
        _project(w, form, p, t1, y1, error)
        accept = accept & (_norm(w, form, p, error, y1) <= 1.0)
    accept = locating | accept
    p["bound"] = w.where(accept, math.inf, 0.5 * size)
    p["before"] = t
    return Trial(Aim(t1, step, size, locating), y1, accept, w.where(accept, length, w.smaller(length, 0.5 * size)), pivot)


def _take(w: MachineWriter, form: Form, method: Method | TaylorSteps, p: Lanes, k: Value, trial: Trial) -> None:
    """What becomes of the lanes after a step that was tried; `k`: slopes, the one at the start first."""
    y, count = p.pointer, form.integrated
    aim, y1, accept, next_h, smallest = trial
    t1, locating = aim.t_1, aim.locating
    watched = _watched(w, form, p, t1, aim.h, y1, accept & ~locating) if form.relations else None
    if watched is not None:
        accept, next_h = accept & ~watched.refused, w.where(watched.refused, w.where(watched.falls, watched.to_event, p["h"]), next_h)
    new = taken(w, p, aim, accept, next_h)
    new["taken"] = w.where(accept, aim.h, 0.0)  # by how far the state has gone on
    each_row(w, count, y1, lambda i: w.where(accept, w.load(y1, i), w.load(y, i)))
    if form.has_events:
        ends = k, w.at(k, method.at_the_end * form.integrated)
        new = _monitored(w, form, p, ends, y1, new, aim.h, accept & ~locating & w.equal(new["code"], RUNNING))
    counts = accept & ~locating & w.equal(new["code"], RUNNING) & w.equal(new["t"], t1)
    stays = counts | (locating & w.equal(new["code"], results.EVENT))
    if smallest is not None:
        pivot = w.where(counts, w.smaller(p["pivot"], smallest), p["pivot"])
        new |= {"pivot": pivot, "code": w.where(counts & (pivot < SMALLEST_PIVOT), results.SINGULAR_PARTITION, new["code"])}
    moving = locating | w.equal(p["code"], RUNNING)
    if watched is not None:
        _note_signs(w, p, watched, t1, moving, stays)
    copied(w, count, y1, y, moving)
    for name, value in new.items():
        p[name] = w.where(moving, value, w.number(0.0) if name == "taken" else p[name])


class Rank(NamedTuple):
    """How near to a loss of rank the rows are in a step."""

    near: Value  # at its start
    square: Value  # the smallest squared sine between a row and those before it, of all stages


def stages(w: MachineWriter, form: Form, method: Method, p: Lanes, k: Value, t: Value, step: Value, y1: Value) -> tuple[Value, Value, Rank | None]:
    """The smallest magnitude of a pivot, whether any changed its sign, and how near rows are to losing rank.

    Puts the slopes of all stages into `k`, and into `y1` the state of the next stage, worked out once, until it is that at the end of the step.
    """
    count, every = form.pivots, form.integrated
    at, pivots, square = y1, w.room(max(len(form.monitored), 1)), w.room()
    n = method.needed
    A, c, no = w.table(np.array([*method.A[1:n, :n], method.b[:n]])), w.table(method.c[:n]), w.literal(0, w.truth)
    copied(w, every, p.pointer, y1)
    w.store(math.inf, square)

    turning = range(count, count + form.turning)

    def stage(i: int, found: tuple) -> tuple:
        first, low, high, turned, near = found
        time = w.fma(step, c[i], t)
        if form.squares and not w.is_first(i):
            put_near_rows(w, form, p.pointer, near, time, at)
        w.run("rates", p.pointer, time, at, w.at(k, i * every), pivots)
        now, directions = w.every(pivots, range(count)), [w.load(pivots, j) for j in turning]
        if form.squares:
            by_rows = squares_of(w, form, pivots)
            near = w.at_first(i, near_rank_loss(by_rows), near)
            w.if_any(near, lambda: w.store(reduce(w.smaller, [left / size for left, size in by_rows], w.load(square)), square))
        first = [w.at_first(i, new, old) for new, old in zip(directions, first, strict=True)]
        turned = turned | turns_round(w, form, first, directions)
        low, high = [w.smaller(a, b) for a, b in zip(low, now, strict=True)], [w.larger(a, b) for a, b in zip(high, now, strict=True)]
        each_row(w, every, y1, lambda row: w.fma(step, weighted(w, A[i], k, form, row), w.load(p.pointer, row)))
        return first, low, high, turned, near

    low, high = ([w.number(x)] * len(w.every(pivots, range(count))) for x in (math.inf, -math.inf))
    found = [w.number(0.0)] * form.turning, low, high, no, no
    _, low, high, changed, near = w.over_stages(n, stage, found)
    smallest = w.least([w.smaller(w.magnitude(a), w.magnitude(b)) for a, b in zip(low, high, strict=True)])
    changed = changed | w.in_any([(a < 0.0) & (b > 0.0) for a, b in zip(low, high, strict=True)])
    return smallest, changed, Rank(near, w.load(square)) if form.squares else None


def squares_of(w: MachineWriter, form: Form, monitored: Value) -> list[tuple[Value, Value]]:
    """What is left of each row beside those before it, and its size, squared."""
    found = [w.load(monitored, j) for j in range(len(form.monitored) - len(form.squares), len(form.monitored))]
    return list(zip(found[::2], found[1::2], strict=True))


def near_rank_loss(squares: list[tuple[Value, Value]]) -> Value:
    """Whether some row is nearly one of those before it."""
    return any_of([left < NEAR_SINE**2 * size for left, size in squares])


def put_near_rows(w: MachineWriter, form: Form, state: Value, near: Value, t: Value, y: Value) -> None:
    """Puts the state `y` of a stage back onto the rows in lanes that are `near` a loss of rank."""

    def put() -> None:
        on_rows = w.room(form.integrated)
        copied(w, form.integrated, y, on_rows)
        w.run("project", state, t, on_rows)
        copied(w, form.integrated, on_rows, y, near)

    w.if_any(near, put)


def turns_round(w: MachineWriter, form: Form, first: list[Value], now: list[Value]) -> Value:
    """Return whether the part of a row's slope along its first one has fallen below its least share; entries of directions alone."""
    along = lambda row, slope: reduce(operator.add, (first[k] * slope[k] for k in row))  # noqa: E731
    width = max(form.speeds, 1)
    rows = [range(k, k + width) for k in range(0, form.turning, width)]
    lasting = [along(row, now) > LEAST_SHARE * along(row, first) for row in rows]
    return ~reduce(operator.and_, lasting) if lasting else w.literal(0, w.truth)


def weighted(w: MachineWriter, weights: np.ndarray, k: Value, form: Form, row: int | Value) -> Value:
    """sum_j w_j k_j of one number of the state; numbers of a loop over stages may all be other than zero."""
    first, *others = [j for j in range(len(weights)) if w.may_count(weights, j)]
    total = w.load(k, row + first * form.integrated) * weights[first]
    for j in others:
        total = w.fma(w.load(k, row + j * form.integrated), weights[j], total)
    return total


def _project(w: MachineWriter, form: Form, p: Lanes, t1: Value, y1: Value, error: Value, rank: Rank | None = None) -> None:
    """Puts `y1` back onto the rows; the error is no smaller than how far that moved it, beyond noise."""
    free = w.room(form.y)
    copied(w, form.y, y1, free)
    w.run("project", p.pointer, t1, y1)
    amplified = None if rank is None else w.where(rank.near, w.smaller(AMPLIFIED * w.eps / rank.square, w.eps ** (1 - NOISE)), 0.0)
    if rank is not None:

        def along_rows() -> None:
            both = w.room(2 * form.y)
            copied(w, form.y, y1, both)
            copied(w, form.y, error, w.at(both, form.y))
            w.run("along", p.pointer, t1, both)
            each_row(w, form.y, error, lambda i: w.where(rank.near, w.load(both, i + form.y), w.load(error, i)))

        w.if_any(rank.near, along_rows)
    for part in form.parts:
        largest = w.largest(part, lambda i: w.magnitude(w.load(y1, i)))
        noise = (w.eps**NOISE if amplified is None else w.larger(amplified, w.eps**NOISE)) * largest
        by_rows = None if amplified is None else amplified * amplified * largest

        def larger_error(i: int | Value, noise: Value = noise, by_rows: Value | None = by_rows) -> Value:
            moved = w.magnitude(w.load(y1, i) - w.load(free, i)) - noise
            along = w.magnitude(w.load(error, i))
            return w.larger(along if by_rows is None else along - by_rows, w.larger(moved, 0.0))

        each_row(w, part, error, larger_error)


def _norm(w: MachineWriter, form: Form, p: Lanes, error: Value, y1: Value) -> Value:
    """Root mean square of the errors of coordinates and speeds, relative to what is allowed; infinite where one is no number."""
    rtol, atol, count = p["rtol"], p["atol"], form.q_and_v

    def relative(i: int | Value) -> Value:
        size = w.larger(w.magnitude(w.load(p.pointer, i)), w.magnitude(w.load(y1, i)))
        return w.load(error, i) / w.fma(rtol, size, atol)

    total = w.sum_of_squares(range(count), relative) / float(count)
    return w.root(w.where(w.is_nan(total), math.inf, total))
