"""Scalar functions with bounds of their round-off (Higham, 2002, 3.3). Values and bounds share one array,
values first. With e_a, e_b the bounds of a and b,

    a + b    e_a + e_b + eps |a + b|
    a b      |a| e_b + |b| e_a + e_a e_b + eps |a b|
    a/b      (e_a + |a/b| e_b)/(|b| - e_b) + eps |a/b|

The bound is infinite if a divisor or radicand may be zero within its own bound.
"""

from collections.abc import Callable

import numpy as np

EPS = float(np.finfo(float).eps)
LOST = 1e3  # numerics: a divisor or radicand smaller than this many bounds may be zero


def with_bound(value: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return a value with the bound `error` plus its own rounding."""
    error += EPS * np.abs(value)
    return np.concatenate([value, error])


def halves(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split an array into its values and their bounds."""
    half = len(x) // 2
    return x[:half], x[half:]


def sum_(x, y):
    """Return a + b with its bound."""
    both, half = x + y, len(x) // 2
    both[half:] += EPS * np.abs(both[:half])
    return both


def difference(x, y):
    """Return a - b with its bound."""
    (a, ea), (b, eb) = halves(x), halves(y)
    return with_bound(a - b, ea + eb)


def negative(x):
    """Return -a with its bound."""
    return np.concatenate([-x[: len(x) // 2], x[len(x) // 2 :]])


def product(x, y):
    """Return a b with its bound."""
    (a, ea), (b, eb) = halves(x), halves(y)
    return with_bound(a * b, np.abs(a) * eb + (np.abs(b) + eb) * ea)


def quotient(x, y):
    """Return a/b with its bound."""
    (a, ea), (b, eb) = halves(x), halves(y)
    value, size = a / b, np.abs(b)
    error = (ea + np.abs(value) * eb) / size * (1 + 2 / LOST)
    return with_bound(value, np.where((eb > 0) & (size <= LOST * eb), np.inf, error))


def root(x):
    """Return the square root of a with the bound e_a/sqrt(a). It is twice the first-order bound, and holds
    even for a below e_a.
    """
    a, ea = halves(x)
    value = np.sqrt(a)
    return with_bound(
        value, np.where((ea > 0) & (np.abs(a) <= LOST * ea), np.inf, np.where(ea > 0, ea / value, 0.0))
    )


def wave(function: Callable) -> Callable:
    """Return sine or cosine with the bound min(e_a, 2), since slopes and values lie between -1 and 1."""

    def bounded(x):
        a, ea = halves(x)
        return with_bound(function(a), np.minimum(ea, 2.0))

    return bounded


def tangent(x):
    """Return tan a with its bound; its derivative is `1 + tan(a)^2`."""
    a, ea = halves(x)
    value = np.tan(a)
    return with_bound(value, 2 * (1 + value**2) * ea)
