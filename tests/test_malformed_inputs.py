"""Every malformed input of the tables is answered with the right kind of error, or code, and with words that say what to do.

The cases run in a process of their own, without the run-time type checks of the other tests, which would answer first.
"""

import json
import os
import subprocess
import sys

import malformed_fits
import malformed_inputs
import malformed_studies
import pytest

TABLES = (malformed_inputs, malformed_fits, malformed_studies)
CASES = {code: answer for table in TABLES for code, answer in table.TABLE.items()}
RUN = """
import gc, json, sys
from jourdain_jax.native import host

gc.disable()  # a process of some seconds
host.EFFORT = 0  # of LLVM, as in the other tests
for prelude, codes in json.load(sys.stdin):
    names = {}
    exec(prelude, names)
    for code in codes:
        try:
            answer = eval(code, names)
            answer = answer if isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], str) else ("accepted", repr(answer)[:200])
        except Exception as error:
            answer = ("/".join(kind.__name__ for kind in type(error).__mro__), str(error))  # a kind of ValueError is one
        print("ANSWER", json.dumps(answer))
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What every case is answered with."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path), "JAX_PLATFORMS": "cpu"}
    folder = tmp_path_factory.mktemp("malformed")
    asked = json.dumps([(table.PRELUDE, list(table.TABLE)) for table in TABLES])
    run = subprocess.run([sys.executable, "-c", RUN], input=asked, capture_output=True, text=True, env=environment, cwd=folder)
    assert run.returncode == 0, run.stderr
    refused = {"lanes.npz", "b.npz", "run.mp4", "run.gif", "run.xyz", "lane-0.gif", "nowhere", "x"}
    assert refused.isdisjoint(path.name for path in folder.iterdir()), "a refused file was written"
    lines = [line.removeprefix("ANSWER ") for line in run.stdout.splitlines() if line.startswith("ANSWER ")]
    return dict(zip(CASES, map(json.loads, lines), strict=True))


def test_no_case_stands_in_two_tables():
    assert len(CASES) == sum(len(table.TABLE) for table in TABLES) > 400


@pytest.mark.parametrize("code", CASES)
def test_malformed_input_is_named_with_what_is_expected(code, answers):
    case = CASES[code]
    kind, words = ("ValueError", case) if isinstance(case, str) else case
    found, text = answers[code]
    assert all(part in text for part in words.split(" ... ")), text
    assert kind in found.split("/"), text
