"""Code of the pages of the documentation, run as it stands."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def code_of(page):
    """Return the Python blocks of a page, in order."""
    return re.findall(
        r"```(?:\{code-cell\} ipython3|python)[^\n]*\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL
    )


def run(page, **names):
    """Return the names that the code of a page leaves beside those that it is given."""
    for code in code_of(page):
        exec(compile(code, str(page), "exec"), names)
    return names
