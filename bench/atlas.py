"""The atlas of where methods fail: hard cases E1 to E36, every method, float64 and float32.

    python bench/atlas.py [--quick] [--json FILE] [--out DIR] [--case NAME ...] [--method NAME ...]
    python bench/atlas.py --redraw FILE --out DIR

Writes a list of {"case", "method", "dtype", "outcome", "error", "tolerance", "mechanism"}, tables and a
picture (PNG and SVG). The engine as it comes is the method `default`. Each floating-point type runs in a
process of its own: JAX chooses it once.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from floats import HERE, TYPES, environment

sys.path[:0] = [str(HERE), str(HERE.parent / "tests")]  # `tests/oracles` holds the closed forms


def chosen(arguments):
    """The cases and methods that were asked for."""
    from atlas_cases.cases import CASES
    from atlas_cases.methods import METHODS

    cases = tuple(
        case
        for case in CASES
        if (not arguments.quick or case.quick) and (not arguments.case or case.name in arguments.case)
    )
    return cases, tuple(
        method for method in METHODS if not arguments.method or method.name in arguments.method
    )


def measure(arguments) -> list[dict]:
    """All cells in the floating-point type of this process; what there is so far is written after every
    case.
    """
    from atlas_cases.run import cells

    found: list[dict] = []

    def report(text: str) -> None:
        print(text, file=sys.stderr, flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(found))

    for cell in cells(*chosen(arguments), progress=report):
        found.append(cell)
    return found


def in_process(dtype: str, arguments) -> list[dict]:
    """The cells of one floating-point type, by a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cells.json"
        command = [
            sys.executable,
            __file__,
            "--only-dtype",
            dtype,
            "--json",
            str(path),
            *(["--quick"] if arguments.quick else []),
        ]
        for option in ("case", "method"):
            command += [f"--{option}", *getattr(arguments, option)] if getattr(arguments, option) else []
        subprocess.run(command, env=os.environ | environment(dtype), check=True)
        return json.loads(path.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="seven cases")
    parser.add_argument("--json", type=Path, help="file for the list of cells")
    parser.add_argument("--out", type=Path, help="folder for the picture and the tables")
    parser.add_argument("--case", nargs="*", help="only these cases")
    parser.add_argument("--method", nargs="*", help="only these methods")
    parser.add_argument(
        "--redraw",
        type=Path,
        metavar="FILE",
        help="measure nothing: picture and tables of what is in this file",
    )
    parser.add_argument("--only-dtype", choices=TYPES, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.redraw:
        found = json.loads(arguments.redraw.read_text())
    elif arguments.only_dtype:
        found = measure(arguments)
    else:
        found = [cell for dtype in TYPES for cell in in_process(dtype, arguments)]
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")
    if arguments.only_dtype:
        return
    from atlas_cases.draw import draw
    from atlas_cases.tables import summary, write_tables

    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        draw(found, arguments.out)
        write_tables(found, arguments.out)
    print(summary(found))


if __name__ == "__main__":
    main()
