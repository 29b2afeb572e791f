"""Families of steady motions: named values against one another, stable parts in full, others dashed, special points marked."""

import os

import numpy as np

from jourdain_jax.analysis.families.family import Family
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.plotting.units import checked_units


def plot_family(family: Family, names: tuple[str, ...], units, title: str | None, path: str | os.PathLike | None, axes):
    """Draw every further name against the first one, one panel each; arguments and results as of `quantities.plot`."""
    if len(names) < 2:
        raise ValueError(f"`plot` of a family takes the name along the horizontal axis and those against it, and {len(names)} were given")
    known = family.equations.scene
    kinds = {"coordinate": known.coordinate_names.entries, "speed": known.speed_names.entries}
    sizes = checked_units(units, kinds)
    across, *upward = [(name, family[name] / sizes.get(name, ("", 1.0))[1]) for name in names]
    plt = pyplot()
    if axes is None:
        axes = plt.subplots(len(upward), 1, sharex=True, figsize=(7.0, 1.2 + 2.4 * len(upward)), squeeze=False, layout="constrained")[1][:, 0]
    axes = np.atleast_1d(axes)
    if len(axes) != len(upward):
        raise ValueError(f"`axes` holds {len(axes)} axes, expected one for each of {', '.join(name for name, _ in upward)}")
    label = {name: f"{name} in {sizes[name][0]}" if name in sizes else name for name in names}
    marks = {"fold": ("d", family.folds), "branch point": ("s", family.branches), "eigenvalues meet or cross": (".", family.changes)}
    for axis, (name, y) in zip(axes, upward, strict=True):
        axis.plot(across[1], y, "C0--", lw=1.0, label=None if family.stable.all() else "unstable")
        axis.plot(across[1], np.where(family.stable, y, np.nan), "C0-", lw=2.0, label="stable" if family.stable.any() else None)
        for kind, (mark, points) in marks.items():
            xy = [[point[k] / sizes.get(k, ("", 1.0))[1] for point in points] for k in (across[0], name)]
            axis.plot(*xy, f"k{mark}", label=kind if points else None, ms=6, mfc="white" if mark == "d" else "black")
        axis.set_ylabel(label[name])
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel(label[across[0]])
    axes[0].legend(fontsize="x-small", loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    axes[0].set_title(title or f"steady motions of {type(known).__name__}", pad=30)
    figure = axes[0].figure
    if path is not None:
        figure.savefig(path, dpi=150)
        plt.close(figure)
    return figure, axes
