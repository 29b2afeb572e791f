"""The run on which batches of the tilting disc are timed: 10 s, a thousand starts, their final states to
1e-12.

The start is leant by 0.3 rad and has yaw, lean and spin rates 0.5, 0.2, -3 rad/s; each lane's four numbers
differ from it by 5 % (standard deviation). States are minimal, y = (x, y, yaw, lean, spin, yaw_rate,
lean_rate, spin_rate).
"""

import jax
import numpy as np

from . import dense, flat

END = 10.0  # s
LANES = 1024
START = np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.5, 0.2, -3.0])
SCATTER = 0.05
MINIMAL = np.array([0, 1, 2, 3, 4, 7, 8, 9])  # of the ten states (q, qdot)


def starts(lanes):
    """Initial minimal states, (lanes, 8)."""
    return START * (1 + SCATTER * np.random.default_rng(0).normal(size=(lanes, len(START))))


def with_all_speeds(y):
    """The states (q, qdot), (lanes, 10), of minimal ones: the contact point moves by `radius spin_rate` along
    the heading.
    """
    forward, yaw = dense.DISC_PARAMETERS["radius"] * y[:, 7], y[:, 2]
    return np.column_stack([y[:, :5], forward * np.cos(yaw), forward * np.sin(yaw), y[:, 5:]])


def final_states(method):
    """A compiled function `(tolerance, starts)` of initial minimal states to final ones, by diffrax;
    `method`: "dense" or "flat".
    """
    rates = {"dense": dense.disc_rates, "flat": flat.disc_rates}[method]

    @jax.jit
    def integrated(tolerance, y):
        return dense.integrate(rates, dense.DISC_PARAMETERS, y, END, "Dopri8", tolerance)

    if method == "flat":
        return lambda tolerance, starts: np.asarray(integrated(tolerance, starts))
    return lambda tolerance, starts: np.asarray(integrated(tolerance, with_all_speeds(starts)))[:, MINIMAL]


def reference(starts):
    """Final minimal states, with a tolerance of 1e-14."""
    return final_states("flat")(1e-14, starts)


def error(found, expected):
    """Largest error over all lanes and states, absolute in SI units."""
    return float(np.max(np.abs(found - expected)))


def loosest(final, expected, first):
    """The loosest tolerance whose final states have an error of 1e-8, on a grid of four per decade from
    `first` down; ValueError where none does.
    """
    for tolerance in 10.0 ** -np.arange(-np.log10(first), 15.01, 0.25):
        if error(final(float(tolerance)), expected) <= 1e-8:
            return float(tolerance)
    raise ValueError(f"no tolerance from {first:.0e} down to 1e-15 gives a final error of 1e-8")
