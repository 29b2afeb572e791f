"""The largest value along a motion, also between the times at which it is saved.

Five saved values around the largest of them have one polynomial of fourth degree, whose largest value near there is found: on a fine grid, then by one step of
Newton's method for p'(s) = 0. For a smooth quantity the error is of the fifth order of the time between values; that of the largest saved value is of the
second.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

POINTS = 5
FINE = 33  # places at which the polynomial is looked at


def largest(times: Float[Array, "times"], values: Float[Array, "times"], reached: Bool[Array, "times"], end: Float[Array, ""]) -> Float[Array, ""]:
    """The largest of `values` at the `times` that were `reached` (the first ones), between them, and of the value at the `end`.

    Its derivatives are those of the value at the time of the largest one, whose own change does not count there.
    """
    seen = jnp.where(reached, values, -jnp.inf)
    k = jnp.argmax(seen)
    best = jnp.maximum(seen[k], end)
    if times.shape[0] < POINTS:
        return best
    count = jnp.sum(reached)
    first = jnp.clip(k - POINTS // 2, 0, jnp.maximum(count - POINTS, 0))
    some = first + jnp.arange(POINTS)
    enough = count >= POINTS
    unit = times[some[-1]] - times[some[0]]
    s = (times[some] - times[k]) / unit  # from -1 to 1
    y = jnp.where(enough, values[some], 0.0)
    low, high = s[jnp.maximum(k - 1 - first, 0)], s[jnp.minimum(k + 1 - first, POINTS - 1)]
    places = jnp.linspace(low, high, FINE)
    coarse = jax.vmap(lambda place: _polynomial(s, y, place))(places)
    near = places[jnp.argmax(coarse)]
    slope = jax.grad(lambda place: _polynomial(s, y, place))
    bend = jax.grad(slope)(near)
    at = jnp.clip(near - jnp.where(bend < 0, slope(near) / jnp.where(bend < 0, bend, -1.0), 0.0), low, high)
    between = _polynomial(s, y, jax.lax.stop_gradient(at))
    return jnp.where(enough, jnp.maximum(best, between), best)


def _polynomial(s: Float[Array, "points"], y: Float[Array, "points"], place: Float[Array, ""]) -> Float[Array, ""]:
    """The value at `place` of the polynomial through (s, y), by Lagrange's formula."""
    total = jnp.zeros_like(place)
    for i in range(POINTS):
        others = [j for j in range(POINTS) if j != i]
        factor = jnp.ones_like(place)
        for j in others:
            factor = factor * (place - s[j]) / (s[i] - s[j])
        total = total + y[i] * factor
    return total
