"""One run prepared for a fit: weighted measurements, the motion, and residuals.

r = (reading - value) / sigma, zero where a sample is missing
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Entries, Scalar
from jourdain_jax.identification.data.channels import Channel, StopEvent
from jourdain_jax.identification.data.delay_filter import Times, grid, intervals
from jourdain_jax.identification.data.experiment import Experiment
from jourdain_jax.identification.data.responses import Drive, Numbers, Reading, ideal, with_numbers
from jourdain_jax.identification.solve.layout import Layout
from jourdain_jax.identification.solve.shooting import LAST, NODE, begin, ended
from jourdain_jax.integrate.inputs import Inputs
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.scene import Scene, state_names


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
