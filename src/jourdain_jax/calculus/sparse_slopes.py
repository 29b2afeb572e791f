"""Derivatives of rows at many states by their entries; where each row holds few coordinates, as in a long chain, elimination keeps to a band.

    (G G' + damping) y = f,   x = G' y          rows in such an order that the entries of G G' lie near the diagonal

Dense matrices take a time that grows with the cube of the rows, a band one that grows with the rows. Where few rows are stated, or no order of them gives a
narrow band, matrices are dense. Source: E. Cuthill and J. McKee, Proc. 24th Nat. Conf. ACM (1969) 157, for the order.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jourdain_jax.calculus.gauss_newton import shortest

FEWEST_ROWS, NARROW = 64, 8  # on NumPy: with fewer rows, and with so many times the width of the band or fewer, matrices are dense
REGULAR = 1e8  # the largest inverse of G G', rows of length one, of which nothing is lost that a second step does not make good


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where matrices of rows have entries that are not zero by structure; values of these have a leading axis of states."""

    rows: np.ndarray  # of each entry
    columns: np.ndarray
    shape: tuple[int, int]
    fewest: int = FEWEST_ROWS  # rows of a matrix whose band is looked for

    @classmethod
    def of(cls, entries: Iterable[tuple[int, int]], shape: tuple[int, int]) -> "Pattern":
        """The pattern with entries at these places."""
        rows, columns = np.array(list(entries), int).reshape(-1, 2).T
        return cls(rows, columns, shape)

    def dense(self, values: np.ndarray) -> np.ndarray:
        """The matrices."""
        found = np.zeros((len(values), *self.shape))
        found[:, self.rows, self.columns] = values
        return found

    def lengths(self, values: np.ndarray) -> np.ndarray:
        """The lengths of all rows, (states, rows)."""
        return np.linalg.norm(self.dense(values), axis=2) if self.band is None else np.sqrt(summed(self.rows, self.shape[0], values**2))

    def shortest(self, values: np.ndarray, right: np.ndarray, typical: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the shortest x with `G x = right` at every state, within the band where rows are surely independent.

        `typical`: lengths of the rows, where one may be shorter.
        """
        if self.band is None:
            return shortest(self.dense(values), right, typical)
        lengths = np.maximum(self.lengths(values), typical)
        d = 1 / np.where(lengths > 0, lengths, 1.0)
        scaled = d[:, self.rows] * values
        y, size = self.band.solved(scaled, np.zeros(len(values)), d * right)
        found, others = self.transposed_times(scaled, y), ~(size < REGULAR)
        if others.any():
            found[others] = shortest(self.dense(values[others]), right[others], typical)
        return found

    @cached_property
    def band(self) -> "Band | None":
        """The band of the products of rows; None where that is not narrow."""
        if self.shape[0] < self.fewest:
            return None
        found = Band.of(self)
        return found if NARROW * (found.width + 1) <= self.shape[0] else None

    def transposed_times(self, values: np.ndarray, y: np.ndarray) -> np.ndarray:
        """`G' y` at every state."""
        return summed(self.columns, self.shape[1], values * y[:, self.rows])


@dataclass(frozen=True)
class Band:
    """`G G'` by diagonals: what of it lies on and below its diagonal, `width` of them, the rows put into such an order that these are few."""

    order: np.ndarray  # numbers of rows
    width: int
    pairs: tuple[np.ndarray, np.ndarray]  # of entries of G that share a column
    places: np.ndarray  # of their products: the column of the band times (width + 1), and how far below the diagonal

    @classmethod
    def of(cls, pattern: Pattern) -> "Band":
        """The band of a pattern."""
        by_column: list[list[int]] = [[] for _ in range(pattern.shape[1])]
        for entry, column in enumerate(pattern.columns.tolist()):
            by_column[column].append(entry)
        neighbours: list[set[int]] = [set() for _ in range(pattern.shape[0])]
        for those in by_column:
            sharing = set(pattern.rows[those].tolist())
            for row in sharing:
                neighbours[row] |= sharing
        order = np.array(_narrowing_order(neighbours), int)
        place = np.argsort(order)
        at = place[pattern.rows]
        a, b = np.array([(a, b) for those in by_column for a in those for b in those if at[a] >= at[b]], int).reshape(-1, 2).T
        width = int(np.max(at[a] - at[b], initial=0))
        return cls(order, width, (a, b), at[b] * (width + 1) + at[a] - at[b])

    @property
    def size(self) -> int:
        """How many numbers the band is kept in: columns from the diagonal down, with columns of zeros behind them."""
        return (len(self.order) + self.width) * (self.width + 1)

    def solved(self, values: np.ndarray, damping: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`(G G' + damping)^-1 f`, and about how large the inverse is, at every state; `G G' = L D L'`.

        How large: by the solution for a right-hand side of ones whose signs make it grow (Cline, Moler, Stewart and Wilkinson, SIAM J. Numer. Anal. 16, 1979).
        """
        (a, b), (states, n), width = self.pairs, f.shape, self.width
        L = summed(self.places, self.size, values[:, a] * values[:, b]).T.reshape(n + width, width + 1, states)
        L[:n, 0] += damping
        x = np.zeros((n + width, 2, states))
        x[:n, 0] = f.T[self.order]
        with np.errstate(all="ignore"):
            for k in range(n):
                below = L[k, 1:] / L[k, 0]
                for j in range(width):
                    L[k + 1 + j, : width - j] -= below[j] * L[k, 1 + j :]
                L[k, 1:] = below
                x[k, 1] += np.copysign(1.0, x[k, 1])
                x[k + 1 : k + 1 + width] -= below[:, None] * x[k]
            x[:n] /= L[:n, :1]
            for k in reversed(range(n)):
                x[k] -= np.sum(L[k, 1:, None] * x[k + 1 : k + 1 + width], axis=0)
        found = np.empty((states, n))
        found[:, self.order] = x[:n, 0].T
        return found, np.max(np.abs(x[:n, 1]), axis=0)


def _narrowing_order(neighbours: list[set[int]]) -> list[int]:
    """An order in which neighbours are near each other: level by level from one that has few, reversed."""
    by_count, found, seen = (lambda k: (len(neighbours[k]), k)), [], set()
    for first in sorted(range(len(neighbours)), key=by_count):
        level = [] if first in seen else [first]
        while level:
            seen.update(level)
            found += level
            level = list(dict.fromkeys(k for row in level for k in sorted(neighbours[row] - seen, key=by_count)))
    return found[::-1]


def summed(groups: np.ndarray, count: int, values: np.ndarray) -> np.ndarray:
    """Sums of the values in each of so many groups, with a leading axis of states."""
    order = np.argsort(groups, kind="stable")
    some, begins = np.unique(groups[order], return_index=True)
    found = np.zeros((len(values), count))
    if some.size:
        found[:, some] = np.add.reduceat(values[:, order], begins, axis=1)
    return found
