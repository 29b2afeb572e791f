"""Residuals of many runs with derivatives, in one compiled program.

Each entry of a batch (`lane` in the code) is one run of one member; a member is a repeat of the experiment or
a first guess. Runs of equal structure share a program, compiled once. Batches have a fixed size, so that
memory does not grow with the number of runs. Short runs are padded to the length of the longest.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import Indices
from jourdain_jax.identification.data.experiment import Experiment
from jourdain_jax.identification.inference.correlated_noise import Chains, whitened
from jourdain_jax.identification.solve.layout import Layout
from jourdain_jax.identification.solve.shooting import Run, on_equal_grids, run_of
from jourdain_jax.integrate.inputs import Sampled
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.scene import Scene, state_names
from jourdain_jax.structure.structure import Reference


def equal_runs(data: Sequence[Experiment]) -> list[tuple[Indices, Run]]:
    """Stack runs of equal structure and shapes. Return each stack with the indices of its runs. Numbers may
    be traced.
    """
    groups: dict[tuple, list[tuple[int, Run]]] = {}
    for indices in grouped(data):
        for i in indices:
            run = run_of(data[i], jnp)
            groups.setdefault(
                (indices[0], *(x.shape for x in jax.tree.leaves(eqx.filter(run, is_array)))), []
            ).append((i, run))
    found = []
    for members in groups.values():
        numbers, runs = zip(*members, strict=True)
        stacked = jax.tree.map(lambda *xs: jnp.stack(xs), *(eqx.filter(run, is_array) for run in runs))
        found.append((numbers, eqx.combine(stacked, eqx.filter(runs[0], is_array, inverse=True))))
    return found


def grouped(data: Sequence[Experiment]) -> list[list[int]]:
    """Return indices of the runs, grouped by equal structure: names, sensors, kinds of inputs, and all shapes
    except the number of times.
    """
    if len(data) == 1:
        return [[0]]
    groups: dict[tuple, list[int]] = {}
    for index, run in enumerate(data):
        parts = run.start, run.readings, run.inputs, run.drives, run.correlation_time
        signals = jax.tree.map(
            lambda x: None if _is_sampled(x) else x, parts[2:4], is_leaf=_is_sampled
        )  # without samples
        arrays, rest = eqx.partition((*parts[:2], signals), is_array)
        kind = (jax.tree.structure((*parts, dict.fromkeys(run.values, 0))), tuple(jax.tree.leaves(rest)))
        groups.setdefault((*kind, tuple(x.shape for x in jax.tree.leaves(arrays))), []).append(index)
    return list(groups.values())


def is_array(x) -> bool:
    return isinstance(x, np.ndarray | jax.Array)


def _is_sampled(x) -> bool:
    return isinstance(x, Sampled)


def most_knots(runs: Sequence[Run]) -> list[int]:
    leaves = [jax.tree.leaves((run.inputs, run.drives), is_leaf=_is_sampled) for run in runs]
    counts = [[x.ts.shape[0] for x in of_run if _is_sampled(x)] for of_run in leaves]
    return [max(column) for column in zip(*counts, strict=True)]


def filled_up(run: Run, times: int, knots: list[int]) -> Run:
    """Pad a run to `times` samples, and its sampled inputs to `knots` samples, with an axis of members.
    Padded samples follow shortly after the end of the run and have zero weight.
    """
    more = times - run.ts.shape[0]
    counts = iter(knots)

    def longer(x):
        if not _is_sampled(x):
            return x
        extra = next(counts) - x.ts.shape[0]
        span = np.asarray(x.ts[-1] - x.ts[0] + 1.0)
        ts = np.concatenate([x.ts, max(x.ts[-1], run.ts[-1]) + span * np.arange(1, extra + 1)])
        return eqx.tree_at(
            lambda s: (s.ts, s.values), x, (ts, np.concatenate([x.values, np.full(extra, x.values[-1])]))
        )

    if knots:
        inputs, drives = jax.tree.map(longer, (run.inputs, run.drives), is_leaf=_is_sampled)
        run = run._replace(inputs=inputs, drives=drives)
    if not more:
        return run
    ts = np.concatenate([run.ts, run.ts[-1] + 1e-6 * (run.ts[-1] - run.t0) * np.arange(1, more + 1)])
    return _of_members(
        run._replace(ts=ts), lambda x: np.pad(x, [(0, 0), (0, more), *[(0, 0)] * (x.ndim - 2)])
    )


# indices of the requested members and of runs; Jacobian and residuals [J r], shape (lanes, samples,
# unknowns + 1), unknowns of runs first
Some = tuple[np.ndarray, np.ndarray, np.ndarray]
_BY_MEMBER = ("values", "weights")  # fields of a run that differ by member


class Group:
    """Runs of equal structure, padded to one length. A lane is one run (by its number in the problem) of one
    member.

    `members`: the number of repeats of the experiment, the leading axis of the values; None: all members
    share the values.
    """

    def __init__(
        self,
        scene: Scene,
        data: Sequence[Experiment],
        indices: list[int],
        layout: Layout,
        options: AllOptions,
        members: int | None,
    ):
        runs = [run_of(data[i], repeats=members is not None) for i in indices]
        if members is None:
            runs = [_of_members(run, lambda x: x[None]) for run in runs]
        self.runs = np.array(indices)
        self._count = members or 1
        self._lengths = [run.ts.shape[0] for run in runs]
        times, knots = max(self._lengths), most_knots(runs)
        equal = runs if runs[0].grid is None or len(runs) == 1 else on_equal_grids(runs)
        filled = [filled_up(run, times, knots) for run in equal]
        first = _of_members(filled[0], lambda x: x[0])
        self.weights = {
            name: np.array([run.weights[name] for run in filled]) for name in first.weights
        }  # (runs, members, times, *channel)
        self._t0, self._ts = np.array([run.t0 for run in filled]), np.array([run.ts for run in filled])
        self.channels, end = {}, 0
        for name, weight in sorted(self.weights.items()):
            begin, end = end, end + math.prod(weight.shape[2:])
            self.channels[name] = slice(begin, end)
        taus = {
            name: np.stack([run.correlation_time[name] for run in filled]) for name in first.correlation_time
        }
        unknown = [
            self.channels.get(name, slice(0))
            for name in sorted({name for run in data for name in run.unknown_correlation})
        ]
        self._chains = Chains.of(self.weights, self._ts, taus, self.channels, unknown) if taus else None
        # all numbers of a run are one row, since each array argument costs as much as some steps of a motion
        self._common = _rows((scene, options), (1, 1))[0]
        of_members = [self._count if name in _BY_MEMBER else 1 for name in Run._fields]
        self._rows = np.stack([_rows(run, of_members) for run in filled])
        leaves, treedef = jax.tree.flatten(((scene, options), first))
        shapes = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if is_array(x) else x for x in leaves)
        self._run = _program(Reference(scene, layout.parameters), treedef, shapes, layout)
        saved = times if first.grid is None else first.grid.shape[0]
        states = saved * len(state_names(scene)) * 8 * (1 + sum(layout.sizes))
        # saved states with tangents of one batch take 2^20 bytes; with 2^18, 2^19 and 2^20 bytes 50 fits of a
        # disc take 25.7, 23.9 and 21.6 ms by machine code, 172, 143 and 132 ms by XLA
        most, total = int(min(64, max(1, 2**20 // states))), self._count * len(runs)
        # equal batches, so that the last one needs few copies
        self._width, self._fewest = most if total <= most else -(-total // -(-total // most)), 1
        self._threads = os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(self._threads)  # for all evaluations; threads start on demand

    def places(self, runs: np.ndarray) -> np.ndarray:
        """Return the positions of these runs in the group."""
        return np.searchsorted(self.runs, runs)

    def evaluate(self, shared, local, members) -> Iterator[Some]:
        """Yield Jacobian and residuals [J r] of all lanes, batch by batch."""
        first, *chunks = self._chunks(len(members))

        def lanes(kept: int, b: np.ndarray, j: np.ndarray) -> Some:
            rows = self._rows[j, members[b] % self._count]
            found = self._run(self._common, np.concatenate([rows, local[b, self.runs[j]], shared[b]], axis=1))
            return b[:kept], self.runs[j[:kept]], np.asarray(found)[:kept]

        yield lanes(*first)  # compiles if necessary
        for k in range(0, len(chunks), self._threads):
            yield from self._pool.map(lanes, *zip(*chunks[k : k + self._threads], strict=True))

    def _chunks(self, members: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Return, for each batch, the number of lanes that count and the indices of their members and runs.
        The last batch is padded with copies of its last lane.
        """
        count = members * len(self.runs)
        # remaining lanes run eight at a time, which is cheaper than compiling a program for fewer
        width, self._fewest = self._width, max(self._fewest, min(count, 8))
        while width >= 2 * max(count, self._fewest):
            width = -(-width // 2)
        lanes = np.minimum(np.arange(-(-count // width) * width), count - 1).reshape(-1, width)
        return [
            (min(width, count - k * width), *np.divmod(some, len(self.runs))) for k, some in enumerate(lanes)
        ]

    def whitened(
        self,
        runs: np.ndarray,
        members: np.ndarray,
        rows: Float[np.ndarray, "lanes samples width"],
        taus: np.ndarray,
    ) -> np.ndarray:
        """Return whitened rows. `taus`: estimated correlation times, (lanes, channels), s."""
        if self._chains is None:
            return rows
        before, rho = self._chains.at(self.places(runs), members % self._count, taus)
        return whitened(rows, np.take_along_axis(rows, before[..., None], axis=1), rho[..., None])

    def log_widths(
        self, runs: np.ndarray, members: np.ndarray, taus: np.ndarray
    ) -> Float[np.ndarray, "lanes"]:
        """Return `sum log sqrt(1 - rho^2)` of each lane."""
        if self._chains is None:
            return np.zeros(len(runs))
        _, rho = self._chains.at(self.places(runs), members % self._count, taus)
        return 0.5 * np.sum(np.log1p(-(rho**2)), axis=1)

    def within(
        self, runs: np.ndarray, share: Float[np.ndarray, "lanes"]
    ) -> Bool[np.ndarray, "lanes samples"]:
        """Return which samples of these runs lie in the first `share` of the span."""
        ts, t0 = self._ts[self.places(runs)], self._t0[self.places(runs)]
        early = np.abs(ts - t0[:, None]) <= (share * np.abs(ts[:, -1] - t0))[:, None]
        counts = [(where.stop - where.start) // early.shape[1] for where in self.channels.values()]
        return np.concatenate([np.repeat(early, count, axis=1) for count in counts], axis=1)

    def by_channel(self, run: int, flat: Float[np.ndarray, "members samples"]) -> dict[str, np.ndarray]:
        """Return weighted residuals of a run by channel, NaN for missing samples. If `flat` is empty, all are
        NaN.
        """
        place, found = int(np.searchsorted(self.runs, run)), {}
        for name, where in self.channels.items():
            weight = self.weights[name][place]
            shape = (len(flat), *weight.shape[1:])
            part = flat[:, where].reshape(shape) if flat.shape[1] else np.full(shape, np.nan)
            found[name] = np.where(weight > 0, part, np.nan)[:, : self._lengths[place]]
        return found


def _of_members(run: Run, of: Callable) -> Run:
    """Return the run with `of` applied to the fields that differ by member."""
    return run._replace(
        **{name: {channel: of(x) for channel, x in getattr(run, name).items()} for name in _BY_MEMBER}
    )


def _rows(trees: Sequence, members: Sequence[int]) -> Float[np.ndarray, "members numbers"]:
    """Return all numbers of some trees in the order of `ravel_pytree`, one row per member. Trees without an
    axis of members are repeated in every row.
    """
    parts = [
        np.asarray(x).reshape(count, -1)
        for tree, count in zip(trees, members, strict=True)
        for x in jax.tree.leaves(tree)
        if is_array(x)
    ]
    return np.hstack(
        [np.zeros((max(members), 0)), *(np.repeat(part, max(members) // len(part), axis=0) for part in parts)]
    )


def _from_vector(tree) -> Callable:
    """Return the inverse of `ravel_pytree(tree)[0]`, without computing that vector."""
    found: list[Callable] = []
    jax.eval_shape(lambda tree: found.append(ravel_pytree(tree)[1]), tree)
    return found[0]


@lru_cache(maxsize=16)
def _program(reference: Reference, treedef, leaves: tuple, layout: Layout) -> Callable:
    """Compile Jacobian and residuals [J r], shape (lanes, samples, local + shared + 1), as a function of the
    shared numbers and, for each lane, one row with the numbers of its run and the unknowns.

    `reference`: reference of the scene; `treedef`, `leaves`: structure of scene, options and run, with shapes
    in place of arrays.
    """
    own, unknowns = layout.sizes[1], sum(layout.sizes)
    zero = lambda x: np.zeros(x.shape, jax.dtypes.canonicalize_dtype(x.dtype))
    zeros = [zero(x) if isinstance(x, jax.ShapeDtypeStruct) else x for x in leaves]
    arrays, rest = eqx.partition(jax.tree.unflatten(treedef, zeros), is_array)
    of_all, of_run = map(_from_vector, arrays)

    def lane(common: Float[Array, "shared"], numbers: Float[Array, "own"]) -> Float[Array, "samples width"]:
        row, x = jnp.split(numbers, [len(numbers) - unknowns])
        (scene, options), run = eqx.combine((of_all(common), of_run(row)), rest)

        def flat(x):
            residuals = run.at(layout, x[own:], x[:own]).residuals(
                layout.scene(scene, x[own:]), simulate, replace(options, tried=True)
            )
            return jnp.concatenate([jnp.ravel(residuals[name]) for name in sorted(residuals)])

        with reference.stands_in():
            # with dense matrices, r is returned once for each direction
            directions = np.eye(
                max(unknowns, 1), unknowns, dtype=x.dtype
            )  # one zero direction if there are no unknowns
            r, J = jax.vmap(lambda e: jax.jvp(flat, (x,), (e,)))(directions)
        return jnp.concatenate([J[:unknowns], r[:1]]).T

    # XLA's newer emitters take twice the time to compile, for a program that is no faster; jaxlib 0.11.1 and
    # later have no others
    older = jax.default_backend() == "cpu" and jax.version.__version_info__ < (0, 11, 1)
    return jax.jit(
        jax.vmap(lane, (None, 0)), compiler_options={"xla_cpu_use_fusion_emitters": False} if older else None
    )
