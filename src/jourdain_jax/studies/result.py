"""Results of a study: statistics, failures, single samples, labelled arrays."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from jourdain_jax.calculus.figures import figure
from jourdain_jax.calculus.files import FilePath
from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.result_codes import CODES
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import warn
from jourdain_jax.scene.coordinates import Labels, check_name
from jourdain_jax.scene.printing import Printed
from jourdain_jax.studies.outputs import Task
from jourdain_jax.studies.statistics import Grid, SobolIndices, Statistics, Tally, combined, sobol_indices
from jourdain_jax.studies.store import Store

LEVELS = (0.025, 0.5, 0.975)  # tuning


@dataclass(frozen=True, repr=False)
class Lane(Printed):
    """One sample of a study: its parameters and start, from which it can be simulated again, and its stored
    results.
    """

    task: Task
    number: int
    starts: dict[str, object]  # in the form of arguments of `jj.start`
    parameters: dict[str, float]
    kept: dict[str, float]  # result code, steps, outputs; empty if only statistics are stored

    def simulate(self, **options) -> Trajectory:
        """Simulate this sample with the options of the study; `options` replace some of them, such as `ts=`
        or `rtol=`.
        """
        task = self.task
        own = task.scene.replace(**self.parameters) if self.parameters else task.scene
        return simulate(own, self.starts, **dict(task.span) | {"options": task.options} | options)

    def _text(self) -> str:
        given = {
            name: f"{np.asarray(value).tolist()}" for name, value in (self.parameters | self.starts).items()
        }
        lines = [f"Sample {self.number}: " + ", ".join(f"{name} = {value}" for name, value in given.items())]
        if self.kept:
            lines.append(f"  {result_codes.MESSAGES.get(int(self.kept['result']), 'not computed yet')}")
            lines += [f"  {name} = {value:.6g}" for name, value in self.kept.items() if name != "result"]
        return "\n".join(lines)


class StudyResult(Printed):
    """Results of a study, read from its folder.

    `store.path` is the folder; `xarray.open_zarr` also opens it. Statistics cover the finished chunks;
    `complete`: whether all are finished. `left_out`: indices of chunks that are omitted, because their
    receipt is damaged or belongs to another study. `study.run` computes these again.
    """

    def __init__(self, store: Store, task: Task | None = None):
        self.store, self.task = store, task
        receipts = {number: store.receipt(number) for number in store.receipts()}
        self.left_out = tuple(number for number, receipt in receipts.items() if receipt is None)
        self._done = [receipt.tally for receipt in receipts.values() if receipt is not None]
        self._tally = Tally.together(self._done, len(store.outputs))

    def __len__(self) -> int:
        return self.store.lanes

    @property
    def outputs(self) -> Labels:
        """Return names of the outputs."""
        return self.store.outputs

    @property
    def varied(self) -> Labels:
        """Return names of varying quantities: parameters, and start values with `_at_start`."""
        return tuple(self.store.study["varied"])

    @property
    def complete(self) -> bool:
        """Return whether all chunks are finished."""
        return len(self._done) == self.store.chunks

    @property
    def counts(self) -> dict[str, int]:
        """Return the number of samples with each result code, by the name of the code; codes without samples
        are omitted.
        """
        return {name: int(count) for name, count in zip(CODES, self._tally.codes, strict=True) if count}

    @property
    def failed(self) -> np.ndarray:
        """Return indices of the samples that reached neither their end nor an event."""
        return self._tally.failed

    def lane(self, number: int) -> Lane:
        """Return sample `number`: its parameters and start, its stored results, and `.simulate()`. Raises
        IndexError if there is none.
        """
        if not 0 <= number < len(self):
            raise IndexError(
                f"sample {number} does not exist; this study has {len(self)} samples, 0 to {len(self) - 1}"
            )
        if self.task is None:
            raise ValueError(
                "the scene of this study is unknown here; call `study.run` with the same arguments, which "
                "reads the stored samples"
            )
        kept = {}
        if self.store.columns:
            self.store.check_arrays({number // self.store.chunk}.intersection(self.store.receipts()))
            kept = {
                name: float(array[number])
                for name, array in self._opened().items()
                if array.dims == ("lane",)
            }
        values = {
            name: float(column[0]) for name, column in self.task.design.values(number, number + 1).items()
        }
        return Lane(self.task, number, *self.task.starts_and_parameters(values), kept)

    @cached_property
    def statistics(self) -> Statistics:
        """Return means, covariances, histograms and extremes of outputs, over the samples with a value."""
        grid = self.store.read_grid()
        if grid is None or not self._done:
            raise ValueError(
                f"no chunk of `{self.store.path}` is finished, or `run/grid.json` is damaged; run the study "
                "again"
            )
        return combined(self.outputs, Grid.from_dict(grid, len(self.outputs)), self._tally)

    def mean(self, output: str) -> float:
        """Return the mean of an `output` over the samples that have it."""
        return float(self.statistics.mean[self._place(output)])

    def deviation(self, output: str) -> float:
        """Return the standard deviation of an `output` over the samples that have it."""
        return float(self.statistics.deviation[self._place(output)])

    def covariance(self, first: str, second: str) -> float:
        """Return the covariance of the outputs `first` and `second` over the samples that have both."""
        return float(self.statistics.covariance[self._place(first), self._place(second)])

    def quantile(self, output: str, level: float) -> tuple[float, float]:
        """Return two bounds of the quantile `level` (0 to 1) of an `output`: edges of its histogram cell."""
        if not 0 <= level <= 1:
            raise ValueError(f"`level` is {level}, expected a number from 0 to 1")
        self._place(output)
        return self.statistics.quantile(output, level)

    def histogram(self, output: str, cells: int = 64) -> tuple[np.ndarray, np.ndarray]:
        """Return the number of samples per cell of an `output`, and the edges of the cells. There are about
        `cells` cells, each made of several cells of the stored grid.
        """
        if cells < 1:
            raise ValueError(f"`cells` is {cells}, expected at least 1")
        self._place(output)
        counts, edges = self.statistics.histogram(output)
        inside = np.flatnonzero(counts)
        first, last = (inside[0], inside[-1] + 1) if inside.size else (0, len(counts))
        step = max(1, math.ceil((last - first) / cells))
        starts = np.arange(first, last, step)
        # the last cell is as wide as the others, unless it contains values beyond the grid
        end = last if last == len(counts) else min(starts[-1] + step, len(counts) - 1)
        return np.add.reduceat(counts[:last], starts), np.append(edges[starts], edges[end])

    def _bars(self, output: str, cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the histogram (counts, edges), and whether each cell extends beyond the grid. In such a cell
        the position of samples is unknown.
        """
        (counts, edges), grid, i = self.histogram(output, cells), self.statistics.grid, self._place(output)
        return counts, edges, (edges[:-1] < grid.low[i]) | (edges[1:] > grid.high[i])

    def sensitivity(self, output: str, confidence: float = 0.95) -> SobolIndices:
        """Return first-order and total Sobol' indices of an `output`, with intervals of the given
        `confidence`. Requires sampler="saltelli".
        """
        self._place(output)
        if self.store.study["sampler"] != "saltelli":
            raise ValueError(
                f"Sobol' indices need sampler='saltelli'; this study has '{self.store.study['sampler']}'"
            )
        if self.store.study["save"] == "statistics" or not self.complete:
            raise ValueError(
                "Sobol' indices need all samples of a study with save='outputs'"
                + ("" if self.complete else "; run it to its end")
            )
        return sobol_indices(self.to_xarray()[output].values, self.varied, confidence=confidence)

    def _place(self, output: str) -> int:
        check_name(output, self.outputs, f"the study has no output `{output}`")
        return self.outputs.index(output)

    def to_xarray(self) -> Any:
        """Return all arrays as an `xarray.Dataset` with names and units, read on use. Unfinished samples are
        NaN and have the result -1.

        Raises ValueError for damaged arrays; this check reads all arrays once.
        """
        self.store.check_arrays(self.store.receipts())
        return self._opened()

    def _opened(self):
        return needed("xarray", "a study as labelled arrays", "studies").open_zarr(
            self.store.path, chunks=None, consolidated=True
        )

    def to_netcdf(self, path: FilePath) -> None:
        """Write all arrays to the NetCDF file `path`, by any installed engine of xarray."""
        found = self.to_xarray().load()
        found.attrs = {
            name: value if isinstance(value, int | float | str) else repr(value)
            for name, value in found.attrs.items()
        }
        found.attrs.pop("coordinates", None)
        for array in found.variables.values():
            array.attrs = {
                name: np.array(value, array.dtype) if name.startswith("flag_") else " ".join(value)
                for name, value in array.attrs.items()
                if isinstance(value, list)
            } | {name: value for name, value in array.attrs.items() if not isinstance(value, list)}
            array.encoding = {}
        found.to_netcdf(path)

    def plot(self, *outputs: str, path: FilePath | None = None):
        """Draw histograms of `outputs` (default: all). Return the figure, and write it to `path` if given.
        Needs matplotlib.
        """
        plt = needed("matplotlib.pyplot", "a plot", "plot")
        names = outputs or self.outputs
        drawn = plt.figure(figsize=(3.6 * len(names), 3.0), layout="constrained")
        self._draw(drawn, names)
        if path is not None:
            drawn.savefig(path, dpi=150)
        return drawn

    def _draw(self, whole, names: Sequence[str], cells: int = 64) -> None:
        """Draw samples per cell of outputs side by side. Cells that extend beyond the grid are pale; a line
        marks the mean.
        """
        for k, name in enumerate(names):
            axis, (counts, edges, beyond) = whole.add_subplot(1, len(names), k + 1), self._bars(name, cells)
            axis.stairs(np.where(beyond, 0, counts), edges, fill=True, color="#1f5fa8", alpha=0.8)
            if beyond.any():
                pale = {"color": "#1f5fa8", "alpha": 0.25, "label": "anywhere in here"}
                axis.stairs(np.where(beyond, counts, 0), edges, fill=True, **pale)
                axis.legend(fontsize="small")
            axis.axvline(self.mean(name), color="#b3470f", lw=1.2)
            column = self.store.columns.get(name)
            unit = column.attributes.get("units") if column else ""
            axis.set_xlabel(f"{name} ({unit})" if unit else name)
            axis.spines[["top", "right"]].set_visible(False)
        whole.axes[0].set_ylabel("samples")

    def _repr_html_(self) -> str:
        drawn = [name for name in self.outputs if self._done and self._bars(name, 40)[0].sum() > 0]
        shown = drawn[:12]  # limit for a notebook
        more = f"and {len(drawn) - len(shown)} more" if len(drawn) > len(shown) else ""
        return super()._repr_html_() + (
            figure(lambda whole: self._draw(whole, shown, 40), 240 * len(shown), 200, more) if shown else ""
        )

    def _in_short(self, output: str, level: float) -> str:
        """Return the text of a quantile: the middle of its cell, or a bound if it lies beyond the grid."""
        (low, high), grid, i = self.quantile(output, level), self.statistics.grid, self._place(output)
        beyond = (">", low) if low >= grid.high[i] else ("<", high) if high <= grid.low[i] else None
        return f"{beyond[0]} {beyond[1]:.5g}" if beyond and low < high else f"{(low + high) / 2:.5g}"

    def _text(self) -> str:
        tally = self._tally
        done = int(tally.codes.sum())
        lines = [
            f"Study in {self.store.path}: {done} of {len(self)} samples"
            + ("" if self.complete else "; run it again to continue")
        ]
        lines += [
            f"  {count} {result_codes.MESSAGES[CODES.index(name)].split(';')[0]}"
            for name, count in self.counts.items()
        ]
        if self.failed.size:
            some = ", ".join(map(str, self.failed[:10]))
            lines.append(f"  failed: samples {some}{' ...' if self.failed.size > 10 else ''}")
        if tally.again[0]:
            lines.append(f"  {tally.again[0]} were run again by another method")
        if done:
            lines.append(
                f"  {tally.steps[0] / done:.1f} steps accepted and {tally.steps[1] / done:.1f} "
                "rejected per sample"
            )
            width = max(map(len, self.outputs))
            lines.append(
                f"  {'':<{width}} {'samples':>9} {'mean':>12} {'deviation':>12} {'2.5 %':>12} "
                f"{'median':>12} {'97.5 %':>12}"
            )
            for i, name in enumerate(self.outputs):
                middle = (f"{self._in_short(name, level):>12}" for level in LEVELS)
                numbers = (
                    f"{self.statistics.lanes[i, i]:>9} {self.statistics.mean[i]:12.5g}"
                    f" {self.statistics.deviation[i]:12.5g} {' '.join(middle)}"
                )
                lines.append(f"  {name:<{width}} {numbers}")
        return "\n".join(lines)


def load_study(path: FilePath) -> StudyResult:
    """Return the results of a study in the folder `path`, finished or not, without its scene. For
    `.lane(k).simulate()`, call `study.run` with the same arguments instead.

    A warning names damaged chunks, whose samples are omitted (`left_out`). Raises ValueError if the folder
    holds no study, a study of an unknown format, or one with a damaged description.
    """
    found = StudyResult(Store(path))
    if found.left_out:
        text = (
            "are omitted: receipts of their chunks are damaged or belong to another study; run the study "
            "again to compute them"
        )
        warn(f"{found.store.lanes_of(found.left_out)} {text}")
    return found


def merge_studies(path: FilePath, shares: Sequence[FilePath]) -> StudyResult:
    """Copy chunks from the folders `shares` of one study (`study.run(..., shard=(k, n))`) into the folder
    `path`, which is one of them.

    Damaged chunks are not copied; `study.run` then computes the missing ones. Raises ValueError if a folder
    contains another study.
    """
    target = Store(path)
    with target.lock():
        held = set(target.done()[0])
        for share in shares:
            other = Store(share)
            different = [
                name
                for name in ("identity", "chunk", "block", "samples")
                if other.study[name] != target.study[name]
            ]
            grid, own = other.read_grid(), target.read_grid()
            if different or (grid and own and grid != own):
                raise ValueError(
                    f"`{share}` is not a share of the study in `{path}`: "
                    f"{' and '.join(different) or 'the grid of statistics'} differ"
                )
            if grid and not own:
                target.write_grid(grid)
            for number in other.receipts():
                if number not in held and other.is_whole(number):
                    target.take_chunk(other, number)
                    held.add(number)
    return StudyResult(target)
