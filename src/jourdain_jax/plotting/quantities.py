"""Named quantities of a motion against time; of many motions, the bands that hold given parts of them."""

import os

import numpy as np

from jourdain_jax.motion.batches.rollout import Rollout
from jourdain_jax.motion.trajectories import results
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.scene.names import UnknownNameError, nearest
from jourdain_jax.scene.numbers import described

ENERGIES = ("energy", "kinetic energy", "potential energy")
_BANDS = ((0.025, 0.975, 0.2), (0.25, 0.75, 0.4))  # lower and upper quantile, opacity


def check_format(path: str | os.PathLike) -> None:
    """ValueError where matplotlib knows no picture with the suffix of this path."""
    known = pyplot().FigureCanvasBase.get_supported_filetypes()
    folder = os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise ValueError(f"cannot write `{os.fspath(path)}`: there is no folder `{folder}`; make it first")
    suffix = os.path.splitext(os.fspath(path))[1].removeprefix(".").lower()
    if suffix not in known:
        raise ValueError(f"cannot write `{path}`: a plot is a .png, .svg or .pdf file, and matplotlib knows no `{suffix or 'file without suffix'}`")


def plot(motion: Trajectory | Rollout, *names: str, path: str | os.PathLike | None = None, axes=None):
    """Plot named quantities of a `motion` against time, one panel each.

    - `names`: coordinates, speeds, `"energy"`, `"kinetic energy"`, `"potential energy"` (default: all coordinates). Of a rollout, coordinates
      and speeds: the median of all lanes that are still under way, and the bands that hold half and 95 % of them.
    - `path`: where to write it (.png, .svg, .pdf); `axes`: existing axes, one per name.

    Returns the matplotlib figure. KeyError for an unknown name, with the nearest valid one; ImportError without matplotlib.
    """
    if not isinstance(motion, Rollout | Trajectory):
        raise ValueError(f"`plot` was given {described(motion)}, expected a motion from `jj.simulate` or a rollout")
    if path is not None:
        check_format(path)
    scene = motion.lanes.scene if isinstance(motion, Rollout) else motion.scene
    names = names or scene.coordinate_names.entries
    values = [_values(motion, name) for name in names]
    plt = pyplot()
    if axes is None:
        figure, axes = plt.subplots(len(names), 1, sharex=True, figsize=(7.0, 1.0 + 1.4 * len(names)), squeeze=False, layout="constrained")
        axes = axes[:, 0]
    axes = np.atleast_1d(axes)
    for axis, name, y in zip(axes, names, values, strict=True):
        if isinstance(motion, Rollout):
            _draw_bands(axis, np.asarray(motion.lanes.ts[0]), y)
        else:
            axis.plot(np.asarray(motion.ts), y, lw=1.5)
        axis.set_ylabel(name)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("t in s")
    figure = axes[0].figure
    if isinstance(motion, Rollout):
        axes[0].set_title(_how_many(motion), fontsize="medium", loc="left")
        axes[0].legend(loc="upper right", fontsize="small", ncols=3)
    if path is not None:
        figure.savefig(path, dpi=150)
        plt.close(figure)
    return figure


def _draw_bands(axis, ts: np.ndarray, quantiles: np.ndarray) -> None:
    """The median and the bands around it; `quantiles` as in `_levels`."""
    for k, (low, high, opacity) in enumerate(_BANDS):
        axis.fill_between(ts, quantiles[2 * k], quantiles[2 * k + 1], color="C0", alpha=opacity, lw=0, label=f"{100 * (high - low):.0f} % of lanes")
    axis.plot(ts, quantiles[-1], color="C0", lw=1.5, label="median")


def _levels() -> list[float]:
    return [level for low, high, _ in _BANDS for level in (low, high)] + [0.5]


def _how_many(rollout: Rollout) -> str:
    stopped = int(np.sum(rollout.result == results.EVENT))
    return f"{len(rollout)} lanes; {stopped} stopped at an event, {rollout.failed.size} failed"


def _values(motion: Trajectory | Rollout, name: str) -> np.ndarray:
    many = isinstance(motion, Rollout)
    scene = motion.lanes.scene if isinstance(motion, Rollout) else motion.scene
    valid = (*scene.coordinate_names.entries, *scene.speed_names.entries, *(() if many else ENERGIES))
    if name not in valid:
        raise UnknownNameError(f"nothing named `{name}` to plot; {nearest(name, valid)}")
    if isinstance(motion, Rollout):
        return motion.quantiles(name, _levels())
    if name in ENERGIES:
        energies = motion.energies()
        return np.asarray({"energy": energies.balance, "kinetic energy": energies.kinetic, "potential energy": energies.potential}[name])
    return np.asarray(motion[name])
