"""Derivatives of constraints at many states by their entries; with few coordinates per constraint, as in a
long chain, linear systems are sparse.

    G G' y = f,   x = G' y

Dense matrices take a time that grows with the cube of the rows, sparse ones of a chain one that grows with the rows.
"""

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from jourdain_jax.calculus.reals import all_finite, largest
from jourdain_jax.calculus.roots import shortest


@dataclass(frozen=True, eq=False)
class Pattern:
    """Positions of the structurally nonzero entries of matrices, by rows. Their values have a leading axis of
    states.
    """

    rows: np.ndarray  # of each entry
    columns: np.ndarray
    shape: tuple[int, int]
    fewest: int = 64  # rows of a matrix that may be sparse

    @classmethod
    def of(cls, entries: Iterable[tuple[int, int]], shape: tuple[int, int]) -> "Pattern":
        """Return the pattern with entries at these places."""
        rows, columns = np.array(list(entries), int).reshape(-1, 2).T
        return cls(rows, columns, shape)

    @property
    def is_sparse(self) -> bool:
        """Whether there are many rows, and few entries in them."""
        return self.shape[0] >= self.fewest and 16 * len(self.rows) <= self.shape[0] * self.shape[1]

    def dense(self, values: np.ndarray) -> np.ndarray:
        """Return the matrices."""
        found = np.zeros((len(values), *self.shape))
        found[:, self.rows, self.columns] = values
        return found

    def lengths(self, values: np.ndarray) -> np.ndarray:
        """Return the lengths of all rows, (states, rows)."""
        return np.sqrt(_summed(self.rows, self.shape[0], values**2))

    def shortest(self, values: np.ndarray, right: np.ndarray, typical: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the shortest x with `G x = right` at every state; where the sparse solution fails, by dense
        matrices as `gauss_newton.shortest` does.

        `typical`: lengths of the rows, if some may be shorter.
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
        """Return `(G G')^-1 f` at every state, from one sparse system for all; NaN where it is singular or
        not finite.
        """
        from scipy import sparse
        from scipy.sparse.linalg import splu

        found, known = np.full(f.shape, np.nan), all_finite(values, axis=1) & all_finite(f, axis=1)
        states, (rows, columns) = np.arange(np.count_nonzero(known))[:, None], self.shape
        places = (states * rows + self.rows).ravel(), (states * columns + self.columns).ravel()
        G = sparse.csr_array((values[known].ravel(), places), shape=(states.size * rows, states.size * columns))
        with contextlib.suppress(RuntimeError):  # a pivot of zero
            factors = splu((G @ G.T).tocsc())
            found[known] = factors.solve(f[known].ravel()).reshape(-1, rows)
        return found

    def transposed_times(self, values: np.ndarray, y: np.ndarray) -> np.ndarray:
        """`G' y` at every state."""
        return _summed(self.columns, self.shape[1], values * y[:, self.rows])


def _summed(groups: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Return the sums of the values in each of `count` groups; values have a leading axis of states."""
    found = np.zeros((len(values), count))
    np.add.at(found, (slice(None), groups), values)
    return found
