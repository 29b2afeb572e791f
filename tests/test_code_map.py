"""The map of the code: `bench/code_map.py` reads the source that is there, and the layer table names all of it."""

import ast
import re
import runpy

import code_map
from test_layers import LAYERS, LONGEST

PAGE = code_map.ROOT / "docs" / "architecture.md"


def test_the_layers_are_the_packages():
    print("\n" + "\n".join(code_map.source_table()))  # `pytest -s` shows it
    assert code_map.layers() == LAYERS
    assert code_map.packages() == set(LAYERS)


def test_sizes_of_the_layers_add_up():
    found = {(entry["figure"], entry["model"]): entry["value"] for entry in code_map.figures_of_source()}
    for what in ("files", "lines"):
        parts = {layer: found[what, layer] for layer in (*LAYERS, code_map.TOP)}
        assert all(parts.values()), parts
        assert sum(parts.values()) == found[what, "all"]


def test_no_source_file_is_longer_than_the_layer_table_allows():
    lines = code_map.lines_of_files()
    longest = max(lines, key=lines.__getitem__)
    assert lines[longest] <= LONGEST, f"{longest}: {lines[longest]} lines"


def test_what_simulate_imports_lies_below_it():
    closure = code_map.import_closure(code_map.ENTRY)
    assert {"motion/integration.py", "lowering/lower.py", "build/structure.py", "scene/scene.py", "calculus/newton.py"} <= closure
    assert not {code_map.layer_of(file) for file in closure} & set(LAYERS[LAYERS.index("motion") + 1 :])


def test_a_call_through_a_callback_goes_up():
    below = compile_in("calculus/below.py", "def calls(f):\n    return f()\n")["calls"]
    above = compile_in("motion/above.py", "def handed():\n    return 1\n")["handed"]
    result, found = code_map.observed(lambda: below(above))
    assert result == 1
    assert found["files"] == {"calculus/below.py": 1, "motion/above.py": 1}
    assert found["up"] == [["calculus/below.py: calls", "motion/above.py: handed", 1]]


def test_the_page_on_the_packages_names_what_there_is():
    text = re.sub(r"\s+", " ", PAGE.read_text(encoding="utf-8"))
    rows = re.findall(r"\| `(\w+)` \|", text)
    assert tuple(reversed(rows)) == LAYERS
    named = re.findall(r"`([\w/]+\.py): ([^`]+)`", text)
    assert len(named) > 40
    missing = [f"{file}: {name}" for file, names in named for name in names.split(", ") if name not in names_in(file)]
    assert not missing, missing


def test_the_drawing_of_the_packages_shows_the_steps_that_the_page_tells():
    drawing = runpy.run_path(str(PAGE.with_name("draw_architecture.py")))
    assert tuple(name for name, _, part in reversed(drawing["ROOMS"]) if not part) == LAYERS
    told = [re.findall(r"^\d+\. \*\*([\w/]+)\.\*\*", section, re.MULTILINE) for section in PAGE.read_text(encoding="utf-8").split("\n## ")[1:]]
    assert told == [[room for room, _ in steps] for _, _, steps in drawing["CALLS"]]


def names_in(file: str) -> set[str]:
    """Functions and classes of a file, methods as `Class.method`."""
    body = ast.parse((code_map.SOURCE / file).read_text(encoding="utf-8")).body
    defined = [node for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    inner = [f"{node.name}.{method.name}" for node in defined for method in ast.iter_child_nodes(node) if isinstance(method, ast.FunctionDef)]
    return {node.name for node in defined} | set(inner)


def compile_in(file: str, text: str) -> dict:
    """The names that a text defines, as if it stood in this file of the package."""
    names: dict = {}
    exec(compile(text, str(code_map.SOURCE / file), "exec"), names)
    return names
