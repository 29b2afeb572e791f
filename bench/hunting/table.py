"""The table of a search, as text and as Markdown, and its figures."""

from collections import Counter
from collections.abc import Iterator

from hunting.record import BY_CODE, BY_WARNING, CRASHED, LOST, OUTCOMES, REFUSED, RIGHT, WRONG

BEGIN, END = "<!-- from here on written by bench/hunt.py -->", "<!-- up to here by bench/hunt.py -->"


def rows(records: list[dict]) -> Iterator[tuple]:
    """Family, cases, outcomes in their order, seconds; the sum at the end."""
    for name in sorted({r["family"] for r in records}):
        yield _row(name, [r for r in records if r["family"] == name])
    yield _row("all", records)


def _row(name: str, own: list[dict]) -> tuple:
    counts = Counter(r["outcome"] for r in own)
    return (name, len(own), *(counts[outcome] for outcome in OUTCOMES), round(sum(r["seconds"] for r in own)))


HEAD = ("family", "cases", *OUTCOMES, "seconds")


def as_text(records: list[dict]) -> Iterator[str]:
    """Columns of even width."""
    short = ("family", "cases", "right", "code", "warn", "refused", "WRONG", "crashed", "no ref", "s")
    for row in (short, *rows(records)):
        yield f"{row[0]:26s}" + "".join(f"{entry!s:>9s}" for entry in row[1:])


def as_markdown(records: list[dict]) -> Iterator[str]:
    """For `docs/atlas.md`; what each family is stands beside its name."""
    from hunting.families import FAMILIES

    what = {f.name: f.what for f in FAMILIES}
    yield from (BEGIN, "", f"| family | what | {' | '.join(HEAD[1:])} |", "|---|---|" + "---|" * (len(HEAD) - 1))
    for row in rows(records):
        yield f"| {row[0]} | {what.get(row[0], '')} | " + " | ".join(str(entry) if entry or k == 0 else "" for k, entry in enumerate(row[1:])) + " |"
    yield from ("", END)


def losses(records: list[dict]) -> Iterator[str]:
    """Every case that is wrong or crashed, with what repeats it alone."""
    for r in records:
        if r["outcome"] in LOST:
            again = f"python bench/hunt.py --only {r['family']} --seed {r['seed']} --dtype {r['dtype']}"
            yield f"{r['outcome'].upper()}: {again}\n    {r['said']}\n    {r['asked']}"


def figures(records: list[dict], wall: float) -> list[dict]:
    """Figures as in the other scripts."""
    found = []
    for row in rows(records):
        counts = dict(zip(OUTCOMES, row[2:-1], strict=True))
        lost = counts[WRONG] + counts[CRASHED]
        found.append({"figure": "wrong in silence or crashed", "model": row[0], "value": lost, "required": 0, "met": lost == 0})
        flagged = counts[BY_CODE] + counts[BY_WARNING] + counts[REFUSED]
        found.append({"figure": "right", "model": row[0], "value": counts[RIGHT], "required": None, "met": None})
        found.append({"figure": "flagged", "model": row[0], "value": flagged, "required": None, "met": None})
    return [*found, {"figure": "wall time, s", "model": "all", "value": round(wall), "required": None, "met": None}]
