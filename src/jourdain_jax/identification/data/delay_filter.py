"""Delays and first-order low-pass filters of signals that are known at discrete times.

    lag y' + y = x,   y(t0) = x(t0);      read at t - delay

A motion is computed at equal intervals h. Between these times, x is the polynomial of degree 5 through the
six nearest points. Its error for an angular frequency w is `0.005 (w h)^6` of the amplitude, or
`0.02 (w h)^6` in the first and last two intervals. Near a jump J of the slope, the error is up to `0.18 J h`
(`0.26 J h` at the ends). Near a jump J of the second derivative, it is up to `0.032 J h^2` (`0.075 J h^2` at
the ends).

The filter is exact for that polynomial p. With rho = lag / h, and s intervals after time k:

    small rho     y = P + (y_k - P_k) exp(-s / rho),   P = sum_j (-rho)^j p^(j)       (P solves the equation)
    large rho     y = y_k exp(-s / rho) + integral_0^s exp(-(s - a) / rho) p(a) da / rho
                      by Gauss-Legendre quadrature

Both are smooth in delay and lag, even at a lag of zero. Source: M. Abramowitz and I. A. Stegun, Handbook of
Mathematical Functions (1964), 25.2 and 25.4.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Entries, array_module, is_traced, real_type

FEWEST_INTERVALS = 64  # numerics: up to the end of a run, or to the next node of a piece
Times = Float[Entries, "times"]
Knots = Float[Array, "knots"]


def intervals(t0, ts: Times, node) -> int:
    """Return the number of equal intervals from the start to the last sample. Equally spaced samples keep
    their intervals; otherwise no interval is longer than the median interval of the samples.

    If times are traced, only the number of samples is known, and there are two intervals per sample. For a
    piece of a run, intervals are counted to the next `node`, after which the grid continues.
    """
    if is_traced((t0, ts)):
        return max(FEWEST_INTERVALS, 2 * (ts.shape[0] - 1))
    steps, end = np.diff(np.asarray(ts, float)), ts[-1] if node is None else node
    needed = float(end - t0) / np.median(steps) if steps.size else 1.0
    count = round(needed) if abs(needed - round(needed)) < 1e-6 * needed else int(np.ceil(needed))
    count *= -(-FEWEST_INTERVALS // count)
    return int(np.ceil(count * float((ts[-1] - t0) / (end - t0)) - 1e-9))


def grid(t0, ts: Times, count: int, node=None) -> Float[Entries, "grid"]:
    """Return the grid of `count` intervals to the last sample. For a piece it extends by at most one more
    interval, so that the next `node` is a grid time.
    """
    end = ts[-1] if node is None else node
    until = count if node is None or node == ts[-1] else int(count * float((end - t0) / (ts[-1] - t0)) + 1e-9)
    xp = array_module((t0, end))
    found = xp.asarray(t0 + (end - t0) * xp.arange(count + 1) / until, real_type())
    return xp.where(xp.arange(count + 1) == until, end, found)  # without round-off at this time


POINTS = 6  # numerics: grid points that determine a polynomial
_MIDDLE = (POINTS - 1) / 2  # numerics
# values -> coefficients, highest power first
_COEFFICIENTS = np.linalg.inv(np.vander(np.arange(POINTS) - _MIDDLE))
_LEAST = 1e-3  # numerics: lower limit of rho in exp(-s / rho)


def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of the quadrature from 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


_NODES, _WEIGHTS = gauss_legendre(10)


def read(
    values: Float[Entries, "grid *channel"],
    grid: Float[Entries, "grid"],
    ts: Times,
    delay,
    lag=None,
    begin: Float[Array, "entries"] | None = None,
) -> tuple[Float[Array, "times *channel"], Float[Entries, "grid entries"]]:
    """Return the reading at `ts` of a quantity with these `values` at the times `grid` (s; six or more,
    equally spaced), and y on the grid. `lag`: None for no filter.

    Times before the grid count as its first time. `delay`, `lag` in s. `begin`: the initial output of the
    filter; None: its steady value.
    """
    count, step = grid.shape[0], (grid[-1] - grid[0]) / (grid.shape[0] - 1)
    x = jnp.maximum((ts - delay - grid[0]) / step, 0.0)
    interval = jnp.clip(jnp.floor(jax.lax.stop_gradient(x)), 0, count - 2).astype(int)
    flat = values.reshape(count, -1)
    coefficients = _COEFFICIENTS.astype(flat.dtype)
    begins = np.arange(count - 1)
    first = np.clip(begins - (POINTS // 2 - 1), 0, count - POINTS)  # of the points about each interval
    some = flat[first[:, None] + np.arange(POINTS)]
    polynomials = jnp.einsum("ij,kjc->kic", coefficients, some)  # (intervals, powers, channel)
    left = jnp.asarray(begins - first - _MIDDLE, flat.dtype)  # position of the interval's start
    since = x - interval
    if lag is None:
        found, y = jax.vmap(jnp.polyval)(polynomials[interval], left[interval] + since), flat
    else:
        rho = lag / step

        def next_one(y, here):
            polynomial, begin = here
            return _relaxed(y, polynomial, begin, jnp.ones((), flat.dtype), rho), y

        end, at_begins = jax.lax.scan(next_one, flat[0] if begin is None else begin, (polynomials, left))
        found = jax.vmap(_relaxed, (0, 0, 0, 0, None))(
            at_begins[interval], polynomials[interval], left[interval], since, rho
        )
        y = jnp.concatenate([at_begins, end[None]])
    return found.reshape(ts.shape[0], *values.shape[1:]), y


def _relaxed(
    y: Float[Array, "channel"], polynomial: Float[Array, "powers channel"], begin, since, rho
) -> Float[Array, "channel"]:
    """Return the output of the filter `since` intervals after the time `begin`, where it was `y`."""
    small = rho < 0.2
    quick, slow = jnp.where(small, rho, 0.1), jnp.where(small, 1.0, rho)
    # P = p - rho p' + rho^2 p'' - ...
    particular, derivative = polynomial, polynomial
    for order in range(1, POINTS):
        powers = np.arange(POINTS - 1, 0, -1, polynomial.dtype)[:, None]
        derivative = jnp.concatenate([jnp.zeros_like(derivative[:1]), powers * derivative[:-1]])
        particular = particular + (-quick) ** order * derivative
    decay = jnp.exp(-since / jnp.maximum(quick, _LEAST))
    by_formula = jnp.polyval(particular, begin + since) + (y - jnp.polyval(particular, begin)) * decay
    nodes, parts = (jnp.asarray(x, polynomial.dtype) for x in (_NODES, _WEIGHTS))
    weights = since / slow * parts * jnp.exp(-since * (1 - nodes) / slow)
    inside = jax.vmap(lambda node: jnp.polyval(polynomial, begin + since * node))(nodes)
    by_quadrature = y * jnp.exp(-since / slow) + weights @ inside
    return jnp.where(small, by_formula, by_quadrature)


def held(ts: Knots, values: Knots) -> tuple[Float[Array, "more_knots"], Float[Array, "more_knots"]]:
    """Return times and values of a command that keeps each value until the next sample. Each change takes a
    thousandth of the shortest interval, with its middle at the stated time.
    """
    half = 0.5e-3 * jnp.min(jnp.diff(ts))
    late = jnp.stack([ts[1:] - half, ts[1:] + half], axis=1).reshape(-1)
    return jnp.concatenate([ts[:1], late]), jnp.concatenate(
        [values[:1], jnp.stack([values[:-1], values[1:]], axis=1).reshape(-1)]
    )


def filtered(ts: Knots, values: Knots, lag, hold: bool = False) -> Knots:
    """Return the exact output of the filter at the samples of a command that is linear between samples, or
    held until the next sample.

        y_k+1 = x_k+1 - lag m + (y_k - x_k + lag m) exp(-h / lag),     m = (x_k+1 - x_k) / h
        held:   y_k+1 = x_k + (y_k - x_k) exp(-h / lag)
    """
    steps = jnp.diff(ts)
    decay = jnp.exp(-steps / jnp.maximum(lag, _LEAST * steps))
    behind = 0 * steps if hold else lag * jnp.diff(values) / steps  # lag behind a steady slope
    ends = values[:-1] if hold else values[1:]

    def next_one(y, here):
        x, end, b, d = here
        y = end - b + (y - x + b) * d
        return y, y

    _, found = jax.lax.scan(next_one, values[0], (values[:-1], ends, behind, decay))
    return jnp.concatenate([values[:1], found])
