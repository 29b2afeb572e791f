"""The charts: one small multiple per problem, log-log, the same colour and mark for a method in all of them;
curves to the lower left are better.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from work_precision_cases.problems import PROBLEMS

# Okabe and Ito's colours, which the colour-blind can tell apart; marks tell apart what shares a colour.
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PURPLE, GREY = (
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#F0E442",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
    "#8A8A8A",
)
YELLOW_DARK = "#A89B00"  # yellow that shows on white
MAIN = ("tilting-disc", "chaplygin-sleigh", "rattleback", "whipple-bicycle")


@dataclass(frozen=True)
class Look:
    """How a method is drawn."""

    label: str
    colour: str
    mark: str
    line: str = "-"
    width: float = 1.3


# What stands in the main chart, in the order of the legend.
MAIN_LOOKS = {
    "Dopri8": Look("jourdain-jax, Dopri8", BLUE, "o", width=2.4),
    "Tsit5": Look("jourdain-jax, Tsit5", BLUE, "s", "--", 2.0),
    "Taylor": Look("jourdain-jax, Taylor series", SKY, "D", "-", 2.0),
    "minimal state, not projected, Dopri8": Look("jourdain-jax, Dopri8, not projected", SKY, "o", ":", 1.8),
    "simulate, as it comes": Look("jourdain-jax, called from Python", GREY, "D", ":"),
    "heyoka, the engine's equations": Look("heyoka, our equations", GREEN, "^"),
    "C by hand, Dopri8": Look("C by hand, Dopri8", YELLOW_DARK, "d"),
    "SymPy to C, SciPy ode DOP853": Look("SymPy to C, SciPy DOP853", ORANGE, "v"),
    "SymPy to C, SciPy ode LSODA": Look("SymPy to C, SciPy LSODA", ORANGE, "<", "--"),
    "JAX by hand, diffrax Dopri8": Look("JAX by hand, diffrax", PURPLE, "P", "--"),
    "Exudyn, joint, generalized-alpha": Look("Exudyn, rolling joint", RED, "X"),
    "Exudyn, penalty, generalized-alpha": Look("Exudyn, penalty", RED, "x", "--"),
    "MuJoCo, implicitfast": Look("MuJoCo, implicitfast", BLACK, "h"),
    "MuJoCo, RK4": Look("MuJoCo, RK4", BLACK, "*", "--"),
    "MJX, Euler": Look("MJX", BLACK, "H", ":"),
}
BATCH_LOOKS = {
    "rollout, Dopri8": Look("jourdain-jax, Dopri8", BLUE, "o", width=2.4),
    "rollout, Taylor": Look("jourdain-jax, Taylor series", SKY, "D", width=2.0),
    "heyoka, equations by hand": Look("heyoka, equations by hand", GREEN, "^"),
    "heyoka, the engine's equations": Look("heyoka, our equations", GREEN, "v", "--"),
    "C by hand, Dopri8": Look("C by hand, Dopri8", YELLOW_DARK, "d"),
    "JAX by hand in blocks of eight, diffrax Dopri8": Look(
        "JAX by hand in blocks of eight, diffrax", PURPLE, "s", ":"
    ),
    "JAX by hand, diffrax Dopri8": Look("JAX by hand, diffrax", PURPLE, "P", "--"),
}
_TIME, _ERROR = "time per trajectory (ms)", "error of the final state (m, rad, m/s, rad/s)"


def draw(entries: list[dict], out: Path) -> None:
    """The pictures for which there are records: methods side by side on four problems, and batches."""
    measured = [e for e in entries if "batch" in e]
    single, batched = (
        [e for e in measured if e["note"].startswith("starts") is of_batches] for of_batches in (False, True)
    )
    if problems := [name for name in MAIN if any(e["problem"] == name for e in single)]:
        _chart(single, problems, out / "work_precision")
    if batched:
        _batches(batched, out / "work_precision_batches")


def _curves(ax, entries: list[dict], looks: dict[str, Look]) -> set[str]:
    """Draw the methods that have points; return which."""
    drawn = set()
    for method, look in looks.items():
        rows = sorted(
            (e for e in entries if e["method"] == method and e["seconds"]), key=lambda e: -e["setting"]
        )
        points = [(e["error"], 1e3 * e["seconds"]) for e in rows if e["error"] and e["error"] < 10]
        if points:
            ax.plot(
                *zip(*points, strict=True),
                color=look.colour,
                marker=look.mark,
                ls=look.line,
                lw=look.width,
                ms=5.5,
                mfc=look.colour,
                alpha=0.95,
            )
            drawn.add(method)
    return drawn


def _chart(entries: list[dict], problems: list[str], path: Path) -> None:
    columns = min(len(problems), 2)
    rows, drawn = math.ceil(len(problems) / columns), set()
    figure, axes = plt.subplots(
        rows, columns, figsize=(0.7 + max(4.1 * columns, 6.8), 1.6 + 3.1 * rows), squeeze=False
    )
    for ax in axes.flat[len(problems) :]:
        ax.set_axis_off()
    for k, (ax, name) in enumerate(zip(axes.flat, problems, strict=False)):
        drawn |= _curves(ax, [e for e in entries if e["problem"] == name], MAIN_LOOKS)
        _finish(
            ax,
            PROBLEMS[name].title,
            _ERROR if k + columns >= len(problems) else "",
            _TIME if k % columns == 0 else "",
        )
    title = "Error against time, one trajectory at a time on one core, warm (lower left is better)"
    _legend(figure, [look for method, look in MAIN_LOOKS.items() if method in drawn], title, path, columns)


def _finish(ax, title: str, xlabel: str, ylabel: str) -> None:
    ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    ax.set_title(title, fontsize=10.5)
    low, high = ax.get_ylim()
    ax.set_ylim(
        10.0 ** math.floor(math.log10(low) + 0.1), 10.0 ** math.ceil(math.log10(high) - 0.1)
    )  # whole decades
    ax.grid(which="major", alpha=0.3, lw=0.6)
    ax.xaxis.set_major_locator(matplotlib.ticker.LogLocator(numticks=7))
    ax.yaxis.set_major_locator(matplotlib.ticker.LogLocator(numticks=7))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(matplotlib.ticker.NullLocator())
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def _legend(figure, looks: list[Look], title: str, path: Path, columns: int) -> None:
    handles = [
        plt.Line2D([], [], color=x.colour, marker=x.mark, ls=x.line, lw=x.width, ms=5.5) for x in looks
    ]
    each = min(len(looks), {1: 2, 2: 3, 3: 4}.get(columns, 6))
    lines = math.ceil(len(looks) / each)
    height = figure.get_figheight()
    figure.suptitle(title, fontsize=12)
    figure.legend(
        handles, [x.label for x in looks], loc="lower center", ncols=each, fontsize=8.5, frameon=False
    )
    figure.tight_layout(rect=(0, (0.12 + 0.2 * lines) / height, 1, 1 - 0.02 / height))
    for suffix in ("png", "svg"):
        figure.savefig(path.with_suffix(f".{suffix}"), dpi=140)
    plt.close(figure)


def _batches(entries: list[dict], path: Path) -> None:
    """Columns: batch sizes; rows: problems."""
    problems, sizes = (
        [name for name in PROBLEMS if any(e["problem"] == name for e in entries)],
        sorted({e["batch"] for e in entries}),
    )
    shape, drawn = (len(problems), len(sizes)), set()
    figure, axes = plt.subplots(
        *shape,
        figsize=(0.7 + 3.7 * shape[1], 1.4 + 3.0 * shape[0]),
        squeeze=False,
        sharex="row",
        sharey="row",
    )
    cells = [
        (ax, name, size)
        for name, row in zip(problems, axes, strict=True)
        for size, ax in zip(sizes, row, strict=True)
    ]
    for ax, name, size in cells:
        drawn |= _curves(ax, [e for e in entries if (e["problem"], e["batch"]) == (name, size)], BATCH_LOOKS)
    for ax, name, size in cells:  # when all curves of a row are there, which share its axes
        many = "alone" if size == 1 else f"batch of {size:,}"
        below = "largest error over the lanes" if name == problems[-1] else ""
        _finish(ax, f"{PROBLEMS[name].title}, {many}", below, _TIME if size == sizes[0] else "")
    looks = [look for method, look in BATCH_LOOKS.items() if method in drawn]
    _legend(
        figure,
        looks,
        "Batches with scattered starts: time per trajectory (lower left is better)",
        path,
        len(sizes),
    )
