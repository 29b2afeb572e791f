"""Statistics of outputs while a study runs, the same bits whatever the chunks and their order.

Lanes are summed block by block (a block: some thousand lanes with fixed numbers), about a centre c near the mean. With m_i = 1 where output i is finite and
x_i = 0 where it is not, a block gives

    N_ij = sum m_i m_j,   A_ij = sum (x_i - c_i) m_j,   S_ij = sum (x_i - c_i)(x_j - c_j)

and the sums over blocks are rounded once (Shewchuk's exact sums, `math.fsum`), so that their order does not matter. Then, over the lanes that have both,

    mean_i = c_i + A_ii / N_ii,    cov_ij = (S_ij - A_ij A_ji / N_ij) / (N_ij - 1)

Histograms count in cells of a fixed grid, from twice the range of the first block; lanes beyond it are counted below and above. A quantile is known to
the cell that holds it, and the smallest and largest values are exact.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

CELLS = 4096


@dataclass(frozen=True)
class Grid:
    """Where values are counted: `CELLS` equal cells from `low` to `high`, and the `centre` of sums, for every output."""

    low: np.ndarray
    high: np.ndarray
    centre: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> "Grid":
        """The grid for values of shape (lanes, outputs), those of the first block."""
        ends = []
        for column in values.T:
            finite = column[np.isfinite(column)]
            low, high, centre = (finite.min(), finite.max(), np.mean(finite)) if finite.size else (-1.0, 1.0, 0.0)
            half = 0.5 * (high - low) or max(1e-6 * abs(low), 1e-12)
            ends.append((low - half, high + half, centre))
        low, high, centre = np.array(ends, float).reshape(-1, 3).T
        return cls(low, high, centre)

    def edges(self, i: int) -> np.ndarray:
        """The edges of the cells of output `i`."""
        return np.linspace(self.low[i], self.high[i], CELLS + 1)

    def as_dict(self) -> dict:
        """The grid for JSON; floats keep all their digits there."""
        return {name: values.tolist() for name, values in vars(self).items()}

    @classmethod
    def from_dict(cls, found: dict, outputs: int) -> "Grid":
        """The grid that `as_dict` wrote, of so many outputs; ValueError where its numbers are not finite, or not in order."""
        low, high, centre = numbers = [np.array(found[name], float) for name in ("low", "high", "centre")]
        if any(x.shape != (outputs,) or not np.isfinite(x).all() for x in numbers) or np.any((centre < low) | (centre > high)):
            raise ValueError(f"the grid of the statistics is {found}, expected finite numbers in order, one each for {outputs} outputs")
        return cls(low, high, centre)


def sums_of_block(grid: Grid, values: np.ndarray) -> np.ndarray:
    """N, A and S of one block of values (lanes, outputs), shape (3, outputs, outputs)."""
    finite = np.isfinite(values)
    x = np.ascontiguousarray(np.where(finite, values - grid.centre, 0.0).T)
    m = np.ascontiguousarray(finite.T, float)
    # not by a library of matrices, whose rounding may depend on its threads
    return np.stack([np.einsum("ik,jk->ij", a, b) for a, b in ((m, m), (x, m), (x, x))])


def counts_of_block(grid: Grid, values: np.ndarray) -> np.ndarray:
    """How many values of each output lie below, in each cell, and above, shape (outputs, CELLS + 2); what is not finite is nowhere."""
    counts = np.zeros((values.shape[1], CELLS + 2), np.int64)
    for i, column in enumerate(values.T):
        finite = column[np.isfinite(column)]
        counts[i] = np.bincount(np.searchsorted(grid.edges(i), finite, side="right"), minlength=CELLS + 2)
    return counts


def extremes_of_block(values: np.ndarray) -> np.ndarray:
    """Smallest and largest value of each output, shape (2, outputs); infinite where there is none."""
    finite = np.isfinite(values)
    return np.stack([np.min(values, axis=0, where=finite, initial=np.inf), np.max(values, axis=0, where=finite, initial=-np.inf)])


@dataclass(frozen=True)
class Statistics:
    """Statistics of all outputs over the lanes that have them."""

    names: tuple[str, ...]
    grid: Grid
    lanes: np.ndarray  # (outputs, outputs): lanes that have both
    mean: np.ndarray  # (outputs,)
    covariance: np.ndarray  # (outputs, outputs)
    extremes: np.ndarray  # (2, outputs)
    counts: np.ndarray  # (outputs, CELLS + 2)

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviations, shape (outputs,)."""
        return np.sqrt(np.diag(self.covariance))

    def histogram(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Lanes per cell of the output `name`, and the edges of the cells; lanes beyond the grid are in cells that reach to the extremes."""
        i = self.names.index(name)
        counts, edges = self.counts[i], self.grid.edges(i)
        if counts[0]:
            edges = np.concatenate([[self.extremes[0, i]], edges])
        if counts[-1]:
            edges = np.append(edges, self.extremes[1, i])
        return counts[0 if counts[0] else 1 : None if counts[-1] else -1], edges

    def quantile(self, name: str, level: float) -> tuple[float, float]:
        """Two numbers between which the quantile `level` (0 to 1) of the output `name` lies: of the n values, the one with number ceil(level n)."""
        counts, edges = self.histogram(name)
        i, total = self.names.index(name), counts.sum()
        if total == 0:
            return math.nan, math.nan
        cell = int(np.searchsorted(np.cumsum(counts), max(1, math.ceil(level * total))))
        smallest, largest = self.extremes[:, i]
        return float(max(edges[cell], smallest)), float(min(edges[cell + 1], largest))


def combined(names: Sequence[str], grid: Grid, sums: Iterable[np.ndarray], counts: np.ndarray, extremes: np.ndarray) -> Statistics:
    """The statistics from the sums of all blocks (each of shape (3, outputs, outputs)), and the counts and extremes of all lanes."""
    blocks = np.stack([*sums, np.zeros((3, len(names), len(names)))])
    n, a, s = np.array([math.fsum(entries) for entries in blocks.reshape(len(blocks), -1).T]).reshape(blocks.shape[1:])
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = grid.centre + np.diag(a) / np.diag(n)
        covariance = np.where(n > 1, (s - a * a.T / n) / (n - 1), np.nan)
    return Statistics(tuple(names), grid, n.astype(np.int64), mean, covariance, extremes, counts)
