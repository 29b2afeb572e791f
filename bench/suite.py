"""What the README's test command costs: wall and processor time, peak of the sum of resident memory of its processes, slowest files and tests.

python bench/suite.py [--quick] [--json FILE] [--only FILE ...]        --quick: three files alone
"""

import argparse
import json
import re
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from threading import Thread

import psutil

COMMAND = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile"]
REQUIRED = {"wall_s": 360.0, "peak_GiB": 5e9 / 2**30}  # on two idle cores
QUICK = ("tests/test_simulate.py", "tests/test_deep_programs.py", "tests/test_labelled.py")
EVERY = 0.5  # s between looks at the processes
_TEST = re.compile(r"^\s*([\d.]+)s (call|setup|teardown)\s+(\S+)", re.MULTILINE)


def measured(files: tuple[str, ...] = ()) -> dict:
    """Run the command on these files (default: all); return its times in s, its peak in GiB, and the slowest files and tests."""
    root = Path(__file__).resolve().parents[1]
    command = [*COMMAND, "--durations=0", "--durations-min=0.05", *files]
    begin, peak, processor = time.perf_counter(), 0, Counter()
    run = subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    tree = psutil.Process(run.pid)
    with run.stdout as stream:
        lines: list[str] = []
        reader = Thread(target=lambda: lines.extend(stream))
        reader.start()
        while run.poll() is None:
            peak = max(peak, _resident(tree, processor))
            time.sleep(EVERY)
        reader.join()
    tests, by_file, text = Counter(), Counter(), "".join(lines)
    for seconds, _, name in _TEST.findall(text):
        tests[name] += float(seconds)
        by_file[name.partition("::")[0]] += float(seconds)
    return {
        "wall_s": time.perf_counter() - begin,
        "processor_s": sum(processor.values()),
        "peak_GiB": peak / 2**30,
        "passed": run.returncode == 0,
        "ended": text.strip().rpartition("\n")[2],
        "slowest files": dict(by_file.most_common(15)),
        "slowest tests": dict(tests.most_common(25)),
    }


def _resident(tree: psutil.Process, processor: Counter) -> int:
    """Return the sum of resident memory of a process and all below it, bytes; note the processor time of each so far."""
    total = 0
    with suppress(psutil.NoSuchProcess):  # the command has ended
        for process in (tree, *tree.children(recursive=True)):
            with suppress(psutil.NoSuchProcess), process.oneshot():
                total += process.memory_info().rss
                used = process.cpu_times()
                processor[process.pid] = max(processor[process.pid], used.user + used.system)
    return total


def figures(found: dict, whole: bool) -> list[dict]:
    """Return rows of figures as the other scripts write them; only the `whole` suite has required ones."""
    rows = [
        (name, "suite" if whole else "part of the suite", found[name], REQUIRED.get(name) if whole else None) for name in ("wall_s", "peak_GiB", "processor_s")
    ]
    rows += [("seconds of a file", name, seconds, None) for name, seconds in found["slowest files"].items()]
    rows += [("seconds of a test", name, seconds, None) for name, seconds in found["slowest tests"].items()]
    return [{"figure": figure, "model": model, "value": value, "required": most, "met": most is None or value <= most} for figure, model, value, most in rows]


def main() -> None:
    """Measure and print."""
    arguments = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    arguments.add_argument("--quick", action="store_true", help="three files alone")
    arguments.add_argument("--only", nargs="+", default=[], metavar="FILE", help="files of tests")
    arguments.add_argument("--json", type=Path, help="where to write all figures")
    given = arguments.parse_args()
    found = measured(tuple(given.only) or (QUICK if given.quick else ()))
    for name in ("slowest files", "slowest tests"):
        print(name)
        print(*(f"  {seconds:7.1f} s  {what}" for what, seconds in found[name].items()), sep="\n")
    print(found["ended"])
    rows = figures(found, whole=not (given.only or given.quick))
    for row in rows[:3]:
        least = "" if row["required"] is None else f" (required on two idle cores: <= {row['required']:.2f})"
        print(f"{row['figure']}: {row['value']:.2f}{least}")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")
    sys.exit(not found["passed"])


if __name__ == "__main__":
    main()
