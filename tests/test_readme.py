"""The README's code runs as it stands."""

import re
from pathlib import Path

import matplotlib.pyplot as plt

README = Path(__file__).parent.parent / "README.md"


def blocks():
    """The Python blocks of the README, in order."""
    return re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


def test_the_quickstart_has_at_most_fifteen_lines_of_code():
    lines = [line for line in blocks()[0].splitlines() if line.strip()]
    assert len(lines) <= 15


def test_all_code_of_the_readme_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scope = {}
    for block in blocks():
        exec(compile(block, str(README), "exec"), scope)
    plt.close("all")
    printed = capsys.readouterr().out
    assert "reached the end of its span" in printed
    assert "Verification of Sleigh: passed" in printed
    assert (tmp_path / "disc.png").stat().st_size > 5000
