"""The atlas of where methods fail: hard cases E1 to E36, every method, float64 and float32.

    python bench/atlas.py [--quick] [--json FILE] [--out DIR] [--case NAME ...] [--method NAME ...]
    python bench/atlas.py --redraw FILE --out DIR

Writes a list of {"case", "method", "dtype", "outcome", "error", "tolerance", "mechanism"}, tables and a
picture (PNG and SVG). The engine as it comes is the method `default`. Each floating-point type runs in a
process of its own: JAX chooses it once.
"""

import argparse
import json
from pathlib import Path

from floats import TYPES, prepare, processes


def measure(quick, names, methods):
    """The cells that are asked for, in the floating-point type of this process."""
    from atlas_cases.cases import CASES
    from atlas_cases.methods import METHODS
    from atlas_cases.run import cells

    cases = [case for case in CASES if (not quick or case.quick) and (not names or case.name in names)]
    return list(cells(cases, [method for method in METHODS if not methods or method.name in methods]))


def main():
    """Measure, or read what was measured; write, draw and sum up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="seven cases")
    parser.add_argument("--json", type=Path, help="file for the list of cells")
    parser.add_argument("--out", type=Path, help="folder for the picture and the tables")
    parser.add_argument("--case", nargs="*", help="only these cases")
    parser.add_argument("--method", nargs="*", help="only these methods")
    parser.add_argument("--redraw", type=Path, help="measure nothing: draw and sum up what is in this file")
    given, found = parser.parse_args(), []
    if given.redraw:
        found = json.loads(given.redraw.read_text())
    else:
        for dtype in TYPES:
            with processes(dtype) as process:
                found += process.submit(measure, given.quick, given.case, given.method).result()
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    prepare("float64")
    from atlas_cases.draw import draw
    from atlas_cases.tables import summary, write_tables

    if given.out:
        given.out.mkdir(parents=True, exist_ok=True)
        draw(found, given.out)
        write_tables(found, given.out)
    print(summary(found))


if __name__ == "__main__":
    main()
