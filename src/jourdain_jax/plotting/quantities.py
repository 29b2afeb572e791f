"""Named quantities of a motion against time."""

import os

import numpy as np

from jourdain_jax.motion.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.scene.names import nearest

ENERGIES = ("energy", "kinetic energy", "potential energy")


def plot(trajectory: Trajectory, *names: str, path: str | os.PathLike | None = None, axes=None):
    """Plot named quantities against time, one panel each: coordinates, speeds, `"energy"`, `"kinetic energy"`, `"potential energy"`.

    Returns the matplotlib figure; written to `path` (.png, .svg, .pdf) where one is given. `axes`: existing axes, one per name.
    KeyError for an unknown name, with the nearest valid one.
    """
    if not names:
        names = trajectory.scene.coordinate_names.entries
    values = [_values(trajectory, name) for name in names]
    plt = pyplot()
    if axes is None:
        figure, axes = plt.subplots(len(names), 1, sharex=True, figsize=(7.0, 1.0 + 1.4 * len(names)), squeeze=False, layout="constrained")
        axes = axes[:, 0]
    axes = np.atleast_1d(axes)
    for axis, name, y in zip(axes, names, values, strict=True):
        axis.plot(np.asarray(trajectory.ts), y, lw=1.5)
        axis.set_ylabel(name)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("t in s")
    figure = axes[0].figure
    if path is not None:
        figure.savefig(path, dpi=150)
        plt.close(figure)
    return figure


def _values(trajectory: Trajectory, name: str) -> np.ndarray:
    if name in ENERGIES:
        energies = trajectory.energies()
        return np.asarray({"energy": energies.balance, "kinetic energy": energies.kinetic, "potential energy": energies.potential}[name])
    valid = (*trajectory.scene.coordinate_names.entries, *trajectory.scene.speed_names.entries, *ENERGIES)
    try:
        return np.asarray(trajectory[name])
    except KeyError:
        raise KeyError(f"nothing named `{name}` to plot; {nearest(name, valid)}") from None
