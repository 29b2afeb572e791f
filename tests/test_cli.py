"""The command line: machine-readable answers, documented exit codes, unknown names answered with the nearest ones."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.cli import main
from jourdain_jax.models.registry import MODELS


def run(capsys, *arguments):
    """Exit code and standard output of one command."""
    code = main(arguments)
    return code, capsys.readouterr()


def test_models_lists_every_model_by_name(capsys):
    code, out = run(capsys, "models", "--json")
    assert code == 0
    assert [row["name"] for row in json.loads(out.out)] == list(MODELS)
    assert run(capsys, "models")[1].out.count("\n") == len(MODELS)


def test_report_has_the_documented_keys(capsys):
    code, out = run(capsys, "report", "chaplygin-sleigh", "--json")
    found = json.loads(out.out)
    assert code == 0
    assert found["degrees_of_freedom"] == 2
    assert found["rank"] == 1
    assert found["nonholonomic_rows"] == ["blade"]
    assert found["growth_vector"] == [2, 3]
    keys = "rows redundant_rows integrable_rows cyclic_coordinates ignorable_coordinates privileged_velocities"
    assert set(keys.split()) <= found.keys()


def test_verify_has_the_documented_keys_and_passes(capsys):
    code, out = run(capsys, "verify", "chaplygin-sleigh", "--json")
    found = json.loads(out.out)
    assert code == 0
    assert found["passed"] is True
    assert max(found[key] for key in ("max_disagreement", "virtual_power", "energy_balance")) < 1e-12
    assert found["gradient_error"] < 1e-8


def test_simulate_writes_what_it_was_asked_for(capsys, tmp_path):
    files = [str(tmp_path / name) for name in ("run.npz", "run.png", "run.gif")]
    arguments = ["--t1", "1", "--set", "mass=2", "--start", "x_rate=1", "heading_rate=0.5", "--samples", "5", "--json"]
    code, out = run(capsys, "simulate", "chaplygin-sleigh", *arguments, "--out", files[0], "--plot", files[1], "--animate", files[2])
    found = json.loads(out.out)
    assert code == 0
    assert found["result"] == 0
    assert found["t_end"] == 1.0
    loaded = jj.load(files[0], MODELS["chaplygin-sleigh"])
    assert float(loaded.scene.mass) == 2.0
    np.testing.assert_allclose(loaded["heading"][-1], found["final"]["heading"])
    assert all((tmp_path / name).stat().st_size > 1000 for name in ("run.png", "run.gif"))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["modles"], "unknown verb `modles`; did you mean `models`"),
        (["report", "chaplygin-slay"], "unknown model `chaplygin-slay`; did you mean `chaplygin-sleigh`"),
        (["simulate", "skate", "--set", "mas=2"], "has no parameter `mas`; did you mean `mass`"),
        (["simulate", "skate", "--set", "mass"], "`mass` is not NAME=VALUE"),
        (["simulate", "skate", "--start", "x=fast"], "`x=fast` is not NAME=VALUE with a number"),
        (["simulate", "skate", "--start", "xx=1"], "has no coordinate or speed `xx`"),
        (["simulate", "skate", "--samples", "1"], "--samples is 1, expected at least 2"),
        (["simulate", "skate", "--out", "nowhere/run.npz"], "there is no folder `nowhere`"),
        (["bicycle", "Rigid", "--samples", "0"], "--samples is 0"),
    ],
)
def test_wrong_commands_exit_with_2_and_say_what_to_do(arguments, sentence, capsys):
    code, out = run(capsys, *arguments)
    assert code == 2
    assert sentence in out.err


def test_importing_computes_nothing_so_that_compiler_flags_still_count():
    check = "import jax, jourdain_jax.cli; jax.config.update('jax_num_cpu_devices', 2); assert jax.device_count() == 2"
    subprocess.run([sys.executable, "-c", check], check=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
