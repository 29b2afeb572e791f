"""Gauss-Newton on NumPy, at many states at once: the root of g nearest to x.

    x <- x - G+ g(x),   G = dg/dx

Rows count as dependent where the triangular factor of the scaled rows says so; then small singular values are left out.
"""

from collections.abc import Callable

import numpy as np

# x of some states, and their numbers -> g, G in the form that `solve` takes
Look = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def nearest_root(
    look: Look, solve: Callable, x: np.ndarray, *, most: int = 25, longest: np.ndarray | float = np.inf, within: tuple = (-np.inf, np.inf)
) -> tuple[np.ndarray, np.ndarray]:
    """Return x with g(x) = 0 near the given x, shape (states, unknowns), and the last corrections relative to 1 + |x|, infinite where they are no numbers.

    `solve`: from G and g to the shortest d with G d = g. No step is longer than `longest` in an entry, and none leads out of the bounds `within`.
    """
    x, last, moving = np.array(x, float), np.full(len(x), np.inf), np.arange(len(x))
    for _ in range(most):
        g, G = look(x[moving], moving)
        step = solve(G, g)
        size = np.max(np.abs(step), axis=1, initial=0.0)
        moves = np.isfinite(size)
        last[moving[~moves]] = np.inf
        step, size, moving = step[moves], size[moves], moving[moves]
        shorter = np.maximum(1.0, np.max(np.abs(step) / longest, axis=1, keepdims=True, initial=0.0))
        x[moving] = np.clip(x[moving] - step / shorter, *within)
        last[moving] = size / (1 + np.max(np.abs(x[moving]), axis=1, initial=0.0))
        moving = moving[last[moving] > 4 * np.finfo(float).eps]
        if not moving.size:
            break
    return x, last


def shortest(G: np.ndarray, g: np.ndarray, typical: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the shortest d with G d = g at every state; least squares where the rows are (nearly) dependent, or shorter than they typically are."""
    return (pseudo_inverses(G, typical) @ g[..., None])[..., 0]


def pseudo_inverses(G: np.ndarray, typical: np.ndarray | float = 0.0) -> np.ndarray:
    """Return G+ at every state, with rows scaled to a length of one, or to less where they are shorter than they typically are; NaN where G is no number."""
    lengths = np.maximum(np.linalg.norm(G, axis=2), typical)
    d = 1 / np.where(lengths > 0, lengths, 1.0)
    found, finite = np.full(np.swapaxes(G, 1, 2).shape, np.nan), np.all(np.isfinite(G), axis=(1, 2))
    scaled = d[..., None] * G
    places = np.flatnonzero(finite)
    if G.shape[1] <= G.shape[2]:
        Q, R = np.linalg.qr(np.swapaxes(scaled[finite], 1, 2))  # D G = R' Q'
        # where the triangular factor has a smaller diagonal, singular values decide
        regular = np.min(np.abs(np.diagonal(R, axis1=1, axis2=2)), axis=1, initial=1.0) > 1e-6
        found[places[regular]] = Q[regular] @ np.swapaxes(np.linalg.inv(R[regular]), 1, 2)
        places = places[~regular]
    for k in places:
        found[k] = _by_singular_values(scaled[k])
    return found * d[:, None]


def _by_singular_values(G: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.pinv(G, rcond=1e-9)
    except np.linalg.LinAlgError:  # numbers too far apart for a decomposition
        return np.full(G.shape[::-1], np.nan)
