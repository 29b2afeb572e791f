"""The command line: machine-readable answers, documented exit codes, unknown names answered with the nearest
ones.
"""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.cli import main
from jourdain_jax.models import MODELS


def run(capsys, command, *arguments):
    """Exit code and standard output of one command."""
    code = main([*command.split(), *arguments])
    return code, capsys.readouterr()


def answer(capsys, command, *arguments):
    """What a command says in JSON."""
    code, out = run(capsys, command, *arguments)
    assert code == 0
    return json.loads(out.out)


def test_models_lists_every_model_by_name(capsys):
    assert [row["name"] for row in answer(capsys, "models --json")] == list(MODELS)
    assert run(capsys, "models")[1].out.count("\n") == len(MODELS)


def test_models_tells_what_can_be_set_and_started_from(capsys):
    code, out = run(capsys, "models tilting-disc")
    assert code == 0
    assert "mass=1 kg, radius=0.5 m, gravity=9.81 m/s^2" in out.out
    assert "yaw_rate, lean_rate, spin_rate" in out.out
    assert "lean=0.3, yaw_rate=0.5, lean_rate=0.2, spin_rate=-3; 10 s" in out.out
    (row,) = answer(capsys, "models tilting-disc --json")
    assert row["example"] == dict(MODELS["tilting-disc"].example)
    code, out = run(capsys, "models tilted-disc")
    assert code == 2
    assert "did you mean `tilting-disc`" in out.err


def test_report_has_the_documented_keys(capsys):
    found = answer(capsys, "report chaplygin-sleigh --json")
    assert found["degrees_of_freedom"] == 2
    assert found["rank"] == 1
    assert found["nonholonomic_rows"] == ["blade"]
    assert found["growth_vector"] == [2, 3]
    keys = (
        "rows redundant_rows integrable_rows cyclic_coordinates ignorable_coordinates privileged_velocities"
    )
    assert set(keys.split()) <= found.keys()


def test_verify_has_the_documented_keys_and_passes(capsys):
    found = answer(capsys, "verify chaplygin-sleigh --json")
    assert found["passed"] is True
    assert max(found[key] for key in ("max_disagreement", "virtual_power", "energy_balance")) < 1e-12
    assert found["gradient_error"] < 1e-8


def test_simulate_writes_what_it_was_asked_for(capsys, tmp_path):
    files = [str(tmp_path / name) for name in ("run.npz", "run.png", "run.gif")]
    command = (
        "simulate chaplygin-sleigh --t1 1 --set mass=2 --start x_rate=1 heading_rate=0.5 --samples 5 --json"
    )
    written = ["--out", files[0], "--plot", files[1], "--animate", files[2]]
    found = answer(capsys, command, *written)
    assert found["result"] == 0
    assert found["t_end"] == 1.0
    loaded = jj.load_trajectory(files[0], MODELS["chaplygin-sleigh"])
    assert float(loaded.scene.mass) == 2.0
    np.testing.assert_allclose(loaded["heading"][-1], found["final"]["heading"])
    assert all((tmp_path / name).stat().st_size > 1000 for name in ("run.png", "run.gif"))


def test_a_file_that_cannot_be_written_is_answered_without_a_traceback(capsys, tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied", str(tmp_path / "run.npz"))

    monkeypatch.setattr("jourdain_jax.cli.model_verbs.save", refuse)
    command = "simulate chaplygin-sleigh --t1 0.1 --samples 2 --out"
    code, out = run(capsys, command, str(tmp_path / "run.npz"))
    assert code == 2
    assert (
        f"cannot read or write `{tmp_path / 'run.npz'}`: Permission denied; check the path and its"
        " permissions" in out.err
    )


def test_the_number_of_bodies_is_set_as_a_parameter_is(capsys):
    found = answer(capsys, "report pendulum-chain --set links=2 mass=0.5 --json")
    assert found["degrees_of_freedom"] == 2
    rows = {row["name"]: row for row in answer(capsys, "models --json")}
    assert rows["pendulum-chain"]["counts"] == {"links": {"value": 5}}
    assert rows["trailer-chain"]["counts"] == {"trailers": {"value": 3}}
    assert rows["skate"]["counts"] == {}
    assert rows["tilting-disc"]["events"] == ["fallen"]
    assert set(rows["tilting-disc"]["domain"]) <= {
        *rows["tilting-disc"]["coordinates"],
        *rows["tilting-disc"]["speeds"],
    }


def test_a_simulation_for_machines_has_all_that_the_printed_one_has(capsys):
    found = answer(capsys, "simulate tilting-disc --t1 0.2 --samples 3 --json")
    contact = found["contacts"]["rim"]
    assert 0 < contact["lowest_normal"] <= contact["highest_normal"]
    assert contact["friction_needed"] > 0
    assert contact["pulls"] is False
    assert contact["determined"] is True
    assert found["smallest_singular_value"] > 0
    assert found["rank"] == [2, 2]
    assert found["start_moved"].keys() == {"coordinates", "speeds"}
    assert found["invariant_drifts"] == {}


def test_the_version_is_told(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("jourdain-jax ")


def test_importing_computes_nothing_so_that_compiler_flags_still_count():
    check = (
        "import jax, jourdain_jax.cli; jax.config.update('jax_num_cpu_devices', 2); assert jax.device_count()"
        " == 2"
    )
    subprocess.run([sys.executable, "-c", check], check=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
