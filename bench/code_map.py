"""Size of the package, layer by layer, and how much of it one simulation runs.

    python bench/code_map.py [--quick] [--json FILE]

What is read from the source: files and lines of every layer (a package of `src/jourdain_jax`; their order is that of `tests/test_layers.py`), and the
files that `motion/simulate.py` imports, directly or through others.

What is measured, in a fresh process for each model, with every call of a Python function observed: the files of the package of which some function runs

    start       in the first `jj.start` of the model's example, which also probes the structure of the scene
    first       in the first `jj.simulate(scene, start, t1=...)`, which lowers and compiles
    second      in the second one, which finds all that is kept

and calls that go up: a function that was called, through jax or directly, by one of a lower layer. Imports point down only, so these are functions that a
lower layer was handed. Steps of generators do not count as calls, and the methods of the scene itself (the layer `models`) count apart.

The JSON is a list of {"figure", "model", "value", "required", "met"}. `--quick`: one model.
"""

import argparse
import ast
import inspect
import json
import os
import statistics
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "jourdain_jax"
SOURCE = ROOT / "src" / PACKAGE
TOP = "(top)"  # modules above all layers
MOST_LINES, MOST_FILES = {"all": 17_000, "equations": 1_300}, 20  # of the package, of the equations of motion; that a call runs
ENTRY = "motion/simulate.py"
MODELS = ("tilting-disc", "skate", "whipple-bicycle")
CALLS = ("start", "first", "second")


def layers() -> tuple[str, ...]:
    """The layers from bottom to top, as `tests/test_layers.py` states them."""
    for node in ast.parse((ROOT / "tests" / "test_layers.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "LAYERS":
            return ast.literal_eval(node.value)
    raise ValueError("tests/test_layers.py states no LAYERS")


def layer_of(file: str) -> str:
    """The layer of a file, given by its path within the package."""
    return file.split("/")[0] if "/" in file else TOP


def lines_of_files() -> dict[str, int]:
    """Number of lines of every source file, by its path within the package."""
    return {path.relative_to(SOURCE).as_posix(): len(path.read_text(encoding="utf-8").splitlines()) for path in sorted(SOURCE.rglob("*.py"))}


def packages() -> set[str]:
    """Names of the packages directly below the package."""
    return {path.parent.name for path in SOURCE.glob("*/__init__.py")}


def imported(file: str) -> set[str]:
    """Files of the package that a file imports by its own statements."""
    found = set()
    for node in ast.walk(ast.parse((SOURCE / file).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = [PACKAGE, *file.split("/")[:-1]][: len(file.split("/")) + 1 - node.level] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            found |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    paths = (name.removeprefix(f"{PACKAGE}.").replace(".", "/") + ".py" for name in found if name.startswith(f"{PACKAGE}."))
    return {path for path in paths if (SOURCE / path).is_file()}


def import_closure(file: str) -> set[str]:
    """The file, and all files of the package that it imports, directly or through others; `__init__` files are left out."""
    found, waiting = set(), [file]
    while waiting:
        new = waiting.pop()
        if new not in found:
            found.add(new)
            waiting += imported(new)
    return found


def observed(call: Callable[[], object]) -> tuple[object, dict]:
    """What `call` returns; and calls per file of the package, calls that went up a layer, those of them to methods of models."""
    order, root = {name: k for k, name in enumerate(layers())}, f"{SOURCE}/"
    files: Counter[str] = Counter()
    up: Counter[tuple[str, str]] = Counter()

    def own(frame) -> str | None:
        path = frame.f_code.co_filename
        return path[len(root) :] if path.startswith(root) else None

    def look(frame, event, argument):
        called = own(frame) if event == "call" else None
        if called is None or frame.f_code.co_name == "<module>":
            return
        files[called] += 1
        if frame.f_code.co_flags & inspect.CO_GENERATOR:
            return
        caller = frame.f_back
        while caller is not None and own(caller) is None:
            caller = caller.f_back
        if caller is not None and order.get(layer_of(called), 0) > order.get(layer_of(own(caller)), len(order)):
            up[(f"{own(caller)}: {caller.f_code.co_qualname}", f"{called}: {frame.f_code.co_qualname}")] += 1

    threading.setprofile(look)
    sys.setprofile(look)
    try:
        result = call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return result, {"files": dict(files), "up": [[*pair, count] for pair, count in up.most_common()]}


def observed_calls(model: str) -> dict[str, dict]:
    """What a start and two simulations of a model run; for a process that has done nothing before."""
    import jax

    import jourdain_jax as jj

    scene = jj.models.MODELS[model]()
    start, first_start = observed(lambda: jax.block_until_ready(jj.start(scene, **scene.example)))
    found = {"start": first_start}
    for name in CALLS[1:]:
        motion, found[name] = observed(lambda: jax.block_until_ready(jj.simulate(scene, start, t1=scene.example_span)))
        motion.raise_if_failed()
    return found


def in_fresh_process(model: str) -> dict[str, dict]:
    """`observed_calls` of a model, in a process of its own."""
    paths = [str(SOURCE.parent), *filter(None, [os.environ.get("PYTHONPATH")])]  # this source, whatever is installed
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    done = subprocess.run([sys.executable, __file__, "--observe", model], env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"`{model}` failed: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else done.returncode}")
    return json.loads(done.stdout.splitlines()[-1])


def figure(name: str, model: str, value: float, required: float | None = None) -> dict:
    """One entry of the JSON; `required`: the largest value that is allowed."""
    return {"figure": name, "model": model, "value": value, "required": required, "met": required is None or value <= required}


def figures_of_source() -> Iterator[dict]:
    """Sizes, and what the entry imports."""
    lines = lines_of_files()
    for layer in (*layers(), TOP):
        own = [count for file, count in lines.items() if layer_of(file) == layer]
        yield figure("files", layer, len(own))
        yield figure("lines", layer, sum(own), MOST_LINES.get(layer))
    yield figure("files", "all", len(lines))
    yield figure("lines", "all", sum(lines.values()), MOST_LINES["all"])
    yield figure("lines of the median file", "all", statistics.median(lines.values()))
    yield figure("lines of the longest file", max(lines, key=lines.__getitem__), max(lines.values()))
    closure = import_closure(ENTRY)
    yield figure("files imported, directly or through others", ENTRY, len(closure))
    yield figure("lines imported, directly or through others", ENTRY, sum(lines[file] for file in closure))


def figures_of_calls(model: str, found: dict[str, dict]) -> Iterator[dict]:
    """What the calls of one model run."""
    said = {"start": "first start", "first": "first simulate", "second": "second simulate"}
    for name in CALLS:
        files, up = found[name]["files"], found[name]["up"]
        yield figure(f"files run, {said[name]}", model, len(files), MOST_FILES if name == "second" else None)
        yield figure(f"lines of the files run, {said[name]}", model, sum(count for file, count in lines_of_files().items() if file in files))
        yield figure(f"calls of own functions, {said[name]}", model, sum(files.values()))
        of_scene = sum(count for _, called, count in up if layer_of(called) == "models")
        yield figure(f"calls up the layers, {said[name]}", model, sum(count for *_, count in up) - of_scene)
        yield figure(f"calls of the scene's own methods, {said[name]}", model, of_scene)
    cold = set(found["start"]["files"]) | set(found["first"]["files"])
    yield figure("files run, first start and first simulate together", model, len(cold))


def source_table() -> Iterator[str]:
    """Files and lines of every layer, bottom first."""
    lines = lines_of_files()
    closure = import_closure(ENTRY)
    yield f"{'layer':<12}{'files':>7}{'lines':>8}{'median':>8}{'longest':>9}  longest file"
    for layer in (*layers(), TOP, "all"):
        own = {file: count for file, count in lines.items() if layer in ("all", layer_of(file))}
        longest = max(own, key=own.__getitem__, default="")
        yield f"{layer:<12}{len(own):>7}{sum(own.values()):>8}{statistics.median(own.values() or [0]):>8.0f}{own.get(longest, 0):>9}  {longest}"
    yield f"{ENTRY} imports {len(closure)} files, itself included, of {sum(lines[file] for file in closure)} lines, directly or through others"


def calls_table(model: str, found: dict[str, dict]) -> Iterator[str]:
    """Files that ran, by layer, and calls that went up."""
    counts = {name: Counter(layer_of(file) for file in found[name]["files"]) for name in CALLS}
    yield f"{model}: files run in the first start, the first and the second simulate"
    for layer in (*layers(), TOP):
        if any(count[layer] for count in counts.values()):
            here = " ".join(sorted(file.removeprefix(f"{layer}/").removesuffix(".py") for file in found["second"]["files"] if layer_of(file) == layer))
            yield f"  {layer:<12}" + "".join(f"{counts[name][layer]:>6}" for name in CALLS) + f"   {here}"
    yield f"  {'all':<12}" + "".join(f"{sum(counts[name].values()):>6}" for name in CALLS) + "   (names: those of the second simulate)"
    for name in CALLS:
        shown = [(caller, called, count) for caller, called, count in found[name]["up"] if layer_of(called) != "models"]
        yield f"  calls up, {name}: {sum(count for *_, count in shown)}"
        yield from (f"    {count:>5}  {caller}  ->  {called}" for caller, called, count in shown)


def main() -> int:
    """Measure, print, write; exit code 1 where a model failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=f"only {MODELS[0]}")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    parser.add_argument("--observe", metavar="MODEL", help="print what one model runs, as JSON, in this process")
    options = parser.parse_args()
    if options.observe:
        print(json.dumps(observed_calls(options.observe)))
        return 0
    print("\n".join(source_table()))
    figures, failures = list(figures_of_source()), 0
    for model in MODELS[:1] if options.quick else MODELS:
        try:
            found = in_fresh_process(model)
        except RuntimeError as error:
            failures += 1
            print(error, file=sys.stderr, flush=True)
            continue
        print("\n" + "\n".join(calls_table(model, found)), flush=True)
        figures += figures_of_calls(model, found)
    print()
    for entry in figures:
        if entry["required"] is not None:
            print(f"{'met ' if entry['met'] else 'MISS'} {entry['value']:>7} (required {entry['required']})  {entry['figure']}: {entry['model']}")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
