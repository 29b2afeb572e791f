"""`jourdain-jax sweep`: a study from a file, its state, going on, export."""

import json

import pytest
import xarray

from jourdain_jax.cli import main
from jourdain_jax.cli.sweep_verbs import described_study
from jourdain_jax.ensembles import task

FILE = """
model = "tilting-disc"
t1 = 1.0
samples = 100
sampler = "latin-hypercube"
[set]
mass = 2.0
[vary]
radius = { normal = [0.5, 0.01] }
[start]
lean = { normal = [0.0, 0.2] }
spin_rate = -3.0
[outputs]
"final lean" = { end = "lean", unit = "rad" }
fell = { happened = "fallen" }
[options]
rtol = 1e-6
[correlation]
"radius lean" = 0.5
"""


@pytest.fixture(autouse=True)
def _blocks_are_small(monkeypatch):
    monkeypatch.setattr(task, "LARGEST_BLOCK", 32)


def test_a_study_runs_from_a_file_goes_on_and_is_exported(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "discs.toml").write_text(FILE)
    assert main(["sweep", "discs.toml", "--shard", "1/2", "--quiet"]) == 0
    assert "64 of 100 lanes; run it again to go on" in capsys.readouterr().out
    assert main(["sweep", "status", "discs.zarr", "--json"]) == 1  # not complete
    assert json.loads(capsys.readouterr().out)["complete"] is False
    assert main(["sweep", "resume", "discs.zarr", "--quiet"]) == 0
    assert main(["sweep", "status", "discs.zarr", "--json"]) == 0
    capsys.readouterr()
    assert main(["sweep", "status", "discs.zarr", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["counts"] == {"success": 100}
    low, high = found["outputs"]["final lean"]["quantiles"]["0.5"]
    assert low < found["outputs"]["final lean"]["mean"] + 0.1
    assert high > found["outputs"]["final lean"]["mean"] - 0.1
    assert main(["sweep", "export", "discs.zarr"]) == 0
    with xarray.open_dataset("discs.nc") as arrays:
        assert arrays.sizes["lane"] == 100
        assert arrays.attrs["parameters"].startswith("{'mass': {'value': 2.0")
    assert main(["sweep", "discs.toml", "--out", "discs.nc", "--quiet"]) == 2
    assert "is a file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"modell": "x"}, "did you mean `model`"),
        ({"model": "disk"}, "unknown model `disk`"),
        ({"vary": {"radius": {"gauss": [1.0, 2.0]}}}, "by one of these names"),
        ({"vary": {"radius": {"normal": [1.0]}}}, "1 numbers, expected 2"),
        ({"vary": {"radius": [1.0]}}, "write, for example"),
        ({"outputs": {"x": {"ende": "lean"}}}, "output `x`"),
        ({"samples": 0}, "`samples` is 0"),
        ({"sampler": "sobol2"}, "did you mean `sobol`"),
        ({"set": 3}, "`set` is an int, expected a table"),
        ({"options": {"processes": 2}}, "`processes` is no entry of"),
        ({"options": {"outputs": {}}}, "`outputs` is no entry of"),
        ({"t1": 1.0, "options": {"t1": 2.0}}, "`t1` is no entry of"),
    ],
)
def test_a_wrong_file_says_what_is_wrong(change, message):
    asked = {"model": "tilting-disc", "samples": 8, "vary": {"radius": {"normal": [0.5, 0.01]}}}
    with pytest.raises(ValueError, match=message):
        described_study(asked | change)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["status", "nothing"], "`nothing` does not exist"),
        (["nothing.toml"], "there is no file `nothing.toml`"),
        (["exprot", "x.zarr"], "did you mean `export`"),
        (["status"], "takes one folder"),
        (["wrong.toml"], "the file is no TOML"),
        (["latin.toml"], "`latin.toml` is no text in UTF-8"),
    ],
)
def test_a_wrong_command_says_what_is_wrong(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrong.toml").write_text("model = ")
    (tmp_path / "latin.toml").write_bytes(b"model = 'd\xefsc'")
    assert main(["sweep", *words]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("error", [RuntimeError("workers died 3 times on lanes 0 to 31"), MemoryError("a process holds 900 MB")])
def test_a_study_that_stops_says_why_in_one_line(error, tmp_path, monkeypatch, capsys):
    def stops(*_):
        raise error

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(task.Task, "run_block", stops)
    (tmp_path / "discs.toml").write_text(FILE)
    assert main(["sweep", "discs.toml", "--quiet"]) == 1
    assert capsys.readouterr().err == f"jourdain-jax: {error}\n"
