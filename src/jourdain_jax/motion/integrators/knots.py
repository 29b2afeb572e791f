"""At which times steps must end, so that nothing of an input that is given by samples is passed over.

A step sees an input at a few times only, so that a short feature between them would be lost at any tolerance. `Sampled` inputs are straight lines between
knots: where steps end at the knots, each step has a smooth input, and nothing is lost. A knot at which the input hardly bends may be passed over: those
at which steps end are chosen so that the straight lines between them are nowhere off by more than

    max(0.1 min(rtol, 1e-4) (max v - min v), round-off)

at the knots in between. They are found one after the other: from the last one, lines to later knots must pass all knots in between within that distance.

A step that ends at a knot has stages there, and so has the step that begins there. Their derivatives with respect to time, and to the times of knots, are
those of the line within their own step (`SeenFromWithin`): the ends of steps need not move with the knots.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from jourdain_jax.motion.inputs import Inputs, Sampled


def knots_between(holders: PyTree, rtol, t0, t1, ts: Float[Array, "times"]) -> Float[Array, "knots"] | None:
    """Times since `t0`, in the order of the motion to `t1`, of the knots of all samples in `holders` at which steps must end, but for the saved times `ts`.

    Then infinite times, with the sign of the motion, at least one. None where there are no samples.
    """
    samples = [x for x in jax.tree.leaves(holders, is_leaf=lambda x: isinstance(x, Sampled)) if isinstance(x, Sampled) and len(x.ts) > 1]
    if not samples:
        return None
    t1, ts = jax.lax.stop_gradient((t1, ts))
    direction, span = jax.lax.stop_gradient((jnp.sign(t1 - t0), jnp.abs(t1 - t0)))
    # so far off the straight lines may be, in parts of the range of values; 1e-12 of the span: times nearer to each other than this are one
    share, near = 0.1 * jnp.minimum(rtol, 1e-4), 1e-12 * span
    # which times these are is a number to differentiation, the times are not: steps end where a knot is moved to
    since = jnp.concatenate([jnp.where(bends(x, share), (x.ts - t0) * direction, jnp.inf) for x in samples])
    ends = jnp.sort(jnp.concatenate([(ts - jax.lax.stop_gradient(t0)) * direction, jnp.stack([jnp.zeros_like(span), span])]))
    number = jax.lax.stop_gradient(since)
    after = jnp.clip(jnp.searchsorted(ends, number), 1, len(ends) - 1)
    is_end = jnp.minimum(jnp.abs(number - ends[after - 1]), jnp.abs(ends[after] - number)) <= near
    since = jnp.sort(jnp.where(is_end | (number < 0) | (number > span), jnp.inf, since))
    number = jax.lax.stop_gradient(since)
    repeated = jnp.concatenate([jnp.zeros(1, bool), number[1:] - number[:-1] <= near])
    return direction * jnp.append(jnp.sort(jnp.where(repeated, jnp.inf, since)), jnp.inf)


def bends(sampled: Sampled, share) -> Bool[Array, "samples"]:
    """The knots at which steps must end: the straight lines between them are off by `share` of the range of values at most, at the other knots."""
    t, v, share = jax.lax.stop_gradient((sampled.ts, sampled.values, share))
    allowed = jnp.maximum(share * (jnp.max(v) - jnp.min(v)), 16 * jnp.finfo(v.dtype).eps * jnp.max(jnp.abs(v)))

    def next_knot(carry, here):
        # lines from the anchor: to the knot before, and the slopes between which a line passes all knots since
        t_a, v_a, t_b, v_b, low, high = carry
        t_k, v_k = here
        slope = (v_k - v_a) / (t_k - t_a)
        straight = (slope >= low) & (slope <= high)
        t_a, v_a = jnp.where(straight, t_a, t_b), jnp.where(straight, v_a, v_b)
        least, most = (v_k - allowed - v_a) / (t_k - t_a), (v_k + allowed - v_a) / (t_k - t_a)
        low, high = jnp.where(straight, jnp.maximum(low, least), least), jnp.where(straight, jnp.minimum(high, most), most)
        return (t_a, v_a, t_k, v_k, low, high), ~straight

    start = (t[0], v[0], t[0], v[0], jnp.asarray(-jnp.inf, v.dtype), jnp.asarray(jnp.inf, v.dtype))
    _, bent = jax.lax.scan(next_knot, start, (t[1:], v[1:]))
    # `bent` tells at a knot that steps end at the one before
    return jnp.concatenate([(v[1] != v[0])[None], bent[1:], (v[-1] != v[-2])[None]])


class SeenFromWithin(eqx.Module):
    """An input by samples, at times of a step: at a knot it is on the line that belongs to the step."""

    sampled: Sampled
    middle: Float[Array, "*lanes"]  # s, of the step; infinite where there is none

    def __call__(self, t):
        """The value at time t, f_k + (t - t_k)/(t_{k+1} - t_k) (f_{k+1} - f_k)."""
        ts, values = self.sampled.ts, self.sampled.values
        at, middle, knots = jax.lax.stop_gradient((t, self.middle, ts))
        # 2.0**-10 of the way to the middle of a step: so far inside a time at its end lies to see on which side of a knot it is
        at = jnp.where(jnp.isfinite(middle), at + (2.0**-10) * (middle - at), at)
        k = jnp.clip(jnp.searchsorted(knots, at, side="right") - 1, 0, max(len(ts) - 2, 0))
        after = jnp.minimum(k + 1, len(ts) - 1)
        on_line = values[k] + (t - ts[k]) / jnp.where(after > k, ts[after] - ts[k], 1.0) * (values[after] - values[k])
        return jnp.where(at < knots[0], values[0], jnp.where(at > knots[-1], values[-1], on_line))


def seen_from_within(inputs: Inputs, middle: Float[Array, "*lanes"]) -> Inputs:
    """`inputs` whose samples are looked at in a step with this middle (s); infinite where there is no step yet."""

    def within(channel):
        sampled = channel.sampled if isinstance(channel, SeenFromWithin) else channel
        return SeenFromWithin(sampled, jax.lax.stop_gradient(middle)) if isinstance(sampled, Sampled) else channel

    return Inputs(tuple(within(channel) for channel in inputs.channels))
