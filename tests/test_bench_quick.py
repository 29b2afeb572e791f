"""Every script of `bench` that has `--quick` runs to its end and writes what it found."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[1] / "bench"
SCRIPTS = sorted(
    path.name for path in BENCH.glob("*.py") if {'"--quick"', '"--json"'} <= set(path.read_text(encoding="utf-8").replace(",", " ").replace("(", " ").split())
)


def test_the_scripts_are_found():
    assert {"lowering.py", "ensembles.py", "identification.py"} <= set(SCRIPTS)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_runs_quickly_to_its_end(script, tmp_path):
    """Whether requirements on time are met depends on the machine; those that are shares or errors of a sample do not, and rows without one are met."""
    out = tmp_path / "figures.json"
    command = [sys.executable, script, "--quick", "--json", str(out)]
    command += ["--out", str(tmp_path)] if '"--out"' in (BENCH / script).read_text(encoding="utf-8") else []
    done = subprocess.run(command, cwd=BENCH, env=os.environ | {"MPLBACKEND": "Agg"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    figures = [row for row in json.loads(out.read_text(encoding="utf-8")) if isinstance(row, dict) and "required" in row]
    assert all(row["met"] for row in figures if row["required"] is None)
    missed = [row for row in figures if "intervals" in str(row.get("figure")) and not row["met"]]
    assert not missed
