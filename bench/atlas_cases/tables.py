"""The table behind the picture (CSV and Markdown), and the figures of the default path."""

import csv
from collections import Counter
from pathlib import Path

from atlas_cases.cases import CASES
from atlas_cases.methods import METHODS
from atlas_cases.outcomes import FLAGGED, NAN, NOT_APPLICABLE, OUTCOMES, RIGHT, STALLED, WRONG

KEYS = ("case", "method", "dtype", "outcome", "error", "tolerance", "mechanism")
_SHORT = {RIGHT: "ok", FLAGGED: "flag", WRONG: "WRONG", NAN: "NaN", STALLED: "stall", NOT_APPLICABLE: ""}


def write_tables(cells: list[dict], out: Path) -> None:
    """`atlas.csv`, one line per cell, and `atlas.md`, outcomes by case and method and the mechanisms of all failures."""
    with (out / "atlas.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, KEYS)
        writer.writeheader()
        writer.writerows(cells)
    (out / "atlas.md").write_text("\n".join([by_method(cells), "", *_outcomes(cells), "", *_failures(cells), ""]))


def _outcomes(cells):
    titles = {case.name: case for case in CASES}
    for dtype in dict.fromkeys(cell["dtype"] for cell in cells):
        here = [cell for cell in cells if cell["dtype"] == dtype]
        methods = [m.name for m in METHODS if any(c["method"] == m.name for c in here)]
        yield from (f"## {dtype}", "", "| case | what | tolerance | " + " | ".join(methods) + " |", "|" + "---|" * (3 + len(methods)))
        for name in dict.fromkeys(cell["case"] for cell in here):
            row = {cell["method"]: cell for cell in here if cell["case"] == name}
            shown = " | ".join(_shown(row.get(method)) for method in methods)
            yield f"| {name} | {titles[name].title} | {next(iter(row.values()))['tolerance']:.0e} ({titles[name].reason}) | {shown} |"
        yield ""


def _shown(cell) -> str:
    if cell is None:
        return ""
    short = _SHORT[cell["outcome"]]
    return f"{short} {cell['error']:.0e}" if cell["error"] is not None and cell["outcome"] in (RIGHT, WRONG) else short


def _failures(cells):
    yield from ("## Why", "", "| case | method | dtype | outcome | mechanism |", "|---|---|---|---|---|")
    for cell in cells:
        if cell["outcome"] not in (RIGHT, NOT_APPLICABLE):
            yield f"| {cell['case']} | {cell['method']} | {cell['dtype']} | {cell['outcome']} | {cell['mechanism']} |"


def by_method(cells: list[dict]) -> str:
    """A Markdown table: how often each method was right, flagged, ..., in both types together."""
    shown = [outcome for outcome in OUTCOMES if outcome != NOT_APPLICABLE]
    lines = ["| method | " + " | ".join(shown) + " |", "|---|" + "---|" * len(shown)]
    for method in dict.fromkeys(cell["method"] for cell in cells):
        counts = Counter(cell["outcome"] for cell in cells if cell["method"] == method)
        lines.append(f"| {method} | " + " | ".join(str(counts[outcome] or "") for outcome in shown) + " |")
    return "\n".join(lines)


def summary(cells: list[dict]) -> str:
    """Counts by method, and what the default path fails at."""
    lines = []
    for method in dict.fromkeys(cell["method"] for cell in cells):
        counts = Counter(cell["outcome"] for cell in cells if cell["method"] == method)
        lines.append(f"{method:22s} " + ", ".join(f"{counts[o]} {o}" for o in OUTCOMES if counts[o]))
    must = {case.name for case in CASES if case.must_be_right}
    for cell in cells:
        engine = cell["method"] in ("default", "rollout")
        lost = cell["outcome"] in (WRONG, NAN, STALLED) or (cell["dtype"] == "float64" and cell["case"] in must and cell["outcome"] == FLAGGED)
        if engine and lost:
            lines.append(f"MARK MISSED: {cell['method']} in {cell['case']} ({cell['dtype']}): {cell['outcome']} {cell['error']} {cell['mechanism']}")
    return "\n".join(lines)
