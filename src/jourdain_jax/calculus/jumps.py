"""Search for jumps of functions along lines, by bisection towards the half with the larger
difference of values.

As the interval shrinks, the difference vanishes for a continuous function and remains for a jump.
"""

from collections.abc import Callable, Iterator

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float


def jumps(
    values: Callable[[np.ndarray], np.ndarray],
    a: Float[np.ndarray, "intervals variables"],
    b: Float[np.ndarray, "intervals variables"],
) -> Iterator[tuple[int, Float[np.ndarray, "variables"], Float[np.ndarray, "variables"]]]:
    """Yield the jumps between `a` and `b`, at most one per interval: the index of the entry that jumps most,
    and the points just before and after.

    `values`: function from points (points, variables) to values (points, entries).
    """
    least, floor = (1e-2, 1e-3) if jnp.result_type(float) == jnp.float32 else (1e-6, 1e-9)
    at_a, at_b = values(a), values(b)
    largest = np.nanmax(np.abs(np.concatenate([at_a, at_b])), axis=0, initial=0.0)
    size = np.maximum(largest, floor * np.max(largest, initial=0.0)) + np.finfo(largest.dtype).tiny
    # after 24 bisections a smooth function shows no relevant jump, after 48 an interval has no width
    for turn in range(48):
        middle = (a + b) / 2
        at_middle = values(middle)
        left, right = _off(at_a, at_middle, size), _off(at_middle, at_b, size)
        first = np.max(left, axis=1, initial=0.0) >= np.max(right, axis=1, initial=0.0)
        off = np.where(first[:, None], left, right)
        if turn >= 24 and not np.any(off > least):
            return
        a, b = np.where(first[:, None], a, middle), np.where(first[:, None], middle, b)
        at_a, at_b = np.where(first[:, None], at_a, at_middle), np.where(first[:, None], at_middle, at_b)
    for k in np.flatnonzero(np.max(off, axis=1, initial=0.0) > least):
        yield int(np.argmax(off[k])), a[k], b[k]


def _off(a: np.ndarray, b: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return differences of entries relative to their sizes."""
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.abs(b - a) / size
    return np.where(np.isfinite(difference), difference, 0.0)
