"""The search for a stop event, as in `motion/integrators/event_search.py`, for lanes side by side."""

import math

from jourdain_jax.motion.integrators.event_search import DIFFERENTIABLE, FLAT, LEAVES, MOST_STEPS, lowest, trial
from jourdain_jax.motion.native.layout import Lanes
from jourdain_jax.native.ir import Value, Writer

EPS = 2.0**-52
_SMALL = math.sqrt(EPS)
Values = list[Value]  # one per event


def no_event(w: Writer, values: Values) -> Value:
    """Whether all values are positive."""
    found = values[0] > 0.0
    for c in values[1:]:
        found = found & (c > 0.0)
    return found


def reach_of_noise(w: Writer, p: Lanes) -> Value:
    """As in `event_search`."""
    return EPS**LEAVES * w.magnitude(p["last_goal"])


def at_start(w: Writer, p: Lanes, c_0: Values, rate_0: Values, c_1: Values) -> tuple[Values, Values]:
    """As in `event_search`."""
    sunk, sinks = [], []
    for a, slope, b in zip(c_0, rate_0, c_1, strict=True):
        rate = slope * p["direction"]
        rises = (rate > 0.0) & (w.magnitude(a) <= reach_of_noise(w, p) * rate)
        sunk.append(~(a > 0.0) & ~rises)
        sinks.append(~(a > 0.0) & rises & ~(b > 0.0))
    return sunk, sinks


def first_event(w: Writer, before: Values, after: Values) -> Value:
    """The number of the event that is the first to happen, by its secant."""
    best, first = None, w.number(0.0)
    for i, (b, a) in enumerate(zip(before, after, strict=True)):
        share = b / (b - a)
        share = w.where(a > 0.0, math.inf, w.where(w.magnitude(share) < math.inf, share, 1.0))
        if best is None:
            best = share
        else:
            first = w.where(share < best, float(i), first)
            best = w.where(share < best, share, best)
    return first


def chosen(w: Writer, index: Value, values: Values) -> Value:
    """The value with this index."""
    found = values[0]
    for i in range(1, len(values)):
        found = w.where(index.equals(float(i)), values[i], found)
    return found


def dip(w: Writer, h: Value, c_0: Values, rate_0: Values, c_1: Values, rate_1: Values) -> tuple[Value, Value]:
    """Whether a value falls below zero between the ends of a step, and after which part of the step the first one is lowest."""
    share = lowest(w, w.number(1.0), h, c_0, rate_0, c_1, rate_1)
    return share < 1.0, share


def advance(w: Writer, p: Lanes, begins: Value, trying: Value, locating: Value, start: tuple[Value, Values, Values], end: tuple[Value, Values]) -> Value:
    """Put the search after a step into its rows, in lanes where it `begins` or which are `locating`; return the number of the event that is now the first.

    `start`, `end`: time and values at both ends of the step, and rates at its start.
    """
    (t_0, c_0, rate_0), (t_1, c_1) = start, end
    changes, count = begins | locating, len(c_1)
    t, flat, left = p.every("search_t"), p.every("search_c"), p["search_left"]
    c = [flat[i * count : (i + 1) * count] for i in range(3)]
    # narrowed: the time tried, one on the other side of the event, and one that was either before
    same_side = _same(w, no_event(w, c_1), no_event(w, c[0]))
    narrowed_t = [t_1, w.where(same_side, t[1], t[0]), w.where(same_side, t[0], t[1])]
    narrowed_c = [c_1, _each(w, same_side, c[1], c[0]), _each(w, same_side, c[0], c[1])]
    fresh_t = [t_1, t_0, w.number(math.inf)]
    fresh_c = [c_1, c_0, [w.number(math.nan)] * count]
    known_t = [w.where(begins, a, w.where(trying, b, old)) for a, b, old in zip(fresh_t, narrowed_t, t, strict=True)]
    known_c = [_each(w, begins, a, _each(w, trying, b, old)) for a, b, old in zip(fresh_c, narrowed_c, c, strict=True)]
    step = w.where(begins, w.magnitude(t_1 - t_0), p["search_step"])
    now_left = w.where(begins, float(MOST_STEPS), w.larger(left - 1.0, 0.0))
    is_before = no_event(w, known_c[0])
    before, after = _each(w, is_before, known_c[0], known_c[1]), _each(w, is_before, known_c[1], known_c[0])
    first = first_event(w, before, after)
    tried, near = trial(w, known_t, [chosen(w, first, x) for x in known_c], step, now_left <= DIFFERENTIABLE + 3.0, EPS)
    trying = begins | trying
    now_left = w.where(trying & near, DIFFERENTIABLE + 1.0, now_left)
    to_trial = w.where(near, 0.0, tried - t_0)
    newton = _newton_shift(w, known_t, chosen(w, first, after), step, chosen(w, first, c_1), chosen(w, first, rate_0), left > 0.0)
    shift = w.where(trying, to_trial, newton)
    for name, new in (("search_t", known_t), ("search_c", [x for part in known_c for x in part])):
        p.put(name, [w.where(changes, a, b) for a, b in zip(new, p.every(name), strict=True)])
    for i, (a, b) in enumerate(zip(c_0, c_1, strict=True)):
        mean = w.magnitude((b - a) / (t_1 - t_0))
        slope = w.where(mean < math.inf, mean, 0.0)
        place = p.layout.rows["search_slope"].start + i
        w.store(w.where(begins, slope, w.load(w.real, p.pointer, place)), p.pointer, place)
    for name, new in (("search_step", step), ("search_left", now_left), ("search_shift", shift)):
        p[name] = w.where(changes, new, p[name])
    return first


def is_flat(w: Writer, p: Lanes, rate: Value) -> Value:
    """Whether the value of a lane's event has no slope where it falls through zero."""
    return w.magnitude(rate) <= FLAT * chosen(w, p["event"], p.every("search_slope"))


def _same(w: Writer, a: Value, b: Value) -> Value:
    return ~w.bitwise("xor", a, b)


def _each(w: Writer, condition: Value, a: Values, b: Values) -> Values:
    return [w.where(condition, x, y) for x, y in zip(a, b, strict=True)]


def _newton_shift(w: Writer, t: Values, after: Value, step: Value, c: Value, rate: Value, searching: Value) -> Value:
    beyond = w.is_nan(after)
    far = w.magnitude(t[0] - t[1]) + _SMALL * step
    usable = searching & (w.magnitude(c) < far * w.magnitude(rate)) & (w.magnitude(rate) < math.inf)
    return w.where(usable & ~beyond, -c / rate, 0.0)
