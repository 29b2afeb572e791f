"""The charts: one small multiple per problem, log-log, the same colour and mark for a method in all of them; curves to the lower left are better."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

# Okabe and Ito's colours, which the colour-blind can tell apart; marks tell apart what shares a colour.
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PURPLE, GREY = "#000000", "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7", "#8A8A8A"
YELLOW_DARK = "#A89B00"  # yellow that shows on white
TITLES = {
    "tilting-disc": "Tilting disc, 10 s",
    "chaplygin-sleigh": "Chaplygin sleigh, 12 s",
    "rattleback": "Rattleback, 20 s",
    "whipple-bicycle": "Whipple bicycle, 5 s",
    "two-wheel-axle": "Two-wheel axle, 10 s",
    "ball-on-turntable": "Ball on a tilted turntable, 10 s",
    "snakeboard": "Snakeboard through 90°, 5.1 s",
    "trailer-chain": "16 trailers, 5 s",
}
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
    "dense autodiff, diffrax Dopri8": Look("dense autodiff, diffrax", PURPLE, "p"),
    "Exudyn, joint, generalized-alpha": Look("Exudyn, rolling joint", RED, "X"),
    "Exudyn, penalty, generalized-alpha": Look("Exudyn, penalty", RED, "x", "--"),
    "MuJoCo, implicitfast": Look("MuJoCo, implicitfast", BLACK, "h"),
    "MuJoCo, RK4": Look("MuJoCo, RK4", BLACK, "*", "--"),
    "MJX, Euler": Look("MJX", BLACK, "H", ":"),
}
OWN_LOOKS = {
    "Dopri8": Look("Dopri8 (lowered)", BLUE, "o", width=2.4),
    "Tsit5": Look("Tsit5 (lowered)", BLUE, "s", "--", 2.0),
    "Kvaerno5": Look("Kvaerno5", GREEN, "^"),
    "implicit midpoint": Look("implicit midpoint", BLACK, "d"),
    "discrete Lagrange-d'Alembert": Look("discrete Lagrange-d'Alembert", BLACK, "P", "--"),
    "discrete gradient": Look("discrete gradient", BLACK, "X", ":"),
    "minimal state, not projected, Dopri8": Look("Dopri8 (lowered), not projected", SKY, "o", ":"),
    "full state, projected, Dopri8": Look("full state, projected", ORANGE, "s"),
    "full state, not projected, Dopri8": Look("full state, not projected", ORANGE, "x", ":"),
    "privileged reduction, Dopri8": Look("privileged reduction, dense", RED, "o"),
    "qr reduction, Dopri8": Look("QR null space", RED, "<", "--"),
    "svd reduction, Dopri8": Look("SVD null space", RED, ">", ":"),
    "kkt reduction, Dopri8": Look("KKT multipliers", PURPLE, "o"),
    "udwadia-kalaba reduction, Dopri8": Look("Udwadia-Kalaba", PURPLE, "<", "--"),
    "gibbs-appell reduction, Dopri8": Look("Gibbs-Appell", PURPLE, ">", ":"),
}
BATCH_LOOKS = {
    "rollout, Dopri8": Look("jourdain-jax, Dopri8", BLUE, "o", width=2.4),
    "rollout, Taylor": Look("jourdain-jax, Taylor series", SKY, "D", width=2.0),
    "heyoka, equations by hand": Look("heyoka, equations by hand", GREEN, "^"),
    "heyoka, the engine's equations": Look("heyoka, our equations", GREEN, "v", "--"),
    "C by hand, Dopri8": Look("C by hand, Dopri8", YELLOW_DARK, "d"),
    "JAX by hand in blocks of eight, diffrax Dopri8": Look("JAX by hand in blocks of eight, diffrax", PURPLE, "s", ":"),
    "JAX by hand, diffrax Dopri8": Look("JAX by hand, diffrax", PURPLE, "P", "--"),
    "dense autodiff, diffrax Dopri8": Look("dense autodiff, diffrax", PURPLE, "p"),
}
_TIME = "time per trajectory (ms)"
_EVALUATIONS = "evaluations of the right-hand side"
_ERROR = "error of the final state (m, rad, m/s, rad/s)"


def draw(entries: list[dict], out: Path) -> None:
    """All pictures for which there are records."""
    single = [
        e for e in entries if e.get("batch") == 1 and e["kind"] in ("ours", "peer") and "rollout" not in e["method"] and not e["note"].startswith("starts")
    ]
    problems = [name for name in TITLES if any(e["problem"] == name for e in single)]
    main = [name for name in MAIN if name in problems]
    if main:
        title = "Error against time, one trajectory at a time on one core, warm (lower left is better)"
        _chart(single, main, MAIN_LOOKS, _time, _TIME, title, out / "work_precision", columns=2)
        _chart(single, problems, MAIN_LOOKS, _time, _TIME, title, out / "work_precision_all")
        evaluations = "Error against evaluations of the right-hand side (not counted: implicit methods, heyoka)"
        _chart(single, problems, MAIN_LOOKS, lambda e: e["rhs_evaluations"], _EVALUATIONS, evaluations, out / "work_precision_evaluations")
        own = "Methods of this engine, by Dopri8 and dense matrices where nothing else is stated (lower left is better)"
        _chart(single, problems, OWN_LOOKS, _time, _TIME, own, out / "work_precision_methods")
    batched = [e for e in entries if "batch" in e and e["note"].startswith("starts")]
    if batched:
        _batches(batched, out / "work_precision_batches")


def _time(entry: dict) -> float:
    return 1e3 * entry["seconds"]


def _grid(count: int, columns: int | None):
    columns = min(count, columns or (2 if count <= 4 else 4))
    rows = math.ceil(count / columns)
    figure, axes = plt.subplots(rows, columns, figsize=(0.7 + max(4.1 * columns, 6.8), 1.6 + 3.1 * rows), squeeze=False)
    for ax in axes.flat[count:]:
        ax.set_axis_off()
    return figure, axes, rows, columns


def _curve(ax, rows: list[dict], look: Look, cost: Callable[[dict], float | None]) -> bool:
    rows = sorted((e for e in rows if e["error"] and cost(e)), key=lambda e: -e["setting"])
    points = [(e["error"], cost(e)) for e in rows if e["error"] < 10]
    if not points:
        return False
    x, y = zip(*points, strict=True)
    ax.plot(x, y, color=look.colour, marker=look.mark, ls=look.line, lw=look.width, ms=5.5, mew=1.0, mfc=look.colour, alpha=0.95)
    return True


def _chart(entries, problems, looks: dict[str, Look], cost, ylabel: str, title: str, path: Path, xlabel: str = _ERROR, columns: int | None = None) -> None:
    figure, axes, rows, columns = _grid(len(problems), columns)
    drawn: dict[str, Look] = {}
    for k, (ax, name) in enumerate(zip(axes.flat, problems, strict=False)):
        for method, look in looks.items():
            if _curve(ax, [e for e in entries if e["problem"] == name and e["method"] == method], look, cost):
                drawn[method] = look
        _finish(ax, TITLES[name], xlabel if k + columns >= len(problems) else "", ylabel if k % columns == 0 else "")
    _legend(figure, [look for method, look in looks.items() if method in drawn], title, path, rows, columns)


def _finish(ax, title: str, xlabel: str, ylabel: str) -> None:
    ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    ax.set_title(title, fontsize=10.5)
    low, high = ax.get_ylim()
    ax.set_ylim(10.0 ** math.floor(math.log10(low) + 0.1), 10.0 ** math.ceil(math.log10(high) - 0.1))  # whole decades
    ax.grid(which="major", alpha=0.3, lw=0.6)
    ax.xaxis.set_major_locator(matplotlib.ticker.LogLocator(numticks=7))
    ax.yaxis.set_major_locator(matplotlib.ticker.LogLocator(numticks=7))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(matplotlib.ticker.NullLocator())
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def _legend(figure, looks: list[Look], title: str, path: Path, rows: int, columns: int) -> None:
    handles = [plt.Line2D([], [], color=x.colour, marker=x.mark, ls=x.line, lw=x.width, ms=5.5) for x in looks]
    each = min(len(looks), {1: 2, 2: 3, 3: 4}.get(columns, 6))
    lines = math.ceil(len(looks) / each)
    height = figure.get_figheight()
    figure.suptitle(title, fontsize=12)
    figure.legend(handles, [x.label for x in looks], loc="lower center", ncols=each, fontsize=8.5, frameon=False)
    figure.tight_layout(rect=(0, (0.12 + 0.2 * lines) / height, 1, 1 - 0.02 / height))
    for suffix in ("png", "svg"):
        figure.savefig(path.with_suffix(f".{suffix}"), dpi=140)
    plt.close(figure)


def _batches(entries: list[dict], path: Path) -> None:
    """Columns: batch sizes; rows: problems."""
    problems = [name for name in TITLES if any(e["problem"] == name for e in entries)]
    sizes = sorted({e["batch"] for e in entries})
    figure, axes = plt.subplots(
        len(problems), len(sizes), figsize=(0.7 + 3.7 * len(sizes), 1.4 + 3.0 * len(problems)), squeeze=False, sharex="row", sharey="row"
    )
    drawn: dict[str, Look] = {}
    for k, name in enumerate(problems):
        for column, size in enumerate(sizes):
            ax = axes[k, column]
            for method, look in BATCH_LOOKS.items():
                if _curve(ax, [e for e in entries if e["problem"] == name and e["batch"] == size and e["method"] == method], look, _time):
                    drawn[method] = look
        for column, size in enumerate(sizes):  # when all curves of a row are there, which share its axes
            ax, many = axes[k, column], "alone" if size == 1 else f"batch of {size:,}"
            _finish(ax, f"{TITLES[name]}, {many}", "largest error over the lanes" if k + 1 == len(problems) else "", "" if column else _TIME)
    looks = [look for method, look in BATCH_LOOKS.items() if method in drawn]
    _legend(figure, looks, "Batches with scattered starts: time per trajectory (lower left is better)", path, len(problems), len(sizes))
