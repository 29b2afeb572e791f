"""Relations of loads, poses, rows and stop events, watched over each step: numbers whose signs decide between branches (`lowering/relations.py`).

A step at whose end some sign is another one than at its start is refused, and from then on steps go half of the way that is left to where it ended,

    h <= max((t_refused - t)/2, resolved),       resolved = span/1000

until one of them, which is no longer than that, passes the change. Zero has the sign of what was before; what is no number changes none.

Where one number k changes its sign in a step, all are also looked at where it vanishes, on the line between the states at the ends,

    y* = y_0 + s (y_1 - y_0),   t* = t_0 + s h,   s = k_0/(k_0 - k_1)

so that |x - a| < w is met although it holds at neither end: that counts as two changes more. After the relations come the values of stop events, if
relations decide these: one that is not positive at y* makes the step end there.

The formulas are those of arrays of JAX and of values of machine code: `w` is `event_search.OnArrays`, or a `Writer`. Numbers are lists.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Of the span. Measured, a mass that passes brake strips of 0.03 to 30 % of half of its way, at a tolerance of 1e-8: 88 to 131 tried steps with 1/1,000 and
# 1/10,000, errors of 3e-8; with 1/100 strips of less than 0.2 % are passed in one step, and flagged. Without any, strips of 10 % are stepped over.
RESOLVED = 1e-3
LONGER = 1.01  # times that: a step that ends at a time asked for may be longer than the one that was meant


class Crossings(NamedTuple):
    """The signs of relations, and how often they have changed."""

    last: Any  # what they were last that was not zero
    by: Any  # the time by which one is known to change, infinite where none is, with the sign of the motion
    count: Any
    together: Any  # the end of the first step in which two or more have changed; infinite: none


class Watched(NamedTuple):
    """A step as relations see it."""

    last: Any
    count: Any
    refused: Any
    falls: Any  # whether a stop event has happened where the one relation that changes does
    to_event: Any  # the step that ends there


def begun(values: Float[Array, "numbers *lanes"], direction) -> Crossings:
    """Return the signs at a start."""
    never = jnp.full(values.shape[1:], jnp.inf, values.dtype)
    last = jnp.where((values > 0) | (values < 0), values, 0.0)
    return jax.lax.stop_gradient(Crossings(last, direction * never, jnp.zeros(values.shape[1:], jnp.int32), never))


def reach(w, before: Crossings, t, direction, span):
    """Return how long a step from t may be."""
    return w.larger(0.5 * ((before.by - t) * direction), RESOLVED * w.magnitude(span))


def unless_zero(w, values: Any, otherwise: Any) -> tuple:
    """Return the values, and what is otherwise where one has no sign."""
    return tuple(w.where((x > 0.0) | (x < 0.0), x, other) for x, other in zip(values, otherwise, strict=True))


def _apart(a, b):
    """Return whether their signs differ."""
    return ((a > 0.0) & (b < 0.0)) | ((a < 0.0) & (b > 0.0))


def _counted(w, found: Any):
    return sum((w.where(x, 1.0, 0.0) for x in found), start=0.0)


def watched(w, before: Crossings, values: Any, relations: int, between: Callable, fits, h, span) -> Watched:
    """Return what a step `h` crosses; `values`: of all numbers at its end, the first so many of them `relations`; `fits`: it would be accepted.

    `between`: (where one alone changes, after which part of the step, otherwise) -> values there.
    """
    now = unless_zero(w, values, before.last)
    crossed = [_apart(a, b) for a, b in zip(before.last, now, strict=True)][:relations]
    count = _counted(w, crossed)
    shares = [w.where(is_crossed, a / (a - b), 0.0) for is_crossed, a, b in zip(crossed, before.last, now, strict=False)]
    share, once = sum(shares, start=0.0), w.equal(count, 1.0)
    hidden = [once & _apart(x, a) & _apart(x, b) for a, b, x in zip(before.last, now, between(once, share, now), strict=True)]
    falls = fits & (_counted(w, hidden[relations:]) > 0.0)
    count = count + w.where(_counted(w, hidden[:relations]) > 0.0, 2.0, 0.0)
    refused = falls | (fits & (count > 0.0) & (w.magnitude(h) > LONGER * (RESOLVED * w.magnitude(span))))
    return Watched(now, count, refused, falls, share * w.magnitude(h))


def noted(w, before: Crossings, step: Watched, t_1, direction, counts) -> Crossings:
    """Return the signs after a step to `t_1`, which `counts` or not."""
    passed = counts & ((step.count > 0.0) | ((t_1 - before.by) * direction >= 0.0))
    by = w.where(step.refused, t_1, w.where(passed, direction * math.inf, before.by))
    first = counts & (step.count > 1.0) & w.equal(before.together, math.inf)
    last = tuple(w.where(counts, new, old) for new, old in zip(step.last, before.last, strict=True))
    return Crossings(last, by, before.count + w.where(counts, step.count, 0.0), w.where(first, t_1, before.together))
