"""Named quantities of motions against time; of many motions, the bands that hold given parts of them."""

import os
from collections.abc import Sequence

import numpy as np

from jourdain_jax.analysis.families.family import Family
from jourdain_jax.calculus.reals import described
from jourdain_jax.calculus.writing import check_place
from jourdain_jax.motion.batches.rollout import Rollout
from jourdain_jax.motion.trajectories import results
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.plotting.families_drawn import plot_family
from jourdain_jax.plotting.units import checked_units
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.names import UnknownNameError, nearest

ENERGIES = ("energy", "kinetic energy", "potential energy")


def check_format(path: str | os.PathLike) -> None:
    """ValueError where matplotlib knows no picture with the suffix of this path."""
    known = pyplot().FigureCanvasBase.get_supported_filetypes()
    check_place(path)
    suffix = os.path.splitext(os.fspath(path))[1].removeprefix(".").lower()
    if suffix not in known:
        raise ValueError(f"cannot write `{path}`: a plot is a .png, .svg or .pdf file, and matplotlib knows no `{suffix or 'file without suffix'}`")


@of_known_numbers
def plot(
    motion,
    *names: str,
    units=None,
    labels=None,
    bands=(0.5, 0.95),
    title: str | None = None,
    path: str | os.PathLike | None = None,
    axes=None,
):
    """Plot named quantities of a `motion` against time, one panel each.

    - `motion`: from `jj.simulate` or `jj.rollout`, or several of them in a list, each in its own colour; `labels`: what the legend calls each of them.
    - `names`: coordinates, speeds, `"kinetic energy"`, `"potential energy"`, `"energy"`, their sum (default: all coordinates of the first motion). Of a
      rollout, coordinates and speeds: the median of all lanes that are still under way, and a band for each number in `bands`, the part of them that it holds.
    - `units`: name -> unit, such as `{"lean": "deg", "spin_rate": "rpm", "t": "ms"}` (default: SI, radians). Coordinates: m, km, cm, mm, rad, mrad, deg,
      turn; speeds: m/s, km/h, cm/s, mm/s, rad/s, deg/s, turn/s, rpm; energies: J, kJ, mJ; `"t"`: s, ms, min, h.
    - A family (`jj.family`) is drawn against its own values: `jj.plot(turns, "x_rate", "lean")`, stable parts in full, special points marked.
    - `title`: default: of a rollout, how its lanes ended. `path`: where to write it (.png, .svg, .pdf); `axes`: existing axes, one per name.

    Returns the matplotlib figure and an array of its axes, shape (names,). KeyError for an unknown name, with the nearest valid one; ValueError for an
    unknown unit, bands outside 0 to 1, or anything that is no motion; ImportError without matplotlib.

    **Examples**

        motions = [jj.simulate(jj.models.TiltingDisc(), {"lean": 0.3, "spin_rate": spin}, t1=3.0) for spin in (-3.0, -4.0)]
        figure, axes = jj.plot(motions, "lean", units={"lean": "deg"}, labels=["slow", "fast"])
    """
    if path is not None:
        check_format(path)
    if isinstance(motion, Family):
        return plot_family(motion, names, units, title, path, axes)
    motions = _checked_motions(motion)
    labels, bands = _checked_labels(labels, len(motions)), _checked_bands(bands)
    names = names or _scene(motions[0]).coordinate_names.entries
    values = [[_values(one, name, bands) for name in names] for one in motions]
    sizes = checked_units(units, _kinds(motions))
    plt = pyplot()
    own = axes is None
    if own:
        figure, axes = plt.subplots(len(names), 1, sharex=True, figsize=(7.0, 1.2 + 1.4 * len(names)), squeeze=False, layout="constrained")
        axes = axes[:, 0]
    axes = np.atleast_1d(axes)
    if len(axes) != len(names):
        raise ValueError(f"`axes` holds {len(axes)} axes for {len(names)} names, expected one for each of {', '.join(names)}")
    unit_of_time, second = sizes.get("t", ("s", 1.0))
    for k, (axis, name) in enumerate(zip(axes, names, strict=True)):
        unit, size = sizes.get(name, ("J" if name in ENERGIES else "", 1.0))
        for j, (one, label) in enumerate(zip(motions, labels, strict=True)):
            _draw(axis, one, values[j][k] / size, second, bands, f"C{j}", label)
        axis.set_ylabel(f"{name} in {unit}" if unit else name)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel(f"t in {unit_of_time}")
    figure = axes[0].figure
    if title is None and len(motions) == 1 and isinstance(motions[0], Rollout):
        stopped = int(np.sum(motions[0].result == results.EVENT))
        title = f"{len(motions[0])} lanes; {stopped} stopped at an event, {motions[0].failed.size} failed"
    _head(figure if own else axes[0], axes[0], title, columns=len(motions))
    if path is not None:
        figure.savefig(path, dpi=150)
        plt.close(figure)
    return figure, axes


def _checked_motions(given) -> list[Trajectory | Rollout]:
    several = isinstance(given, list | tuple)
    motions = list(given) if several else [given]
    for k, one in enumerate(motions):
        if not isinstance(one, Rollout | Trajectory):
            where = f" in place {k}" if several else ""
            raise ValueError(f"`plot` was given {described(one)}{where}, expected a motion from `jj.simulate` or a rollout")
    if not motions:
        raise ValueError("`plot` was given an empty list, expected motions from `jj.simulate` or rollouts")
    return motions


def _checked_labels(labels, count: int) -> list[str]:
    if labels is None:
        return [""] if count == 1 else [f"motion {k}" for k in range(count)]
    if isinstance(labels, str) or len(labels) != count:
        raise ValueError(f"`labels` is {labels!r}, expected a list of as many as there are motions, {count}")
    return [str(label) for label in labels]


def _checked_bands(bands) -> list[float]:
    try:
        parts = sorted({float(part) for part in bands})
    except (TypeError, ValueError):
        parts = [np.nan]
    if not all(0 < part < 1 for part in parts):
        raise ValueError(f"`bands` is {bands!r}, expected parts of the lanes between 0 and 1, such as (0.5, 0.95)")
    return parts


def _scene(motion: Trajectory | Rollout):
    return motion.lanes.scene if isinstance(motion, Rollout) else motion.scene


def _kinds(motions: Sequence) -> dict[str, tuple[str, ...]]:
    """Names that may be plotted, by what they are."""
    coordinates = tuple(dict.fromkeys(name for one in motions for name in _scene(one).coordinate_names.entries))
    speeds = tuple(dict.fromkeys(name for one in motions for name in _scene(one).speed_names.entries))
    return {"coordinate": coordinates, "speed": speeds, "energy": ENERGIES, "time": ("t",)}


def _draw(axis, motion, y: np.ndarray, second: float, bands: Sequence[float], colour: str, label: str) -> None:
    """A line; of a rollout the bands, widest and palest first, and the median, `y` as `_values` gives them."""
    if not isinstance(motion, Rollout):
        axis.plot(np.asarray(motion.ts) / second, y, color=colour, lw=1.5, label=label)
        return
    ts, named = np.asarray(motion.lanes.ts[0]) / second, f"{label}, " if label else ""
    for k, part in reversed(list(enumerate(bands))):
        low, high = y[2 * k], y[2 * k + 1]
        axis.fill_between(ts, low, high, color=colour, alpha=0.2 if k else 0.4, lw=0, label=f"{named}{100 * part:.3g} % of lanes")
    axis.plot(ts, y[-1], color=colour, lw=1.5, label=f"{named}median")


def _head(place, axis, title: str | None, columns: int) -> None:
    """Title and legend of all panels; on a figure of our own above them, where they hide nothing, otherwise within the first panel, `place`.

    One column of the legend for each motion, or one for each entry where there is one motion.
    """
    if title:
        axis.set_title(title, fontsize="medium", loc="left")
    handles, labels = axis.get_legend_handles_labels()
    shown = [(handle, label) for handle, label in zip(handles, labels, strict=True) if label]
    if shown:
        row = {"loc": "outside upper left", "ncols": min(columns if columns > 1 else len(shown), 4)}
        place.legend(*zip(*shown, strict=True), fontsize="small", **({"loc": "best"} if place is axis else row))


def _values(motion: Trajectory | Rollout, name: str, bands: Sequence[float]) -> np.ndarray:
    """Values at all times; of a rollout the lower and the upper end of each band in turn, and the median last."""
    many, scene = isinstance(motion, Rollout), _scene(motion)
    valid = (*scene.coordinate_names.entries, *scene.speed_names.entries, *(() if many else ENERGIES))
    if name not in valid:
        raise UnknownNameError(f"nothing named `{name}` to plot; {nearest(name, valid)}")
    if isinstance(motion, Rollout):
        return motion.quantiles(name, [level for part in bands for level in ((1 - part) / 2, (1 + part) / 2)] + [0.5])
    if name in ENERGIES:
        energies = motion.energies()
        return np.asarray({"energy": energies.kinetic + energies.potential, "kinetic energy": energies.kinetic, "potential energy": energies.potential}[name])
    return np.asarray(motion[name])
