"""Plots of named quantities over time, quantile bands of rollouts, and families against a parameter."""

import os
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jourdain_jax.analysis.families.family import Family
from jourdain_jax.calculus.figures import pyplot
from jourdain_jax.calculus.files import FilePath, check_place
from jourdain_jax.calculus.reals import check_kind, described
from jourdain_jax.equations.kinematics import partial_velocities
from jourdain_jax.integrate import result_codes
from jourdain_jax.motion.rollout import Rollout
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.coordinates import Labels, UnknownNameError, check_name

ENERGIES = ("energy", "kinetic energy", "potential energy")
UNITS = {  # size in SI units, by kind of quantity
    "time": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    "coordinate": {
        "m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3,
        "rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "turn": 2 * np.pi,
    },
    "speed": {
        "m/s": 1.0, "km/h": 1 / 3.6, "cm/s": 1e-2, "mm/s": 1e-3,
        "rad/s": 1.0, "deg/s": np.pi / 180, "turn/s": 2 * np.pi, "rpm": np.pi / 30,
    },
    "energy": {"J": 1.0, "kJ": 1e3, "mJ": 1e-3},
}  # fmt: skip

GREEK = (
    "alpha beta gamma delta epsilon zeta eta theta kappa lambda mu nu xi pi rho sigma tau phi chi psi omega"
)


def check_format(path: FilePath) -> None:
    """Raise ValueError if matplotlib cannot write a picture to this path."""
    known = pyplot().FigureCanvasBase.get_supported_filetypes()
    check_place(path)
    suffix = os.path.splitext(os.fspath(path))[1].removeprefix(".").lower()
    if suffix not in known:
        raise ValueError(
            f"cannot write `{path}`: a plot is a .png, .svg or .pdf file; matplotlib cannot "
            f"write `{suffix or 'file without suffix'}`"
        )


@of_known_numbers
def plot(
    motion: "Trajectory | Rollout | Family | Sequence[Trajectory | Rollout]",
    *names: str,
    units: "Mapping[str, str] | None" = None,
    labels: "Sequence[str] | None" = None,
    bands: Sequence[float] = (0.5, 0.95),
    title: str | None = None,
    path: FilePath | None = None,
    axes: Any = None,
) -> tuple[Any, Any]:
    """Plot named quantities of a `motion` over time, one panel each.

    - `motion`: a motion or rollout, or a list of several, each in its own colour; `labels`: their names in
      the legend.
    - `names`: coordinates, speeds, `"kinetic energy"`, `"potential energy"` or their sum `"energy"` (default:
      all coordinates of the first motion). A rollout has only coordinates and speeds. It is drawn as the
      median of the samples still running, with a band for each fraction in `bands`.
    - `units`: name -> unit, such as `{"lean": "deg", "spin_rate": "rpm", "t": "ms"}` (default: m, rad and
      their rates, where a body moves by 1 m or turns by 1 rad per unit; otherwise none).
      Coordinates: m, km, cm, mm, rad, mrad, deg, turn; speeds: m/s, km/h, cm/s, mm/s, rad/s, deg/s, turn/s,
      rpm; energies: J, kJ, mJ; `"t"`: s, ms, min, h.
    - A family (`jj.family`) is drawn against one of its quantities, named first:
      `jj.plot(turns, "x_rate", "lean")`. Stable parts are solid lines; special points are marked.
    - `title`: for a rollout, by default the number of samples that stopped or failed. `path`: file to write
      (.png, .svg, .pdf); `axes`: existing axes, one per name.
    - For one column of a journal or two: `with plt.style.context("jourdain_jax.views.column")`, or
      `.two_columns`. The width of a figure and the height of a panel are those of matplotlib's style.

    Returns the matplotlib figure and an array of its axes, shape (names,). Raises KeyError for an unknown
    name, ValueError for an unknown unit, bands outside 0 to 1 or an invalid motion, and ImportError without
    matplotlib.

    **Examples**

        disc, starts = jj.models.TiltingDisc(), [{"lean": 0.3, "spin_rate": spin} for spin in (-3.0, -4.0)]
        motions = [jj.simulate(disc, start, t1=3.0) for start in starts]
        figure, axes = jj.plot(motions, "lean", units={"lean": "deg"}, labels=["slow", "fast"])
    """
    if path is not None:
        check_format(path)
    if isinstance(motion, Family):
        figure, axes = _plot_family(motion, names, units, title, axes)
    else:
        motions = _checked_motions(motion)
        figure, axes = _plot_motions(
            motions, names, units, _checked_labels(labels, len(motions)), _checked_bands(bands), title, axes
        )
    if path is not None:
        figure.savefig(path, dpi=150)
        pyplot().close(figure)
    return figure, axes


def _plot_motions(
    motions: list, names: Labels, units, labels: list[str], bands: list[float], title: str | None, axes
):
    scenes = [_scene(one) for one in motions]
    names = names or scenes[0].coordinate_names.entries
    values = [[_values(one, name, bands) for name in names] for one in motions]
    one = motions[0].lane(0) if isinstance(motions[0], Rollout) else motions[0]
    sizes = _usual_units(one.scene, np.asarray(one.q)[0]) | _checked_units(units, scenes)
    own = axes is None
    axes = _panels(axes, names, 0.3)
    for k, (axis, name) in enumerate(zip(axes, names, strict=True)):
        unit, size = sizes[name]
        for j, (one, label) in enumerate(zip(motions, labels, strict=True)):
            _draw(axis, one, values[j][k] / size, sizes["t"][1], bands, f"C{j}", label)
        axis.set_ylabel(_label(name, unit))
    axes[-1].set_xlabel(_label("t", sizes["t"][0]))
    if title is None and len(motions) == 1 and isinstance(motions[0], Rollout):
        stopped = int(np.sum(motions[0].result == result_codes.EVENT))
        title = f"{len(motions[0])} samples; {stopped} stopped at an event, {motions[0].failed.size} failed"
    if title:
        axes[0].set_title(title, fontsize="medium", loc="left")
    handles, texts = axes[0].get_legend_handles_labels()
    # legend above all panels of a new figure: one column per motion, or per entry for a single motion
    if texts:
        row: dict[str, Any] = {
            "loc": "outside upper left",
            "ncols": min(len(motions) if len(motions) > 1 else len(texts), 4),
        }
        (axes[0].figure if own else axes[0]).legend(handles, texts, fontsize="small", **(row if own else {}))
    return axes[0].figure, axes


def _plot_family(family: Family, names: Labels, units, title: str | None, axes):
    """Draw all other names against the first. Stable parts are solid, others dashed; special points are
    marked.
    """
    if len(names) < 2:
        raise ValueError(
            "`plot` of a family needs a name for the horizontal axis and at least one for the "
            f"vertical axis, got {len(names)} names"
        )
    scene = family.equations.scene
    sizes = _usual_units(scene, np.asarray([family[name][0] for name in scene.coordinate_names.entries]))
    sizes = dict.fromkeys(names, ("", 1.0)) | sizes | _checked_units(units, [scene])
    label = {name: _label(name, unit) for name, (unit, _) in sizes.items()}
    axes = _panels(axes, names[1:], 0.5)
    marks = {
        "fold": ("d", family.folds),
        "branch point": ("s", family.branches),
        "eigenvalues meet or cross": (".", family.changes),
    }
    x = family[names[0]] / sizes[names[0]][1]
    for axis, name in zip(axes, names[1:], strict=True):
        y = family[name] / sizes[name][1]
        axis.plot(x, y, "C0--", lw=1.0, label=None if family.stable.all() else "unstable")
        stable = np.where(family.stable, y, np.nan)
        axis.plot(x, stable, "C0-", lw=2.0, label="stable" if family.stable.any() else None)
        for kind, (mark, points) in marks.items():
            xy = [[point[k] / sizes[k][1] for point in points] for k in (names[0], name)]
            axis.plot(
                *xy, f"k{mark}", label=kind if points else None, ms=6, mfc="white" if mark == "d" else "black"
            )
        axis.set_ylabel(label[name])
    axes[-1].set_xlabel(label[names[0]])
    axes[0].legend(fontsize="x-small", loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    axes[0].set_title(title or f"{family.equations.what} of {type(scene).__name__}", pad=30)
    return axes[0].figure, axes


def _panels(axes, names: Sequence[str], height: float) -> np.ndarray:
    """Return axes for each name: the user's, or one panel per name in a column, with letters. `height`: of a
    panel, relative to a figure of matplotlib's style.
    """
    if axes is None:
        plt = pyplot()
        wide, high = plt.rcParams["figure.figsize"]
        size = wide, high * (0.25 + height * len(names))
        axes = plt.subplots(len(names), 1, sharex=True, figsize=size, squeeze=False, layout="constrained")[1]
        axes = axes[:, 0]
        for k, axis in enumerate(axes if len(names) > 1 else ()):
            axis.set_title(f"({chr(ord('a') + k)})", loc="right", fontsize="small")
    axes = np.atleast_1d(axes)
    if len(axes) != len(names):
        raise ValueError(
            f"`axes` holds {len(axes)} axes for {len(names)} names; pass one for each of {', '.join(names)}"
        )
    for axis in axes:
        axis.grid(alpha=0.3)
    return axes


def _label(name: str, unit: str) -> str:
    """Return the label of an axis; single and Greek letters are set as symbols, with a dot for `_rate`."""
    parts = re.fullmatch(rf"({GREEK.replace(' ', '|')}|[a-zA-Z])_?(\d*)(_rate)?", name)
    if parts:
        letter, number, rate = parts.groups()
        letter = "\\" * (len(letter) > 1) + letter
        letter = rf"\dot{{{letter}}}" if rate else letter
        name = f"${letter}_{{{number}}}$" if number else f"${letter}$"
    return f"{name} in {unit}" if unit else name


def _usual_units(scene, q: np.ndarray) -> dict[str, tuple[str, float]]:
    """Return name -> (unit, 1.0) of energies, and of coordinates and speeds as far as the motion of bodies
    shows them.

    A speed is in m/s if it moves a body by 1 m/s in a fixed direction, and in rad/s if it turns one by
    1 rad/s; if it does both, or neither, its unit stays open. A coordinate is known by its own rate.
    """
    names, units = scene.speed_names.entries, dict.fromkeys(ENERGIES, "J")
    near, far = (partial_velocities(scene, 0.0, x, np.zeros(len(names))) for x in (q, q + 0.1))
    for k, name in enumerate(names):
        moves = np.isclose(np.linalg.norm(near.linear[:, :, k], axis=1), 1.0)
        fixed = np.isclose(near.linear[:, :, k], far.linear[:, :, k]).all(axis=1)
        turns = np.isclose(np.linalg.norm(near.angular[:, :, k], axis=1), 1.0).any()
        if (moves & fixed).any() != turns:
            unit = "rad" if turns else "m"
            units |= {name.removesuffix("_rate"): unit, name: f"{unit}/s"}
    valid = (*ENERGIES, *scene.coordinate_names.entries, *names)
    return {name: (units.get(name, ""), 1.0) for name in valid}


def _checked_units(units, scenes: Sequence) -> dict[str, tuple[str, float]]:
    """Return name -> (unit, size in SI). Raises KeyError for an unknown name, ValueError for an unknown or
    unsuitable unit.
    """
    check_kind(units, Mapping | None, "`units`", 'a dictionary from names to units, such as {"lean": "deg"}')
    kinds = {
        name: kind
        for scene in scenes
        for kind, of in (("coordinate", scene.coordinate_names), ("speed", scene.speed_names))
        for name in of.entries
    }
    kinds |= dict.fromkeys(ENERGIES, "energy") | {"t": "time"}
    found = {"t": ("s", 1.0)}
    for name, unit in (units or {}).items():
        check_name(name, kinds, f"`units` names `{name}`, which cannot be plotted", UnknownNameError)
        known = UNITS[kinds[name]]
        check_name(unit, known, f"`{unit}` is not a known unit of the {kinds[name]} `{name}`")
        found[name] = unit, known[unit]
    return found


def _checked_motions(given) -> list[Trajectory | Rollout]:
    several = isinstance(given, list | tuple)
    motions = list(given) if several else [given]
    for k, one in enumerate(motions):
        if not isinstance(one, Rollout | Trajectory):
            where = f" in place {k}" if several else ""
            raise ValueError(
                f"`plot` was given {described(one)}{where}, expected a motion from `jj.simulate` or a rollout"
            )
    if not motions:
        raise ValueError("`plot` was given an empty list, expected motions from `jj.simulate` or rollouts")
    return motions


def _checked_labels(labels, count: int) -> list[str]:
    if labels is None:
        return [""] if count == 1 else [f"motion {k}" for k in range(count)]
    if isinstance(labels, str) or len(labels) != count:
        raise ValueError(f"`labels` is {labels!r}, expected a list of {count} labels, one per motion")
    return [str(label) for label in labels]


def _checked_bands(bands) -> list[float]:
    try:
        parts = sorted({float(part) for part in bands})
    except (TypeError, ValueError):
        parts = [np.nan]
    if not all(0 < part < 1 for part in parts):
        raise ValueError(f"`bands` is {bands!r}, expected fractions between 0 and 1, such as (0.5, 0.95)")
    return parts


def _scene(motion: Trajectory | Rollout):
    return motion.lanes.scene if isinstance(motion, Rollout) else motion.scene


def _draw(
    axis, motion, y: np.ndarray, second: float, bands: Sequence[float], colour: str, label: str
) -> None:
    """Draw a line, or the median and bands of a rollout, widest and palest first. `y`: result of
    `_values`.
    """
    many = isinstance(motion, Rollout)
    ts = np.asarray(motion.lanes.ts[0] if many else motion.ts) / second
    if many:
        named = f"{label}, " if label else ""
        for k, part in reversed(list(enumerate(bands))):
            band = f"{named}{100 * part:.3g} % of samples"
            axis.fill_between(
                ts, y[2 * k], y[2 * k + 1], color=colour, alpha=0.2 if k else 0.4, lw=0, label=band
            )
        y, label = y[-1], f"{named}median"
    axis.plot(ts, y, color=colour, lw=1.5, label=label)


def _values(motion: Trajectory | Rollout, name: str, bands: Sequence[float]) -> np.ndarray:
    """Return values at all times; for a rollout the lower and upper end of each band, then the median."""
    many, scene = isinstance(motion, Rollout), _scene(motion)
    valid = (*scene.coordinate_names, *scene.speed_names, *(() if many else ENERGIES))
    check_name(name, valid, f"`{name}` cannot be plotted", UnknownNameError)
    if isinstance(motion, Rollout):
        return motion.quantiles(
            name, [level for part in bands for level in ((1 - part) / 2, (1 + part) / 2)] + [0.5]
        )
    if name in ENERGIES:
        energies = motion.energies()
        if name == "energy":
            return np.asarray(energies.kinetic + energies.potential)
        return np.asarray(energies.kinetic if name == "kinetic energy" else energies.potential)
    return np.asarray(motion[name])
