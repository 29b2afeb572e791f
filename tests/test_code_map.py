"""The map of the code: what `bench/code_map.py` counts does not rise, the layer table names all packages, and
the page on them what there is.
"""

import ast
import re
import runpy

import code_map
import pytest
from test_layers import LAYERS

PAGE = code_map.ROOT / "docs" / "architecture.md"


# A change that takes code away lowers these; one that adds some says in its commit what it replaces.
CEILINGS = {
    "code tokens of src": 475_285,
    "code tokens of docs": 13_475,
    "code tokens of notebooks": 7431,
    "caches": 50,
    "named numbers": 298,
    "tests for a tracer": 60,
    "functions with more than 8 parameters": 2,
    "ways: projection of a state onto its constraints": 3,
    "ways: projection of a state after a step": 1,
    "ways: values and derivatives of constraints, for a projection": 2,
    "ways: damped least squares": 2,
    "ways: step of a motion, event search, adjoint": 1,
    "code tokens of tests": 292_431,
    "code tokens of bench": 98_611,
    "test files that reach private names": 32,
}


def test_the_layers_are_the_packages():
    assert code_map.layers() == LAYERS
    assert code_map.packages() == set(LAYERS)


def test_no_column_of_the_table_rises():
    found = code_map.figures_of_source()
    assert found.keys() == CEILINGS.keys()
    higher = {name: value for name, value in found.items() if value > CEILINGS[name]}
    assert not higher, higher


MARK = re.compile(r"# (physics|numerics|tuning|code)\b")


def unmarked(text):
    """Names of the numbers at module level without a mark, beside the name or in the line above.

    `physics`: a size of the world, which models are held against; `numerics`: accuracy, round-off and limits
    of iterations, which change results; `tuning`: limits of memory and time, sizes of what is drawn, which do
    not; `code`: a number that only names something, such as a result code.
    """
    lines = text.split("\n")
    return [
        ast.unparse(node.targets[0] if isinstance(node, ast.Assign) else node.target)
        for node in ast.parse(text).body
        if isinstance(node, ast.Assign | ast.AnnAssign)
        if any(map(code_map._is_number, getattr(node.value, "elts", [node.value])))
        if not MARK.search(lines[node.lineno - 1]) and not MARK.match(lines[node.lineno - 2])
    ]


def test_every_constant_says_of_which_kind_it_is():
    found = {
        str(path.relative_to(code_map.SOURCE)): unmarked(path.read_text(encoding="utf-8"))
        for path in sorted(code_map.SOURCE.rglob("*.py"))
    }
    assert not {path: names for path, names in found.items() if names}
    text = "A = 1  # numerics\nB = 2\n# tuning: s\nC, D = 3, 4\nE = -5  # a tuning\nF = (1 / 3,)  # codes\n"
    assert unmarked(text) == ["B", "E", "F"]


@pytest.mark.parametrize(
    ("text", "tokens"),
    [
        ('"""Free."""\nx = 1  # free\n', 3),
        (f'x = "{"a" * 78}"\n', 4),
        (f'x = f"{{y}}{"a" * 40}"\n', 4),
        ("def f(a, *, b=2):\n    return (\n        a\n    )\n", 16),
    ],
)
def test_tokens_are_counted_by_the_rule(text, tokens):
    assert code_map.code_tokens(text) == tokens


def test_private_names_are_seen_through_other_files():
    reached = code_map.reaching()
    assert "test_quality.py" not in reached
    assert any(name.startswith("jourdain_jax.") for name in reached["test_native_mutants.py"])


def test_the_page_on_the_packages_names_what_there_is():
    text = re.sub(r"\s+", " ", PAGE.read_text(encoding="utf-8"))
    rows = re.findall(r"\| `(\w+)` \|", text)
    assert tuple(reversed(rows)) == LAYERS
    named = re.findall(r"`([\w/]+\.py): ([^`]+)`", text)
    assert len(named) > 40
    missing = [
        f"{file}: {name}" for file, names in named for name in names.split(", ") if name not in names_in(file)
    ]
    assert not missing, missing


def test_the_drawing_of_the_packages_shows_the_steps_that_the_page_tells():
    drawing = runpy.run_path(str(PAGE.with_name("draw_architecture.py")))
    assert tuple(name for name, _, part in reversed(drawing["ROOMS"]) if not part) == LAYERS
    told = [
        re.findall(r"^\d+\. \*\*([\w/]+)\.\*\*", section, re.MULTILINE)
        for section in PAGE.read_text(encoding="utf-8").split("\n## ")[1:]
    ]
    assert [steps for steps in told if steps] == [
        [room for room, _ in steps] for _, _, steps in drawing["CALLS"]
    ]


def names_in(file):
    """Functions and classes of a file, methods as `Class.method`."""
    body = ast.parse((code_map.SOURCE / file).read_text(encoding="utf-8")).body
    defined = [node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    inner = [
        f"{node.name}.{method.name}"
        for node in defined
        for method in ast.iter_child_nodes(node)
        if isinstance(method, ast.FunctionDef)
    ]
    return {node.name for node in defined} | set(inner)
