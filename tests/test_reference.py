"""The examples of the reference: every public name has one, and they print what their pages say."""

import contextlib
import inspect
import io
import re
from importlib import import_module
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

PAGES = sorted(
    page for page in (Path(__file__).parents[1] / "docs" / "reference").glob("*.md") if page.stem != "index"
)
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|nan|inf)", re.IGNORECASE)


def blocks(page):
    """Code, and what it prints."""
    return re.findall(
        r"```python\n(.*?)```\n(?:\n```text\n(.*?)```\n)?", page.read_text(encoding="utf-8"), re.DOTALL
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_name_has_an_example(page):
    code, text = "\n".join(code for code, _ in blocks(page)), page.read_text(encoding="utf-8")
    for module, name in re.findall(r"auto\w+:: (jourdain_jax(?:\.\w+)?)\.(\w+)$", text, re.MULTILINE):
        documented = inspect.getdoc(getattr(import_module(module), name)) or ""
        assert re.search(rf"\b{name}\b", code) or re.search(r"^    \S", documented, re.MULTILINE), name


def assert_alike(printed, told):
    """Words are equal, and numbers but for round-off and what other machines print otherwise."""
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", told).split()
    found, expected = ([float(x) for x in NUMBER.findall(text)] for text in (printed, told))
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-9)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_examples_print_what_is_told(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for code, told in blocks(page):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(code, names)
        assert_alike(printed.getvalue(), told)
    plt.close("all")
