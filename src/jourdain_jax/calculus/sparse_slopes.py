"""Sparse Jacobians G of constraints at many states: each constraint involves few coordinates, as in
a long chain.

    G x = f,   x shortest:      G G' y = f,   x = G' y

The time of a dense solution grows with the cube of the number of rows, that of a sparse solution of a
chain linearly.
"""

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from jourdain_jax.calculus.reals import all_finite, largest
from jourdain_jax.calculus.roots import shortest


@dataclass(frozen=True, eq=False)
class Pattern:
    """Positions of the structurally nonzero entries of a matrix. Values have a leading axis of states."""

    rows: np.ndarray  # row index of each entry
    columns: np.ndarray
    shape: tuple[int, int]
    fewest: int = 64  # number of rows from which a matrix may be treated as sparse

    @classmethod
    def of(cls, entries: Iterable[tuple[int, int]], shape: tuple[int, int]) -> "Pattern":
        """Return the pattern of `entries`, given as (row, column) pairs."""
        rows, columns = np.array(list(entries), int).reshape(-1, 2).T
        return cls(rows, columns, shape)

    @property
    def is_sparse(self) -> bool:
        """Return whether the matrix is large and sparse enough for sparse solution."""
        return self.shape[0] >= self.fewest and 16 * len(self.rows) <= self.shape[0] * self.shape[1]

    def dense(self, values: np.ndarray) -> np.ndarray:
        """Return the dense matrices, (states, rows, columns)."""
        found = np.zeros((len(values), *self.shape))
        found[:, self.rows, self.columns] = values
        return found

    def lengths(self, values: np.ndarray) -> np.ndarray:
        """Return the lengths of all rows, (states, rows)."""
        return np.sqrt(_summed(self.rows, self.shape[0], values**2))

    def shortest(
        self, values: np.ndarray, right: np.ndarray, typical: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Return the shortest x with `G x = right` at every state. Where the sparse solution fails, solve by
        dense matrices (`roots.shortest`).

        `typical`: typical row lengths, which limit the scaling of short rows.
        """
        if not self.is_sparse:
            return shortest(self.dense(values), right, typical)
        lengths = np.maximum(self.lengths(values), typical)
        d = 1 / np.where(lengths > 0, lengths, 1.0)
        scaled, right_scaled = d[:, self.rows] * values, d * right
        with np.errstate(invalid="ignore", over="ignore"):
            found = self.transposed_times(scaled, self.solved(scaled, right_scaled))
            left = _summed(self.rows, self.shape[0], scaled * found[:, self.columns]) - right_scaled
            others = ~(largest(left, 1) <= 1e-8 * largest(right_scaled, 1))
        if others.any():
            found[others] = shortest(self.dense(values[others]), right[others], typical)
        return found

    def solved(self, values: np.ndarray, f: np.ndarray) -> np.ndarray:
        """Return `(G G')^-1 f` at every state from one block-diagonal sparse system; NaN if singular or not
        finite.
        """
        from scipy import sparse
        from scipy.sparse.linalg import splu

        found, known = np.full(f.shape, np.nan), all_finite(values, axis=1) & all_finite(f, axis=1)
        states, (rows, columns) = np.arange(np.count_nonzero(known))[:, None], self.shape
        places = (states * rows + self.rows).ravel(), (states * columns + self.columns).ravel()
        G = sparse.csr_array(
            (values[known].ravel(), places), shape=(states.size * rows, states.size * columns)
        )
        with contextlib.suppress(RuntimeError):  # zero pivot
            factors = splu((G @ G.T).tocsc())
            found[known] = factors.solve(f[known].ravel()).reshape(-1, rows)
        return found

    def transposed_times(self, values: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return `G' y` at every state."""
        return _summed(self.columns, self.shape[1], values * y[:, self.rows])


def _summed(groups: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Return the sums of the values in each of `count` groups; values have a leading axis of states."""
    found = np.zeros((len(values), count))
    np.add.at(found, (slice(None), groups), values)
    return found
