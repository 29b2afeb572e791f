"""Which stop event of a step came first, and when: trials of shorter steps from the last state before it.

An event happens where its value falls through zero. A motion that starts with a value of zero, as round-off has it, and a rate that raises it goes on

    |c_0| <= noise c_0',   noise = eps^0.6 span

if the value is positive after a first step, which is tried again at half its length where it is not, down to that noise; then the event has happened at
the start, as it has where the value is lower, or does not rise.

All event values are positive at t_b, or rise from zero there, and one of them is not at t_a. What is not a number is not positive: such a value lies
beyond its boundary. Of the values that are not positive at t_a, the one whose secant from t_b falls to zero first is followed; the next trial, between t_b
and t_a, is by Chandrupatla's method (inverse quadratic interpolation where it is safe, otherwise the middle). Where a trial finds another event, all that
is after it no longer counts: so the event that is found has no other before it, as far as values were seen.

The times tried are numbers to differentiation. Near the event, shifts of Newton's method follow,

    t <- t - c/cdot,   y <- y + (shift of t) f

whose last ones are zero in value and carry the derivatives of the event time and of the state at the event (the saltation term): each is
an honest step, and Newton's method doubles the order at which it is right, so that they give derivatives up to the third. Where c is not a number beyond
the event, only values before it are known: then cdot, which may be infinite there, is a number too, and first derivatives are right.

Source: T. R. Chandrupatla, Advances in Engineering Software 28 (1997) 145-149.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

MOST_STEPS = 72
DIFFERENTIABLE = 2
FLAT = 1e-8  # of its mean rate over a step: a value that falls through zero so slowly has a root of several fold, or as good as that
LEAVES = 0.6  # exponent of round-off
LATE = 0.98  # of a step: a dip that is later is left to the next one


def reach_of_noise(span) -> Float[Array, "*lanes"]:
    """The time in which a value rises by no more than it may be below zero at a start."""
    return jnp.finfo(span.dtype).eps ** LEAVES * span


def at_start(c_0, c_dot_0, c_1, span) -> tuple[Bool[Array, "events *lanes"], Bool[Array, "events *lanes"]]:
    """Which events have happened at a state, of a start; and which values, though they rise from zero there, are not positive after a step."""
    c_0, c_dot_0, c_1 = jax.lax.stop_gradient((c_0, c_dot_0, c_1))
    rises = (c_dot_0 > 0) & (jnp.abs(c_0) <= reach_of_noise(span) * c_dot_0)
    beyond = ~(c_0 > 0)
    return beyond & ~rises, beyond & rises & ~(c_1 > 0)


class Bracket(eqx.Module):
    """Three times with the values of all events there: the last one tried, one on the other side of the event, and one that was either before."""

    t: Float[Array, "3 *lanes"]
    c: Float[Array, "3 events *lanes"]

    @property
    def before(self) -> Bool[Array, "*lanes"]:
        """Whether the last time tried is before the event."""
        return no_event(self.c[0])

    @property
    def ends(self) -> tuple[Float[Array, "events *lanes"], Float[Array, "events *lanes"]]:
        """Values before and after the event."""
        return jnp.where(self.before, self.c[0], self.c[1]), jnp.where(self.before, self.c[1], self.c[0])

    @property
    def first(self) -> Int[Array, "*lanes"]:
        """Index of the event that is the first to happen, by its secant."""
        before, after = self.ends
        share = before / (before - after)
        share = jnp.where(jnp.isfinite(share), share, 1.0)
        return jnp.argmin(jnp.where(after > 0, jnp.inf, share), axis=0).astype(jnp.int32)

    def narrowed(self, t: Float[Array, "*lanes"], c: Float[Array, "events *lanes"]) -> "Bracket":
        """The bracket, narrowed by the values at a time in between."""
        same = no_event(c) == self.before
        older = (jnp.where(same, self.t[1], self.t[0]), jnp.where(same, self.t[0], self.t[1]))
        older_c = (jnp.where(same, self.c[1], self.c[0]), jnp.where(same, self.c[0], self.c[1]))
        return Bracket(jnp.stack([t, *older]), jnp.stack([c, *older_c]))


def no_event(values: Float[Array, "events *lanes"]) -> Bool[Array, "*lanes"]:
    """Whether all values are positive, which NaN is not."""
    return jnp.all(values > 0, axis=0)


def bracket(t_0: Float[Array, "*lanes"], c_0, t_1: Float[Array, "*lanes"], c_1) -> Bracket:
    """What is known after a step from `t_0`, before the event, to `t_1`, after it."""
    t_0, c_0, t_1, c_1 = jax.lax.stop_gradient((t_0, c_0, t_1, c_1))
    return Bracket(jnp.stack([t_1, t_0, jnp.full_like(t_0, jnp.inf)]), jnp.stack([c_1, c_0, jnp.full_like(c_0, jnp.nan)]))


class Trial(eqx.Module):
    """Where to look next, or that the last time tried is near enough."""

    t: Float[Array, "*lanes"]
    near: Bool[Array, "*lanes"]


class OnArrays:
    """What the formulas of the search take of a `Writer` of machine code, for arrays of JAX."""

    where, magnitude, larger, smaller, root, equal = map(staticmethod, (jnp.where, jnp.abs, jnp.maximum, jnp.minimum, jnp.sqrt, jnp.equal))


def next_trial(known: Bracket, step: Float[Array, "*lanes"], last: Bool[Array, "*lanes"]) -> Trial:
    """The next time to try in a step of length `step`; with `last` the search ends, at a time where the value is a number."""
    return Trial(*trial(OnArrays, known.t, [chosen(known.first, c) for c in known.c], step, last, float(jnp.finfo(known.t.dtype).eps)))


def trial(w, t, c, step, last, eps: float) -> tuple:
    """The formulas of `next_trial`, of the times and values of a bracket; `w`: `OnArrays`, or a `Writer` of machine code."""
    (t_1, t_2, t_3), (c_1, c_2, c_3) = t, c
    width, tiny = t_2 - t_1, 2 * eps * (w.magnitude(t_1) + w.magnitude(t_2))
    xi, phi = (t_1 - t_2) / (t_3 - t_2), (c_1 - c_2) / (c_3 - c_2)
    safe = (phi * phi < xi) & ((1.0 - phi) * (1.0 - phi) < 1.0 - xi)
    inverse = c_1 / (c_2 - c_1) * c_3 / (c_2 - c_3) - (t_3 - t_1) / width * c_1 / (c_3 - c_1) * c_2 / (c_2 - c_3)
    share = w.where(w.equal(w.magnitude(t_3), math.inf), c_1 / (c_1 - c_2), w.where(safe, inverse, 0.5))
    share = w.where(w.magnitude(share) < math.inf, share, 0.5)
    least = w.smaller(tiny / w.magnitude(width), 0.5)
    # near in time by the slope, and small beside the value at the other end: neither says enough of a value that is flat, or that jumps; nor does the mean
    # slope over the whole step, before anything was tried
    slope, tried = (c_1 - c_3) / (t_1 - t_3), w.magnitude(t_3) < math.inf
    slope = w.where(w.magnitude(slope) < math.inf, slope, (c_1 - c_2) / (t_1 - t_2))
    small = (w.magnitude(c_1) <= math.sqrt(eps) * step * w.magnitude(slope)) & (w.magnitude(c_1) <= 1e-3 * w.magnitude(c_2))
    near = w.equal(c_1, 0.0) | (tried & small)
    closed = (w.magnitude(width) <= 2.0 * tiny) | last
    clipped = w.smaller(w.larger(share, least), 1.0 - least)
    return w.where(closed, t_2, t_1 + clipped * width), near | (closed & (w.magnitude(c_1) < math.inf))


class Search(eqx.Module):
    """What is known of the event's time, for each lane."""

    known: Bracket
    step: Float[Array, "*lanes"]  # length of the step in which the event lies
    left: Int[Array, "*lanes"]  # steps; 0: found
    shift: Float[Array, "*lanes"]  # the next step, with its sign
    slope: Float[Array, "events *lanes"]  # magnitude of the mean rate of the values over that step

    @property
    def trying(self) -> Bool[Array, "*lanes"]:
        """Whether trials start at the last state before the event; then Newton's shifts do, each where the last one ended."""
        return self.left > DIFFERENTIABLE + 1


def none(t: Float[Array, "*lanes"], values: Float[Array, "events *lanes"]) -> Search:
    """Nothing to search for."""
    t, c = jax.lax.stop_gradient((t, values))
    return Search(bracket(t, c, t, c), jnp.zeros_like(t), jnp.zeros(jnp.shape(t), jnp.int32), jnp.zeros_like(t), jnp.zeros_like(c))


def advanced(search: Search, begins: Bool[Array, "*lanes"], t_0, c_0, c_dot_0, t_1, c_1) -> Search:
    """The search after a step from `t_0` to `t_1`, with the values of all events there and the rates of the first; `begins`: it is the step of the event."""
    now, c = jax.lax.stop_gradient((t_1, c_1))
    fresh, narrowed = bracket(t_0, c_0, now, c), search.known.narrowed(now, c)
    trying = begins | search.trying
    known = jax.tree.map(lambda new, old, kept: jnp.where(begins, new, jnp.where(trying, old, kept)), fresh, narrowed, search.known)
    step = jnp.where(begins, jnp.abs(now - jax.lax.stop_gradient(t_0)), search.step)
    left = jnp.where(begins, MOST_STEPS, jnp.maximum(search.left - 1, 0))
    trial = next_trial(known, step, left <= DIFFERENTIABLE + 3)
    left = jnp.where(trying & trial.near, DIFFERENTIABLE + 1, left).astype(jnp.int32)
    shift = jnp.where(trial.near, 0.0, trial.t - jax.lax.stop_gradient(t_0))
    first = known.first
    slope = jnp.where(begins, mean_slope(fresh), search.slope)
    newton = newton_shift(known, step, chosen(first, c_1), chosen(first, c_dot_0), search.left > 0)
    newton = without_slope(newton, chosen(first, c_1), (search.left == 1) & is_flat(chosen(first, c_dot_0), chosen(first, slope)))
    return Search(known, step, left, jnp.where(trying, shift, newton), slope)


def mean_slope(known: Bracket) -> Float[Array, "events *lanes"]:
    """The magnitude of the mean rate of the values between the first two times of a bracket; zero where one of them is not finite."""
    slope = jnp.abs(known.c[0] - known.c[1]) / jnp.abs(known.t[0] - known.t[1])
    return jnp.where(jnp.isfinite(slope), slope, 0.0)


def is_flat(c_dot: Float[Array, "*lanes"], slope: Float[Array, "*lanes"]) -> Bool[Array, "*lanes"]:
    """Whether a value has no slope where it falls through zero, as far as its digits tell, beside its mean `slope` over the step."""
    c_dot, slope = jax.lax.stop_gradient((c_dot, slope))
    return jnp.abs(c_dot) <= FLAT * slope


@jax.custom_jvp
def without_slope(shift, c, flat: Bool[Array, "*lanes"]) -> Float[Array, "*lanes"]:
    """The shift to c = 0, whose derivative is not a number where the value is flat: the time of such an event has none that could be told."""
    return shift


@without_slope.defjvp
def _without_slope_jvp(primals, tangents):
    (shift, _, flat), (d_shift, dc, _) = primals, tangents
    return shift, jnp.where(flat, 0.0, 1.0) * d_shift + jnp.where(flat, jnp.nan, 0.0) * dc


def newton_shift(known: Bracket, step, c, c_dot, searching) -> Float[Array, "*lanes"]:
    """Newton's shift to c = 0, and zero where it says nothing; `step`: length of the step in which the event lies."""
    _, after = known.ends
    beyond = jnp.isnan(chosen(known.first, after))
    c_dot = jnp.where(beyond, jax.lax.stop_gradient(c_dot), c_dot)
    far = jnp.abs(known.t[0] - known.t[1]) + jnp.sqrt(jnp.finfo(known.t.dtype).eps) * step
    usable = searching & (jnp.abs(c) < far * jnp.abs(c_dot)) & jnp.isfinite(c_dot)
    shift = jnp.where(usable, -c / jnp.where(usable, c_dot, 1.0), 0.0)
    return jnp.where(beyond, shift - jax.lax.stop_gradient(shift), shift)


class Dip(eqx.Module):
    """Whether a value that is positive at both ends of a step falls below zero in between, and after which part of the step the first one is lowest."""

    happens: Bool[Array, "*lanes"]
    share: Float[Array, "*lanes"]


def dip(h: Float[Array, "*lanes"], c_0, c_dot_0, c_1, c_dot_1) -> Dip:
    """The dips of the cubics through values (those at the start positive) and rates (events, *lanes) at the ends of a step `h`."""
    share = lowest(OnArrays, jnp.ones_like(h), *jax.lax.stop_gradient((h, c_0, c_dot_0, c_1, c_dot_1)))
    return Dip(share < 1, share)


def lowest(w, share, h, c_0, c_dot_0, c_1, c_dot_1):
    """After which part of a step, of which all is the `share` at first, the first dip is lowest; `w`: as of `trial`.

    p(s) = c_0 + m_0 s + A s^2 + B s^3,   lowest at s = -m_0/(A + sqrt(A^2 - 3 B m_0))
    """
    for a, slope_a, b, slope_b in zip(c_0, c_dot_0, c_1, c_dot_1, strict=True):
        m_0, m_1 = h * slope_a, h * slope_b
        rise = b - a
        A, B = 3.0 * rise - 2.0 * m_0 - m_1, m_0 + m_1 - 2.0 * rise
        s = -m_0 / (A + w.root(w.larger(A * A - 3.0 * B * m_0, 0.0)))
        value = a + s * (m_0 + s * (A + s * B))
        dips = (b > 0.0) & (m_0 < 0.0) & (m_1 > 0.0) & (s < LATE) & (value < -1e-12 * (a + b))
        share = w.smaller(share, w.where(dips, s, 1.0))
    return share


def chosen(index, values: Float[Array, "events *lanes"]) -> Float[Array, "*lanes"]:
    """The value with this index, of the first one where there is none."""
    chosen = values[0]
    for i in range(1, len(values)):
        chosen = jnp.where(index == i, values[i], chosen)
    return chosen
