"""Runs made ready: measurements with weights, the motion of a scene and the residuals that it leaves; grouped by structure, and filled up to one length.

r = (reading - value) / sigma, zero where a sample is missing
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.channels import Channel
from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.grids import grid, intervals
from jourdain_jax.analysis.layout import Layout
from jourdain_jax.analysis.nodes import LAST, NODE, begin, ended
from jourdain_jax.analysis.sensors import Drive, Reading, ideal, with_numbers
from jourdain_jax.analysis.stop_events import StopEvent
from jourdain_jax.motion.inputs import Inputs, Sampled
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.scene import Scene

FILLED = 1e-6  # of a run's span: between the times that fill up a short one


class Run(NamedTuple):
    """A run made ready: its measurements with weights 1 / sigma, zero where a sample is missing."""

    t0: Float[Array | np.ndarray, ""]
    ts: Float[Array | np.ndarray, "times"]
    grid: Float[Array | np.ndarray, "grid"] | None  # s, at equal intervals: where sensors are late, the motion is worked out there
    values: dict[str, Float[Array | np.ndarray, "..."]]
    weights: dict[str, Float[Array | np.ndarray, "..."]]
    start: dict[str, Float[Array | np.ndarray, "..."]]
    inputs: dict | Inputs | None
    sensors: dict[str, Reading]
    drives: dict[str, Drive]
    correlation_time: dict[str, Float[Array | np.ndarray, ""]]  # s, of channels whose noise has a memory

    def motion(self, scene: Scene, simulate: Callable, ts, options: AllOptions) -> Trajectory:
        """The motion at these times."""
        inputs = self.inputs
        for drive in self.drives.values():
            inputs = eqx.tree_at(lambda i, k=drive.index: i.channels[k], inputs, drive.signal())
        if options.backend == "auto" and any(drive.unknown for drive in self.drives.values()):
            options = replace(options, backend="xla")  # which differentiates with respect to samples
        return simulate(scene, begin(scene, self.start, self.t0), t0=self.t0, ts=ts, inputs=inputs, options=options)

    def residuals(self, scene: Scene, simulate: Callable, options: AllOptions) -> dict[str, Float[Array | np.ndarray, "..."]]:
        """`(reading - value) / sigma` by channel; of a piece of a run also what it ends at."""
        ts = self.ts if self.grid is None else self.grid
        motion = self.motion(scene, simulate, ts, replace(options, events=False))
        states = motion.motions() if any(isinstance(sensor.operation, Channel) for sensor in self.sensors.values()) else None
        found, filters, place = {}, [], len(scene.coordinate_names) + len(scene.speed_names)
        for name, weight in self.weights.items():
            sensor, at_first = self.sensors.get(name, ideal(name)), None
            if isinstance(sensor.operation, StopEvent):
                shown = self.stops(sensor.operation, name, partial(self.motion, scene, simulate, options=options))
            else:
                x = sensor.quantity(motion, states)
                if sensor.has_filter and NODE in self.start:
                    place, at_first = place + x[0].size, self.start[NODE][place : place + x[0].size]
                shown, y = sensor.shown(x, self.grid, self.ts, at_first)
                filters += [y] if sensor.has_filter else []
            found[name] = jnp.where(weight > 0, (shown - self.values[name]) * weight, 0.0)
        return found | ended(motion, filters, self.start, ts)

    def stops(self, event: StopEvent, name: str, motion: Callable) -> Float[Array, ""]:
        """When the motion stops at the event whose time is the channel `name`; samples may end long before it."""
        observed = jnp.max(jnp.where(self.weights[name] > 0, self.values[name] - self.t0, 0.0))
        return event.time(motion, self.t0, jnp.maximum(self.ts[-1] - self.t0, observed))

    def at(self, layout: Layout, shared, local) -> "Run":
        """The run with these unknowns."""
        changed = layout.start(self.start, local)
        if not layout.numbers:
            return self._replace(start=changed)
        known = layout.known(shared, local)
        return self._replace(start=changed, sensors=with_numbers(self.sensors, known), drives=with_numbers(self.drives, known))


def run_of(data: Experiment, xp=np, repeats: bool = False) -> Run:
    """A run with weights; `xp`: NumPy, or `jax.numpy` where numbers are traced; `repeats`: values have a leading axis."""
    weights = {}
    for name, values in data.values.items():
        sigma, known = data.sigma_of(name, repeats), xp.isfinite(xp.asarray(values))
        weights[name] = xp.where(known & xp.isfinite(sigma), 1.0 / sigma, 0.0)
    measured = {name: xp.where(weights[name] > 0, xp.asarray(values), 0.0) for name, values in data.values.items()}
    found = Run(data.t0, data.ts, None, measured, weights, data.start, data.inputs, data.readings, data.drives, data.correlation_time)
    return on_equal_grids([found])[0] if any(sensor.is_late for sensor in data.readings.values()) else found


def on_equal_grids(runs: Sequence[Run]) -> list[Run]:
    """The runs on grids of as many intervals as the longest needs."""
    nodes = [run.start.get(LAST) for run in runs]
    count = max(intervals(run.t0, run.ts, node) for run, node in zip(runs, nodes, strict=True))
    return [run._replace(grid=grid(run.t0, run.ts, count, node)) for run, node in zip(runs, nodes, strict=True)]


def equal_runs(data: Sequence[Experiment]) -> list[tuple[tuple[int, ...], Run]]:
    """Runs of equal structure and shapes stacked, with their numbers, for use where numbers may be traced."""
    groups: dict[tuple, list[tuple[int, Run]]] = {}
    for indices in grouped(data):
        for i in indices:
            run = run_of(data[i], jnp)
            groups.setdefault((indices[0], *(x.shape for x in jax.tree.leaves(eqx.filter(run, is_array)))), []).append((i, run))
    found = []
    for members in groups.values():
        numbers, runs = zip(*members, strict=True)
        stacked = jax.tree.map(lambda *xs: jnp.stack(xs), *(eqx.filter(run, is_array) for run in runs))
        found.append((numbers, eqx.combine(stacked, eqx.filter(runs[0], is_array, inverse=True))))
    return found


def grouped(data: Sequence[Experiment]) -> list[list[int]]:
    """Indices of the runs, grouped by equal structure: names, sensors, kinds of inputs, shapes but for the number of times."""
    if len(data) == 1:
        return [[0]]
    groups: dict[tuple, list[int]] = {}
    for index, run in enumerate(data):
        parts = run.start, run.readings, run.inputs, run.drives, run.correlation_time
        arrays, rest = eqx.partition((*parts[:2], _without_knots(parts[2:4])), is_array)
        kind = (jax.tree.structure((*parts, dict.fromkeys(run.values, 0))), tuple(jax.tree.leaves(rest)))
        groups.setdefault((*kind, tuple(x.shape for x in jax.tree.leaves(arrays))), []).append(index)
    return list(groups.values())


def is_array(x) -> bool:
    return isinstance(x, np.ndarray | jax.Array)


def _is_sampled(x) -> bool:
    return isinstance(x, Sampled)


def _without_knots(inputs):
    return jax.tree.map(lambda x: None if _is_sampled(x) else x, inputs, is_leaf=_is_sampled)


def most_knots(runs: Sequence[Run]) -> list[int]:
    counts = [[x.ts.shape[0] for x in jax.tree.leaves((run.inputs, run.drives), is_leaf=_is_sampled) if _is_sampled(x)] for run in runs]
    return [max(column) for column in zip(*counts, strict=True)]


def filled_up(run: Run, times: int, knots: list[int], axis: int) -> Run:
    """The run with as many times and knots as these; what is added is close behind its end, and does not count."""
    more = times - run.ts.shape[0]
    if not (more or knots):
        return run
    counts = iter(knots)

    def longer(x):
        if not _is_sampled(x):
            return x
        extra = next(counts) - x.ts.shape[0]
        span = np.asarray(x.ts[-1] - x.ts[0] + 1.0)
        ts = np.concatenate([x.ts, max(x.ts[-1], run.ts[-1]) + span * np.arange(1, extra + 1)])
        return eqx.tree_at(lambda s: (s.ts, s.values), x, (ts, np.concatenate([x.values, np.full(extra, x.values[-1])])))

    inputs, drives = jax.tree.map(longer, (run.inputs, run.drives), is_leaf=_is_sampled)
    run = run._replace(inputs=inputs, drives=drives)
    if not more:
        return run
    pad = lambda x: np.concatenate([x, np.zeros((*x.shape[:axis], more, *x.shape[axis + 1 :]))], axis=axis)  # noqa: E731
    ts = np.concatenate([run.ts, run.ts[-1] + FILLED * (run.ts[-1] - run.t0) * np.arange(1, more + 1)])
    return run._replace(ts=ts, values={n: pad(x) for n, x in run.values.items()}, weights={n: pad(x) for n, x in run.weights.items()})
