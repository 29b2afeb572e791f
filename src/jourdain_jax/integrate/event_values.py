"""Formulas of the event search. From values at the ends of a step they compute the first event, the time at
which a value falls through zero, and the next trial time. `event_search.py` describes the method and its
source.
"""

import math
import operator
from functools import reduce
from typing import Any

# a value whose rate at zero is less than this part of its mean rate counts as a multiple root
FLAT = 1e-8  # numerics
LEAVES = 0.6  # numerics: exponent of round-off, in the noise of times
LATE = 0.98  # numerics: fraction of a step; the next step finds later dips
Values = Any  # one per event


def any_of(found: Values):
    """Return whether any condition holds."""
    return reduce(operator.or_, found)


def no_event(values: Values):
    """Return whether all values are positive. NaN is not positive."""
    return reduce(operator.and_, [c > 0.0 for c in values])


def chosen(w, index, values: Values):
    """Return the value with this index; for an invalid index, the first."""
    found = values[0]
    for i in range(1, len(values)):
        found = w.where(w.equal(index, i), values[i], found)
    return found


def reach_of_noise(w, span):
    """Return the time after which a value that rises from zero at the start exceeds its round-off."""
    return w.eps**LEAVES * w.magnitude(span)


def at_start(w, c_0: Values, c_dot_0: Values, c_1: Values, h, direction, span) -> tuple[list, list]:
    """Return which events happen at the start, and which values rise from zero there but are not positive
    after a step `h`.
    """
    sunk, sinks, noise = [], [], reach_of_noise(w, span)
    for a, slope, b in zip(c_0, c_dot_0, c_1, strict=True):
        rate, change = slope * direction, w.magnitude(b - a)
        level = ~(a > 0.0) & (change > 0.0) & is_level(w, a, slope, b, h, noise)
        rises = ((rate > 0.0) & (w.magnitude(a) <= noise * rate)) | level
        sunk.append(~(a > 0.0) & ~rises)
        sinks.append(rises & ~(b > 0.0))
    return sunk, sinks


def is_level(w, a, slope, b, h, noise):
    """Return whether value and rate at the start of a step `h` are round-off relative to the change."""
    straight = w.larger(w.magnitude(a), w.magnitude(h * slope))  # change along a straight line
    return straight * w.magnitude(h) <= noise * w.magnitude(b - a)


def first_event(w, before: Values, after: Values):
    """Return the index of the first event within a step: its secant is the first to reach zero."""
    shares = [b / (b - a) for b, a in zip(before, after, strict=True)]
    best, *later = (
        w.where(a > 0.0, math.inf, w.where(w.magnitude(share) < math.inf, share, 1.0))
        for a, share in zip(after, shares, strict=True)
    )
    first = 0.0
    for i, share in enumerate(later, 1):
        first, best = w.where(share < best, i, first), w.where(share < best, share, best)
    return first


def cubic(h, a, slope_a, b, slope_b) -> tuple:
    """Return m, A, B of the cubic `a + m s + A s^2 + B s^3` with given values and rates at the ends of a step
    h, s = 0 and s = 1.
    """
    m_0, m_1, rise = h * slope_a, h * slope_b, b - a
    return m_0, 3.0 * rise - 2.0 * m_0 - m_1, m_0 + m_1 - 2.0 * rise


def falls_through(w, h, a, slope_a, b, slope_b):
    """Return the fraction of a step at which the cubic is zero, or, if its root is not found, the secant."""
    m, A, B = cubic(h, a, slope_a, b, slope_b)
    s = line = a / (a - b)
    for _ in range(4):
        s = s - (a + s * (m + s * (A + s * B))) / (m + s * (2.0 * A + s * (3.0 * B)))
    left = a + s * (m + s * (A + s * B))
    return w.where((s > 0.0) & (s < 1.0) & (w.magnitude(left) < 1e-3 * (a - b)), s, line)


def trial(w, t, c, step, last, guess) -> tuple:
    """Return the next trial time in a step of length `step`, and whether the last trial is near enough. `t`
    and `c` are times and values of a bracket. The first trial divides the bracket at the fraction `guess`. If
    `last`, the search ends, provided that the value is finite.
    """
    eps = w.eps
    (t_1, t_2, t_3), (c_1, c_2, c_3) = t, c
    width, tiny = t_2 - t_1, 2 * eps * (w.magnitude(t_1) + w.magnitude(t_2))
    xi, phi = (t_1 - t_2) / (t_3 - t_2), (c_1 - c_2) / (c_3 - c_2)
    safe = (phi * phi < xi) & ((1.0 - phi) * (1.0 - phi) < 1.0 - xi)
    inverse = c_1 / (c_2 - c_1) * c_3 / (c_2 - c_3) - (t_3 - t_1) / width * c_1 / (c_3 - c_1) * c_2 / (
        c_2 - c_3
    )
    share = w.where(w.equal(w.magnitude(t_3), math.inf), guess, w.where(safe, inverse, 0.5))
    share = w.where(w.magnitude(share) < math.inf, share, 0.5)
    least = w.smaller(tiny / w.magnitude(width), 0.5)
    # A trial is near enough if the value, divided by the slope, is a short time, and if the value is small
    # relative to that at the other end. Either condition alone fails for flat or jumping values. So does the
    # mean slope of the whole step, which is the only slope known before any trial.
    slope, tried = (c_1 - c_3) / (t_1 - t_3), w.magnitude(t_3) < math.inf
    slope = w.where(w.magnitude(slope) < math.inf, slope, (c_1 - c_2) / (t_1 - t_2))
    small = (w.magnitude(c_1) <= math.sqrt(eps) * step * w.magnitude(slope)) & (
        w.magnitude(c_1) <= 1e-3 * w.magnitude(c_2)
    )
    zero = w.equal(c_1, 0.0)  # at the event, or after it if the value stays zero
    near, share = tried & small & ~zero, w.where(tried & (zero | w.equal(c_2, 0.0)), 0.5, share)
    closed = (w.magnitude(width) <= 2.0 * tiny) | last
    clipped = w.smaller(w.larger(share, least), 1.0 - least)
    return w.where(closed, t_2, t_1 + clipped * width), near | (closed & (w.magnitude(c_1) < math.inf))


def is_flat(w, c_dot, slope):
    """Return whether the slope of a value at its zero is negligible relative to its mean `slope` over the
    step.
    """
    return w.magnitude(c_dot) <= FLAT * slope


def may_fall(w, h, near: bool, c_0: Values, c_dot_0: Values, c_1: Values, c_dot_1: Values) -> list:
    """Return which values may fall through zero in a step `h`. The cubic through values and rates at its ends
    stays positive if its Bernstein coefficients are positive: c_0, c_0 + h c'_0/3, c_1 - h c'_1/3, c_1. If
    `near`, each of them must exceed the range of all four.
    """
    third, found = h / 3.0, []
    for a, slope_a, b, slope_b in zip(c_0, c_dot_0, c_1, c_dot_1, strict=True):
        four = a, b, a + third * slope_a, b - third * slope_b
        margin = reduce(w.larger, four) - reduce(w.smaller, four) if near else 0.0
        found.append(~reduce(operator.and_, [x > margin for x in four]))
    return found


def lowest(w, h, begin: list, middle: list | None, end: list):
    """Return the fraction of a step `h` at which the first dip below zero between its ends is lowest; 1 if
    there is no dip. `begin`, `middle`, `end`: values and rates. With r = sqrt(A^2 - 3 B m_0), the cubic
    p(s) = c_0 + m_0 s + A s^2 + B s^3 is lowest at s = -m_0/(A + r) = (r - A)/(3 B).

    With a `middle`, each half has a cubic. The value in the middle shows the error of the cubic of the step:
    a minimum of a half below a quarter of that counts as a dip, too, and so does a point of inflection
    (r = 0) where the cubic has no minimum.
    """
    shares = []
    for i in range(len(begin[0])):
        (a, slope_a), (b, slope_b) = ([x[i] for x in at] for at in (begin, end))
        if middle is None:
            shares.append(_lowest(w, h, a, slope_a, b, slope_b, 0.0))
            continue
        c, slope = (x[i] for x in middle)
        error = w.magnitude(c - 0.5 * (a + b) - 0.125 * h * (slope_a - slope_b)) / 4.0
        first = _lowest(w, 0.5 * h, a, slope_a, c, slope, error)
        second = _lowest(w, 0.5 * h, c, slope, b, slope_b, error)
        second = w.where(c > 0.0, 0.5 + 0.5 * second, 0.5)
        shares.append(w.where(b > 0.0, w.where(first < 1.0, 0.5 * first, second), 1.0))
    share = reduce(w.smaller, shares)
    return w.where(share < LATE, share, 1.0)


def until_back(w, h, direction, noise, begin: list, soon: Values, c_1: Values):
    """Return half of the fraction of a step `h` after which a value that rises from zero would return to zero
    if its rate kept falling as it does at the start; 1 if that lies beyond the step. `begin`: values and
    rates; `soon`: rates after 2^-10 of the step.
    """
    found = w.number(1.0)
    for c, rate, later, end in zip(*begin, soon, c_1, strict=True):
        rises, falls = rate * direction, (rate - later) * direction
        share = rises / (1024.0 * falls)
        back = (rises > 0.0) & ~(c > noise * rises) & (512.0 * falls > rises) & (end > 0.0)
        back = back & (share * w.magnitude(h) > noise)  # otherwise the rate is round-off
        found = w.where(back, w.smaller(found, share), found)
    return found


def _lowest(w, h, a, slope_a, b, slope_b, error):
    m_0, A, B = cubic(h, a, slope_a, b, slope_b)
    r = w.root(w.larger(A * A - 3.0 * B * m_0, 0.0))
    s = w.where(A > 0.0, -m_0 / (A + r), (r - A) / (3.0 * B))
    value = a + s * (m_0 + s * (A + s * B))
    dips = (b > 0.0) & (s > 0.0) & (s < 1.0) & (value < error - 1e-12 * (a + b))
    return w.where(dips, s, 1.0)


def ahead(w, h, c_0: Values, c_dot_0: Values, c_1: Values, c_dot_1: Values, sinks: Values):
    """Return half of the fraction of a step `h` during which values that rise from zero stay positive; at
    least 0.01, at most one half.
    """
    share = w.number(0.5)
    for a, slope_a, b, slope_b, sinking in zip(c_0, c_dot_0, c_1, c_dot_1, sinks, strict=True):
        m, A, B = cubic(h, a, slope_a, b, slope_b)
        back = m / (w.root(w.larger(A * A - 4.0 * B * m, 0.0)) - A)  # half of the root of m + A s + B s^2
        share = w.where(sinking & (back > 0.0) & (back < share), back, share)
    return w.larger(share, 0.01)
