"""What the README's test command costs: wall and processor time, peak of the sum of resident memory of its
processes, slowest files and tests.

    python bench/suite.py [--quick] [--json FILE]        --quick: three files alone

What is required, of the whole suite alone, is for two idle cores.
"""

import re
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from threading import Thread

import psutil
from figures import HERE, figure, main

COMMAND = [sys.executable, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile"]
QUICK = ("tests/test_simulate.py", "tests/test_deep_programs.py", "tests/test_labelled.py")
_TEST = re.compile(r"^\s*([\d.]+)s (call|setup|teardown)\s+(\S+)", re.MULTILINE)


def suite(quick):
    """Run the command; yield its times in s, its peak in GiB, and the slowest files and tests."""
    command = [*COMMAND, "--durations=0", "--durations-min=0.05", *(QUICK if quick else ())]
    begin, peak, processor = time.perf_counter(), 0, Counter()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    run = subprocess.Popen(command, cwd=HERE.parent, **pipes)
    tree = psutil.Process(run.pid)
    with run.stdout as stream:
        lines = []
        reader = Thread(target=lambda: lines.extend(stream))
        reader.start()
        while run.poll() is None:
            peak = max(peak, _resident(tree, processor))
            time.sleep(0.5)  # between looks at the processes
        reader.join()
    tests, by_file, text = Counter(), Counter(), "".join(lines)
    for seconds, _, name in _TEST.findall(text):
        tests[name] += float(seconds)
        by_file[name.partition("::")[0]] += float(seconds)
    name, seconds, size = ("part of the suite", None, None) if quick else ("suite", 360.0, 5e9 / 2**30)
    yield figure("wall_s", name, time.perf_counter() - begin, seconds)
    yield figure("peak_GiB", name, peak / 2**30, size)
    yield figure("processor_s", name, sum(processor.values()))
    yield from (figure("seconds of a file", name, seconds) for name, seconds in by_file.most_common(15))
    yield from (figure("seconds of a test", name, seconds) for name, seconds in tests.most_common(25))
    if run.returncode:
        raise RuntimeError(text.strip().rpartition("\n")[2])


def _resident(tree: psutil.Process, processor: Counter):
    """Return the sum of resident memory of a process and all below it, bytes; note the processor time of each
    so far.
    """
    total = 0
    with suppress(psutil.NoSuchProcess):  # the command has ended
        for process in (tree, *tree.children(recursive=True)):
            with suppress(psutil.NoSuchProcess), process.oneshot():
                total += process.memory_info().rss
                used = process.cpu_times()
                processor[process.pid] = max(processor[process.pid], used.user + used.system)
    return total


if __name__ == "__main__":
    main(__doc__, (suite,))
