"""Runs at rtol = atol = 1e-12 against closed forms, measured at the end of the run."""

import jax.numpy as jnp
import numpy as np
from tolerances import relative_error

import jourdain_jax as jj


def end_error(scene, start, motion, run, same="", **columns):
    """Largest error at the end of a run, of each quantity relative to the largest value that it takes during
    the run.

    **Arguments:** `start`, values by name; `motion(times, **run)`, true values by name, to `run["t_end"]` in
    s; names of coordinates and speeds that are the `same` there, and others with theirs.
    """
    span = run["t_end"]
    exact = motion(np.linspace(0.0, span, 101), **run)
    expected = {name: exact[name] for name in same.split()} | {
        name: exact[other] for name, other in columns.items()
    }
    ends = jnp.asarray(
        [0.0, span]
    )  # no time between, where the solver interpolates less accurately than it steps
    trajectory = jj.simulate(scene, start, ts=ends, rtol=1e-12, atol=1e-12).raise_if_failed()
    return max(
        relative_error(trajectory[name][-1], values[-1], size=float(np.max(np.abs(values))))
        for name, values in expected.items()
    )
