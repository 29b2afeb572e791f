"""The tables behind the picture, in Markdown, and the figures of the default path."""

from collections import Counter

from figures import markdown

from atlas_cases.cases import CASES
from atlas_cases.outcomes import FLAGGED, NAN, NOT_APPLICABLE, OUTCOMES, RIGHT, STALLED, WRONG

TITLE = "# The atlas: outcomes by method and by case\n\nWritten by `python bench/atlas.py --out DIR`.\n"
SHOWN = (RIGHT, FLAGGED, WRONG, NAN, STALLED)


def write_tables(cells, out):
    """Write `atlas_tables.md`: outcomes by method, by case, and the reasons of failures."""
    written = "\n".join([TITLE, *by_method(cells), "", *by_case(cells), "", *_reasons(cells), ""])
    (out / "atlas_tables.md").write_text(written, encoding="utf-8")


def _different(cells, key):
    return list(dict.fromkeys(cell[key] for cell in cells))


def _where(cells, **keys):
    return [cell for cell in cells if all(cell[key] == value for key, value in keys.items())]


def _counts(cells) -> Counter:
    return Counter(cell["outcome"] for cell in cells)


def by_method(cells):
    """How often each method was right, flagged, ..., and in how many cases it was asked."""
    types, rows = _different(cells, "dtype"), []
    for method in _different(cells, "method"):
        row = [method]
        for dtype in types:
            counts = _counts(_where(cells, method=method, dtype=dtype))
            row += [sum(counts[o] for o in SHOWN), *(counts[o] or "" for o in SHOWN)]
        rows.append(row)
    head = ["method", *(name for dtype in types for name in (f"{dtype}: asked", *SHOWN))]
    return ["## Outcomes by method", "", *markdown(head, rows)]


def by_case(cells):
    """What the engine as it comes makes of each case, and how many of the other methods are right, flagged,
    ....
    """
    types, titles, rows = _different(cells, "dtype"), {case.name: case.title for case in CASES}, []
    for name in _different(cells, "case"):
        row = [name, titles[name]]
        for dtype in types:
            here = _where(cells, case=name, dtype=dtype)
            default = _where(here, method="default")
            counts = _counts(here) - _counts(default)
            tolerance = here[0]["tolerance"]
            row.append(f"{tolerance:.0e}" if tolerance else "a flag")
            row += ["".join(map(_in_words, default)), " / ".join(str(counts[outcome]) for outcome in SHOWN)]
        rows.append(row)
    head = ["case", "what", *(x for dtype in types for x in (f"tolerance, {dtype}", "default", "others"))]
    about = f"Other methods: {' / '.join(SHOWN)}."
    return ["## Outcomes by case", "", about, "", *markdown(head, rows)]


def _in_words(cell):
    outcome, error = cell["outcome"], cell["error"]
    if outcome in (RIGHT, WRONG) and error is not None:
        return f"{outcome}, {error:.0e}"
    return "" if outcome == NOT_APPLICABLE else outcome


def _reasons(cells):
    """Every mechanism once, without a method's own words (in brackets), with the methods and the cases for
    which it was the reason.
    """
    found = {}
    for cell in cells:
        if cell["outcome"] not in (RIGHT, NOT_APPLICABLE):
            methods, cases = found.setdefault(cell["mechanism"].partition(" [")[0], ({}, {}))
            methods[cell["method"]] = cases[cell["case"]] = None
    rows = [(mechanism, *map(", ".join, names)) for mechanism, names in found.items()]
    return ["## Why methods fail", "", *markdown(("mechanism", "methods", "cases"), rows)]


def summary(cells):
    """Counts by method, and what the default path fails at."""
    lines = []
    for method in _different(cells, "method"):
        counts = _counts(_where(cells, method=method))
        lines.append(f"{method:22s} " + ", ".join(f"{counts[o]} {o}" for o in OUTCOMES if counts[o]))
    must = {case.name for case in CASES if case.must_be_right}
    for cell in _where(cells, method="default") + _where(cells, method="rollout"):
        required = cell["method"] == "default" and cell["dtype"] == "float64" and cell["case"] in must
        if cell["outcome"] in (WRONG, NAN, STALLED) or (required and cell["outcome"] == FLAGGED):
            told = "MARK MISSED: {method} in {case} ({dtype}): {outcome} {error} {mechanism}"
            lines.append(told.format(**cell))
    return "\n".join(lines)
