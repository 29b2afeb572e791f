"""`gather` and `scatter` on NumPy arrays where plain indexing suffices: whole slices along all axes that are
not indexed.

All other cases (windows, indices out of bounds) are answered with None.
"""

import numpy as np


def gathered(equation, x: np.ndarray, indices: np.ndarray) -> np.ndarray | None:
    """`x[..., indices, ...]`."""
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    axes, lanes = _integers(numbers.start_index_map), _integers(numbers.operand_batching_dims)
    whole = all(size == (1 if axis in (*axes, *lanes) else x.shape[axis]) for axis, size in enumerate(sizes))
    places = _places(x, axes, lanes, _integers(numbers.start_indices_batching_dims), indices)
    if not whole or set(_integers(numbers.collapsed_slice_dims)) != set(axes) or places is None:
        return None
    found = np.moveaxis(x, (*lanes, *axes), range(len(places)))[places]
    return np.moveaxis(found, range(indices.ndim - 1, found.ndim), _integers(numbers.offset_dims))


def scattered(equation, x: np.ndarray, indices: np.ndarray, updates: np.ndarray) -> np.ndarray | None:
    """`x` with `updates` in the places `x[..., indices, ...]`."""
    numbers = equation.params["dimension_numbers"]
    axes, lanes = _integers(numbers.scatter_dims_to_operand_dims), _integers(numbers.operand_batching_dims)
    window = _integers(numbers.update_window_dims)
    whole = [updates.shape[axis] for axis in window] == [n for axis, n in enumerate(x.shape) if axis not in (*axes, *lanes)]
    places = _places(x, axes, lanes, _integers(numbers.scatter_indices_batching_dims), indices)
    if not whole or set(_integers(numbers.inserted_window_dims)) != set(axes) or places is None:
        return None
    result = np.array(x)
    np.moveaxis(result, (*lanes, *axes), range(len(places)))[places] = np.moveaxis(updates, window, range(indices.ndim - 1, updates.ndim))
    return result


def _places(x: np.ndarray, axes, lanes, lanes_of_indices, indices: np.ndarray) -> tuple[np.ndarray, ...] | None:
    """Index arrays for the axes `(*lanes, *axes)` of x; None where one is out of bounds."""
    sizes = np.array([x.shape[axis] for axis in axes], int)
    if not np.all((indices >= 0) & (indices < sizes)):
        return None
    every = np.indices(indices.shape[:-1], sparse=True)
    return *(every[axis] for axis in lanes_of_indices), *np.moveaxis(indices, -1, 0)


def _integers(numbers) -> tuple[int, ...]:
    return tuple(map(int, numbers))
