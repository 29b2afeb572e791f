"""Running statistics of a study's outputs, whose bits do not depend on the chunks and their order.

The device computes sums and histograms, in doubles, and only these reach the host. There is one sum for each
block of some thousand samples with fixed indices, relative to a centre c near the mean. With m_i = 1 where
output i is finite and x_i = 0 where it is not, a block gives

    N_ij = sum m_i m_j,   A_ij = sum (x_i - c_i) m_j,   S_ij = sum (x_i - c_i)(x_j - c_j)

The sums over blocks are rounded once (Shewchuk's exact sums, `math.fsum`), so that their order has no effect.
Then, over the samples with both outputs,

    mean_i = c_i + A_ii / N_ii,    cov_ij = (S_ij - A_ij A_ji / N_ij) / (N_ij - 1)

Histograms have a fixed grid of cells over twice the range of the first block, and count samples below and
above this range. A quantile is known up to its cell; the smallest and largest values are exact.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.integrate.result_codes import CODES, EVENT, SUCCESS

CELLS = 4096


@dataclass(frozen=True)
class Grid:
    """The grid of the histograms of all outputs: `CELLS` equal cells from `low` to `high`, and the `centre`
    of sums.
    """

    low: np.ndarray
    high: np.ndarray
    centre: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> "Grid":
        """Return the grid for the values of the first block, shape (samples, outputs)."""
        ends = []
        for column in values.T:
            finite = column[np.isfinite(column)]
            low, high, centre = (
                (finite.min(), finite.max(), np.mean(finite)) if finite.size else (-1.0, 1.0, 0.0)
            )
            half = 0.5 * (high - low) or max(1e-6 * abs(low), 1e-12)
            ends.append((low - half, high + half, centre))
        low, high, centre = np.array(ends, float).reshape(-1, 3).T
        return cls(low, high, centre)

    def edges(self) -> np.ndarray:
        """Return the edges of the cells of all outputs, shape (outputs, CELLS + 1)."""
        return np.linspace(self.low, self.high, CELLS + 1, axis=1)

    def as_dict(self) -> dict:
        """Return the grid for JSON, where floats keep all their digits."""
        return {name: values.tolist() for name, values in vars(self).items()}

    @classmethod
    def from_dict(cls, found: dict, outputs: int) -> "Grid":
        """Return the grid written by `as_dict`, for this number of `outputs`. Raises ValueError for numbers
        that are not finite or not in order.
        """
        low, high, centre = numbers = [np.array(found[name], float) for name in ("low", "high", "centre")]
        if any(x.shape != (outputs,) or not np.isfinite(x).all() for x in numbers) or np.any(
            (centre < low) | (centre > high)
        ):
            raise ValueError(
                f"the grid of the statistics is {found}, expected finite numbers in order, one "
                f"each for {outputs} outputs"
            )
        return cls(low, high, centre)


@dataclass(frozen=True)
class Tally:
    """Counts and sums over some samples: the arrays of a receipt."""

    codes: np.ndarray  # number of samples per result code
    again: np.ndarray  # (1,): number of samples that were run again
    steps: np.ndarray  # (2,): accepted and rejected steps
    failed: np.ndarray  # indices of failed samples
    sums: np.ndarray  # (blocks, 3, outputs, outputs): N, A and S of each block
    # (2, cells): indices of nonempty cells in (outputs, CELLS + 2), and their counts; the first and last cell
    # of each output are below and above the grid
    cells: np.ndarray
    extremes: np.ndarray  # (2, outputs): smallest and largest value; infinite if there is none

    @classmethod
    def of_block(cls, grid: Grid, lanes: range, ends: Mapping[str, jax.Array], values: jax.Array) -> "Tally":
        """Return the tally of the first `lanes` samples of a block, from their ends and values (samples,
        outputs).
        """
        with jax.enable_x64(True):
            counted = jax.device_get(_counted(grid.edges(), grid.centre, len(lanes), ends, values))
        failed = np.zeros(0, np.int64)
        if counted["codes"].sum() > counted["codes"][[SUCCESS, EVENT]].sum():
            codes = np.asarray(ends["result"])[: len(lanes)]
            failed = lanes.start + np.flatnonzero((codes != SUCCESS) & (codes != EVENT))
        return cls(**counted | {"cells": _sparse(counted["cells"])}, failed=failed)

    @classmethod
    def together(cls, several: Iterable["Tally"], outputs: int) -> "Tally":
        """Return the combined tally of `several` tallies, for this number of outputs."""
        known = list(several)
        counts = np.zeros((outputs, CELLS + 2), np.int64)
        for one in known:
            counts.reshape(-1)[one.cells[0]] += one.cells[1]
        nothing = np.stack([np.full(outputs, np.inf), np.full(outputs, -np.inf)])
        low, high = np.stack([nothing, *(one.extremes for one in known)], axis=1)
        return cls(
            sum((one.codes for one in known), np.zeros(len(CODES), np.int64)),
            sum((one.again for one in known), np.zeros(1, np.int64)),
            sum((one.steps for one in known), np.zeros(2, np.int64)),
            np.concatenate([np.zeros(0, np.int64), *(one.failed for one in known)]),
            np.concatenate([np.zeros((0, 3, outputs, outputs)), *(one.sums for one in known)]),
            _sparse(counts),
            np.stack([low.min(axis=0), high.max(axis=0)]),
        )

    @classmethod
    def checked(cls, arrays: Mapping[str, np.ndarray], lanes: range, outputs: int) -> "Tally":
        """Return the tally of some `lanes` in these arrays. Raises ValueError for numbers out of range."""
        codes, again, steps, failed, sums, (place, counts), extremes = (
            arrays[name] for name in cls.__dataclass_fields__
        )
        shapes = (
            again.shape == (1,)
            and steps.shape == (2,)
            and sums.shape[1:] == (3, outputs, outputs)
            and extremes.shape == (2, outputs)
        )
        numbers = (
            codes.sum() == len(lanes)
            and codes.size <= len(CODES)
            and min(codes.min(), again.min(), steps.min()) >= 0
        )
        within = np.all((failed >= lanes.start) & (failed < lanes.stop)) and np.all(
            (place >= 0) & (place < outputs * (CELLS + 2)) & (counts > 0)
        )
        if not (shapes and numbers and within):
            raise ValueError("the receipt of a chunk holds numbers that are out of their ranges")
        return cls(**dict(arrays) | {"codes": np.pad(codes, (0, len(CODES) - codes.size))})


@jax.jit
def _counted(edges, centre, lanes, ends, values) -> dict[str, jax.Array]:
    """Return the fields of a tally of the first `lanes` samples, without `failed`; `cells` has the number of
    samples in every cell.
    """
    counts = jnp.arange(len(values)) < lanes
    values, finite = values.astype(float), jnp.isfinite(values) & counts[:, None]
    x, m = jnp.where(finite, values - centre, 0.0), finite.astype(float)
    places = jax.vmap(lambda of_one, column: jnp.searchsorted(of_one, column, side="right"))(edges, values.T)
    cells = jnp.zeros((len(edges), CELLS + 2), int).at[jnp.arange(len(edges))[:, None], places].add(finite.T)
    return {
        "codes": jnp.sum((ends["result"][:, None] == jnp.arange(len(CODES))) & counts[:, None], axis=0),
        "again": jnp.sum((ends["retries"] > 0) & counts)[None],
        "steps": jnp.stack(
            [jnp.sum(jnp.where(counts, ends[name], 0), dtype=int) for name in ("steps", "rejected_steps")]
        ),
        # a matrix product may round differently, depending on threads
        "sums": jnp.stack([jnp.sum(a[:, :, None] * b[:, None], axis=0) for a, b in ((m, m), (x, m), (x, x))])[
            None
        ],
        "cells": cells,
        "extremes": jnp.stack(
            [
                jnp.min(values, 0, initial=jnp.inf, where=finite),
                jnp.max(values, 0, initial=-jnp.inf, where=finite),
            ]
        ),
    }


def _sparse(counts: np.ndarray) -> np.ndarray:
    return np.stack([place := np.flatnonzero(counts), counts.reshape(-1)[place]])


@dataclass(frozen=True)
class Statistics:
    """Statistics of all outputs over the samples with a value."""

    names: tuple[str, ...]
    grid: Grid
    lanes: np.ndarray  # (outputs, outputs): number of samples with both outputs
    mean: np.ndarray  # (outputs,)
    covariance: np.ndarray  # (outputs, outputs)
    extremes: np.ndarray  # (2, outputs)
    counts: np.ndarray  # (outputs, CELLS + 2)

    @property
    def deviation(self) -> np.ndarray:
        """Return standard deviations, shape (outputs,)."""
        return np.sqrt(np.diag(self.covariance))

    def histogram(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return samples per cell of the output `name`, and the edges of the cells. Samples beyond the grid
        are in outer cells that extend to the extremes.
        """
        i = self.names.index(name)
        counts, (least, largest) = self.counts[i], self.extremes[:, i]
        first, last = int(not counts[0]), len(counts) - int(not counts[-1])
        edges = np.concatenate([[least], self.grid.edges()[i], [largest]])
        return counts[first:last], edges[first : last + 1]

    def quantile(self, name: str, level: float) -> tuple[float, float]:
        """Return two bounds of the quantile `level` (0 to 1) of the output `name`. The quantile is number
        ceil(level n) of the n sorted values.
        """
        counts, edges = self.histogram(name)
        i, total = self.names.index(name), counts.sum()
        if total == 0:
            return math.nan, math.nan
        cell = int(np.searchsorted(np.cumsum(counts), max(1, math.ceil(level * total))))
        smallest, largest = self.extremes[:, i]
        return float(max(edges[cell], smallest)), float(min(edges[cell + 1], largest))


def combined(names: Sequence[str], grid: Grid, tally: Tally) -> Statistics:
    """Return the statistics of all samples of a tally."""
    sums = tally.sums.reshape(len(tally.sums), -1)
    n, a, s = np.array([math.fsum(entries) for entries in sums.T]).reshape(3, len(names), len(names))
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = grid.centre + np.diag(a) / np.diag(n)
        covariance = np.where(n > 1, (s - a * a.T / n) / (n - 1), np.nan)
    counts = np.zeros((len(names), CELLS + 2), np.int64)
    counts.reshape(-1)[tally.cells[0]] = tally.cells[1]
    return Statistics(tuple(names), grid, n.astype(np.int64), mean, covariance, tally.extremes, counts)
