"""Equal intervals of time, where the motion is worked out that late sensors read between."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import is_traced

FEWEST_INTERVALS = 64  # up to the end of a run, or to the next node of a piece


def intervals(t0, ts: Float[Array | np.ndarray, "times"], node=None) -> int:
    """How many there are from the start to the last sample: those of the samples where these are equal, too; else none longer than their median.

    Of traced times only their number is known: there are two intervals for each of theirs, as if the first sample were at the start. Of a piece of a run the
    intervals up to the next `node` are counted so, and there are more beyond.
    """
    if is_traced((t0, ts)):
        return max(FEWEST_INTERVALS, 2 * (ts.shape[0] - 1))
    steps, end = np.diff(np.asarray(ts, float)), ts[-1] if node is None else node
    needed = float(end - t0) / np.median(steps) if steps.size else 1.0
    count = round(needed) if abs(needed - round(needed)) < 1e-6 * needed else int(np.ceil(needed))
    count *= -(-FEWEST_INTERVALS // count)
    return int(np.ceil(count * float((ts[-1] - t0) / (end - t0)) - 1e-9))


def grid(t0, ts: Float[Array | np.ndarray, "times"], count: int, node=None) -> Float[Array | np.ndarray, "grid"]:
    """So many intervals up to the last sample; those of a piece go on for at most one more, so that its next `node` is one of the times."""
    end = ts[-1] if node is None else node
    until = count if node is None or node == ts[-1] else int(count * float((end - t0) / (ts[-1] - t0)) + 1e-9)
    xp = jnp if is_traced((t0, end)) else np
    found = xp.asarray(t0 + (end - t0) * xp.arange(count + 1) / until, jnp.result_type(float))
    return xp.where(xp.arange(count + 1) == until, end, found)  # this one without round-off
