"""Relations of loads, poses, rows and stop events, watched over each step: numbers whose signs decide between branches (`lowering/relations.py`).

A step at whose end some sign is another one than at its start is refused, and from then on steps go half of the way that is left to where it ended,

    h <= max((t_refused - t)/2, resolved),       resolved = span/1000

until one of them, which is no longer than that, passes the change. Zero has the sign of what was before; what is no number changes none.

Where one number k changes its sign in a step, all are also looked at where it vanishes, on the line between the states at the ends,

    y* = y_0 + s (y_1 - y_0),   t* = t_0 + s h,   s = k_0/(k_0 - k_1)

so that |x - a| < w is met although it holds at neither end: that counts as two changes more. After the relations come the values of stop events, if
relations decide these: one that is not positive at y* makes the step end there.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

# Of the span. Measured, a mass that passes brake strips of 0.03 to 30 % of half of its way, at a tolerance of 1e-8: 88 to 131 tried steps with 1/1,000 and
# 1/10,000, errors of 3e-8; with 1/100 strips of less than 0.2 % are passed in one step, and flagged. Without any, strips of 10 % are stepped over.
RESOLVED = 1e-3
LONGER = 1.01  # times that: a step that ends at a time asked for may be longer than the one that was meant


class Crossings(eqx.Module):
    """The signs of relations, and how often they have changed."""

    last: Float[Array, "numbers *lanes"] | None  # what they were last that was not zero
    by: Float[Array, "*lanes"] | None  # the time by which one is known to change, infinite where none is, with the sign of the motion
    count: Int[Array, "*lanes"]
    together: Float[Array, "*lanes"]  # the end of the first step in which two or more have changed; infinite: none

    def reach(self, t, direction, span) -> Float[Array, "*lanes"]:
        """How long a step from t may be."""
        return jnp.maximum(0.5 * (self.by - t) * direction, RESOLVED * span)

    def watched(
        self, values: Callable, relations: int, start: tuple[Array, PyTree], end: tuple[Array, PyTree], fits: Bool[Array, "*lanes"], h, span
    ) -> "Watched":
        """What a step h crosses from its `start` to its `end`, (t, y); `values`: (t, y) -> numbers, first `relations`; `fits`: it would be accepted."""
        now = _unless_zero(values(*end), self.last)
        crossed = _apart(now, self.last) & (jnp.arange(len(now)) < relations).reshape(-1, *[1] * h.ndim)
        count = jnp.sum(crossed, axis=0, dtype=jnp.int32)
        share = jnp.sum(jnp.where(crossed, self.last / (self.last - now), 0.0), axis=0)
        state = jax.tree.map(lambda a, b: a + jnp.where(count == 1, share, 0.0).astype(a.dtype) * (b - a), start, end)
        between = jax.lax.cond(eqxi.unvmap_any(count == 1), lambda: _unless_zero(values(*state), now), lambda: now)
        hidden = (count == 1) & _apart(between, now) & _apart(between, self.last)
        falls = fits & jnp.any(hidden[relations:], axis=0)
        count = count + 2 * jnp.any(hidden[:relations], axis=0)
        refused = falls | (fits & (count > 0) & (jnp.abs(h) > LONGER * RESOLVED * span))
        return jax.lax.stop_gradient(Watched(now, count, refused, falls, share * jnp.abs(h)))


class Watched(NamedTuple):
    """A step as relations see it."""

    last: Float[Array, "numbers *lanes"]
    count: Int[Array, "*lanes"]
    refused: Bool[Array, "*lanes"]
    falls: Bool[Array, "*lanes"]  # whether a stop event has happened where the one relation that changes does
    to_event: Float[Array, "*lanes"]  # the step that ends there

    def noted(self, before: Crossings, t_1, direction, counts: Bool[Array, "*lanes"]) -> Crossings:
        """The signs after a step to `t_1`, which `counts` or not."""
        passed = counts & ((self.count > 0) | ((t_1 - before.by) * direction >= 0))
        by = jnp.where(self.refused, t_1, jnp.where(passed, direction * jnp.inf, before.by))
        first = counts & (self.count > 1) & jnp.isinf(before.together)
        last = jnp.where(counts, self.last, before.last)
        return Crossings(last, by, before.count + jnp.where(counts, self.count, 0), jnp.where(first, t_1, before.together))


def _unless_zero(values, otherwise):
    return jnp.where((values > 0) | (values < 0), values, otherwise)


def _apart(a, b) -> Bool[Array, "..."]:
    """Whether their signs differ."""
    return ((a > 0) & (b < 0)) | ((a < 0) & (b > 0))


def begun(values: Float[Array, "numbers *lanes"], direction) -> Crossings:
    """The signs at a start."""
    never = jnp.full(values.shape[1:], jnp.inf, values.dtype)
    return jax.lax.stop_gradient(Crossings(_unless_zero(values, 0.0), direction * never, jnp.zeros(values.shape[1:], jnp.int32), never))
