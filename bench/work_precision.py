"""Work-precision charts: error against time for four problems, this engine's methods and its peers, each at
its best settings.

    taskset -c 0 python bench/work_precision.py [--quick] [--json FILE] [--out DIR] [--problem NAME ...]
        [--part NAME ...]
    python bench/work_precision.py --redraw FILE --out DIR

Writes a list of records (see `work_precision_cases/record.py`), among them how every reference was obtained
({"reference", ...}); pictures (PNG and SVG); a table. The main chart is `work_precision.png`.
Times are wall time of the fastest of some warm runs. Peers that are not installed are skipped with a message.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
sys.path[:0] = [str(HERE), str(HERE.parent / "tests")]  # `tests/oracles` holds the closed forms
PARTS = ("curves", "batches")
BEGIN = time.perf_counter()


def say(text: str) -> None:
    """A line with the time since the start."""
    print(f"[{time.perf_counter() - BEGIN:6.0f} s] {text}", flush=True)


def curves(names, quick: bool) -> Iterator[dict]:
    """References and single trajectories."""
    from figures import figure
    from work_precision_cases import (
        measure,
        ours,
        peer_c,
        peer_diffrax,
        peer_exudyn,
        peer_heyoka,
        peer_mujoco,
        peer_sympy,
    )
    from work_precision_cases.problems import PROBLEMS

    for name in names:
        problem = PROBLEMS[name]
        reference = problem.truth
        say(f"{name}: {reference.how}; {reference.uncertainty:.1e} from {reference.against}")
        yield figure("uncertainty of the reference", name, reference.uncertainty) | {
            "reference": name,
            "how": reference.how,
            "against": reference.against,
            "uncertainty": reference.uncertainty,
        }
        peers = [
            *peer_sympy.curves(problem, quick),
            *peer_c.curves(problem),
            *peer_heyoka.curves(problem),
            *peer_diffrax.curves(problem),
        ]
        for curve in [
            *ours.curves(problem, quick),
            *peers,
            *peer_exudyn.curves(problem, quick),
            *peer_mujoco.curves(problem, quick),
        ]:
            yield from measure.points(problem, curve, say)[0]


def measured(arguments) -> Iterator[dict]:
    """All records."""
    from work_precision_cases import batches
    from work_precision_cases.problems import PROBLEMS, QUICK

    names, quick = arguments.problem or (QUICK if arguments.quick else tuple(PROBLEMS)), arguments.quick
    if "curves" in arguments.part:
        yield from curves(names, quick)
    for name in names:
        if "batches" in arguments.part and name in batches.PROBLEMS:
            say(f"batches: {name}")
            yield from batches.measured(PROBLEMS[name], quick, say)


def main() -> None:
    """Measure, or read what was measured; draw and tabulate."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="disc and sleigh, fewer methods: under two minutes"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="file for the list of records")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for pictures")
    parser.add_argument("--problem", nargs="*", metavar="NAME", help="only these problems")
    parser.add_argument("--part", nargs="*", choices=PARTS, default=list(PARTS), help="only these parts")
    parser.add_argument(
        "--redraw", type=Path, metavar="FILE", help="measure nothing: draw what is in this file"
    )
    arguments = parser.parse_args()
    if arguments.redraw:
        found = json.loads(arguments.redraw.read_text(encoding="utf-8"))
    else:
        say(f"Python {platform.python_version()}, {platform.machine()}, float64")
        found = []
        for entry in measured(arguments):
            found.append(entry)
            if arguments.json:
                arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if arguments.out:
        from work_precision_cases.draw import draw

        arguments.out.mkdir(parents=True, exist_ok=True)
        draw(found, arguments.out)


if __name__ == "__main__":
    main()
