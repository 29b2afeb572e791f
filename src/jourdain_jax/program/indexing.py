"""`gather` and `scatter` on NumPy arrays, as far as plain indexing makes them: whole slices along all axes but those that are indexed.

All other cases (windows, batched indices, indices out of bounds) are answered with None.
"""

import numpy as np


def gathered(equation, x: np.ndarray, indices: np.ndarray) -> np.ndarray | None:
    """`x[..., indices, ...]`."""
    params = equation.params
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    axes = tuple(map(int, numbers.start_index_map))
    whole = all(size == (1 if axis in axes else x.shape[axis]) for axis, size in enumerate(sizes))
    if not whole or numbers.operand_batching_dims or set(map(int, numbers.collapsed_slice_dims)) != set(axes) or not _inside(x, axes, indices):
        return None
    found = np.moveaxis(x, axes, range(len(axes)))[tuple(np.moveaxis(indices, -1, 0))]
    first = indices.ndim - 1
    return np.moveaxis(found, range(first, found.ndim), tuple(map(int, numbers.offset_dims)))


def scattered(equation, x: np.ndarray, indices: np.ndarray, updates: np.ndarray) -> np.ndarray | None:
    """`x` with `updates` in the places `x[..., indices, ...]`."""
    numbers = equation.params["dimension_numbers"]
    axes = tuple(map(int, numbers.scatter_dims_to_operand_dims))
    window = tuple(map(int, numbers.update_window_dims))
    others = [n for axis, n in enumerate(x.shape) if axis not in axes]
    whole = [updates.shape[axis] for axis in window] == others
    if not whole or numbers.operand_batching_dims or set(map(int, numbers.inserted_window_dims)) != set(axes) or not _inside(x, axes, indices):
        return None
    result = np.array(x)
    first = indices.ndim - 1
    np.moveaxis(result, axes, range(len(axes)))[tuple(np.moveaxis(indices, -1, 0))] = np.moveaxis(updates, window, range(first, updates.ndim))
    return result


def _inside(x: np.ndarray, axes: tuple[int, ...], indices: np.ndarray) -> bool:
    sizes = np.array([x.shape[axis] for axis in axes])
    return bool(np.all((indices >= 0) & (indices < sizes)))
