"""Multiple shooting: runs are divided into pieces with their own starts, joined by continuity.

    piece i of a run      motion x(t; s_i, theta) from t_i to t_i+1, from the state s_i;   s_0: start
    continuity            x(t_i+1; s_i, theta) = s_i+1

Continuity is an equation, not a residual. With delayed sensors, pieces overlap: a sample belongs to the piece
that contains its earliest possible time, and that piece extends beyond t_i+1. The output of a sensor's
low-pass filter is part of s.

Over a short piece a motion depends almost linearly on its unknowns, even if the whole run is chaotic. Source:
H. G. Bock, in: Modelling of Chemical Reaction Systems (1981) 102; H. G. Bock, E. Kostina and J. P. Schlöder,
GAMM-Mitteilungen 30 (2007) 376.

Nodes are the states s = (q, u, y) between pieces: coordinates, speeds, and filter outputs y.

A piece begins at the projection of its node onto the constraints, and continuity is required of all entries
of s. No chart of the constraint manifold is needed, which could be singular.

`Run` is a run or a piece, prepared for a fit, with residuals r = (reading - value) / sigma, zero where a
sample is missing.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.reals import Entries, Number, PerTime, Scalar, checked_real, checked_whole
from jourdain_jax.identification.data.channels import Channel, StopEvent
from jourdain_jax.identification.data.delay_filter import FEWEST_INTERVALS, Times, grid, intervals
from jourdain_jax.identification.data.experiment import (
    Drive,
    Experiment,
    Numbers,
    Reading,
    ideal,
    latest,
    with_numbers,
)
from jourdain_jax.identification.solve.layout import Layout
from jourdain_jax.integrate.inputs import Inputs, Sampled
from jourdain_jax.integrate.state import state_of
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.scene import Scene, state_names

Ends = Int[np.ndarray, "ends"]
NODE, LAST = "node of a piece", "time of the next node"  # keys in the start of a piece


def begin(scene: Scene, start: dict, t0):
    """Return the initial values for `simulate`: the start of a run, or for a later piece its node, which
    `simulate` projects onto the constraints.
    """
    if NODE in start:
        q, u, _ = jnp.split(start[NODE], np.cumsum([len(scene.coordinate_names), len(scene.speed_names)]))
        return state_of(scene, t0, q, u)
    return {name: value for name, value in start.items() if name != LAST}


def ended(
    motion: Trajectory, filters: Sequence[Float[Array, "times entries"]], start: dict, ts: PerTime
) -> dict[str, Float[Array, "states"]]:
    """Return the end state of a piece; empty for a whole run. `ts`: the times of the motion."""
    if LAST not in start:
        return {}
    last = jnp.argmin(jnp.abs(ts - start[LAST]))
    # its residuals follow those of all channels
    return {"~end of a piece": jnp.concatenate([x[last] for x in (motion.q, motion.u, *filters)])}


@dataclass(frozen=True)
class MultipleShooting:
    """Fit each run in pieces with their own starts, each ending where the next one begins.

        jj.fit(guess, run, free=("mass", "length"), shooting=jj.identification.MultipleShooting(duration=0.5))

    - `duration`: approximate length of a piece, s. Choose the time over which neighbouring motions diverge by
      a factor of two to five.
    - `pieces`: number of pieces of each run; give either this or `duration`.

    Use it for motions that are unstable or chaotic over the whole run: over a piece, the problem is almost
    linear. The objective and its minimum are those of a fit without `shooting`. Pieces begin at samples; if a
    sensor has a delay, they overlap by its largest possible value.

    **Raises** ValueError unless either a positive finite duration or at least two pieces are given. `fit`
    raises it for a run with too few samples.
    """

    pieces: int | None = None
    duration: float | None = None  # s

    def __post_init__(self):
        if (self.pieces is None) == (self.duration is None):
            raise ValueError(
                "`MultipleShooting` expects either `pieces` (number per run) or `duration` (of a piece, in "
                "s), such as `duration=0.5`"
            )
        if self.pieces is not None:
            expected = "of two or more; for one piece omit `shooting`"
            checked_whole(self.pieces, "`pieces` of `MultipleShooting`", 2, expected=expected)
        else:
            number: Number = checked_real(
                self.duration, "`duration` of `MultipleShooting`", (), advice="give a time in s"
            )
            if not (np.isfinite(number) and number > 0):
                raise ValueError(
                    f"`duration` of `MultipleShooting` is {self.duration} s, expected a positive finite time"
                )


def ends_of_pieces(run: Experiment, shooting: MultipleShooting, index: int) -> Ends:
    """Return the indices of the samples at which pieces begin, and of the last sample. Raises ValueError if
    there are fewer intervals than pieces, or if an event ended the run.
    """
    if run.ended_by:
        raise ValueError(
            f"run {index} has a measured time of its event `{run.ended_by}`, which `shooting` does not use; "
            "omit this time, and the samples after it"
        )
    ts = np.asarray(run.ts)
    count = len(ts) - 1
    pieces = shooting.pieces
    if pieces is not None:
        if pieces > count:
            raise ValueError(
                f"run {index} has {len(ts)} samples, too few for {pieces} pieces; give at most {count} pieces"
            )
        return np.round(np.linspace(0, count, pieces + 1)).astype(int)
    at = float(run.t0) + shooting.duration * np.arange(
        1, max(1, round((ts[-1] - float(run.t0)) / shooting.duration))
    )
    after = np.clip(np.searchsorted(ts, at), 1, count)
    nearest = np.where(at - ts[after - 1] < ts[after] - at, after - 1, after)
    return np.unique([0, *nearest[(nearest > 0) & (nearest < count)], count])


def numbers_of_filters(run: Experiment) -> int:
    """Return the number of filter outputs of the sensors of a `checked` run."""
    return sum(
        math.prod(x.shape[1:])
        for name, x in run.values.items()
        if name in run.readings and run.readings[name].has_filter
    )


def owned(run: Experiment, ends: Ends) -> dict[str, Ends]:
    """Return for each channel the index of the first sample of each piece, and the number of samples.

    A sample at a node belongs to the later piece. With a delayed sensor, a sample belongs to a later piece
    only if that piece began at least the largest delay before the sample.
    """
    ts, found = np.asarray(run.ts, float), {}
    for name in run.values:
        late = latest(run.sensors[name].delay) if name in run.sensors else 0.0
        inner = np.searchsorted(ts, ts[ends[1:-1]] + late - 1e-9 * (ts[-1] - ts[0]))
        found[name] = np.hstack([0, inner, len(ts)])
    return found


def in_pieces(run: Experiment, ends: Ends, states: int) -> list[Experiment]:
    """Return the pieces of a `checked` run. All but the first begin at a node of `states` numbers. `ends`:
    first and last samples of the pieces.
    """
    found, firsts = [], owned(run, ends)
    for k, (first, end) in enumerate(pairwise(ends)):
        last = max(end, *(own[k + 1] - 1 for own in firsts.values()))
        here, of_piece = slice(first, last + 1), np.arange(first, last + 1)
        values = {}
        for name, x in run.values.items():
            begin, after = firsts[name][k : k + 2]
            counts = (of_piece >= begin) & (of_piece < after)
            part = np.asarray(x[here], float)
            values[name] = np.where(counts.reshape(-1, *[1] * (part.ndim - 1)), part, np.nan)
        begins = first == ends[0]
        t0 = run.t0 if begins else np.asarray(run.ts[first])
        piece = run.changed(
            ts=run.ts[here],
            t0=t0,
            values=values,
            sigma={name: x if x.ndim == 0 else x[here] for name, x in run.sigma.items()},
            start=(run.start if begins else {NODE: np.zeros(states)}) | {LAST: np.asarray(run.ts[end])},
            unknown_start=run.unknown_start if begins else {},
            # a grid may end one interval later
            inputs=_cut(run, float(t0), float(run.ts[last] + (run.ts[last] - t0) / FEWEST_INTERVALS)),
        )
        found.append(piece)
    return found


def _cut(run: Experiment, t0: float, t1: float) -> dict | Inputs | None:
    """Return the inputs with only the samples around this span. Commands of actuators keep all samples, since
    an unknown delay shifts them.
    """
    if not isinstance(run.inputs, Inputs):
        return run.inputs
    driven = {drive.index for drive in run.drives.values()}

    def between(index: int, signal):
        if index in driven or not isinstance(signal, Sampled):
            return signal
        ts = np.asarray(signal.ts)
        first = max(int(np.searchsorted(ts, t0, "right")) - 1, 0)
        some = slice(first, max(min(int(np.searchsorted(ts, t1)), len(ts) - 1), first) + 1)
        return Sampled(ts[some], np.asarray(signal.values)[some])

    return Inputs(tuple(between(k, x) for k, x in enumerate(run.inputs.channels)))


def check_shooting(shooting) -> None:
    """Raise ValueError unless `shooting` is a `MultipleShooting` or None."""
    if shooting is not None and not isinstance(shooting, MultipleShooting):
        raise ValueError(
            f"`shooting` is {shooting!r}, expected `jj.identification.MultipleShooting(duration=...)`, "
            "`jj.identification.MultipleShooting(pieces=...)`, or None"
        )


class Run(NamedTuple):
    """A prepared run: measurements with weights 1 / sigma, zero where a sample is missing."""

    t0: Float[Entries, ""]
    ts: Times
    # s, at equal intervals: the times of the motion if sensors have delays or lags
    grid: Float[Entries, "grid"] | None
    values: dict[str, Numbers]
    weights: dict[str, Numbers]
    start: dict[str, Numbers]
    inputs: dict | Inputs | None
    sensors: dict[str, Reading]
    drives: dict[str, Drive]
    correlation_time: dict[str, Float[Entries, ""]]  # s, of channels with correlated noise

    def motion(self, scene: Scene, simulate: Callable, ts, options: AllOptions) -> Trajectory:
        """Return the motion at these times."""
        inputs = self.inputs
        for drive in self.drives.values():
            inputs = drive.put_into(inputs)
        if options.backend == "auto" and any(drive.unknown for drive in self.drives.values()):
            options = replace(options, backend="xla")  # for derivatives with respect to samples
        return simulate(
            scene, begin(scene, self.start, self.t0), t0=self.t0, ts=ts, inputs=inputs, options=options
        )

    def residuals(self, scene: Scene, simulate: Callable, options: AllOptions) -> dict[str, Numbers]:
        """Return `(reading - value) / sigma` by channel, and for a piece of a run also its end state."""
        ts = self.ts if self.grid is None else self.grid
        motion = self.motion(scene, simulate, ts, replace(options, events=False))
        if any(isinstance(sensor.operation, Channel) for sensor in self.sensors.values()):
            states = motion.motions()
        else:
            states = None
        found, filters, place = {}, [], len(state_names(scene))
        for name, weight in self.weights.items():
            sensor, at_first = self.sensors.get(name, ideal(name)), None
            if isinstance(sensor.operation, StopEvent):
                shown = self.stops(
                    sensor.operation, name, partial(self.motion, scene, simulate, options=options)
                )
            else:
                x = sensor.quantity(motion, states)
                if sensor.has_filter and NODE in self.start:
                    place, at_first = place + x[0].size, self.start[NODE][place : place + x[0].size]
                shown, y = sensor.shown(x, self.grid, self.ts, at_first)
                filters += [y] if sensor.has_filter else []
            found[name] = jnp.where(weight > 0, (shown - self.values[name]) * weight, 0.0)
        return found | ended(motion, filters, self.start, ts)

    def stops(self, event: StopEvent, name: str, motion: Callable) -> Scalar:
        """Return the time at which the motion stops at the event of the channel `name`, which may be long
        after the last sample.
        """
        observed = jnp.max(jnp.where(self.weights[name] > 0, self.values[name] - self.t0, 0.0))
        return event.time(motion, self.t0, jnp.maximum(self.ts[-1] - self.t0, observed))

    def at(self, layout: Layout, shared, local) -> "Run":
        """Return the run with these values of the unknowns."""
        changed = layout.start(self.start, shared, local)
        if not layout.numbers:
            return self._replace(start=changed)
        known = layout.known(shared, local)
        return self._replace(
            start=changed, sensors=with_numbers(self.sensors, known), drives=with_numbers(self.drives, known)
        )


def run_of(data: Experiment, xp=np, repeats: bool = False) -> Run:
    """Return the prepared run with its weights. `xp`: NumPy, or `jax.numpy` for traced numbers; `repeats`:
    whether values have a leading axis.
    """
    weights = {}
    for name, values in data.values.items():
        sigma, known = data.sigma_of(name, repeats), xp.isfinite(xp.asarray(values))
        weights[name] = xp.where(known & xp.isfinite(sigma), 1.0 / sigma, 0.0)
    measured = {
        name: xp.where(weights[name] > 0, xp.asarray(values), 0.0) for name, values in data.values.items()
    }
    models = data.readings, data.drives, data.correlation_time
    found = Run(data.t0, data.ts, None, measured, weights, data.start, data.inputs, *models)
    return on_equal_grids([found])[0] if any(sensor.is_late for sensor in data.readings.values()) else found


def on_equal_grids(runs: Sequence[Run]) -> list[Run]:
    """Return the runs on grids with the number of intervals that the longest run needs."""
    nodes = [run.start.get(LAST) for run in runs]
    count = max(intervals(run.t0, run.ts, node) for run, node in zip(runs, nodes, strict=True))
    return [
        run._replace(grid=grid(run.t0, run.ts, count, node)) for run, node in zip(runs, nodes, strict=True)
    ]
