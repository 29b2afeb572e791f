"""`jourdain-jax sweep`: a study from a file, its state, going on, export."""

import json
import subprocess
import sys

import pytest
import xarray

from jourdain_jax.cli import main
from jourdain_jax.studies import run

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
pytestmark = pytest.mark.usefixtures("small_blocks")


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """The command, where the file is."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "discs.toml").write_text(FILE)
    return lambda *words: main(["sweep", *words])


def test_a_study_runs_from_a_file_goes_on_and_is_exported(sweep, capsys):
    assert sweep("discs.toml", "--shard", "1/2", "--quiet") == 0
    assert "64 of 100 samples; run it again to continue" in capsys.readouterr().out
    assert sweep("status", "discs.zarr", "--json") == 1  # not complete
    assert json.loads(capsys.readouterr().out)["complete"] is False
    assert sweep("resume", "discs.zarr", "--quiet") == 0
    assert sweep("status", "discs.zarr", "--json") == 0
    capsys.readouterr()
    assert sweep("status", "discs.zarr", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["counts"] == {"success": 100}
    low, high = found["outputs"]["final lean"]["quantiles"]["0.5"]
    assert low < found["outputs"]["final lean"]["mean"] + 0.1
    assert high > found["outputs"]["final lean"]["mean"] - 0.1
    assert sweep("export", "discs.zarr") == 0
    with xarray.open_dataset("discs.nc") as arrays:
        assert arrays.sizes["lane"] == 100
        assert arrays.attrs["parameters"].startswith("{'mass': {'value': 2.0")
    assert sweep("discs.toml", "--out", "discs.nc", "--quiet") == 2
    assert "is a file" in capsys.readouterr().err


REPLACED = """
import copy
import datetime
import sys
import tomllib

from jourdain_jax.cli import main
from jourdain_jax.cli.sweep_verbs import described_study

WRONG = [
    datetime.date(2020, 1, 1),
    datetime.datetime(2020, 1, 1, 12),
    datetime.time(1),
    1e30,
    10**400,
    float("nan"),
    -1,
    "text",
    True,
    [],
    {},
]
WRONG += [[datetime.date(2020, 1, 1)], {"a": {"b": [1]}}, [10**400, 1.0]]


def places(x, around=()):
    for key, value in x.items() if isinstance(x, dict) else enumerate(x) if isinstance(x, list) else ():
        yield (*around, key)
        yield from places(value, (*around, key))


asked = tomllib.loads(sys.argv[1]) | {"seed": 3, "save": "outputs", "keep_every": 1}
for *way, last in places(asked):
    for value in WRONG:
        changed = copy.deepcopy(asked)
        holder = changed
        for key in way:
            holder = holder[key]
        holder[last] = value
        try:
            made, how = described_study(changed)
            made.task(**{name: x for name, x in how.items() if name != "chunk"})
            print("taken")
        except Exception as error:
            print(
                "refused"
                if isinstance(error, ValueError)
                else f"{way} {last} {value!r:.40}: {type(error).__name__} {error}"
            )
for file in sys.argv[2:]:
    print(main(["sweep", file, "--quiet"]), file)
"""
WIDE = {
    "brackets": ("vary = " + "[" * 5000 + "]" * 5000, "brackets: nested more than 250 levels deep"),
    "dots": ("[" + "a." * 300 + "a]", "dots: nested more than 250 levels deep"),
    "tables": ("a = " + "{ a = " * 300 + "1" + " }" * 300, "tables: nested more than 250 levels deep"),
    "many": (FILE.replace("samples = 100", "samples = 1e30"), "`samples` is 1e+30, expected a whole number"),
    "long": (
        FILE.replace("samples = 100", "samples = 1" + "0" * 30),
        "expected a whole number of at least 1 and at most 9007199254740992",
    ),
    "date": (
        FILE.replace("samples = 100", "samples = 2020-01-01"),
        "`samples` is datetime.date(2020, 1, 1), expected a whole number",
    ),
    "longer": (FILE.replace("samples = 100", "samples = 1" + "0" * 5000), "longer: not valid TOML"),
    "zero": (FILE + "\0", "zero: a binary file"),
    "latin": ("model = 'd\xefsc'", "latin: not UTF-8 text"),
}


def test_whatever_stands_in_a_file_is_taken_or_refused_by_name(tmp_path):
    """Every entry, one after another, replaced by something else; and files beyond all bounds. In a process
    without the tests' checks of types.
    """
    for name, (text, _) in WIDE.items():
        (tmp_path / name).write_text(text, encoding="latin-1")
    done = subprocess.run(
        [sys.executable, "-c", REPLACED, FILE, *WIDE], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    found = lines[: -len(WIDE)]
    assert len(found) > 250
    assert set(found) <= {"taken", "refused"}
    assert found.count("refused") > 200
    assert lines[-len(WIDE) :] == [f"2 {name}" for name in WIDE]
    said = [line for line in done.stderr.splitlines() if line.startswith("jourdain-jax: ")]
    for (_, message), line in zip(WIDE.values(), said, strict=True):
        assert message in line
        assert len(line) < 500
    assert {file.name for file in tmp_path.iterdir()} == {*WIDE}


@pytest.mark.parametrize("shard", ["1", "0/2", "3/2", "1_0/20", "a/b", "\u0661/2", "1/" + "9" * 5000])
def test_a_shard_is_two_whole_numbers(shard, sweep, capsys):
    assert sweep("discs.toml", "--shard", shard) == 2
    assert "--shard" in capsys.readouterr().err


@pytest.mark.parametrize(
    "error", [RuntimeError("workers died 3 times on lanes 0 to 31"), MemoryError("a process holds 900 MB")]
)
def test_a_study_that_stops_says_why_in_one_line(error, sweep, monkeypatch, capsys):
    def stops(*_):
        raise error

    monkeypatch.setattr(run.Runner, "run_block", stops)
    assert sweep("discs.toml", "--quiet") == 1
    assert capsys.readouterr().err == f"jourdain-jax: {error}\n"
