"""Scales of speeds and rows over many states, in NumPy: what a row is judged by where it is short or vanishes."""

import numpy as np
from jaxtyping import Float


def speed_scales(M: Float[np.ndarray, "states speeds speeds"]) -> Float[np.ndarray, "states speeds"]:
    """Scales of the speeds (see `speed_scale`) at many states, by NumPy."""
    diagonal = np.diagonal(M, axis1=1, axis2=2)
    return np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1)), 1)


def typical_row_lengths(A: Float[np.ndarray, "states rows speeds"], elsewhere: Float[np.ndarray, "others rows speeds"]) -> Float[np.ndarray, "rows"]:
    """The length of each row at most states: the median, or the largest for a row that vanishes at half of them.

    A row that is round-off at all `A` of what it is `elsewhere`, off the geometric rows, keeps that length, and so counts as zero.
    """
    length, beyond = (usual_lengths_of(np.sqrt(np.sum(x**2, axis=2))) for x in (A, elsewhere))
    return np.where(length > np.sqrt(np.finfo(A.dtype).eps) * beyond, length, beyond)


def usual_lengths_of(length: Float[np.ndarray, "states rows"]) -> Float[np.ndarray, "rows"]:
    """The median over the states at which all are numbers, or the largest for a row that vanishes at half of them; 0 for one that always does."""
    length = length[np.all(np.isfinite(length), axis=1)]
    if not len(length):
        return np.zeros(length.shape[1], length.dtype)
    median = np.median(length, axis=0)
    return np.where(median > 0, median, length.max(axis=0))
