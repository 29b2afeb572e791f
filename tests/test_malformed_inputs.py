"""Every malformed input of the table is answered with the right kind of error, or code, and with words that say what to do.

The cases run in a process of their own, without the run-time type checks of the other tests, which would answer first.
"""

import json
import os
import subprocess
import sys

import pytest
from malformed_inputs import PRELUDE, TABLE

RUN = """
import gc

gc.disable()  # a process of some seconds
for code in json.loads(CASES):
    try:
        answer = eval(code)
        answer = answer if isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[0], str) else ("accepted", repr(answer)[:200])
    except Exception as error:
        answer = ("/".join(kind.__name__ for kind in type(error).__mro__), str(error))  # a kind of ValueError is one
    print("ANSWER", json.dumps(answer))
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What every case is answered with."""
    effort = "from jourdain_jax.native import host\nhost.EFFORT = 0"  # of LLVM, as in the other tests
    source = f"{effort}\n{PRELUDE}\nCASES = {json.dumps(list(TABLE))!r}\n{RUN}"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path), "JAX_PLATFORMS": "cpu"}
    folder = tmp_path_factory.mktemp("malformed")
    run = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, env=environment, cwd=folder)
    assert run.returncode == 0, run.stderr
    refused = {"lanes.npz", "b.npz", "run.mp4", "run.gif", "run.xyz", "lane-0.gif", "nowhere"}
    assert refused.isdisjoint(path.name for path in folder.iterdir()), "a refused file was written"
    lines = [line.removeprefix("ANSWER ") for line in run.stdout.splitlines() if line.startswith("ANSWER ")]
    return dict(zip(TABLE, map(json.loads, lines), strict=True))


def test_the_table_is_long():
    assert len(TABLE) >= 100


@pytest.mark.parametrize("code", TABLE)
def test_malformed_input_is_named_with_what_is_expected(code, answers):
    kind, words = TABLE[code]
    found, text = answers[code]
    assert words in text, text
    assert kind in found.split("/"), text
