"""The atlas as one picture: cases down, methods across, colour and mark by outcome, float64 beside float32."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Rectangle

from atlas_cases.case import Case
from atlas_cases.cases import CASES
from atlas_cases.methods import METHODS
from atlas_cases.outcomes import FLAGGED, NAN, NOT_APPLICABLE, RIGHT, STALLED, WRONG

# Okabe and Ito's colours, which the colour-blind can tell apart, and a mark for print in grey.
LOOKS = {
    RIGHT: ("#009E73", ""),
    FLAGGED: ("#56B4E9", "f"),
    WRONG: ("#D55E00", "×"),
    NAN: ("#000000", "N"),
    STALLED: ("#F0E442", "s"),
    NOT_APPLICABLE: ("#F1F1F1", ""),
}
WORDS = {
    RIGHT: "right within the tolerance",
    FLAGGED: "f  says that it failed",
    WRONG: "×  wrong, and says nothing",
    NAN: "N  NaN, and says nothing",
    STALLED: "s  out of steps",
    NOT_APPLICABLE: "not asked",
}
GAP = 0.35  # between groups of methods


def draw(cells: list[dict], out: Path) -> None:
    """`atlas.png` and `atlas.svg`."""
    types = list(dict.fromkeys(cell["dtype"] for cell in cells))
    cases = [case for case in CASES if any(cell["case"] == case.name for cell in cells)]
    methods = [method for method in METHODS if any(cell["method"] == method.name for cell in cells)]
    columns, x = {}, 0.0
    for k, method in enumerate(methods):
        x += GAP if k and method.group != methods[k - 1].group else 0.0
        columns[method.name] = x
        x += 1.0
    height, width = len(cases), x
    figure, axes = plt.subplots(1, len(types), figsize=(5.2 + 0.27 * width * len(types), 2.6 + 0.235 * height), sharey=True, squeeze=False)
    for ax, dtype in zip(axes[0], types, strict=True):
        for row, case in enumerate(cases):
            for cell in (c for c in cells if c["case"] == case.name and c["dtype"] == dtype):
                _cell(ax, columns[cell["method"]], row, cell["outcome"])
        ax.set(xlim=(-0.1, width + 0.1), ylim=(height, -0.1), title=dtype)
        ax.set_xticks([c + 0.5 for c in columns.values()], list(columns), rotation=90, fontsize=8)
        ax.set_yticks([r + 0.5 for r in range(height)], [_label(case) for case in cases], fontsize=8)
        ax.tick_params(length=0)
        for spine in ax.spines.values():
            spine.set_visible(False)
        for group in dict.fromkeys(method.group for method in methods):
            inside = [columns[method.name] + 0.5 for method in methods if method.group == group]
            ax.text(sum(inside) / len(inside), -0.35, group, ha="center", va="bottom", fontsize=7, style="italic")
        ax.title.set_position((0.5, 1.0))
        ax.set_title(dtype, pad=18, fontsize=11)
        ax.add_patch(Rectangle((columns["default"] - 0.04, -0.02), 1.04, height + 0.04, fill=False, lw=1.6, ec="black")) if "default" in columns else None
    handles = [Rectangle((0, 0), 1, 1, color=LOOKS[outcome][0]) for outcome in LOOKS]
    figure.legend(handles, [WORDS[outcome] for outcome in LOOKS], loc="lower center", ncols=len(LOOKS), fontsize=9, frameon=False)
    figure.suptitle("Where methods fail: hard cases of constrained dynamics. Framed: the engine with nothing chosen.", fontsize=12)
    figure.tight_layout(rect=(0, 0.025, 1, 0.99))
    for suffix in ("png", "svg"):
        figure.savefig(out / f"atlas.{suffix}", dpi=130)
    plt.close(figure)


def _label(case: Case) -> str:
    return f"{case.title}{' (no answer: f is right)' if case.flag_is_right else ''}   {case.name}"


def _cell(ax, x: float, y: float, outcome: str) -> None:
    colour, mark = LOOKS[outcome]
    ax.add_patch(Rectangle((x + 0.04, y + 0.05), 0.92, 0.9, color=colour, lw=0))
    if mark:
        light = "white" if outcome in (WRONG, NAN) else "black"
        ax.text(x + 0.5, y + 0.54, mark, ha="center", va="center", fontsize=7, color=light)
