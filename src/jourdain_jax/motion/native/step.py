"""One step of lanes side by side, as in `motion/integrators/erk_step.py`, which says what it does and why."""

import math
from functools import reduce

import numpy as np

from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.motion.integrators.erk_step import LARGEST_FACTOR, LEAST_FACTOR, LOCATING, NOISE, RUNNING, SAFETY, Method
from jourdain_jax.motion.integrators.event_search import DIFFERENTIABLE
from jourdain_jax.motion.native import search
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.layout import Lanes, Layout
from jourdain_jax.motion.trajectories import results
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.math_functions import power

IDLE = -9.0  # code of a place that has no lane


def write_step(w: Writer, form: Form, method: Method) -> None:
    """`step(state)`: one step, tried by all lanes that are on their way."""
    with w.function("step", "void", {"state": "ptr"}, attributes="noinline") as (state,):
        _write_step(w, form, method, Lanes(w, form.layout, state))
        w.give()


def _write_step(w: Writer, form: Form, method: Method, p: Lanes) -> None:
    layout = form.layout
    t, y, h, code, goal, direction = p["t"], p.every("y"), p["h"], p["code"], p["goal"], p["direction"]
    locating = code.equals(float(LOCATING))
    rest = w.magnitude(goal - t)
    lands = ~locating & (h >= 0.999 * rest)
    size = w.where(lands, rest, w.where(2.0 * h > rest, 0.5 * rest, h))
    shortened = size < h
    step = w.where(locating, p["search_shift"], direction * size) if form.has_events else direction * size
    t1 = w.where(lands, goal, t + step)
    step = t1 - t
    k, smallest, changed_sign = _stages(w, form, method, p, t, y, step)
    y1 = [w.fma(step, x, start) for x, start in zip(_weighted(w, method.b, k, layout), y, strict=True)]
    error = [step * x for x in _weighted(w, method.b_error, k, layout)]
    at = w.room(w.real, layout.y)
    if form.projects:
        free = y1
        y1 = _called_on(w, at, y1, "project", p.pointer, t1)
        error = [w.larger(w.magnitude(e), moved) for e, moved in zip(error, _removed(w, layout, y1, free), strict=True)]
    size_of_error = _norm(w, layout, p, error, y, y1)
    if form.pivots:
        size_of_error = w.where(changed_sign & ~locating, math.inf, size_of_error)
    accept = locating | (size_of_error <= 1.0)
    factor = SAFETY * power(w, w.where(size_of_error > 0.0, size_of_error, 1e-30), -1 / method.order)
    factor = w.larger(w.where(size_of_error < math.inf, factor, 0.0), LEAST_FACTOR)
    proposed = size * w.smaller(factor, w.where(accept, LARGEST_FACTOR, w.number(1.0)))
    next_h = w.where(accept & shortened, w.larger(proposed, h), proposed)
    accepted = p["accepted"] + _count(w, accept & ~locating)
    rejected = p["rejected"] + _count(w, ~accept)
    too_short = (next_h < p["shortest"]) | (t1 + direction * next_h).equals(t1)
    arrived = accept & t1.equals(p["last_goal"])
    new_code = w.where(((accepted + rejected) >= p["max_steps"]) & ~arrived, float(results.MAX_STEPS), float(RUNNING))
    new_code = w.where(too_short, float(results.STEP_TOO_SMALL), new_code)
    new = {"t": w.where(accept, t1, t), "h": next_h, "code": new_code, "accepted": accepted, "rejected": rejected}
    new_y = [w.where(accept, b, a) for a, b in zip(y, y1, strict=True)]
    if form.has_events:
        new, new_y = _watched(w, form, method, p, k, at, step, accept, new, new_y)
    if form.pivots:
        counts = accept & ~locating & new["code"].equals(float(RUNNING)) & new["t"].equals(t1)
        pivot = w.where(counts, w.smaller(p["pivot"], smallest), p["pivot"])
        new |= {"pivot": pivot, "code": w.where(counts & (pivot < SMALLEST_PIVOT), float(results.SINGULAR_PARTITION), new["code"])}
    moving = locating | code.equals(float(RUNNING))
    for name, value in new.items():
        p[name] = w.where(moving, value, p[name])
    p.put("y", [w.where(moving, a, b) for a, b in zip(new_y, y, strict=True)])


def _stages(w: Writer, form: Form, method: Method, p: Lanes, t: Value, y: list[Value], step: Value) -> tuple[Value, Value, Value]:
    """Where the slopes of all stages are; the smallest magnitude of a pivot, and whether any changed its sign."""
    layout, count = form.layout, form.pivots
    k, at, pivots = w.room(w.real, layout.y * method.needed), w.room(w.real, layout.y), w.room(w.real, max(count, 1))
    low, high = [w.number(math.inf)] * count, [w.number(-math.inf)] * count
    for i in range(method.needed):
        stage = y if i == 0 else [w.fma(step, x, start) for x, start in zip(_weighted(w, method.A[i], k, layout), y, strict=True)]
        for j, x in enumerate(stage):
            w.store(x, at, j)
        w.call("rates", "void", p.pointer, w.fma(step, float(method.c[i]), t), at, w.at(k, i * layout.y, w.real), pivots)
        now = [w.load(w.real, pivots, j) for j in range(count)]
        low, high = [w.smaller(a, b) for a, b in zip(low, now, strict=True)], [w.larger(a, b) for a, b in zip(high, now, strict=True)]
    smallest, changed = w.number(math.inf), w.literal(0, w.truth)
    for a, b in zip(low, high, strict=True):
        smallest = w.smaller(smallest, w.smaller(w.magnitude(a), w.magnitude(b)))
        changed = changed | ((a < 0.0) & (b > 0.0))
    return k, smallest, changed


def _weighted(w: Writer, weights: np.ndarray, k: Value, layout: Layout) -> list[Value]:
    """sum_j w_j k_j, number by number."""
    used = [j for j in range(len(weights)) if weights[j] != 0]
    totals = []
    for row in range(layout.y):
        total = w.load(w.real, k, used[0] * layout.y + row) * float(weights[used[0]])
        for j in used[1:]:
            total = w.fma(w.load(w.real, k, j * layout.y + row), float(weights[j]), total)
        totals.append(total)
    return totals


def _called_on(w: Writer, at: Value, y: list[Value], function: str, state: Value, t: Value) -> list[Value]:
    """A state changed in place by a function."""
    for i, x in enumerate(y):
        w.store(x, at, i)
    w.call(function, "void", state, t, at)
    return [w.load(w.real, at, i) for i in range(len(y))]


def _removed(w: Writer, layout: Layout, projected: list[Value], free: list[Value]) -> list[Value]:
    """How far a projection moved a state, beyond noise."""
    found = []
    for part in layout.parts:
        largest = reduce(w.larger, [w.magnitude(projected[i]) for i in part])
        found += [w.larger(w.magnitude(projected[i] - free[i]) - search.EPS**NOISE * largest, 0.0) for i in part]
    return found


def _norm(w: Writer, layout: Layout, p: Lanes, error: list[Value], y: list[Value], y1: list[Value]) -> Value:
    """Root mean square of the errors of coordinates and speeds, relative to what is allowed; infinite where one is no number."""
    rtol, atol, total = p["rtol"], p["atol"], w.number(0.0)
    count = layout.coordinates + layout.speeds
    for e, a, b in list(zip(error, y, y1, strict=True))[:count]:
        relative = e / w.fma(rtol, w.larger(w.magnitude(a), w.magnitude(b)), atol)
        total = w.fma(relative, relative, total)
    total = total / float(count)
    return w.intrinsic("sqrt", w.where(w.is_nan(total), math.inf, total))


def _count(w: Writer, happens: Value) -> Value:
    return w.where(happens, 1.0, w.number(0.0))


def _watched(w: Writer, form: Form, method: Method, p: Lanes, k: Value, at: Value, step: Value, accept: Value, new: dict[str, Value], new_y: list[Value]):
    """The step in which an event may have happened or is being located, or before which one has."""
    layout, count = form.layout, form.layout.events
    t, y, code = p["t"], p.every("y"), p["code"]
    locating, fresh = code.equals(float(LOCATING)), (p["accepted"] + p["rejected"]).equals(0.0)
    accept = accept & ~locating & new["code"].equals(float(RUNNING))

    def events(t: Value, y: list[Value], stage: int) -> tuple[list[Value], list[Value]]:
        values, rates = w.room(w.real, count), w.room(w.real, count)
        for i, x in enumerate(y):
            w.store(x, at, i)
        w.call("events", "void", p.pointer, t, at, w.at(k, stage * layout.y, w.real), values, rates)
        return [w.load(w.real, values, i) for i in range(count)], [w.load(w.real, rates, i) for i in range(count)]

    c_0, rate_0 = events(t, y, 0)
    c_1, rate_1 = events(new["t"], new_y, method.at_the_end)
    dips, share = search.dip(w, step, c_0, rate_0, c_1, rate_1)
    dips = accept & dips
    happened = accept & ~dips & ~search.no_event(w, c_1)
    was_trying = p["search_left"] > DIFFERENTIABLE + 1.0
    changes, first = happened | locating, w.room(w.real)
    w.store(p["event"], first)
    with w.when(w.any(changes)):
        w.store(search.advance(w, p, happened, was_trying, locating, t, c_0, rate_0, new["t"], c_1), first)
    left, shift = p["search_left"], p["search_shift"]
    found, back = locating & left.equals(0.0), changes & (left > DIFFERENTIABLE + 1.0)
    stays = back | dips
    new_y = [w.where(found, w.fma(shift, w.load(w.real, k, i), b), w.where(stays, a, b)) for i, (a, b) in enumerate(zip(y, new_y, strict=True))]
    tried = _count(w, dips)
    now = w.where(found, float(results.EVENT), w.where(locating, float(LOCATING), new["code"]))
    new = {
        "t": w.where(found, new["t"] + shift, w.where(stays, t, new["t"])),
        "h": w.where(dips, share * w.magnitude(step), w.where(locating, p["h"], new["h"])),
        "code": w.where(happened, float(LOCATING), now),
        "accepted": new["accepted"] - tried,
        "rejected": new["rejected"] + tried,
        "event": w.where(happened | (locating & was_trying), w.load(w.real, first), p["event"]),
    }
    # a motion that starts beyond an event has no motion at all
    finite = reduce(lambda a, b: a & b, [w.magnitude(x) < math.inf for x in y])
    over = fresh & finite & ~search.no_event(w, c_0)
    which = w.number(float(count - 1))
    for i in reversed(range(count - 1)):
        which = w.where(c_0[i] > 0.0, which, float(i))
    begun = {"t": t, "h": p["h"], "code": w.number(float(results.EVENT)), "accepted": p["accepted"], "rejected": p["rejected"], "event": which}
    return {name: w.where(over, begun[name], value) for name, value in new.items()}, [w.where(over, a, b) for a, b in zip(y, new_y, strict=True)]
