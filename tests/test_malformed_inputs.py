"""Every malformed input of the tables is answered with the right kind of error, or code, and with words that say what to do."""

import json
import os
import subprocess
import sys

import answered
import malformed_calls
import malformed_fits
import malformed_inputs
import malformed_studies
import pytest

TABLES = (malformed_inputs, malformed_fits, malformed_studies, malformed_calls)
CASES = {code: case for table in TABLES for code, case in table.TABLE.items()}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """What every case is answered with: in a process of its own where a run-time type check, which users do not have, would answer first."""
    folder = tmp_path_factory.mktemp("malformed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        here = answered.answers([(table.PRELUDE, table.TABLE) for table in TABLES])
    checked = {code for code, (kinds, _) in here.items() if "TypeCheckError" in kinds}
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path), "JAX_PLATFORMS": "cpu"}
    asked = json.dumps([(table.PRELUDE, [code for code in table.TABLE if code in checked]) for table in TABLES])
    run = subprocess.run([sys.executable, answered.__file__], input=asked, capture_output=True, text=True, env=environment, cwd=folder)
    assert run.returncode == 0, run.stderr
    refused = {"lanes.npz", "b.npz", "run.mp4", "run.gif", "run.xyz", "lane-0.gif", "nowhere", "x"}
    assert refused.isdisjoint(path.name for path in folder.iterdir()), "a refused file was written"
    return here | json.loads(run.stdout.splitlines()[-1].removeprefix("ANSWERS "))


def test_no_case_stands_in_two_tables():
    assert len(CASES) == sum(len(table.TABLE) for table in TABLES) > 400


@pytest.mark.parametrize("code", CASES)
def test_malformed_input_is_named_with_what_is_expected(code, found):
    case = CASES[code]
    kind, words = ("ValueError", case) if isinstance(case, str) else case
    kinds, text = found[code]
    assert all(part in text for part in words.split(" ... ")), text
    assert kind in kinds.split("/"), text
