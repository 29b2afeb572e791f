"""Size of the code by one rule, and how much of the package one simulation runs.

    python bench/code_map.py [--quick] [--json FILE] [--private]

Read from the source: code tokens of every folder (docstrings, comments and layout are free, a string counts
one per 40 characters begun, as Python 3.11 splits text); test files that reach names below the top level of
the package, through other files of `tests` too; caches (decorators, containers at module level that are
filled later); numbers at module level and as defaults of classes; tests for tracers; functions with more than
8 parameters.

Measured, in a fresh process for each model that has imported the whole package, with every call of a Python
function observed: files of the package of which some function runs

    build       in the first `jj.build` of the model
    first       in the first `jj.simulate(scene, start, t1=...)` after it
    gradient    in the first gradient of its end with respect to the start
    warm        in one more `jj.simulate`

`tests/test_code_map.py` holds what is read as ceilings, `tests/test_call_costs.py` the files of the first
model. The JSON is a list of {"figure", "model", "value", "required", "met"}; `--quick`: one model;
`--private`: which private modules every test file reaches.
"""

import ast
import importlib
import inspect
import pkgutil
import re
import sys
import threading
import tokenize
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path

from figures import figure, fresh, main

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "jourdain_jax"
SOURCE = ROOT / "src" / PACKAGE
FOLDERS = ("src", "tests", "bench", "docs", "notebooks")
PUBLIC = {PACKAGE, *(f"{PACKAGE}.{name}" for name in ("models", "bicycle", "cli", "dynamics.reduced"))}
PUBLIC |= {f"{PACKAGE}.{name}" for name in ("analysis", "equations", "identification", "studies")}
# below public names, tests may speak to the scalar program and its operations, also as machine code, and to
# one step
SEAMS = tuple(
    f"{PACKAGE}.{name}" for name in ("program", "calculus.scalar_operations", "integrate.loop.step")
)
THROUGH = "evaluated_natively"  # the file of `tests` that runs a scalar program as machine code
CACHES = {"cache", "lru_cache", "cached_property"}
CONTAINERS = {"dict", "list", "set", "defaultdict", "OrderedDict", "Counter", "deque"}
CONTAINERS |= {f"Weak{kind}" for kind in ("KeyDictionary", "ValueDictionary", "Set")}
TRACERS = {"is_traced", "is_traced_type", "nothing_is_traced", "checked_unless_traced", "Tracer"}
TRACERS |= {"ConcretizationTypeError", "TracerBoolConversionError"}
MOST_PARAMETERS = 8
MOST_FILES = {"build": 70, "first": 35, "gradient": 50, "warm": 20}  # of the first model
MODELS = ("tilting-disc", "skate", "whipple-bicycle")
# A comment, a string or another token; f-strings are one string, as for Python 3.11.
STRING = r"""(?:[rbfu]|[bf]r|r[bf])?(?:'''(?:[^\\]|\\.)*?'''|\"{3}(?:[^\\]|\\.)*?\"{3}"""
STRING += r"""|'(?:[^\\\n']|\\.)*'|"(?:[^\\\n"]|\\.)*")"""
TOKEN = re.compile(
    rf"#[^\n]*|(?P<string>{STRING})|(?P<other>{tokenize.Number}|\w+|{tokenize.Special})",
    re.DOTALL | re.IGNORECASE,
)


def layers():
    """Return the layers from bottom to top, as `tests/test_layers.py` states them."""
    for node in ast.parse((ROOT / "tests" / "test_layers.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LAYERS":
            return ast.literal_eval(node.value)
    raise ValueError("tests/test_layers.py states no LAYERS")


def packages():
    """Return the names of the packages directly below the package."""
    return {path.parent.name for path in SOURCE.glob("*/__init__.py")}


def statements(node: ast.AST):
    """Yield a node and all statements in it, without their expressions."""
    yield node
    for block in ("body", "orelse", "finalbody", "handlers", "cases"):
        for inner in getattr(node, block, ()):
            yield from statements(inner)


def code_tokens(text, tree=None):
    """Return the number of code tokens of a file."""
    documented = {
        node.body[0].lineno
        for node in statements(tree or ast.parse(text))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and ast.get_docstring(node, clean=False) is not None
    }
    total, line, at = 0, 1, 0
    for token in TOKEN.finditer(text):
        if token["string"]:
            line, at = line + text.count("\n", at, token.start()), token.start()
            total += 0 if line in documented else 1 + (len(token["string"]) - 1) // 40
        else:
            total += token["other"] is not None
    return total


def modules_imported(path):
    """Return the names of the modules that a file imports, those of the package and of `tests` as far down as
    a file goes.
    """
    found = set()
    for node in statements(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            deeper = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            found |= {name if _file(name) else node.module for name in deeper.values()}
    return found


@cache
def _file(module) -> Path | None:
    """Return the file of a module of the package or of `tests`."""
    for root in (ROOT / "src", ROOT / "tests"):
        path = root.joinpath(*module.split("."))
        for file in (path.with_suffix(".py"), path / "__init__.py"):
            if file.is_file():
                return file
    return None


def private_modules(path, known):
    """Return the modules of the package that a file of `tests` reaches, itself or through others there,
    beyond public ones and the seams.
    """
    if path not in known:
        known[path] = set()
        for module in modules_imported(path):
            if module.split(".")[0] == PACKAGE:
                seam = any(module == name or module.startswith(f"{name}.") for name in SEAMS)
                known[path] |= set() if seam or module in PUBLIC else {module}
            elif module != THROUGH and (other := _file(module)) is not None:
                known[path] |= private_modules(other, known)
    return known[path]


@cache
def reaching():
    """Return the private modules that every test file reaches, by the name of the file, where there are
    any.
    """
    known: dict[Path, set[str]] = {}
    files = sorted((ROOT / "tests").glob("test_*.py"))
    found = {path.name: sorted(private_modules(path, known)) for path in files}
    return {name: modules for name, modules in found.items() if modules}


def counted(tree: ast.Module) -> Counter:
    """Return caches, numbers, tests for tracers and functions with many parameters of a file."""
    found: Counter = Counter()
    for node in ast.walk(tree):
        name = getattr(node, "id", None) or getattr(node, "attr", None)
        found["caches"] += name in CACHES
        found["tests for a tracer"] += name in TRACERS
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            every = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
            many = sum(x.arg not in ("self", "cls") for x in every) > MOST_PARAMETERS
            found[f"functions with more than {MOST_PARAMETERS} parameters"] += many
    for body in (tree.body, *(node.body for node in tree.body if isinstance(node, ast.ClassDef))):
        for value in (node.value for node in body if isinstance(node, ast.Assign | ast.AnnAssign)):
            found["caches"] += body is tree.body and _is_empty(value)
            numbers = value.elts if isinstance(value, ast.Tuple) else [value]
            found["named numbers"] += sum(map(_is_number, numbers))
    return found


def _is_empty(value: ast.expr | None):
    """Return whether this makes a container with nothing in it."""
    if isinstance(value, ast.Call):
        name = getattr(value.func, "id", None) or getattr(value.func, "attr", None)
        return name in CONTAINERS and all(isinstance(argument, ast.Name) for argument in value.args)
    return value is not None and ast.unparse(value) in ("{}", "[]")


def _is_number(value: ast.expr | None):
    """Return whether this is a number, or worked out from one."""
    if isinstance(value, ast.BinOp):
        return _is_number(value.left) or _is_number(value.right)
    if isinstance(value, ast.UnaryOp):
        return _is_number(value.operand)
    return isinstance(value, ast.Constant) and type(value.value) in (int, float)


def figures_of_source():
    """Return what is read from the source."""
    found: Counter = Counter()
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py*")):
            if path.suffix in (".py", ".pyi"):
                tree = ast.parse(text := path.read_text(encoding="utf-8"))
                found[f"code tokens of {folder}"] += code_tokens(text, tree)
                found += counted(tree) if folder == "src" else Counter()
    found["test files that reach private names"] = len(reaching())
    return dict(found) | ways()


def ways():
    """Return the number of ways of each fact that the page on the packages lists."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("\n## Ways\n")[1]
    rows = re.findall(r"^\| ([^|`]+) \| ([^|]*`[^|]*) \|$", page, re.MULTILINE)
    return {f"ways: {fact}": listed.count(";") + 1 for fact, listed in rows}


def observed(call: Callable[[], object]):
    """Return what `call` returns, and calls of Python functions per file of the package."""
    files: Counter[str] = Counter()
    root = f"{SOURCE}/"

    def look(frame, event, argument):
        code = frame.f_code
        own = event == "call" and code.co_filename.startswith(root) and code.co_name != "<module>"
        if own and not code.co_flags & inspect.CO_GENERATOR:
            files[code.co_filename[len(root) :]] += 1

    threading.setprofile(look)
    sys.setprofile(look)
    try:
        result = call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return result, dict(files)


def observed_calls(model):
    """Return what the calls run for a model; for a process that has done nothing before."""
    import jax

    import jourdain_jax as jj

    for module in pkgutil.walk_packages(jj.__path__, f"{PACKAGE}."):  # classes and decorators of an import
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    scene = jj.models.MODELS[model]()
    span = scene.example_span
    _, built = observed(lambda: jj.build(scene))
    start = jj.start(scene, **scene.example)

    def moved():
        return jax.block_until_ready(jj.simulate(scene, start, t1=span))

    def slope():
        end = lambda start: jj.simulate(scene, start, t1=span).q_end.sum()
        return jax.block_until_ready(jax.grad(end)(start))

    motion, first = observed(moved)
    motion.raise_if_failed()
    return {"build": built, "first": first, "gradient": observed(slope)[1], "warm": observed(moved)[1]}


def source(quick):
    """Yield what is read from the source."""
    yield from (figure(name, "all", value) for name, value in figures_of_source().items())


def calls(quick):
    """Yield how much of the package runs, for every model."""
    for model in MODELS[: 1 if quick else None]:
        program = "import code_map, json, sys; print(json.dumps(code_map.observed_calls(sys.argv[1])))"
        found = fresh(program, model)
        for name, files in found.items():
            most = MOST_FILES[name] if model == MODELS[0] else None
            yield figure(f"files run, {name}", model, len(files), most)
            yield figure(f"calls of own functions, {name}", model, sum(files.values()))
        yield figure("files run, build, first and gradient", model, len(set().union(*found.values())))


if __name__ == "__main__":
    if "--private" in sys.argv:
        print(*(f"{name}: {' '.join(modules)}" for name, modules in reaching().items()), sep="\n")
    else:
        main(__doc__, (source, calls))
