"""What the scripts share: entries of their JSON, the command line that measures, prints and writes, processes
of their own, and warm times.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path

import jax

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent / "tests"))  # closed forms, and small scenes


def figure(name: str, model: str, value, most: float | None = None, *, least: float | None = None) -> dict:
    """Return one entry: what was measured (None: it could not be), and whether it keeps the bounds that are
    given.
    """
    value = value.item() if hasattr(value, "item") else value
    bounds = [bound for bound in (least, most) if bound is not None]
    required = bounds if len(bounds) == 2 else (*bounds, None)[0]
    met = value is not None and (most is None or value <= most) and (least is None or value >= least)
    return {"figure": name, "model": model, "value": value, "required": required, "met": met or not bounds}


def main(
    about: str,
    parts: dict | Iterable[Callable],
    *,
    quick: Iterable[str] | None = None,
    out: Path | None = None,
    drawn: Callable | None = None,
) -> None:
    """Measure the parts that are asked for, print every figure as it comes, and write what there is so far;
    exit code 1 where a part raised an error.

    **Arguments:** `parts`, functions by name (or their own names) that take whether to be quick (a bool),
    and the folder of `--out` where `out`, its default, is given, and yield figures; `quick`, the names that
    `--quick` is left with; `drawn`, where given, takes all figures and that folder instead, also for
    `--redraw`.
    """
    parts = parts if isinstance(parts, dict) else {part.__name__: part for part in parts}
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to this file")
    parser.add_argument(
        "--only", nargs="+", choices=parts, metavar="NAME", help=f"only these: {', '.join(parts)}"
    )
    if out is not None:
        where = "folder of pictures and tables (default: with --quick a temporary one)"
        parser.add_argument("--out", type=Path, metavar="DIR", help=where)
    if drawn:
        parser.add_argument("--redraw", type=Path, metavar="FILE", help="measure nothing: draw this file")
    given, found, more = parser.parse_args(), [], []
    if out is not None:
        more = [given.out or (Path(tempfile.mkdtemp()) if given.quick else out)]
        more[0].mkdir(parents=True, exist_ok=True)

    def add(entry: dict) -> None:
        found.append(entry)
        value = f"{entry['value']:.4g}" if isinstance(entry["value"], float) else str(entry["value"])
        asked = "" if entry["required"] is None else f" (required {entry['required']})"
        print(
            f"{value:>10}  {entry['figure']}, {entry['model']}{asked}{'' if entry['met'] else ' MISSED'}",
            flush=True,
        )
        write()

    def write() -> None:
        if given.json:
            given.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")

    raised, folder = False, more.pop() if drawn else None
    if drawn and given.redraw:
        drawn(json.loads(given.redraw.read_text(encoding="utf-8")), folder)
        return
    write()
    for name in given.only or (quick if given.quick and quick is not None else parts):
        try:
            for entry in parts[name](given.quick, *more):
                add(entry)
        except Exception as error:
            raised = True
            traceback.print_exc()
            said = f"{type(error).__name__}: {error}"[:200]
            add(figure(f"{name} raised an error", "", said) | {"met": False})
    if drawn:
        drawn(found, folder)
    sys.exit(raised)


def fresh(program: str, *arguments, **environment: str):
    """Return what the last line of a program's output says as JSON; it runs in a process of its own and finds
    the modules that this one finds.
    """
    paths = os.pathsep.join(filter(None, [str(HERE), str(HERE.parent / "src"), *sys.path]))
    command = [sys.executable, "-c", program, *map(str, arguments)]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": paths} | environment, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"{arguments}: {(done.stderr.strip().splitlines() or [done.returncode])[-1]}")
    print(*done.stdout.splitlines()[:-1], sep="\n", end="")
    return json.loads(done.stdout.splitlines()[-1])


def markdown(head: Iterable[str], rows: Iterable[Iterable]) -> list[str]:
    """Return the lines of a table."""
    lines = [f"| {' | '.join(map(str, row))} |" for row in (head, *rows)]
    return [lines[0], "|" + "---|" * len(head), *lines[1:]]


def seconds_of(call: Callable, clock: Callable = time.process_time) -> tuple:
    """Return what a call gives, and its seconds (of processor time, unless another clock is given) until all
    of it is there.
    """
    begin = clock()
    found = jax.block_until_ready(call())
    return found, clock() - begin


def compiled(function: Callable, *arguments) -> tuple:
    """Return a call of a function with these arguments, and the processor time, s, that it took to trace and
    compile it.
    """
    begin = time.process_time()
    run = jax.jit(function).lower(*arguments).compile()
    return lambda: jax.block_until_ready(run(*arguments)), time.process_time() - begin


def fastest(run: Callable, repeats: int) -> float:
    """Return the wall time of the fastest of some runs after a first one that compiles, s."""
    run()
    return min(seconds_of(run, time.perf_counter)[1] for _ in range(repeats))


def least_processor_time(runs: dict, repeats: int) -> dict:
    """Return the processor time of each run, s: the least of some repeats, in turn, after a first one that
    compiles.
    """
    for run in runs.values():
        run()
    laps = [{name: seconds_of(run)[1] for name, run in runs.items()} for _ in range(repeats)]
    return {name: min(lap[name] for lap in laps) for name in runs}
