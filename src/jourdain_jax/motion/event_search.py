"""Going back to a stop event inside the loop over steps: which shift of time brings the event value c to zero.

Every step of the search starts at (t_0, y_0), where its first slope gives the rate of c, and ends at t_1 = t_0 + h. The next shift is

    -c_1/s,   s = 2 (c_1 - c_0)/h - cdot_0     slope at t_1 of the parabola through c_0, cdot_0, c_1; cdot_0 itself where h is tiny

between times at which c is known to be positive and not to be; to their middle where that does not help. Shifts are numbers to differentiation,
but for the last ones, which are zero in value and carry the derivatives of the event time and of the state at the event (the saltation term): each is
an honest step, and Newton's method doubles the order at which it is right, so that they give derivatives up to the third.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

MOST_STEPS = 30
_DIFFERENTIABLE = 2


class Search(eqx.Module):
    """What is known of the event's time, for each lane."""

    before: Float[Array, "*lanes"]  # a time with c > 0
    after: Float[Array, "*lanes"]  # a time with c <= 0
    left: Int[Array, "*lanes"]  # steps; 0: found
    shift: Float[Array, "*lanes"]  # the next step, with its sign


def none(t: Float[Array, "*lanes"]) -> Search:
    """Nothing to search for."""
    t = jax.lax.stop_gradient(t)
    return Search(t, t, jnp.zeros(jnp.shape(t), jnp.int32), jnp.zeros_like(t))


def begun(t_0: Float[Array, "*lanes"], t_1: Float[Array, "*lanes"]) -> Search:
    """The search after a step from `t_0`, before the event, to `t_1`, beyond it."""
    t_0, t_1 = jax.lax.stop_gradient((t_0, t_1))
    return Search(t_0, t_1, jnp.full(jnp.shape(t_0), MOST_STEPS + 1, jnp.int32), jnp.zeros_like(t_0))


def advanced(search: Search, h, c_0, c_dot_0, t_1, c_1) -> Search:
    """The search after a step by `h` to the time `t_1`; `c_0`, `c_1`: values of the event at its ends (any unit), `c_dot_0`: the rate of the first."""
    left = jnp.maximum(search.left - 1, 0)
    now, c, h, c_0, rate = jax.lax.stop_gradient((t_1, c_1, h, c_0, c_dot_0))  # numbers to differentiation
    before, after = jnp.where(c > 0, now, search.before), jnp.where(c > 0, search.after, now)
    width = jnp.abs(after - before)
    small = jnp.sqrt(jnp.finfo(now.dtype).eps) * (jnp.abs(now) + width)
    large = jnp.abs(h) > small
    chord = jnp.where(large, (c - c_0) / jnp.where(large, h, 1.0), rate)
    slope = jnp.where(large, 2 * chord - rate, rate)
    # to the middle where the parabola bends back, leads far beyond, or the last step did little
    steep = slope * chord > 0
    shift = jnp.where(c == 0, 0.0, -c / jnp.where(steep, slope, 1.0))
    low, high = jnp.minimum(before, after) - now, jnp.maximum(before, after) - now
    sensible = (steep | (c == 0)) & (shift >= low - 0.1 * width) & (shift <= high + 0.1 * width)
    helped = ~large | (jnp.abs(c) <= 0.5 * jnp.abs(c_0)) | (left == MOST_STEPS)
    shift = jnp.where(sensible & helped, jnp.clip(shift, low, high), 0.5 * (low + high))
    # near enough: one more step to the event, then the differentiable ones
    left = jnp.where((left > _DIFFERENTIABLE) & (jnp.abs(c) <= small * jnp.abs(chord)), _DIFFERENTIABLE + 1, left)
    usable = (search.left > 0) & (jnp.abs(c) < (width + small) * jnp.abs(rate)) & jnp.isfinite(rate)
    newton = jnp.where(usable, -c_1 / jnp.where(usable, c_dot_0, 1.0), 0.0)
    return Search(before, after, left, jnp.where(left > _DIFFERENTIABLE, shift, newton))
