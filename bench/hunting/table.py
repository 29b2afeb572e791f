"""The table of a search, as text and as Markdown, and its figures."""

from collections import Counter

from figures import figure, markdown

from hunting.record import BY_CODE, BY_WARNING, CRASHED, LOST, OUTCOMES, REFUSED, RIGHT, WRONG


def rows(records):
    """Family, cases, outcomes in their order, seconds; the sum at the end."""
    for name in sorted({r["family"] for r in records}):
        yield _row(name, [r for r in records if r["family"] == name])
    yield _row("all", records)


def _row(name, own):
    counts = Counter(r["outcome"] for r in own)
    return (name, len(own), *(counts[outcome] for outcome in OUTCOMES), round(sum(r["seconds"] for r in own)))


HEAD = ("family", "cases", *OUTCOMES, "seconds")


def as_markdown(records):
    """Return the table of `bench/records/hunt.md`, with a description of each family."""
    from hunting.families import FAMILIES

    what = {f.name: f.what for f in FAMILIES}
    shown = []
    for name, count, *rest in rows(records):
        shown.append((name, what.get(name, ""), count, *(entry or "" for entry in rest)))
    return markdown(("family", "what", *HEAD[1:]), shown)


def losses(records):
    """Every case that is wrong or crashed, with what repeats it alone."""
    for r in records:
        if r["outcome"] in LOST:
            again = f"python bench/hunt.py --only {r['family']} --seed {r['seed']} --dtype {r['dtype']}"
            yield f"{r['outcome'].upper()}: {again}\n    {r['said']}\n    {r['asked']}"


def figures(records, wall):
    """Figures as in the other scripts."""
    for row in rows(records):
        counts = dict(zip(OUTCOMES, row[2:-1], strict=True))
        yield figure("wrong in silence or crashed", row[0], counts[WRONG] + counts[CRASHED], 0)
        yield figure("right", row[0], counts[RIGHT])
        yield figure("flagged", row[0], counts[BY_CODE] + counts[BY_WARNING] + counts[REFUSED])
    yield figure("wall time, s", "all", round(wall))
