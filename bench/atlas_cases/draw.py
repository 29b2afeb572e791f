"""The atlas as one picture: cases down, methods across, colour and mark by outcome; a cell is split where
float64 and float32 differ.
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Polygon, Rectangle

from atlas_cases.case import Case
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
CELL, LEFT, RIGHT_MARGIN, TOP, BOTTOM = 0.185, 4.3, 0.4, 0.95, 1.75  # inches
SQUARE = ((0.05, 0.05), (0.95, 0.05), (0.95, 0.95), (0.05, 0.95))
HALVES = (SQUARE[0], SQUARE[1], SQUARE[3]), SQUARE[1:]


def draw(cells: list[dict], out: Path) -> None:
    """`atlas.png` and `atlas.svg`."""
    types = list(dict.fromkeys(cell["dtype"] for cell in cells))
    asked = [
        method
        for method in METHODS
        if any(c["method"] == method.name and c["outcome"] != NOT_APPLICABLE for c in cells)
    ]
    columns = _places([(method.name, method.group) for method in asked], 0.45)
    cases = sorted((case for case in CASES if any(cell["case"] == case.name for cell in cells)), key=_number)
    rows = _places([(case.name, _number(case)) for case in cases], 0.22)
    width, height = max(columns.values()) + 1.0, max(rows.values()) + 1.0
    size = (max(9.0, LEFT + CELL * width + RIGHT_MARGIN), TOP + CELL * height + BOTTOM)
    figure = plt.figure(figsize=size)
    ax = figure.add_axes((LEFT / size[0], BOTTOM / size[1], CELL * width / size[0], CELL * height / size[1]))
    ax.set(xlim=(0, width), ylim=(height, 0))
    ax.axis("off")
    found = {(cell["case"], cell["method"], cell["dtype"]): cell["outcome"] for cell in cells}
    for case, y in rows.items():
        for method, x in columns.items():
            outcomes = [found[case, method, dtype] for dtype in types]
            if len(set(outcomes)) == 1:
                _filled(ax, x, y, SQUARE, outcomes[0], (0.5, 0.53), 6.5)
            else:
                for corners, outcome, middle in zip(
                    HALVES, outcomes, ((0.29, 0.33), (0.71, 0.74)), strict=True
                ):
                    _filled(ax, x, y, corners, outcome, middle, 5)
    for case in cases:
        label = (
            f"{case.title}{' (no answer: f is right)' if case.flag_is_right else ''}  "
            f" $\\bf{{{case.name.split()[0]}}}$"
        )
        ax.text(-0.4, rows[case.name] + 0.54, label, ha="right", va="center", fontsize=7.5)
    for name, x in columns.items():
        ax.text(x + 0.55, height + 0.3, name, ha="center", va="top", rotation=90, fontsize=7.5)
    for group in dict.fromkeys(method.group for method in asked):
        inside = [columns[method.name] for method in asked if method.group == group]
        ax.text(
            (min(inside) + max(inside) + 1) / 2,
            -0.45,
            group,
            ha="center",
            va="bottom",
            fontsize=8,
            style="italic",
        )
    if "default" in columns:
        ax.add_patch(
            Rectangle(
                (columns["default"] - 0.03, -0.04),
                1.06,
                height + 0.08,
                fill=False,
                lw=1.6,
                ec="black",
                clip_on=False,
            )
        )
    how = (
        f"Framed: the engine with nothing chosen. A cell is split where precisions differ: {types[0]} upper"
        f" left, {types[-1]} lower right."
    )
    titles = (("Where methods fail: hard cases of constrained dynamics", 0.2, 12), (how, 0.44, 8.5))
    for text, below, points in titles:
        figure.text(0.5, 1 - below / size[1], text, ha="center", va="top", fontsize=points)
    handles = [
        Rectangle((0, 0), 1, 1, facecolor=colour, edgecolor="#BBBBBB", lw=0.5, label=words)
        for colour, _, words in LOOKS.values()
    ]
    figure.legend(
        handles=handles, loc="lower center", ncols=3 if width < 30 else len(LOOKS), fontsize=8, frameon=False
    )
    for suffix in ("png", "svg"):
        figure.savefig(out / f"atlas.{suffix}", dpi=150)
    plt.close(figure)


def _places(names: list[tuple], gap: float) -> dict[str, float]:
    """Where each name begins, one apart, and `gap` more from one group to the next."""
    breaks = [k > 0 and group != names[k - 1][1] for k, (_, group) in enumerate(names)]
    return {name: k + gap * sum(breaks[: k + 1]) for k, (name, _) in enumerate(names)}


def _number(case: Case) -> int:
    return int(case.name.split()[0][1:])


def _filled(ax, x: float, y: float, corners, outcome: str, middle: tuple[float, float], size: float) -> None:
    colour, mark, _ = LOOKS[outcome]
    ax.add_patch(Polygon([(x + a, y + b) for a, b in corners], facecolor=colour, lw=0))
    ax.text(
        x + middle[0],
        y + middle[1],
        mark,
        ha="center",
        va="center",
        fontsize=size,
        color="white" if outcome in (WRONG, NAN) else "black",
    )
