"""Choose the knots of sampled inputs at which steps end.

A step evaluates an input only a few times and could miss a short feature at any tolerance. `Sampled` inputs
are piecewise linear with knots at their sample times. Steps end at knots, so that the input is smooth within
each step. A knot is skipped if the polygon through the other knots deviates from it by at most

    max(0.1 min(rtol, 1e-4) (max v - min v), round-off)

Knots are chosen greedily: the line from one to the next must pass all knots in between within that distance.

The steps before and after a knot both evaluate the input there. Each step takes derivatives with respect to
time and knot times from the line on its own side (`SeenFromWithin`), so that ends of steps need not move with
the knots.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import PerLane, PerTime, largest
from jourdain_jax.integrate.inputs import Inputs, Sampled


def knots_between(samples: Sequence[Sampled], rtol, t0, t1, ts: PerTime) -> Float[Array, "knots"]:
    """Return the knots of `samples` at which steps must end: times since `t0`, in the order of the motion,
    excluding the times `ts`. At least one infinite time follows.
    """
    t1, ts = jax.lax.stop_gradient((t1, ts))
    direction, span = jax.lax.stop_gradient((jnp.sign(t1 - t0), jnp.abs(t1 - t0)))
    # tolerance of the polygon, relative to the range of values; times closer than 1e-12 of the span coincide
    share, near = 0.1 * jnp.minimum(rtol, 1e-4), 1e-12 * span
    # the choice of knots has no derivative, but their times do
    since = jnp.concatenate([jnp.where(bends(x, share), (x.ts - t0) * direction, jnp.inf) for x in samples])
    ends = jnp.sort(
        jnp.concatenate(
            [(ts - jax.lax.stop_gradient(t0)) * direction, jnp.stack([jnp.zeros_like(span), span])]
        )
    )
    number = jax.lax.stop_gradient(since)
    after = jnp.clip(jnp.searchsorted(ends, number), 1, len(ends) - 1)
    is_end = jnp.minimum(jnp.abs(number - ends[after - 1]), jnp.abs(ends[after] - number)) <= near
    since = jnp.sort(jnp.where(is_end | (number < 0) | (number > span), jnp.inf, since))
    number = jax.lax.stop_gradient(since)
    repeated = jnp.append(False, number[1:] - number[:-1] <= near)
    return direction * jnp.append(jnp.sort(jnp.where(repeated, jnp.inf, since)), jnp.inf)


def bends(sampled: Sampled, share) -> Bool[Array, "samples"]:
    """Return at which samples steps must end: straight lines between these samples deviate from the others by
    at most `share` of the range of values.
    """
    t, v, share = jax.lax.stop_gradient((sampled.ts, sampled.values, share))
    allowed = jnp.maximum(share * (jnp.max(v) - jnp.min(v)), 16 * jnp.finfo(v.dtype).eps * largest(v))

    def next_knot(carry, here):
        # anchor, last knot, and the range of slopes from the anchor that pass all knots since
        t_a, v_a, t_b, v_b, low, high = carry
        t_k, v_k = here
        slope = (v_k - v_a) / (t_k - t_a)
        straight = (slope >= low) & (slope <= high)
        t_a, v_a = jnp.where(straight, t_a, t_b), jnp.where(straight, v_a, v_b)
        least, most = (v_k - allowed - v_a) / (t_k - t_a), (v_k + allowed - v_a) / (t_k - t_a)
        low = jnp.where(straight, jnp.maximum(low, least), least)
        high = jnp.where(straight, jnp.minimum(high, most), most)
        return (t_a, v_a, t_k, v_k, low, high), ~straight

    start = (t[0], v[0], t[0], v[0], jnp.asarray(-jnp.inf, v.dtype), jnp.asarray(jnp.inf, v.dtype))
    _, bent = jax.lax.scan(next_knot, start, (t[1:], v[1:]))
    # if `bent` at a knot, a step ends at the previous knot
    return jnp.hstack([v[1] != v[0], bent[1:], v[-1] != v[-2]])


class SeenFromWithin(eqx.Module):
    """Sampled input within one step. At a knot it uses the line of this step, not that of the next."""

    sampled: Sampled
    middle: PerLane  # middle of the step, s; infinite if there is no step

    def __call__(self, t):
        """Return the value at time t, `f_k + (t - t_k)/(t_{k+1} - t_k) (f_{k+1} - f_k)`."""
        ts, values = self.sampled.ts, self.sampled.values
        at, middle, knots = jax.lax.stop_gradient((t, self.middle, ts))
        # to select the side of a knot, shift t towards the middle of the step, by 2.0**-10 of the distance
        at = jnp.where(jnp.isfinite(middle), at + (2.0**-10) * (middle - at), at)
        k = jnp.clip(jnp.searchsorted(knots, at, side="right") - 1, 0, max(len(ts) - 2, 0))
        after = jnp.minimum(k + 1, len(ts) - 1)
        on_line = values[k] + (t - ts[k]) / jnp.where(after > k, ts[after] - ts[k], 1.0) * (
            values[after] - values[k]
        )
        return jnp.where(at < knots[0], values[0], jnp.where(at > knots[-1], values[-1], on_line))


def seen_from_within(inputs: Inputs, middle: PerLane) -> Inputs:
    """Return `inputs`, with samples seen from within the step around `middle` (s; infinite: no step)."""

    def within(channel):
        sampled = channel.sampled if isinstance(channel, SeenFromWithin) else channel
        if isinstance(sampled, Sampled):
            return SeenFromWithin(sampled, jax.lax.stop_gradient(middle))
        return channel

    return Inputs(tuple(within(channel) for channel in inputs.channels))
