"""What a sensor shows of a quantity that is known at equal intervals of time: late by a delay, and through a first-order low-pass.

    reading(t) = y(t - delay),      lag y' + y = x,      y(t0) = x(t0):      the filter starts at rest

Between the times of the grid, x is the polynomial of degree 5 through the six nearest of them. With intervals h and a motion of angular frequency w its error
is 0.005 (w h)^6 of the amplitude, in the first and the last two intervals 0.02 (w h)^6. Near a jump J of the slope it is up to 0.18 J h, at the ends 0.26 J h;
near a jump J of the second derivative 0.032 J h^2, at the ends 0.075 J h^2. The filter acts on that polynomial exactly. With rho = lag / h:

    small rho     y = P + (y_k - P_k) exp(-s / rho),   P = sum_j (-rho)^j p^(j)       (P solves the equation; s: intervals since time k)
    large rho     y = y_k exp(-s / rho) + integral_0^s exp(-(s - a) / rho) p(a) da / rho       by Gauss-Legendre quadrature: P would lose digits

Both are smooth in delay and lag, at a lag of zero as well. Source: M. Abramowitz and I. A. Stegun, Handbook of Mathematical Functions (1964), 25.2 and 25.4.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

POINTS = 6  # of the grid, that a polynomial goes through
_MIDDLE = (POINTS - 1) / 2
_COEFFICIENTS = np.linalg.inv(np.vander(np.arange(POINTS) - _MIDDLE, increasing=True))  # of powers of the distance from the middle, from values
_SMALL = 0.2  # of rho
_LEAST = 1e-3  # of rho, in exp(-s / rho)
_NODES, _WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(10))
_NODES = _NODES + 0.5


def read(
    values: Float[Array | np.ndarray, "grid *channel"],
    grid: Float[Array | np.ndarray, "grid"],
    ts: Float[Array | np.ndarray, "times"],
    delay,
    lag=None,
    begin: Float[Array, "entries"] | None = None,
) -> tuple[Float[Array, "times *channel"], Float[Array | np.ndarray, "grid entries"]]:
    """What is shown at `ts` of a quantity with these `values` at the times `grid` (s, at equal intervals, six or more), and y there; `lag` None: there is none.

    Times before the first of the grid count as that. `delay`, `lag` in s. `begin`: what the filter gives at first; None: it starts at rest.
    """
    count, step = grid.shape[0], (grid[-1] - grid[0]) / (grid.shape[0] - 1)
    x = jnp.maximum((ts - delay - grid[0]) / step, 0.0)
    interval = jnp.clip(jnp.floor(jax.lax.stop_gradient(x)), 0, count - 2).astype(int)
    flat = values.reshape(count, -1)
    coefficients = _COEFFICIENTS.astype(flat.dtype)
    some = flat[_first(np.arange(count - 1), count)[:, None] + np.arange(POINTS)]
    polynomials = jnp.einsum("ij,kjc->kic", coefficients, some)  # (intervals, powers, channel)
    left = (np.arange(count - 1) - _first(np.arange(count - 1), count) - _MIDDLE).astype(flat.dtype)  # place of the interval's begin
    since = (x - interval)[:, None]
    if lag is None:
        found, y = _value(polynomials[interval], jnp.asarray(left)[interval][:, None] + since), flat
    else:
        rho = lag / step

        def next_one(y, here):
            polynomial, begin = here
            return _relaxed(y, polynomial, begin, jnp.ones((), flat.dtype), rho), y

        end, begins = jax.lax.scan(next_one, flat[0] if begin is None else begin, (polynomials, jnp.asarray(left)))
        found = jax.vmap(_relaxed, (0, 0, 0, 0, None))(begins[interval], polynomials[interval], jnp.asarray(left)[interval], since[:, 0], rho)
        y = jnp.concatenate([begins, end[None]])
    return found.reshape(ts.shape[0], *values.shape[1:]), y


def _first(interval: np.ndarray, count: int) -> np.ndarray:
    """The first of the points about an interval."""
    return np.clip(interval - (POINTS // 2 - 1), 0, count - POINTS)


def _value(polynomial: Float[Array, "*batch powers channel"], at) -> Float[Array, "*batch channel"]:
    found = polynomial[..., -1, :]
    for power in range(POINTS - 2, -1, -1):
        found = found * at + polynomial[..., power, :]
    return found


def _relaxed(y: Float[Array, "channel"], polynomial: Float[Array, "powers channel"], begin, since, rho) -> Float[Array, "channel"]:
    """What the filter gives `since` intervals after the place `begin`, where it gave `y`."""
    quick, slow = jnp.where(rho < _SMALL, rho, 0.5 * _SMALL), jnp.where(rho < _SMALL, 1.0, rho)
    # P = p - rho p' + rho^2 p'' - ...
    particular, derivative = polynomial, polynomial
    for order in range(1, POINTS):
        powers = jnp.arange(1, POINTS, dtype=polynomial.dtype)[:, None]
        derivative = jnp.concatenate([powers * derivative[1:], jnp.zeros_like(derivative[:1])])
        particular = particular + (-quick) ** order * derivative
    decay = jnp.exp(-since / jnp.maximum(quick, _LEAST))
    by_formula = _value(particular, begin + since) + (y - _value(particular, begin)) * decay
    weights = since / slow * jnp.asarray(_WEIGHTS, polynomial.dtype) * jnp.exp(-since * (1 - _NODES.astype(polynomial.dtype)) / slow)
    inside = jax.vmap(lambda node: _value(polynomial, begin + since * node))(jnp.asarray(_NODES, polynomial.dtype))
    by_quadrature = y * jnp.exp(-since / slow) + weights @ inside
    return jnp.where(rho < _SMALL, by_formula, by_quadrature)


def held(ts: Float[Array, "knots"], values: Float[Array, "knots"]) -> tuple[Float[Array, "more_knots"], Float[Array, "more_knots"]]:
    """Knots of a command that keeps each value until the next one: it passes over in a thousandth of the shortest interval, half of it before the time."""
    half = 0.5e-3 * jnp.min(jnp.diff(ts))
    late = jnp.stack([ts[1:] - half, ts[1:] + half], axis=1).reshape(-1)
    return jnp.concatenate([ts[:1], late]), jnp.concatenate([values[:1], jnp.stack([values[:-1], values[1:]], axis=1).reshape(-1)])


def filtered_held(ts: Float[Array, "knots"], values: Float[Array, "knots"], lag) -> Float[Array, "knots"]:
    """What the filter gives at the knots of such a command: y_k+1 = x_k + (y_k - x_k) exp(-h / lag)."""
    steps = jnp.diff(ts)
    decay = jnp.exp(-steps / jnp.maximum(lag, _LEAST * steps))

    def next_one(y, here):
        x, d = here
        y = x + (y - x) * d
        return y, y

    _, found = jax.lax.scan(next_one, values[0], (values[:-1], decay))
    return jnp.concatenate([values[:1], found])


def filtered(ts: Float[Array, "knots"], values: Float[Array, "knots"], lag) -> Float[Array, "knots"]:
    """What the same filter gives at the knots of samples that are linear in between: exactly there.

    y_k+1 = x_k+1 - lag m + (y_k - x_k + lag m) exp(-h / lag),     m = (x_k+1 - x_k) / h
    """
    steps = jnp.diff(ts)
    decay = jnp.exp(-steps / jnp.maximum(lag, _LEAST * steps))
    behind = lag * jnp.diff(values) / steps  # of the filter's output on a slope that lasts

    def next_one(y, here):
        x, following, b, d = here
        y = following - b + (y - x + b) * d
        return y, y

    _, found = jax.lax.scan(next_one, values[0], (values[:-1], values[1:], behind, decay))
    return jnp.concatenate([values[:1], found])
