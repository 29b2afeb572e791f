"""The table behind the charts, and the figures in words."""

from pathlib import Path

_MARKS = {True: "met ", False: "MISS", None: "    "}


def write_table(entries: list[dict], out: Path) -> None:
    """`work_precision.md`: references, then every measurement."""
    lines = ["## References", "", "| what | how | uncertainty | against |", "|---|---|---|---|"]
    lines += [f"| {e['reference']} | {e['how']} | {e['uncertainty']:.1e} | {e['against']} |" for e in entries if "reference" in e]
    lines += ["", "## Measurements", "", "| problem | method | kind | setting | batch | error | ms | evaluations | energy drift | slip (m/s) | note |"]
    lines.append("|" + "---|" * 11)
    for e in entries:
        if "method" in e:
            shown = [_shown(e[key], ".1e") for key in ("energy_drift", "slip")]
            lines.append(
                f"| {e['problem']} | {e['method']} | {e['kind']} | {e['setting']:.1e} {e['setting_unit']} | {e['batch']} | {_shown(e['error'], '.1e')} | "
                f"{1e3 * e['seconds']:.4g} | {_shown(e['rhs_evaluations'], '.0f')} | {shown[0]} | {shown[1]} | {e['note']} |"
            )
    (out / "work_precision.md").write_text("\n".join([*lines, "", "## Figures", "", summary(entries), ""]), encoding="utf-8")


def _shown(value, form: str) -> str:
    return "" if value is None else format(value, form)


def summary(entries: list[dict]) -> str:
    """Memory, cold starts and figures."""
    lines = [f"peak memory, {e['memory']}: {e['peak_rss_mb']:.0f} MB" for e in entries if "memory" in e]
    lines += [f"{e['cold']}, {e['cache']}: {e['seconds']['total']:.1f} s from a fresh process to the first trajectory" for e in entries if "cold" in e]
    for e in entries:
        if "figure" in e:
            value = "not measured" if e["value"] is None else f"{e['value']:,.3g}"
            required = "" if e["required"] is None else f" (required {e['required']:,})"
            lines += [f"{_MARKS[e['met']]} {value}{required}  {e['figure']}", f"       {e['how']}"]
    return "\n".join(lines)
