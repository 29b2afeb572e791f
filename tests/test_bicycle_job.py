"""The real job: measured bicycles in, stability speeds with uncertainty and rides out."""

import json

import pytest
from numpy.testing import assert_allclose

from jourdain_jax.bicycle import Refused, run, shipped_bicycles, table, write_results
from jourdain_jax.cli import main
from jourdain_jax.cli.bicycle_verbs import prefixes


@pytest.fixture(scope="module")
def studies():
    """A measured bicycle, one that has no capsize speed, and one that is refused."""
    shipped = shipped_bicycles()
    return run([shipped[name] for name in ("Rigid", "Yellowrev", "Tms")], samples=60)


def test_the_speeds_are_those_of_the_linear_formulas(studies):
    # from the published appendix formulas, evaluated on the same files
    rigid = studies[0].speeds
    assert_allclose(rigid["weave_speed"]["value"], 5.0083877167528, rtol=1e-9)
    assert_allclose(rigid["capsize_speed"]["value"], 6.4290536046576, rtol=1e-9)
    assert_allclose(studies[1].speeds["weave_speed"]["value"], 3.7592036310992, rtol=1e-9)


def test_a_file_that_is_missing_is_named(tmp_path, capsys):
    assert main(["bicycle", "missing.txt", "--out", str(tmp_path)]) == 1
    assert "refused: missing.txt: cannot be read" in capsys.readouterr().out


def test_limits_hold_the_value_and_say_how_many_samples_have_the_speed(studies):
    weave = studies[0].speeds["weave_speed"]
    assert weave["low"] < weave["value"] < weave["high"]
    assert weave["fraction"] == 1.0
    assert 0.02 < weave["high"] - weave["low"] < 0.3  # 0.14 m/s with 2,000 samples
    assert studies[1].speeds["capsize_speed"] is None or studies[1].speeds["capsize_speed"]["value"] is None


def test_a_degenerate_file_is_refused_by_name(tmp_path):
    (refused,) = run([shipped_bicycles()["Tms"]], samples=60)
    assert isinstance(refused, Refused)
    assert "rR" in refused.error
    write_results([refused], tmp_path / "result.json")
    (row,) = json.loads((tmp_path / "result.json").read_text())
    assert row["weave_speed"] is None
    assert "refused" in table([refused])


def test_other_files_go_on_where_one_is_refused(studies):
    assert [isinstance(one, Refused) for one in studies] == [False, False, True]


def test_result_and_table_say_what_the_limits_mean(studies, tmp_path):
    write_results(studies, tmp_path / "result.json")
    rows = json.loads((tmp_path / "result.json").read_text())
    assert len(rows) == 3
    for row in rows:
        assert {"file", "weave_speed", "capsize_speed"} <= row.keys()
    assert rows[2]["weave_speed"] is None
    assert set(rows[0]["weave_speed"]) == {"value", "low", "high", "fraction"}
    text = table(studies)
    assert "independent" in text
    assert "missing sigma counts as zero" in " ".join(text.split())
    assert "refused" in text


def test_the_command_writes_its_table_and_figures(tmp_path, capsys):
    assert main(["bicycle", "Rigid", "Tms", "--samples", "60", "--out", str(tmp_path / "out")]) == 1  # one file was refused
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"result.json", "eigenvalues.png", "ride.png", "ride.gif"}
    assert "5.0084" in capsys.readouterr().out


def test_figures_of_two_bicycles_with_one_name_have_two_names():
    assert prefixes(["Rigid"]) == [""]
    assert prefixes([]) == []
    assert prefixes(["Rigid", "my bike", "Rigid", "my_bike"]) == ["Rigid-", "my_bike-", "Rigid-2-", "my_bike-2-"]
