"""The tables behind the picture (CSV and Markdown), and the figures of the default path."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from atlas_cases.cases import CASES
from atlas_cases.outcomes import FLAGGED, NAN, NOT_APPLICABLE, OUTCOMES, RIGHT, STALLED, WRONG

TITLE = "# The atlas: outcomes by method and by case\n\nWritten by `python bench/atlas.py --out DIR`.\n"


def write_tables(cells: list[dict], out: Path) -> None:
    """Write `atlas_tables.md`: outcomes by method, by case, and the reasons of failures."""
    written = "\n".join([TITLE, *by_method(cells), "", *by_case(cells), "", *_reasons(cells), ""])
    (out / "atlas_tables.md").write_text(written, encoding="utf-8")


SHOWN = (RIGHT, FLAGGED, WRONG, NAN, STALLED)


def _types(cells) -> list[str]:
    return list(dict.fromkeys(cell["dtype"] for cell in cells))


def _counts(cells, dtype: str) -> Counter:
    return Counter(cell["outcome"] for cell in cells if cell["dtype"] == dtype)


def by_method(cells: list[dict]) -> Iterator[str]:
    """How often each method was right, flagged, ..., and in how many cases it was asked."""
    types = _types(cells)
    yield from (
        "## Outcomes by method",
        "",
        "| method | " + " | ".join(f"{dtype}: asked | " + " | ".join(SHOWN) for dtype in types) + " |",
    )
    yield "|---|" + "---|" * (len(types) * (1 + len(SHOWN)))
    for method in dict.fromkeys(cell["method"] for cell in cells):
        counts = [_counts([cell for cell in cells if cell["method"] == method], dtype) for dtype in types]
        yield (
            f"| {method} | "
            + " | ".join(
                f"{sum(c[o] for o in SHOWN)} | " + " | ".join(str(c[o] or "") for o in SHOWN) for c in counts
            )
            + " |"
        )


def by_case(cells: list[dict]) -> Iterator[str]:
    """What the engine as it comes makes of each case, and how many of the other methods are right, flagged,
    ....
    """
    types, titles = _types(cells), {case.name: case.title for case in CASES}
    yield from ("## Outcomes by case", "", "Other methods: " + " / ".join(SHOWN) + ".", "")
    yield "| case | what | " + " | ".join(f"tolerance, {dtype} | default | others" for dtype in types) + " |"
    yield "|---|---|" + "---|" * (3 * len(types))
    for name in dict.fromkeys(cell["case"] for cell in cells):
        here = [cell for cell in cells if cell["case"] == name]
        shown = []
        for dtype in types:
            default = next(
                (cell for cell in here if cell["method"] == "default" and cell["dtype"] == dtype), None
            )
            counts = _counts([cell for cell in here if cell["method"] != "default"], dtype)
            tolerance = next(cell["tolerance"] for cell in here if cell["dtype"] == dtype)
            shown += [
                f"{tolerance:.0e}" if tolerance else "a flag",
                _in_words(default),
                " / ".join(str(counts[outcome]) for outcome in SHOWN),
            ]
        yield f"| {name} | {titles[name]} | " + " | ".join(shown) + " |"


def _in_words(cell) -> str:
    if cell is None or cell["outcome"] == NOT_APPLICABLE:
        return ""
    return (
        f"{cell['outcome']}, {cell['error']:.0e}"
        if cell["outcome"] in (RIGHT, WRONG) and cell["error"] is not None
        else cell["outcome"]
    )


def _reasons(cells) -> Iterator[str]:
    """Every mechanism once, without a method's own words (in brackets), with the methods and the cases for
    which it was the reason.
    """
    yield from ("## Why methods fail", "", "| mechanism | methods | cases |", "|---|---|---|")
    found: dict[str, tuple[dict, dict]] = {}
    for cell in cells:
        if cell["outcome"] not in (RIGHT, NOT_APPLICABLE):
            methods, cases = found.setdefault(cell["mechanism"].partition(" [")[0], ({}, {}))
            methods[cell["method"]] = cases[cell["case"]] = None
    for mechanism, (methods, cases) in found.items():
        yield f"| {mechanism} | {', '.join(methods)} | {', '.join(cases)} |"


def summary(cells: list[dict]) -> str:
    """Counts by method, and what the default path fails at."""
    lines = []
    for method in dict.fromkeys(cell["method"] for cell in cells):
        counts = Counter(cell["outcome"] for cell in cells if cell["method"] == method)
        lines.append(f"{method:22s} " + ", ".join(f"{counts[o]} {o}" for o in OUTCOMES if counts[o]))
    must = {case.name for case in CASES if case.must_be_right}
    for cell in cells:
        engine = cell["method"] in ("default", "rollout")
        required = cell["method"] == "default" and cell["dtype"] == "float64" and cell["case"] in must
        lost = cell["outcome"] in (WRONG, NAN, STALLED) or (required and cell["outcome"] == FLAGGED)
        if engine and lost:
            lines.append(
                f"MARK MISSED: {cell['method']} in {cell['case']} ({cell['dtype']}): {cell['outcome']}"
                f" {cell['error']} {cell['mechanism']}"
            )
    return "\n".join(lines)
