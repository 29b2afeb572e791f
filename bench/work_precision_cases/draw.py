"""The charts: one small multiple per problem, log-log, the same colour and mark for a method in all of them;
curves to the lower left are better.
"""

import math
from dataclasses import dataclass

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from work_precision_cases.problems import PROBLEMS

# Okabe and Ito's colours, which the colour-blind can tell apart; marks tell apart what shares a colour.
BLACK, ORANGE, SKY, GREEN, BLUE = "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2"
RED, PURPLE, GREY = "#D55E00", "#CC79A7", "#8A8A8A"
YELLOW_DARK = "#A89B00"  # yellow that shows on white


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
    "rollout, Dopri8": MAIN_LOOKS["Dopri8"],
    "rollout, Taylor": MAIN_LOOKS["Taylor"],
    "heyoka, equations by hand": Look("heyoka, equations by hand", GREEN, "^"),
    "heyoka, the engine's equations": Look("heyoka, our equations", GREEN, "v", "--"),
    "C by hand, Dopri8": MAIN_LOOKS["C by hand, Dopri8"],
    "JAX by hand in blocks of eight, diffrax Dopri8": Look(
        "JAX by hand in blocks of eight, diffrax", PURPLE, "s", ":"
    ),
    "JAX by hand, diffrax Dopri8": MAIN_LOOKS["JAX by hand, diffrax Dopri8"],
}
TIME, ERROR = "time per trajectory (ms)", "error of the final state (m, rad, m/s, rad/s)"


def draw(entries, out):
    """The pictures for which there are records: methods side by side on four problems, and batches."""
    measured = [e for e in entries if "batch" in e]
    batched = [e for e in measured if e["note"].startswith("starts")]
    single = [e for e in measured if e not in batched]
    cells = {PROBLEMS[name].title: [e for e in single if e["problem"] == name] for name in PROBLEMS}
    title = "Error against time, one trajectory at a time on one core, warm (lower left is better)"
    _chart(cells, MAIN_LOOKS, 2, title, ERROR, out / "work_precision")
    sizes, cells = sorted({e["batch"] for e in batched}), {}
    for name in PROBLEMS:
        for size in sizes:
            many = "alone" if size == 1 else f"batch of {size:,}"
            here = [e for e in batched if (e["problem"], e["batch"]) == (name, size)]
            cells[f"{PROBLEMS[name].title}, {many}"] = here
    title, error = "Batches with scattered starts: time per trajectory", "largest error over the lanes"
    how = {"sharex": "row", "sharey": "row"}
    title = f"{title} (lower left is better)"
    _chart(cells, BATCH_LOOKS, len(sizes), title, error, out / "work_precision_batches", **how)


def _chart(cells, looks, columns, title, error, path, **how):
    """One picture of all cells, by title, that have entries; none where there are none."""
    cells = {name: entries for name, entries in cells.items() if entries}
    if not cells:
        return
    rows = math.ceil(len(cells) / columns)
    size = (0.7 + max(4.0 * columns, 6.8), 1.6 + 3.1 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **how)
    drawn = set()
    for ax, entries in zip(axes.flat, cells.values(), strict=False):
        drawn |= _curves(ax, entries, looks)
    for ax in axes.flat[len(cells) :]:
        ax.set_axis_off()
    for ax, name in zip(axes.flat, cells, strict=False):  # when all curves of a row are there
        _finish(ax, name)
    for ax in axes[-1]:
        ax.set_xlabel(error)
    for ax in axes[:, 0]:
        ax.set_ylabel(TIME)
    figure.suptitle(title, fontsize=12)
    shown = [look for method, look in looks.items() if method in drawn]
    handles = [plt.Line2D([], [], label=look.label, **_style(look)) for look in shown]
    figure.legend(handles=handles, loc="outside lower center", ncols=columns + 1, fontsize=8.5, frameon=False)
    for suffix in ("png", "svg"):
        figure.savefig(path.with_suffix(f".{suffix}"), dpi=140)
    plt.close(figure)


def _style(look: Look):
    return {"color": look.colour, "marker": look.mark, "ls": look.line, "lw": look.width, "ms": 5.5}


def _curves(ax, entries, looks):
    """Draw the methods that have points; return which."""
    drawn = set()
    rows = sorted(entries, key=lambda e: -e["setting"])
    for method, look in looks.items():
        shown = [e for e in rows if e["method"] == method and e["seconds"] and e["error"] and e["error"] < 10]
        if shown:
            errors, times = ([e[key] for e in shown] for key in ("error", "seconds"))
            ax.plot(errors, [1e3 * seconds for seconds in times], alpha=0.95, **_style(look))
            drawn.add(method)
    return drawn


def _finish(ax, title):
    ax.set(xscale="log", yscale="log")
    ax.set_title(title, fontsize=10.5)
    low, high = ax.get_ylim()
    whole = math.floor(math.log10(low) + 0.1), math.ceil(math.log10(high) - 0.1)  # decades
    ax.set_ylim(*(10.0**power for power in whole))
    ax.grid(which="major", alpha=0.3, lw=0.6)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(matplotlib.ticker.LogLocator(numticks=7))
        axis.set_minor_locator(matplotlib.ticker.NullLocator())
    ax.spines[["top", "right"]].set_visible(False)
