"""The layer table of the package, held by reading every import in `src` (no import is executed).

Bottom to top: calculus < program < kernels < scene < equations < structure < dynamics < lowering < integrate
< motion < analysis < identification < studies < models < importers < bicycle < views < cli.
A layer imports itself and what lies below it; only the package's `__init__` sees everything.
"""

import ast
from collections import Counter
from pathlib import Path
from typing import NamedTuple

PACKAGE = "jourdain_jax"
SOURCE = Path(__file__).parents[1] / "src" / PACKAGE
LAYERS = (
    "calculus",
    "program",
    "kernels",
    "scene",
    "equations",
    "structure",
    "dynamics",
    "lowering",
    "integrate",
    "motion",
    "analysis",
    "identification",
    "studies",
    "models",
    "importers",
    "bicycle",
    "views",
    "cli",
)
ENTRY_MODULES = ("__init__", "__main__")  # above every layer
OWNERS = {"diffrax": ("integrate", "motion")}  # third-party packages that only the named layers know
# may be imported inside a function
OPTIONAL = (
    "matplotlib mpl_toolkits IPython tqdm scipy sympy zarr google_crc32c xarray pandas distributed trimesh"
)
VAGUE_NAMES = ("utils", "util", "misc", "common", "helpers", "helper")
LONGEST = 400
MOST_FILES = 20


class Import(NamedTuple):
    target: str  # resolved to a module of the package where it is one
    line: int
    in_function: bool
    star: bool


def _modules(root, package):
    """Dotted module name -> file, a package's `__init__.py` under the package's own name."""
    parts = {path: path.relative_to(root).with_suffix("").parts for path in sorted(root.rglob("*.py"))}
    return {
        ".".join((package, *(part for part in names if part != "__init__"))): path
        for path, names in parts.items()
    }


def _statements(node, inside=False):
    """All statements in a node, and whether they stand in a function."""
    yield node, inside
    inside |= isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    for block in ("body", "orelse", "finalbody", "handlers", "cases"):
        for inner in getattr(node, block, ()):
            yield from _statements(inner, inside)


def _imports(module, path, known):
    above = [*module.split("."), *(["__init__"] if path.name == "__init__.py" else [])]
    for node, inside in _statements(ast.parse(path.read_text())):
        if isinstance(node, ast.Import | ast.ImportFrom):
            level, named = getattr(node, "level", 0), getattr(node, "module", None)
            base = ".".join([*above[: -level if level else 0], *([named] if named else [])])
            for name in (alias.name for alias in node.names):
                target = (
                    name
                    if isinstance(node, ast.Import)
                    else f"{base}.{name}"
                    if f"{base}.{name}" in known
                    else base
                )
                yield Import(target, node.lineno, inside, name == "*")


def _rank(module, package):
    """Place of a module's layer in the table, the first name below the package; None where it has none."""
    layer = module.removeprefix(package).lstrip(".").split(".")[0] or "__init__"
    return len(LAYERS) if layer in ENTRY_MODULES else LAYERS.index(layer) if layer in LAYERS else None


def _cycles(edges):
    """One line per cycle of modules, found by depth-first search."""
    found, done = [], set()

    def walk(module, path):
        if module in path:
            found.append("cycle: " + " -> ".join([*path[path.index(module) :], module]))
        elif module not in done:
            for target in sorted(edges.get(module, ())):
                walk(target, [*path, module])
            done.add(module)

    for module in sorted(edges):
        walk(module, [])
    return found


def violations(root, package):
    """Every breach of the rules in the tree at `root`, one sentence each."""
    known = _modules(root, package)
    files = [path for path in known.values() if path.name not in ("__init__.py", "__main__.py")]
    folders, names = Counter(path.parent for path in files), Counter(path.name for path in files)
    found = [
        f"{folder.name}: {n} files, more than {MOST_FILES}" for folder, n in folders.items() if n > MOST_FILES
    ]
    found += [f"{n} files are named {name}" for name, n in names.items() if n > 1]
    edges: dict[str, set[str]] = {}
    for module, path in known.items():
        rank = _rank(module, package)
        if rank is None:
            found.append(f"{module} is not in the layer table")
            continue
        if any(part in VAGUE_NAMES for part in module.split(".")):
            found.append(f"{module}: vague name")
        if (lines := len(path.read_text().splitlines())) > LONGEST:
            found.append(f"{module}: {lines} lines, more than {LONGEST}")
        for item in _imports(module, path, known):
            where, top = f"{module}:{item.line}: {item.target}", item.target.split(".")[0]
            within = top == package
            broken = {
                "star import": item.star,
                "import inside a function": item.in_function and top not in OPTIONAL.split(),
                "belongs to another layer": top in OWNERS and module.split(".")[1] not in OWNERS[top],
                "lies above": within and (_rank(item.target, package) or 0) > rank,
            }
            found += [f"{where}: {rule}" for rule, is_broken in broken.items() if is_broken]
            if within and item.target != module:
                edges.setdefault(module, set()).add(item.target)
    return found + _cycles(edges)


def test_imports_point_down_the_layer_table():
    modules = _modules(SOURCE, PACKAGE)
    assert modules, f"no source found in {SOURCE}"
    found = violations(SOURCE, PACKAGE)
    assert not found, "\n".join(found)
