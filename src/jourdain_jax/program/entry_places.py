"""Flat places of the entries that a gather reads or a scatter writes, and both operations on NumPy arrays."""

import math
from collections.abc import Sequence

import jax
import numpy as np


def places(shape: Sequence[int], indices: np.ndarray, sizes: Sequence[int], axes, lanes, mode) -> np.ndarray:
    """Return the flat places of windows in an array of the given `shape`; their axes follow the axes of
    the indices.

    The windows have the given sizes and begin at `indices` along `axes`. A window beyond the array has places
    -1, unless the mode moves it inside. `lanes`: pairs of a batch axis of the array and of the indices.
    """
    begin = np.zeros((*indices.shape[:-1], len(shape)), int)
    begin[..., list(axes)] = indices
    for axis, along in lanes:
        begin[..., axis] = np.indices(indices.shape[:-1], sparse=True)[along]
    inside = np.clip(begin, 0, np.subtract(shape, sizes))
    strides = np.cumprod([1, *shape[:0:-1]])[::-1][: len(shape)]
    first = (inside @ strides)[(..., *[None] * len(shape))]
    found = first + np.arange(math.prod(shape)).reshape(shape)[tuple(map(slice, sizes))]
    if mode != jax.lax.GatherScatterMode.FILL_OR_DROP:
        return found
    beyond = np.any(begin != inside, axis=-1)
    return np.where(beyond.reshape(first.shape), -1, found)


def gathered(params, x: np.ndarray, indices: np.ndarray) -> np.ndarray | None:
    """Return the windows of x that begin at the indices; None if one lies beyond x."""
    n, count = params["dimension_numbers"], indices.ndim - 1
    lanes = zip(n.operand_batching_dims, n.start_indices_batching_dims, strict=True)
    found = places(x.shape, indices, params["slice_sizes"], n.start_index_map, lanes, params["mode"])
    if np.any(found < 0):
        return None
    found = np.squeeze(
        found, tuple(count + axis for axis in (*n.collapsed_slice_dims, *n.operand_batching_dims))
    )
    return np.ravel(x)[np.moveaxis(found, range(count, found.ndim), n.offset_dims)]


def targets(params, x, indices: np.ndarray, update) -> tuple[np.ndarray, np.ndarray]:
    """Return the flat places of x that a scatter changes, and the entries of `update` for these places."""
    n, count = params["dimension_numbers"], indices.ndim - 1
    moved = np.moveaxis(update, n.update_window_dims, range(count, update.ndim))
    window = iter(moved.shape[count:])
    alone = (*n.inserted_window_dims, *n.operand_batching_dims)
    sizes = [1 if axis in alone else next(window) for axis in range(x.ndim)]
    lanes = zip(n.operand_batching_dims, n.scatter_indices_batching_dims, strict=True)
    found = places(x.shape, indices, sizes, n.scatter_dims_to_operand_dims, lanes, params["mode"]).ravel()
    return found[found >= 0], moved.ravel()[found >= 0]


def scattered(params, x, indices: np.ndarray, update) -> np.ndarray | None:
    """Return x with the entries of `update` at its places; None if the scatter changes entries
    by a function.
    """
    if params["update_jaxpr"] is not None:
        return None
    flat, (where, entries) = x.flatten(), targets(params, x, indices, update)
    flat[where] = entries
    return flat.reshape(x.shape)
