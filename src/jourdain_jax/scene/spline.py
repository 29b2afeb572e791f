"""Cubic spline through samples, for poses and prescribed coordinates known at discrete times.

On [t_k, t_k+1], of length h, with a = (t_k+1 - t)/h, b = 1 - a and the second derivatives m_k at the knots
(Press et al., Numerical Recipes, 3.3):

    s(t) = a v_k + b v_k+1 + ((a^3 - a) m_k + (b^3 - b) m_k+1) h^2/6
    h_k-1 m_k-1 + 2 (h_k-1 + h_k) m_k + h_k m_k+1 = 6 ((v_k+1 - v_k)/h_k - (v_k - v_k-1)/h_k-1)

The third derivative is continuous at the second and the second-last knot ("not a knot"). A piecewise linear
curve is no substitute: its second derivative is zero between knots, so its motion has no inertia force.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import all_finite, checked_real, known_numbers, real_type


class Spline(eqx.Module):
    """A twice continuously differentiable function of time through `values` at the times `ts`; linear
    beyond the ends.

        class Cart(jj.Scene):
            ...
            drive: jj.Spline                                 # jj.Spline(ts, positions)

            def prescribed(self, t):
                return {"x": self.drive(t)}

    **Arguments**

    - `ts`: knots, s, increasing; `values`: one number per knot. Two knots give a line, three a parabola, more
      a cubic spline.

    A spline is differentiable with respect to `values` and `ts`. It can be a field of a scene, a value in its
    methods, or an input. For samples of a smooth motion at intervals h its error is of order h^4.

    **Raises** ValueError for other shapes, times that do not increase, or numbers that are not finite.
    """

    ts: Float[Array, "samples"]  # s
    values: Float[Array, "samples"]

    def __init__(self, ts: Any, values: Any):
        self.ts, self.values = checked_samples("Spline", ts, values, 2, "coordinate")

    def __call__(self, t: Any) -> Array:
        """Return the value at time t (s)."""
        return smooth_through_samples(jnp.asarray(t, real_type()), self.ts, self.values)


def checked_samples(
    kind: str, ts, values, least: int, of: str
) -> tuple[Float[Array, "samples"], Float[Array, "samples"]]:
    """Return times and values, at least `least` of each, as checked arrays. `kind` and `of` name them in
    errors. Raises ValueError for other shapes and invalid numbers.
    """
    ts = checked_real(ts, f"`ts` of `{kind}`", advice="give times in s")
    values = checked_real(values, f"`values` of `{kind}`", advice="give one number per time")
    if ts.ndim != 1 or ts.shape[0] < least or values.shape != ts.shape:
        raise ValueError(
            f"`{kind}` was given times of shape {ts.shape} and values of shape {values.shape}, expected two "
            f"vectors of one length, at least {least}; give one value per time, and one `{kind}` per {of}"
        )
    knots, numbers = known_numbers(ts), known_numbers(values)
    if not (all_finite(knots) and np.all(np.diff(knots) > 0)):
        raise ValueError(
            f"the times of `{kind}` must be finite and increase from one to the next; sort the "
            "samples by time and merge samples of equal time"
        )
    if not all_finite(numbers):
        first = int(np.argmin(np.isfinite(numbers)))
        raise ValueError(
            f"value {first} of `{kind}` is {numbers[first]}, expected finite numbers; omit missing samples"
        )
    return ts, values


@jax.jit  # jitted so that its name appears in the trace and the search for kinks can skip it
def smooth_through_samples(t, ts, values):
    """Return the cubic spline through `values` at `ts`, at time(s) t."""
    m, inside = _second_derivatives(ts, values), jnp.clip(t, ts[0], ts[-1])
    k = jnp.clip(jnp.searchsorted(ts, inside, side="right") - 1, 0, ts.shape[0] - 2)
    h, rise = ts[k + 1] - ts[k], values[k + 1] - values[k]
    a, b = (ts[k + 1] - inside) / h, (inside - ts[k]) / h
    value = a * values[k] + b * values[k + 1] + ((a**3 - a) * m[k] + (b**3 - b) * m[k + 1]) * h**2 / 6
    slope = rise / h + ((3 * b**2 - 1) * m[k + 1] - (3 * a**2 - 1) * m[k]) * h / 6
    return value + slope * (t - inside)


def _second_derivatives(ts, values) -> Float[Array, "samples"]:
    h = jnp.diff(ts)
    bends = 6 * jnp.diff(jnp.diff(values) / h)
    if bends.shape[0] == 0:
        return jnp.zeros_like(values)
    if bends.shape[0] == 1:  # a parabola
        return jnp.broadcast_to(bends / (3 * (h[0] + h[1])), values.shape)
    # m_0 = (1 + first) m_1 - first m_2, and likewise at the other end
    first, last = h[0] / h[1], h[-1] / h[-2]
    middle = (2 * (h[:-1] + h[1:])).at[0].add(h[0] * (1 + first)).at[-1].add(h[-1] * (1 + last))
    below = h[:-1].at[0].set(0.0).at[-1].add(-h[-1] * last)
    above = h[1:].at[-1].set(0.0).at[0].add(-h[0] * first)
    m = jax.lax.linalg.tridiagonal_solve(below, middle, above, bends[:, None])[:, 0]
    return jnp.concatenate([(1 + first) * m[:1] - first * m[1:2], m, (1 + last) * m[-1:] - last * m[-2:-1]])
