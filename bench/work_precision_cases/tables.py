"""The table behind the charts."""

from pathlib import Path


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
    (out / "work_precision.md").write_text("\n".join([*lines, ""]), encoding="utf-8")


def _shown(value, form: str) -> str:
    return "" if value is None else format(value, form)
