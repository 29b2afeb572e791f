"""The layer table of the package, held by reading every import in `src` (no import is executed).

Bottom to top: calculus < eager < program < native < scene < equations < build < dynamics < lowering < motion < analysis < ensembles < models <
importers < bicycle < plotting < cli.
A layer imports itself and what lies below it; only the package's `__init__` sees everything.
"""

import ast
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = "jourdain_jax"
SOURCE = Path(__file__).parents[1] / "src" / PACKAGE
LAYERS = (
    "calculus",
    "eager",
    "program",
    "native",
    "scene",
    "equations",
    "build",
    "dynamics",
    "lowering",
    "motion",
    "analysis",
    "ensembles",
    "models",
    "importers",
    "bicycle",
    "plotting",
    "cli",
)
ENTRY_MODULES = ("__init__", "__main__")  # above every layer
OWNERS = {"diffrax": ("motion",)}  # third-party packages that only the named layers know
OPTIONAL = (
    "matplotlib",
    "mpl_toolkits",
    "IPython",
    "tqdm",
    "scipy",
    "sympy",
    "zarr",
    "google_crc32c",
    "xarray",
    "pandas",
    "distributed",
    "trimesh",
)  # may be imported inside a function
VAGUE_NAMES = ("utils", "util", "misc", "common", "helpers", "helper")
LONGEST = 400


@dataclass(frozen=True)
class Import:
    module: str  # the module that imports
    target: str  # what it imports, resolved to a module of the package where it is one
    line: int
    in_function: bool
    star: bool


def _modules(root: Path, package: str) -> dict[str, Path]:
    """Dotted module name -> file, a package's `__init__.py` under the package's own name."""
    modules = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts[-1] == "__init__":
            parts = parts[:-1]
        modules[".".join((package, *parts))] = path
    return modules


def _imports(module: str, path: Path, known: dict[str, Path]) -> list[Import]:
    found = []

    def resolve(base: str, name: str | None) -> str:
        return f"{base}.{name}" if name is not None and f"{base}.{name}" in known else base

    def visit(node: ast.AST, in_function: bool) -> None:
        if isinstance(node, ast.Import):
            found.extend(Import(module, alias.name, node.lineno, in_function, False) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
                parents = parents[: len(parents) - node.level + 1]
                base = ".".join([*parents, *([node.module] if node.module else [])])
            for alias in node.names:
                target = resolve(base, alias.name)
                found.append(Import(module, target, node.lineno, in_function, alias.name == "*"))
        inside = in_function or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for child in ast.iter_child_nodes(node):
            visit(child, inside)

    visit(ast.parse(path.read_text()), False)
    return found


def _layer(module: str, package: str) -> str:
    """The layer of a module: the first name below the package (`__init__` for the package itself)."""
    inner = module.removeprefix(package).lstrip(".")
    return inner.split(".")[0] if inner else "__init__"


def _rank(layer: str) -> int | None:
    if layer in ENTRY_MODULES:
        return len(LAYERS)
    return LAYERS.index(layer) if layer in LAYERS else None


def _within(target: str, package: str) -> bool:
    return target == package or target.startswith(package + ".")


def _cycles(edges: dict[str, set[str]]) -> list[str]:
    """One line per cycle of modules, found by depth-first search."""
    found, done = [], set()

    def walk(module: str, path: list[str]) -> None:
        if module in path:
            found.append("cycle: " + " -> ".join([*path[path.index(module) :], module]))
            return
        if module in done:
            return
        for target in sorted(edges.get(module, ())):
            walk(target, [*path, module])
        done.add(module)

    for module in sorted(edges):
        walk(module, [])
    return found


def violations(root: Path, package: str) -> list[str]:
    """Every breach of the rules in the tree at `root`, one sentence each."""
    known = _modules(root, package)
    found: list[str] = []
    edges: dict[str, set[str]] = {}
    for module, path in known.items():
        layer = _layer(module, package)
        rank = _rank(layer)
        if rank is None:
            found.append(f"{module}: `{layer}` is not in the layer table")
            continue
        if any(part in VAGUE_NAMES for part in module.split(".")):
            found.append(f"{module}: vague name")
        lines = len(path.read_text().splitlines())
        if lines > LONGEST:
            found.append(f"{module}: {lines} lines, more than {LONGEST}")
        for item in _imports(module, path, known):
            where = f"{module}:{item.line}"
            top = item.target.split(".")[0]
            if item.star:
                found.append(f"{where}: star import of {item.target}")
            if item.in_function and top not in OPTIONAL:
                found.append(f"{where}: import of {item.target} inside a function")
            if top in OWNERS and layer not in OWNERS[top]:
                found.append(f"{where}: {layer} imports {top}, which belongs to {', '.join(OWNERS[top])}")
            if _within(item.target, package) and item.target != module:
                edges.setdefault(module, set()).add(item.target)
                target_rank = _rank(_layer(item.target, package))
                if target_rank is not None and target_rank > rank:
                    found.append(f"{where}: {layer} imports {item.target} above it")
    return found + _cycles(edges)


def test_imports_point_down_the_layer_table():
    modules = _modules(SOURCE, PACKAGE)
    assert modules, f"no source found in {SOURCE}"
    found = violations(SOURCE, PACKAGE)
    assert not found, "\n".join(found)


def _write(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


CLEAN = {
    "__init__.py": "from .scene import Scene\nfrom .motion.simulate import simulate\n",
    "calculus/__init__.py": "from .rotations import rot_z\n",
    "calculus/rotations.py": "import numpy as np\nrot_z = np.eye\n",
    "scene/__init__.py": "from .base import Scene\n",
    "scene/base.py": "from pk.calculus import rot_z\nfrom ..calculus.rotations import rot_z as r\nclass Scene: ...\n",
    "motion/__init__.py": "",
    "motion/simulate.py": "import diffrax\nfrom pk.scene import Scene\ndef simulate():\n    import tqdm\n",
    "cli.py": "from pk.motion import simulate\n",
}


def test_a_clean_tree_has_no_violations(tmp_path):
    assert violations(_write(tmp_path, CLEAN), "pk") == []


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("scene/base.py", "from pk.motion.simulate import simulate\n", "scene imports pk.motion.simulate above it"),
        ("scene/base.py", "from ..motion import simulate\n", "scene imports pk.motion.simulate above it"),
        ("scene/base.py", "import pk.motion.simulate\n", "scene imports pk.motion.simulate above it"),
        ("scene/base.py", "from pk import cli\n", "scene imports pk.cli above it"),
        ("scene/base.py", "import pk\n", "scene imports pk above it"),
        ("scene/base.py", "import diffrax as dfx\n", "scene imports diffrax"),
        ("cli.py", "from diffrax import diffeqsolve\n", "cli imports diffrax"),
        ("scene/base.py", "def f():\n    import json\n", "import of json inside a function"),
        ("scene/base.py", "class A:\n    def f(self):\n        from pk.calculus import g\n", "inside a function"),
        ("scene/base.py", "from pk.calculus import *\n", "star import"),
        ("scene/utils.py", "", "vague name"),
        ("scene/base.py", "x = 1\n" * 401, "401 lines"),
        ("sculpting/base.py", "", "`sculpting` is not in the layer table"),
        ("calculus/rotations.py", "import pk.calculus.other\n", None),
    ],
)
def test_the_checker_sees_a_violation(tmp_path, file, text, expected):
    found = violations(_write(tmp_path, {**CLEAN, file: text}), "pk")
    if expected is None:
        assert found == []
    else:
        assert any(expected in line for line in found), found


def test_the_checker_sees_a_cycle_of_modules(tmp_path):
    cycle = {"scene/a.py": "from .b import y\n", "scene/b.py": "from .c import z\n", "scene/c.py": "from . import a\n"}
    found = violations(_write(tmp_path, {**CLEAN, **cycle}), "pk")
    assert found == ["cycle: pk.scene.a -> pk.scene.b -> pk.scene.c -> pk.scene.a"]
