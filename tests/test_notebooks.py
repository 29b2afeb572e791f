"""The notebooks run from their text sources, each to its checked number, and the executed copies beside them
are of the same text.
"""

import shutil
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parent.parent / "notebooks"
SOURCES = sorted(FOLDER.glob("*.py"))


# what the slow ones show is also looked at in `test_bicycle.py` and `test_studies.py`
@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_a_notebook_runs_to_its_end(source, tmp_path, monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel then shows its figures in the notebook
    shutil.copytree(FOLDER / "data", tmp_path / "data")
    notebook = jupytext.read(source)
    NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    pictures = [
        o
        for cell in notebook.cells
        if cell.cell_type == "code"
        for o in cell.outputs
        if "image/png" in o.get("data", {})
    ]
    assert pictures
    assert any("assert" in cell.source for cell in notebook.cells)


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_the_executed_copy_is_of_the_same_text(source):
    copy = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    text = jupytext.read(source)
    assert [cell.source for cell in copy.cells] == [cell.source for cell in text.cells]
    assert all(cell.execution_count for cell in copy.cells if cell.cell_type == "code")
