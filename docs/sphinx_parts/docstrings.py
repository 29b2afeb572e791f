"""Docstrings of the package as Sphinx reads them: an indented paragraph is code, single backticks quote code,
and nothing else is markup.
"""

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

_SPECIAL = re.compile(r"(?<![*\w])\*(?!\*)|\||(?<=\w)_(?!\w)")  # `*` of a shape, `|x|`, `name_`


def as_rest(lines: list[str]) -> list[str]:
    """The lines in reStructuredText."""
    found: list[str] = []
    in_code = in_items = False
    for line in lines:
        indented, blank = line.startswith("    "), not line.strip()
        if in_code and (indented or blank):
            found.append(line)
            continue
        in_code = False
        if indented and found and not found[-1].strip():
            found += ["::", "", line]
            in_code = True
            continue
        if line.startswith("- ") and found and found[-1].strip() and not in_items:
            found.append("")
        in_items = line.startswith("- ") or (in_items and not blank)
        found.append(line if blank else _plain(line))
    return found


def _plain(line: str) -> str:
    """Without markup but for bold headings, items and quoted code."""
    parts = re.split(r"(`[^`]*`|\*\*[^*]+\*\*)", line)
    return "".join(
        part if part.startswith(("`", "**")) else _SPECIAL.sub(lambda found: "\\" + found.group(0), part)
        for part in parts
    )


def _process(app, what, name, value, options, lines):
    lines[:] = as_rest(lines)


def setup(app: "Sphinx") -> dict:
    """Registers the reading of docstrings."""
    app.connect("autodoc-process-docstring", _process)
    return {"parallel_read_safe": True}
