"""Hands-free rides of the nonlinear bicycle after a kick in lean rate, below, inside and above its stable range."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.bicycle.linear import upright_running
from jourdain_jax.models.whipple_bicycle import WhippleBicycle
from jourdain_jax.motion.batches.rollout import Rollout, rollout
from jourdain_jax.motion.start import State

KICK = 0.1  # rad/s, in lean
SPAN = 6.0  # s
_SAMPLES = 301
_WITHOUT_RANGE = (3.0, 5.0, 8.0)  # m/s, where a bicycle has no stable range


class Rides(eqx.Module):
    """Three rides, by label."""

    labels: tuple[str, ...] = eqx.field(static=True)
    speeds: np.ndarray  # m/s
    lanes: Rollout


def ride_speeds(weave: float, capsize: float, stable: bool) -> tuple[tuple[str, ...], np.ndarray]:
    """Labels and speeds (m/s): below, inside and above the stable range; at fixed speeds, and so labelled, where there is no range."""
    if not stable or not np.isfinite(weave):
        return tuple(f"no stable range, {v:.1f} m/s" for v in _WITHOUT_RANGE), np.array(_WITHOUT_RANGE)
    if not np.isfinite(capsize) or capsize <= weave:  # stable from the weave speed on
        speeds = np.array([0.75 * weave, 1.2 * weave, 2.0 * weave])
        return ("below the stable range", "inside it, near its start", "inside it, faster (it has no end)"), speeds
    return ("below the stable range", "inside the stable range", "above the stable range"), np.array([0.75 * weave, (weave + capsize) / 2, 1.3 * capsize])


def ride(values: dict[str, float], labels: tuple[str, ...], speeds: np.ndarray) -> Rides:
    """Simulate the rides of the bicycle with these parameters: a kick in lean rate from upright running, no hands, until it falls."""
    parameters = {name: jnp.full(len(speeds), value) for name, value in values.items()}
    bicycle = WhippleBicycle.from_values(values)
    kicked = jax.vmap(lambda speed: _kicked(bicycle, speed))(jnp.asarray(speeds))
    times = np.linspace(0.0, SPAN, _SAMPLES)
    return Rides(labels, speeds, rollout(WhippleBicycle(), kicked, parameters=parameters, ts=times, progress=False, work=False))


def _kicked(bicycle: WhippleBicycle, speed) -> State:
    """Upright running with a rate of lean, which leaves the rows alone: at zero lean and steer they do not contain it."""
    running = upright_running(bicycle, speed)
    lean = bicycle.speed_names.index("lean_rate", "speed")
    return eqx.tree_at(lambda state: state.u, running, running.u.at[lean].set(KICK))
