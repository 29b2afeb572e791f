"""Extremes and integrals of a quantity along a motion, from its values at saved times and at the end.

Between saved times the quantity is a polynomial through nearby values. For the largest value, a polynomial p
of degree four goes through the five values around the largest; a fine grid and one step of Newton's method
for p'(s) = 0 locate its maximum. For the integral, a polynomial of degree three goes through the four values
around each interval; Simpson's rule integrates it exactly. With a time h between values, the error of the
maximum of a smooth quantity is of order h^5, that of its integral of order h^4. With saved values alone both
would be of order h^2.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Count, Scalar, described
from jourdain_jax.motion.trajectories.trajectory import Trajectory

Values = Float[Array, "times"]
FOR_EXTREMES, FOR_INTEGRALS = 5, 4  # numerics: number of values that determine a polynomial


def sampled(
    motion: Trajectory, quantity: str | Callable
) -> tuple[Float[Array, "more"], Float[Array, "more"], Count]:
    """Return times and values of a quantity, and the number of valid values. `quantity`: a name, or a
    function of a trajectory that returns its values at all times.

    Times are the saved times that were reached, followed by the end. The end replaces the last saved time if
    the two are very close. Remaining entries repeat the end.
    """
    reached, ts = jnp.sum(motion.valid), jnp.asarray(motion.ts)
    before, last = (ts[jnp.maximum(reached - k, 0)] for k in (2, 1))
    beyond = jnp.abs(motion.t_end - last)
    # An end very close to the last saved time replaces it, since a polynomial through both oscillates.
    place = reached - ((beyond > 0) & (beyond <= (1 / 16) * jnp.abs(last - before)))  # index of the end

    def with_end(values, end):
        kept = jnp.where((jnp.arange(len(values)) < place).reshape(-1, *[1] * end.ndim), values, end)
        return jnp.concatenate([kept, end[None]])

    work = None if motion.work is None else with_end(motion.work, jnp.full_like(motion.t_end, jnp.nan))
    times = with_end(ts, motion.t_end)
    whole = dataclasses.replace(
        motion, ts=times, q=with_end(motion.q, motion.q_end), u=with_end(motion.u, motion.u_end), work=work
    )
    values = whole[quantity] if isinstance(quantity, str) else quantity(whole)
    if getattr(values, "shape", None) != times.shape or jnp.iscomplexobj(values):
        raise ValueError(
            f"the quantity of an output is {described(values)}, expected real numbers of shape "
            f"({times.shape[0]},), one for each time of the motion"
        )
    return times, values, jnp.where(beyond > 0, place + 1, jnp.maximum(reached, 1))


def largest(times: Values, values: Values, count: Count) -> Scalar:
    """Return the maximum of the quantity over the first `count` of `values` and between them. Its derivative
    is that of the quantity at the time of the maximum.
    """
    k = jnp.argmax(jnp.where(jnp.arange(times.shape[0]) < count, values, -jnp.inf))
    if times.shape[0] < FOR_EXTREMES:
        return values[k]
    first, s, y = _window(times, values, count, k - FOR_EXTREMES // 2, k, FOR_EXTREMES)
    low = s[jnp.clip(k - 1 - first, 0, FOR_EXTREMES - 1)]
    high = s[jnp.clip(k + 1 - first, 0, FOR_EXTREMES - 1)]
    # a fine grid for the polynomial
    places = jnp.linspace(low, high, 33)
    near = places[jnp.argmax(jax.vmap(lambda place: _polynomial(s, y, place))(places))]
    slope = jax.grad(lambda place: _polynomial(s, y, place))
    bend = jax.grad(slope)(near)
    at = jnp.clip(near - jnp.where(bend < 0, slope(near) / jnp.where(bend < 0, bend, -1.0), 0.0), low, high)
    return jnp.where(
        count >= FOR_EXTREMES, jnp.maximum(values[k], _polynomial(s, y, jax.lax.stop_gradient(at))), values[k]
    )


def integral(times: Values, values: Values, count: Count) -> Scalar:
    """Return the integral over time of the first `count` of `values`."""

    def over(i):
        """Return the integral from time i to the next: h (y_i + 4 p(middle) + y_next) / 6, or the trapezoid
        if there are too few values for a polynomial.
        """
        even = 0.5 * (values[i] + values[i + 1])
        middle = even
        if times.shape[0] >= FOR_INTEGRALS:
            first, s, y = _window(times, values, count, i - 1, i, FOR_INTEGRALS)
            at = 0.5 * s[jnp.minimum(i + 1 - first, FOR_INTEGRALS - 1)]
            middle = jnp.where(count >= FOR_INTEGRALS, _polynomial(s, y, at), even)
        return jnp.where(i + 1 < count, (times[i + 1] - times[i]) * (2.0 * even + 4.0 * middle) / 6.0, 0.0)

    return jnp.sum(jax.vmap(over)(jnp.arange(times.shape[0] - 1)))


def _window(times, values, count, first, zero, points: int):
    """Return the index of the first of `points` neighbouring values (`first` if possible), their times
    relative to `zero` in units of the window, and the values.

    If there are fewer values than `points`, artificial times avoid a division by zero.
    """
    first = jnp.clip(first, 0, jnp.maximum(count - points, 0))
    some = first + jnp.arange(points)
    enough = count >= points
    since = jnp.where(enough, times[some] - times[zero], jnp.arange(points, dtype=times.dtype))
    return first, since / (since[-1] - since[0]), jnp.where(enough, values[some], 0.0)


def _polynomial(s: Float[Array, "points"], y: Float[Array, "points"], place: Scalar) -> Scalar:
    """Return the value at `place` of the polynomial through (s, y), by Lagrange's formula."""
    total = jnp.zeros_like(place)
    for i in range(s.shape[0]):
        factor = y[i]
        for j in range(s.shape[0]):
            factor = factor if i == j else factor * (place - s[j]) / (s[i] - s[j])
        total = total + factor
    return total
