"""What a scene predicts for the measurements of many runs, against what was measured, with derivatives, in one compiled program.

A lane is one run of one member (a repeat of the experiment, or a first guess of its own). Some lanes at a time go through one program, which is
compiled once for runs of equal structure, whatever their number: memory does not grow with it. Short runs are filled up to the length of the longest.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.correlated_noise import Chains, whitened
from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.layout import Layout
from jourdain_jax.analysis.runs import Run, filled_up, grouped, is_array, most_knots, on_equal_grids, run_of
from jourdain_jax.build.reference import Reference
from jourdain_jax.motion.forward_mode import simulate_alongside
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.scene.scene import Scene

TOUCHED = 2**18  # bytes of saved states with their tangents in one loop: far below what XLA compiles into one function (see `jourdain_jax`)
MOST_LANES = 64
AHEAD = 4  # groups of lanes that are begun before the first is read
_WHITE, _NONE = np.zeros((1, 1)), np.zeros(0)


class Lanes:
    """All lanes of a problem; `evaluate` gives their weighted residuals with derivatives."""

    def __init__(self, scene: Scene, data: Sequence[Experiment], layout: Layout, options: AllOptions, members: int | None):
        self.members = members
        ready = lambda i: run_of(data[i], repeats=members is not None)  # noqa: E731
        self._groups = [_Group(scene, indices, list(map(ready, indices)), layout, options, members) for indices in grouped(data)]
        self.lengths = [run.ts.shape[0] for run in data]
        self._of_run = {run: group for group in self._groups for run in group.indices}

    def evaluate(self, shared: Float[np.ndarray, "members shared"], local: Float[np.ndarray, "members runs local"], members: np.ndarray):
        """Yields, some lanes at a time: numbers of members (among those given) and of runs, and [J r] (lanes, samples, unknowns + 1), own unknowns first."""
        for group in self._groups:
            yield from group.evaluate(shared, local, members)

    def counted(self, names: Sequence[str], members: np.ndarray) -> Float[np.ndarray, "members names"]:
        """Samples of each of these channels that are not missing, in all runs."""
        found = np.zeros((len(members), len(names)))
        for k, name in enumerate(names):
            for group in self._groups:
                weights = group.weights.get(name)
                if weights is not None:
                    here = np.count_nonzero(weights, axis=tuple(range(2, weights.ndim))) if self.members is not None else np.count_nonzero(weights)
                    found[:, k] += here.sum(axis=0)[members] if self.members is not None else here
        return found

    def channels(self, run: int) -> dict[str, slice]:
        """Where the samples of each channel are in the residuals of a run."""
        return self._group_of(run).channels

    def within(self, runs: np.ndarray, share: Float[np.ndarray, "lanes"]) -> np.ndarray:
        """Which samples (lanes, samples) of these runs, of equal structure, lie in the first `share` of a run's span."""
        group = self._group_of(int(runs[0]))
        return group.within([group.indices.index(run) for run in runs.tolist()], share)

    def whitened(self, runs: np.ndarray, members: np.ndarray, rows: Float[np.ndarray, "lanes samples width"], taus: dict[str, np.ndarray]) -> np.ndarray:
        """Rows of lanes of equal structure, whitened; `taus`: correlation times (lanes,) that are estimated, s."""
        before, rho = self._group_of(int(runs[0])).chained(runs, members, taus)
        return rows if before is None else whitened(rows, np.take_along_axis(rows, before[..., None], axis=1), rho[..., None])

    def log_widths(self, runs: np.ndarray, members: np.ndarray, taus: dict[str, np.ndarray]) -> Float[np.ndarray, "lanes"]:
        """`sum log sqrt(1 - rho^2)` of lanes of equal structure."""
        _, rho = self._group_of(int(runs[0])).chained(runs, members, taus)
        return 0.5 * np.sum(np.log1p(-(rho**2)), axis=1)

    def by_channel(self, run: int, flat: Float[np.ndarray, "*members samples"]) -> dict[str, np.ndarray]:
        """Weighted residuals of a run by channel, NaN where a sample is missing."""
        group = self._group_of(run)
        return group.by_channel(group.indices.index(run), flat, self.lengths[run])

    def _group_of(self, run: int) -> "_Group":
        return self._of_run[run]


class _Group:
    """Runs of equal structure, filled up to one length."""

    def __init__(self, scene: Scene, indices: list[int], runs: list[Run], layout: Layout, options: AllOptions, members: int | None):
        self.indices, self._members, self._runs = indices, members, np.array(indices)
        times, knots = max(run.ts.shape[0] for run in runs), most_knots(runs)
        equal = runs if runs[0].grid is None or len(runs) == 1 else on_equal_grids(runs)
        filled = [filled_up(run, times, knots, 0 if members is None else 1) for run in equal]
        leaves, treedef = jax.tree.flatten(((scene, options), filled[0]))
        # numbers of a run in one row, since each array that is handed over costs as much as some of the steps of a motion
        repeated = {id(x) for part in (filled[0].values, filled[0].weights) for x in part.values()} if members is not None else set()
        common = treedef.children()[0].num_leaves
        of_first = leaves[common:]
        self._common = np.concatenate([_NONE, *(np.ravel(x) for x in leaves[:common] if is_array(x))])
        alike = [k for k, x in enumerate(of_first) if is_array(x) and id(x) not in repeated]
        by_member = [k for k, x in enumerate(of_first) if id(x) in repeated]
        of_runs = [of_first, *map(jax.tree.leaves, filled[1:])]
        self._rows = np.stack([np.concatenate([_NONE, *(np.ravel(run[k]) for k in alike)]) for run in of_runs])
        count = members or 1
        self._own_rows = np.stack([np.concatenate([np.zeros((count, 0)), *(run[k].reshape(count, -1) for k in by_member)], axis=1) for run in of_runs])
        marks = [_Number(x.shape[int(id(x) in repeated) :], x.dtype, k >= common, id(x) in repeated) if is_array(x) else x for k, x in enumerate(leaves)]
        reference = Reference.where_free(scene, layout.parameters)
        self.weights = {name: np.array([run.weights[name] for run in filled]) for name in filled[0].weights}  # (runs, *members, times, *channel)
        self._t0, self._ts = np.array([run.t0 for run in filled]), np.array([run.ts for run in filled])
        self.channels, end = {}, 0
        for name, weight in sorted(filled[0].weights.items()):
            begin, end = end, end + math.prod(weight.shape[0 if members is None else 1 :])
            self.channels[name] = slice(begin, end)
        self.samples = end
        self._run = _program(reference, treedef, tuple(marks), layout)
        taus = {name: np.stack([run.correlation_time[name] for run in filled]) for name in filled[0].correlation_time}
        self.chains = Chains.of(self.weights, self._ts, taus, self.channels, members is not None) if taus else None
        saved = times if filled[0].grid is None else filled[0].grid.shape[0]
        states = saved * (len(scene.coordinate_names) + len(scene.speed_names)) * 8 * (1 + sum(layout.sizes))
        self._width = int(min(MOST_LANES, max(1, TOUCHED // states)))
        self._kept: dict[int, list] = {}

    def evaluate(self, shared, local, members):
        if len(members) not in self._kept:
            self._kept = {len(members): self._chunks(len(members))}
        first, *chunks = self._kept[len(members)]

        def lanes(kept: int, b: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            own = self._own_rows[j, members[b] if self._members is not None else 0]
            found = self._run(self._common, np.concatenate([self._rows[j], own, local[b, self._runs[j]], shared[b]], axis=1))
            return b[:kept], self._runs[j[:kept]], np.asarray(found)[:kept]

        yield lanes(*first)  # compiles, where that is needed
        waiting: list[Future] = []
        try:
            for chunk in chunks:
                waiting.append(_threads().submit(lanes, *chunk))
                if len(waiting) == AHEAD:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            for future in waiting:
                future.cancel()

    def _chunks(self, members: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """How many lanes at a time, with positions of their members and runs; these are filled up with copies of the last."""
        count = members * len(self.indices)
        width = min(self._width, 1 << (count - 1).bit_length())
        lanes = np.minimum(np.arange(-(-count // width) * width), count - 1).reshape(-1, width)
        return [(min(width, count - k * width), *np.divmod(some, len(self.indices))) for k, some in enumerate(lanes)]

    def chained(self, runs: np.ndarray, members: np.ndarray, taus: dict[str, np.ndarray]) -> tuple[np.ndarray | None, np.ndarray]:
        """For each sample of lanes, the place of the one before it (None: all noise is white) and their correlation."""
        if self.chains is None:
            return None, _WHITE
        places = [self.indices.index(run) for run in runs.tolist()]
        return self.chains.at(places, None if self._members is None else members, taus)

    def within(self, places: list[int], share: Float[np.ndarray, "lanes"]) -> np.ndarray:
        """Which samples of the runs at these places lie in the first `share` of the span, shape (lanes, samples)."""
        ts, t0 = self._ts[places], self._t0[places]
        early = np.abs(ts - t0[:, None]) <= (share * np.abs(ts[:, -1] - t0))[:, None]
        counts = [(where.stop - where.start) // early.shape[1] for where in self.channels.values()]
        return np.concatenate([np.repeat(early, count, axis=1) for count in counts], axis=1)

    def by_channel(self, place: int, flat, times: int) -> dict[str, np.ndarray]:
        """Residuals of the run at this place by channel; all NaN where `flat` is empty, since they were not worked out."""
        found = {}
        for name, where in self.channels.items():
            weight = self.weights[name][place]
            shape = weight.shape if self._members is None else weight.shape[1:]
            part = flat[..., where].reshape((*flat.shape[:-1], *shape)) if flat.shape[-1] else np.full((*flat.shape[:-1], *shape), np.nan)
            found[name] = np.where(weight > 0, part, np.nan)[(slice(None),) * (flat.ndim - 1) + (slice(times),)]
        return found


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="jourdain_fit")


class _Number(NamedTuple):
    """What stands in place of an array: what it is, and whether it is in the row of a run, and there among the numbers that differ by member."""

    shape: tuple[int, ...]
    dtype: np.dtype
    of_run: bool
    of_member: bool


@lru_cache(maxsize=16)
def _program(reference: Reference, treedef, leaves: tuple, layout: Layout) -> Callable:
    """Compile [J r] of lanes, shape (lanes, samples, local + shared + 1), from numbers that all share and rows of runs with their unknowns.

    `reference`: of the scene; `treedef`, `leaves`: of scene, options and run, with a `_Number` in place of each array.
    """
    own, unknowns = layout.sizes[1], sum(layout.sizes)

    def lane(common: Float[Array, "shared"], row: Float[Array, "own"], x: Float[Array, "unknowns"]) -> Float[Array, "samples width"]:
        found = dict.fromkeys(range(len(leaves)))
        for vector, kinds in ((common, [(False, False)]), (row, [(True, False), (True, True)])):
            begin = 0
            for kind in kinds:
                for k, leaf in enumerate(leaves):
                    if isinstance(leaf, _Number) and leaf[2:] == kind:
                        end = begin + math.prod(leaf.shape)
                        found[k], begin = vector[begin:end].reshape(leaf.shape).astype(jax.dtypes.canonicalize_dtype(leaf.dtype)), end
        (scene, options), run = jax.tree.unflatten(treedef, [found[k] if isinstance(leaf, _Number) else leaf for k, leaf in enumerate(leaves)])

        def flat(x):
            residuals = run.at(layout, x[own:], x[:own]).residuals(layout.scene(scene, x[own:]), simulate_alongside, options)
            return jnp.concatenate([jnp.ravel(residuals[name]) for name in sorted(residuals)])

        with reference.stands_in():
            r, J = jax.vmap(lambda e: jax.jvp(flat, (x,), (e,)), out_axes=(None, 1))(np.eye(unknowns, dtype=x.dtype))
        return jnp.concatenate([J, r[:, None]], axis=1)

    each = jax.vmap(lane, (None, 0, 0))

    def lanes(common: Float[Array, "shared"], rows: Float[Array, "lanes own"]) -> Float[Array, "lanes samples width"]:
        return each(common, *jnp.split(rows, [rows.shape[1] - unknowns], axis=1))

    return jax.jit(lanes)
