"""The page on scenes from other tools: its code runs as it stands, in order, beside the files that it shows."""

import re
from pathlib import Path

import pytest

pytest.importorskip("sympy")
PAGE = Path(__file__).parents[1] / "docs" / "howto" / "from_other_tools.md"


def test_the_code_of_the_page_runs(tmp_path, monkeypatch, capsys):
    text = PAGE.read_text(encoding="utf-8")
    for name, content in re.findall(r"```\{code-block\} xml\n:caption: (\S+)\n\n(.*?)```", text, re.DOTALL):
        (tmp_path / name).write_text(content, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    scope: dict = {}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(compile(block, str(PAGE), "exec"), scope)
    printed = capsys.readouterr().out
    assert printed.count("reached the end of its span") == text.count("print(motion)")
    assert [scope[name]().coordinate_names.entries[0] for name in ("Disc", "Robot", "Arm")] == ["yaw", "x", "shoulder"]
