"""First guesses of the states between pieces, from what was measured there.

A coordinate or speed that a channel shows is that of a parabola through the samples about the node; so is the rate of a coordinate,
qdot = N(q) u + nu, met by the smallest change of the speeds. What no channel shows stays as it is at the start; coordinates that no geometric row depends on
go on from piece to piece by as much as they change along each. A sensor shows y as it was a delay ago, and the quantity is y + lag y'.
"""

import jax
import numpy as np
from jaxtyping import Float, Int

from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.sensors import ideal
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.equations.projection import closure_residual
from jourdain_jax.scene.coordinates import Names
from jourdain_jax.scene.scene import Scene

_SAMPLES = 5  # that a parabola goes through


def first_nodes(
    scene: Scene, run: Experiment, ends: Int[np.ndarray, "ends"], q: Float[np.ndarray, "coordinates"], u: Float[np.ndarray, "speeds"]
) -> Float[np.ndarray, "pieces states"]:
    """Nodes at the begin of all pieces of a run, the first one included; q, u: its start."""
    ts = np.asarray(run.ts, float)
    at = np.concatenate([[float(run.t0)], ts[ends[1:-1]]])
    qs, us, rates = np.tile(q, (len(at), 1)), np.tile(u, (len(at), 1)), np.full((len(at), len(q)), np.nan)
    speeds, filters = np.zeros(len(u), bool), []
    for name, values in run.values.items():
        reading = run.readings.get(name, ideal(name))
        gain, bias, delay, lag = (np.asarray(reading.numbers[number]) for number in ("gain", "bias", "delay", "lag"))
        of_state = reading.operation is None and not np.any(gain == 0)
        if not (of_state or reading.has_filter):
            continue
        y = ((np.asarray(values, float) - bias) / np.where(gain == 0, 1.0, gain)).reshape(len(ts), -1)
        found = np.array([[_parabola(ts - delay, column, t) for column in y.T] for t in at])  # (nodes, entries, 2)
        if reading.has_filter:
            filters.append(np.nan_to_num(found[..., 0]))
        if not of_state:
            continue
        found[..., 0] += lag * found[..., 1]
        for names, state, of_speeds in ((scene.coordinate_names, qs, False), (scene.speed_names, us, True)):
            if reading.name in names:
                where = _entries(names, reading.name)
                state[:, where] = np.where(np.isfinite(found[..., 0]), found[..., 0], state[:, where])
                if of_speeds:
                    speeds[where] = True
                else:
                    rates[:, where] = found[..., 1]
    if np.isfinite(rates).any():
        qdot, N = _rates(scene, at, qs, us)
        for k in range(len(at)):
            known = np.isfinite(rates[k])
            us[k, ~speeds] += np.linalg.lstsq(N[k][np.ix_(known, ~speeds)], (rates[k] - qdot[k])[known], rcond=1e-8)[0]
    return np.concatenate([qs, us, *filters], axis=1)


def goes_on(scene: Scene, q: Float[np.ndarray, "coordinates"]) -> np.ndarray:
    """Which coordinates no geometric row and no unit norm depends on, such as headings and distances."""
    beside = q + 0.1 * np.sin(1.0 + np.arange(q.size))  # where no slope vanishes by symmetry
    return ~np.any(_closures(scene, beside) != 0, axis=0)


@eval_numpy
def _closures(scene: Scene, q):
    return jax.jacfwd(lambda q: closure_residual(scene, 0.0, q))(q)


@eval_numpy
def _rates(scene: Scene, t, q, u):
    """qdot and N, at every node."""

    def one(t, q, u):
        return coordinate_rates(scene, t, q, u), jax.jacfwd(coordinate_rates, 3)(scene, t, q, u)

    return jax.vmap(one)(t, q, u)


def _entries(names: Names, name: str) -> np.ndarray:
    for group, first, length in names.groups:
        if group == name:
            return np.arange(first, first + length)
    return np.array([names.entries.index(name)])


def _parabola(ts: Float[np.ndarray, "times"], x: Float[np.ndarray, "times"], t: float) -> tuple[float, float]:
    """Value and slope at a time of the parabola through the nearest samples; NaN where there are fewer than three."""
    there = np.flatnonzero(np.isfinite(x))
    near = there[np.argsort(np.abs(ts[there] - t), kind="stable")[:_SAMPLES]]
    if len(near) < 3:
        return np.nan, np.nan
    _, slope, value = np.polyfit(ts[near] - t, x[near], 2)
    return float(value), float(slope)
