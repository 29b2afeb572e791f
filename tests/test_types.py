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


# What the code's own types do not depend on is not read: 600 files less. Arrays of JAX keep their types.
MYPY = """
[mypy]
[mypy-IPython.*,matplotlib.*,diffrax.*,optimistix.*,jaxlib.*,jax.experimental.*,jax._src.*]
follow_imports = skip
follow_imports_for_stubs = true
[mypy-jax._src.array,jax._src.basearray,jax._src.literals,jax._src.typing]
follow_imports = normal
"""


@pytest.mark.parametrize("checker", OPTIONS)
def test_checkers_find_nothing_in_right_code_and_each_mistake(checker, tmp_path):
    if importlib.util.find_spec(checker) is None:
        pytest.skip(f"{checker} is not installed")
    for page in (ROOT / "README.md", *(DOCS / "tutorials").glob("*.md")):
        (tmp_path / f"{page.stem}_page.py").write_text("\n".join(code_of(page)))
    (tmp_path / "mypy.ini").write_text(MYPY)
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
