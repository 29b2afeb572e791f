"""What checkers of types say of users' code: nothing of what is right, and something of each mistake. pyright
runs where it is installed.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from pages import DOCS, ROOT, code_of

OPTIONS = {
    "mypy": (
        "--strict",
        "--allow-untyped-defs",
        "--allow-incomplete-defs",
        "--allow-untyped-calls",
        f"--cache-dir={os.devnull}",
        "--config-file=mypy.ini",
    ),
    "pyright": ("--pythonpath", sys.executable),
}


@pytest.mark.parametrize("checker", OPTIONS)
def test_checkers_find_nothing_in_right_code_and_each_mistake(checker, tmp_path):
    if importlib.util.find_spec(checker) is None:
        pytest.skip(f"{checker} is not installed")
    for page in (ROOT / "README.md", *(DOCS / "tutorials").glob("*.md")):
        (tmp_path / f"{page.stem}_page.py").write_text("\n".join(code_of(page)))
    (tmp_path / "mypy.ini").write_text(
        "[mypy]\n[mypy-IPython.*,matplotlib.*,diffrax.*,optimistix.*]\nfollow_imports = skip\n"
    )  # 200 files less
    snippets = ROOT / "tests" / "typing"
    said = subprocess.run(
        [sys.executable, "-m", checker, *OPTIONS[checker], *tmp_path.glob("*.py"), *snippets.glob("*.py")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    ).stdout
    found = {
        (Path(file).name, int(line))
        for file, line in re.findall(r"^ *(\S+?):(\d+).*? error", said, re.MULTILINE)
    }
    lines = (snippets / "wrong.py").read_text().splitlines()
    assert found == {
        ("wrong.py", number) for number, line in enumerate(lines, 1) if line.endswith("# wrong")
    }, said
