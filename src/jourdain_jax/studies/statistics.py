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

Sobol' indices are the shares of an output's variance due to each varying quantity. With independent samples
A_j, B_j, and AB_j^i equal to A_j except for quantity i, taken from B_j (Saltelli et al. 2010):

    S_i  = mean_j f(B_j) (f(AB_j^i) - f(A_j)) / V    first order: reduction of V if i is fixed (table 2, b)
    ST_i = mean_j (f(A_j) - f(AB_j^i))^2 / (2 V)     total: remainder if all others are fixed (2, f; Jansen)

V is the variance over all A_j and B_j. The mean of f is subtracted first, which reduces the errors.
Half-widths of intervals are standard errors, from groups of samples drawn again with replacement (Efron's
bootstrap), times the normal quantile of the confidence.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.lazy_imports import module_on_first_use
from jourdain_jax.integrate.result_codes import CODES, EVENT, SUCCESS
from jourdain_jax.scene.printing import Printed

CELLS = 4096  # tuning


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
            raise ValueError("the receipt of a chunk has numbers out of range")
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


special = module_on_first_use("scipy.special")


@dataclass(frozen=True, repr=False)
class SobolIndices(Printed):
    """Sobol' indices of one output for the varying quantities, each as `value +- half-width` at the stated
    confidence.
    """

    names: tuple[str, ...]
    first: np.ndarray  # (quantities,)
    first_half_width: np.ndarray
    total: np.ndarray
    total_half_width: np.ndarray
    confidence: float
    groups: int  # number of groups of samples used
    left_out: int  # number of groups with a sample without a finite value

    def _text(self) -> str:
        width = max(map(len, self.names))
        note = f"; {self.left_out} groups with a missing value are omitted" if self.left_out else ""
        lines = [
            f"Sobol' indices from {self.groups} groups of samples, with limits of "
            f"{100 * self.confidence:g} %{note}"
        ]
        lines.append(f"  {'':<{width}} {'first order':>22} {'total':>22}")
        rows = zip(
            self.names, self.first, self.first_half_width, self.total, self.total_half_width, strict=True
        )
        lines += [
            f"  {name:<{width}} {f'{s:.4f} +- {ds:.4f}':>22} {f'{st:.4f} +- {dst:.4f}':>22}"
            for name, s, ds, st, dst in rows
        ]
        return "\n".join(lines)


def sobol_indices(values: Any, names: Sequence[str], *, confidence: float = 0.95) -> SobolIndices:
    """Return Sobol' indices of a quantity from its `values` on a design with sampler "saltelli", whose
    variables are called `names`.

        vary = {"a": jj.studies.Uniform(-1.0, 1.0), "b": jj.studies.Uniform(0.0, 1.0)}
        design = jj.studies.Design(vary, sampler="saltelli", samples=4 * 1024)
        at = design.values()
        print(jj.studies.sobol_indices(at["a"] + at["b"] ** 2, design.names))

    `confidence`: of each interval. Groups with a value that is not finite are omitted and counted; if they
    are many or not random, the indices describe only the rest. Raises ValueError if the number of values is
    not a multiple of variables + 2, or if nothing varies.
    """
    values, names = np.asarray(values, float), tuple(names)
    group = len(names) + 2
    if values.ndim != 1 or values.size % group or not values.size:
        raise ValueError(
            f"there are {values.size} values, expected a multiple of {group}; give the values of a design of "
            f"{len(names)} variables with sampler='saltelli'"
        )
    if not 0 < confidence < 1:
        raise ValueError(f"`confidence` is {confidence}, expected a number between 0 and 1")
    groups = values.reshape(-1, group)
    sound = np.isfinite(groups).all(axis=1)
    groups = groups[sound]
    if len(groups) < 2 or np.ptp(groups[:, [0, -1]]) == 0:  # the variance of these columns is the divisor
        raise ValueError(
            "fewer than two groups of samples have values, or all values are equal; Sobol' "
            "indices need a quantity that varies"
        )
    generator = np.random.default_rng(0)
    drawn = np.stack([_indices(groups[generator.integers(0, len(groups), len(groups))]) for _ in range(200)])
    half = special.ndtri(0.5 + confidence / 2) * drawn.std(axis=0, ddof=1)
    first, total = _indices(groups)
    return SobolIndices(names, first, half[0], total, half[1], confidence, len(groups), int(np.sum(~sound)))


def _indices(groups: np.ndarray) -> np.ndarray:
    """Return S and ST, shape (2, variables), from rows f(A), f(AB^1), ..., f(B)."""
    centred = groups - groups[:, [0, -1]].mean()
    a, mixed, b = centred[:, :1], centred[:, 1:-1], centred[:, -1:]
    variance = np.concatenate([a, b]).var()
    # S = mean f(B) (f(AB) - f(A)) / V;  ST = mean (f(A) - f(AB))^2 / (2 V)
    return np.stack([np.mean(b * (mixed - a), axis=0), np.mean((a - mixed) ** 2, axis=0) / 2]) / variance
