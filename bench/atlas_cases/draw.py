"""The atlas as one picture: cases down, methods across, colour and mark by outcome; a cell is split where
float64 and float32 differ.
"""

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Patch, Polygon, Rectangle

from atlas_cases.cases import CASES
from atlas_cases.methods import METHODS
from atlas_cases.outcomes import FLAGGED, NAN, NOT_APPLICABLE, RIGHT, STALLED, WRONG

# Okabe and Ito's colours, which the colour-blind can tell apart, a mark for print in grey, and what it means.
LOOKS = {
    RIGHT: ("#009E73", "", "right within the tolerance"),
    FLAGGED: ("#8CCBF0", "f", "f  says that it failed"),
    WRONG: ("#D55E00", "×", "×  wrong, and says nothing"),
    NAN: ("#000000", "N", "N  NaN, and says nothing"),
    STALLED: ("#F0E442", "s", "s  out of steps"),
    NOT_APPLICABLE: ("#F3F3F3", "", "not asked"),
}
SQUARE = np.array([(0.05, 0.05), (0.95, 0.05), (0.95, 0.95), (0.05, 0.95)])
# corners, place and size of the mark: of a whole cell, and of the halves of the two types
WHOLE, HALVES = (SQUARE, 0.5, 6.5), ((SQUARE[[0, 1, 3]], 0.31, 5), (SQUARE[1:], 0.72, 5))
CELL = 0.185  # inches


def draw(cells, out):
    """`atlas.png` and `atlas.svg`."""
    found = {(cell["case"], cell["method"], cell["dtype"]): cell["outcome"] for cell in cells}
    names, _, types = (list(dict.fromkeys(key)) for key in zip(*found, strict=True))
    used = {method for (_, method, _), outcome in found.items() if outcome != NOT_APPLICABLE}
    asked = [method for method in METHODS if method.name in used]
    cases = [case for case in CASES if case.name in names]
    columns = _places([(method.name, method.group) for method in asked], 0.45)
    rows = _places([(case.name, case.name.split()[0]) for case in cases], 0.22)
    width, height = max(columns.values()) + 1.0, max(rows.values()) + 1.0
    size = (max(9.0, CELL * width + 5.6), CELL * height + 2.9)
    figure, ax = plt.subplots(figsize=size, layout="constrained")
    ax.set(xlim=(-0.1, width + 0.1), ylim=(height + 0.1, -0.1))
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0, labelsize=7.5)
    ax.set_xticks([x + 0.5 for x in columns.values()], columns, rotation=90)
    labels = [case.title + " (no answer: f is right)" * case.flag_is_right for case in cases]
    numbers = [f"   $\\bf{{{case.name.split()[0]}}}$" for case in cases]
    ax.set_yticks([y + 0.5 for y in rows.values()], [*map(str.__add__, labels, numbers)])
    for (case, method, dtype), outcome in found.items():
        if method in columns:
            split = len({found[case, method, other] for other in types}) > 1
            corners, middle, size = HALVES[types.index(dtype)] if split else WHOLE
            place, (colour, mark, _) = np.array([columns[method], rows[case]]), LOOKS[outcome]
            ax.add_patch(Polygon(place + corners, facecolor=colour, lw=0))
            on_dark = {"color": "white"} if outcome in (WRONG, NAN) else {}
            ax.text(*(place + middle), mark, ha="center", va="center", fontsize=size, **on_dark)
    for group in dict.fromkeys(method.group for method in asked):
        middle = np.mean([columns[method.name] for method in asked if method.group == group]) + 0.5
        ax.text(middle, -0.45, group, ha="center", va="bottom", fontsize=8, style="italic")
    if "default" in columns:
        ax.add_patch(Rectangle((columns["default"], 0), 1, height, fill=False, lw=1.6, clip_on=False))
    figure.suptitle("Where methods fail: hard cases of constrained dynamics", fontsize=12)
    how = "Framed: the engine with nothing chosen. A cell is split where precisions differ:"
    ax.set_title(f"{how} {types[0]} upper left, {types[-1]} lower right.", fontsize=8.5, pad=20)
    handles = [Patch(fc=colour, ec="#BBBBBB", lw=0.5, label=words) for colour, _, words in LOOKS.values()]
    ncols = 3 if width < 30 else len(LOOKS)
    figure.legend(handles=handles, loc="outside lower center", ncols=ncols, fontsize=8, frameon=False)
    for suffix in ("png", "svg"):
        figure.savefig(out / f"atlas.{suffix}", dpi=150)
    plt.close(figure)


def _places(names, gap):
    """Where each name begins, one apart, and `gap` more from one group to the next."""
    breaks = [k > 0 and group != names[k - 1][1] for k, (_, group) in enumerate(names)]
    return {name: k + gap * sum(breaks[: k + 1]) for k, (name, _) in enumerate(names)}
