"""The atlas as one picture: cases down, methods across, colour and mark by outcome; a cell is split where float64 and float32 differ."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Polygon, Rectangle

from atlas_cases.case import Case
from atlas_cases.cases import CASES
from atlas_cases.methods import METHODS
from atlas_cases.outcomes import FLAGGED, NAN, NOT_APPLICABLE, RIGHT, STALLED, WRONG

# Okabe and Ito's colours, which the colour-blind can tell apart, and a mark for print in grey.
LOOKS = {
    RIGHT: ("#009E73", ""),
    FLAGGED: ("#8CCBF0", "f"),
    WRONG: ("#D55E00", "×"),
    NAN: ("#000000", "N"),
    STALLED: ("#F0E442", "s"),
    NOT_APPLICABLE: ("#F3F3F3", ""),
}
WORDS = {
    RIGHT: "right within the tolerance",
    FLAGGED: "f  says that it failed",
    WRONG: "×  wrong, and says nothing",
    NAN: "N  NaN, and says nothing",
    STALLED: "s  out of steps",
    NOT_APPLICABLE: "not asked",
}
GROUP_GAP, CASE_GAP = 0.45, 0.22  # between groups of methods, and between hard cases E1, E2, ...
CELL, LEFT, RIGHT_MARGIN, TOP, BOTTOM = 0.185, 4.3, 0.4, 0.95, 1.75  # inches
NARROWEST = 9.0  # of the picture, for its title


def draw(cells: list[dict], out: Path) -> None:
    """`atlas.png` and `atlas.svg`."""
    types = list(dict.fromkeys(cell["dtype"] for cell in cells))
    asked = [method for method in METHODS if any(c["method"] == method.name and c["outcome"] != NOT_APPLICABLE for c in cells)]
    columns = _places([method.name for method in asked], [method.group for method in asked], GROUP_GAP)
    cases = sorted((case for case in CASES if any(cell["case"] == case.name for cell in cells)), key=_number)
    rows = _places([case.name for case in cases], [_number(case) for case in cases], CASE_GAP)
    width, height = max(columns.values()) + 1.0, max(rows.values()) + 1.0
    size = (max(NARROWEST, LEFT + CELL * width + RIGHT_MARGIN), TOP + CELL * height + BOTTOM)
    figure = plt.figure(figsize=size)
    ax = figure.add_axes((LEFT / size[0], BOTTOM / size[1], CELL * width / size[0], CELL * height / size[1]))
    ax.set(xlim=(0, width), ylim=(height, 0))
    ax.axis("off")
    found = {(cell["case"], cell["method"], cell["dtype"]): cell["outcome"] for cell in cells}
    for case, y in rows.items():
        for method, x in columns.items():
            _cell(ax, x, y, [found[case, method, dtype] for dtype in types])
    for case in cases:
        ax.text(-0.4, rows[case.name] + 0.54, _label(case), ha="right", va="center", fontsize=7.5)
    for name, x in columns.items():
        ax.text(x + 0.55, height + 0.3, name, ha="center", va="top", rotation=90, fontsize=7.5)
    for group in dict.fromkeys(method.group for method in asked):
        inside = [columns[method.name] for method in asked if method.group == group]
        ax.text((min(inside) + max(inside) + 1) / 2, -0.45, group, ha="center", va="bottom", fontsize=8, style="italic")
    if "default" in columns:
        frame = Rectangle((columns["default"] - 0.03, -0.04), 1.06, height + 0.08, fill=False, lw=1.6, ec="black", clip_on=False)
        ax.add_patch(frame)
    centre = 0.5 * size[0]
    figure.text(centre / size[0], 1 - 0.2 / size[1], "Where methods fail: hard cases of constrained dynamics", ha="center", va="top", fontsize=12)
    how = f"Framed: the engine with nothing chosen. A cell is split where precisions differ: {types[0]} upper left, {types[-1]} lower right."
    figure.text(centre / size[0], 1 - 0.44 / size[1], how, ha="center", va="top", fontsize=8.5)
    handles = [Rectangle((0, 0), 1, 1, facecolor=colour, edgecolor="#BBBBBB", lw=0.5) for colour, _ in LOOKS.values()]
    figure.legend(handles, [WORDS[outcome] for outcome in LOOKS], loc="lower center", ncols=3 if width < 30 else len(LOOKS), fontsize=8, frameon=False)
    for suffix in ("png", "svg"):
        figure.savefig(out / f"atlas.{suffix}", dpi=150)
    plt.close(figure)


def _places(names, groups, gap: float) -> dict[str, float]:
    """Where each name begins, one apart, and `gap` more from one group to the next."""
    places, at = {}, 0.0
    for k, name in enumerate(names):
        at += gap if k and groups[k] != groups[k - 1] else 0.0
        places[name] = at
        at += 1.0
    return places


def _number(case: Case) -> int:
    return int(case.name.split()[0][1:])


def _label(case: Case) -> str:
    return f"{case.title}{' (no answer: f is right)' if case.flag_is_right else ''}   $\\bf{{{case.name.split()[0]}}}$"


def _cell(ax, x: float, y: float, outcomes: list[str]) -> None:
    left, right, top, bottom = x + 0.05, x + 0.95, y + 0.05, y + 0.95
    if len(set(outcomes)) == 1:
        _filled(ax, [(left, top), (right, top), (right, bottom), (left, bottom)], outcomes[0], (x + 0.5, y + 0.53), 6.5)
        return
    _filled(ax, [(left, top), (right, top), (left, bottom)], outcomes[0], (x + 0.29, y + 0.33), 5)
    _filled(ax, [(right, top), (right, bottom), (left, bottom)], outcomes[1], (x + 0.71, y + 0.74), 5)


def _filled(ax, corners, outcome: str, middle: tuple[float, float], size: float) -> None:
    colour, mark = LOOKS[outcome]
    ax.add_patch(Polygon(corners, facecolor=colour, lw=0))
    if mark:
        ax.text(*middle, mark, ha="center", va="center", fontsize=size, color="white" if outcome in (WRONG, NAN) else "black")
