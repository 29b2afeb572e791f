"""The run on which batches of the tilting disc are timed: 10 s, a thousand starts, their final states to 1e-12.

The start is leant by 0.3 rad and has yaw, lean and spin rates 0.5, 0.2, -3 rad/s; each lane's four numbers differ from it by 5 % (standard
deviation). States are minimal, y = (x, y, yaw, lean, spin, yaw_rate, lean_rate, spin_rate).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from . import dense, flat

END = 10.0  # s
LANES = 1024
START = np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.5, 0.2, -3.0])
SCATTER = 0.05
MINIMAL = np.array([0, 1, 2, 3, 4, 7, 8, 9])  # of the ten states (q, qdot)


def starts(lanes: int = LANES, seed: int = 0) -> np.ndarray:
    """Initial minimal states, (lanes, 8)."""
    return START * (1 + SCATTER * np.random.default_rng(seed).normal(size=(lanes, len(START))))


def with_all_speeds(y: np.ndarray, radius: float = dense.DISC_PARAMETERS["radius"]) -> np.ndarray:
    """The states (q, qdot), (lanes, 10), of minimal ones: the contact point moves by `radius spin_rate` along the heading."""
    forward = radius * y[:, 7]
    return np.concatenate([y[:, :5], (forward * np.cos(y[:, 2]))[:, None], (forward * np.sin(y[:, 2]))[:, None], y[:, 5:]], axis=1)


def reference(y: np.ndarray, end: float = END) -> np.ndarray:
    """Final minimal states, with a tolerance of 1e-14."""
    run = jax.jit(lambda y: dense.integrate(flat.disc_rates, dense.DISC_PARAMETERS, y, end, "Dopri8", 1e-14)[0])
    return np.asarray(run(jnp.asarray(y)))


def error(found: np.ndarray, expected: np.ndarray) -> float:
    """Largest error over all lanes and states, absolute in SI units."""
    return float(np.max(np.abs(found - expected)))


def loosest(final: Callable[[float], np.ndarray], expected: np.ndarray, wanted: float = 1e-8, per_decade: int = 4) -> tuple[float, float]:
    """The loosest tolerance on a grid whose final states have the error wanted, and that error.

    **Arguments:** `final(tolerance)`, final minimal states; `expected`, the reference.
    **Raises:** `ValueError` if no tolerance down to 1e-15 does.
    """
    for k in range(6 * per_decade, 15 * per_decade + 1):
        tolerance = 10.0 ** (-k / per_decade)
        found = error(final(tolerance), expected)
        if found <= wanted:
            return tolerance, found
    raise ValueError(f"no tolerance down to 1e-15 gives a final error of {wanted:.0e}")
