"""The HTML report of a fit: its numbers are those of the fit, its predictions those of a simulation, and it loads nothing."""

import re
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest

import jourdain_jax as jj
from jourdain_jax.analysis.fit_page import prediction

START = {"x_rate": -0.6, "heading_rate": 0.9}
TS = jnp.linspace(0.0, 4.0, 41)


@pytest.fixture(scope="module")
def fitted():
    truth, noise = jj.models.ChaplyginSleigh(offset=0.25), np.random.default_rng(0)
    motion = jj.simulate(truth, START, ts=TS)
    values = {name: np.asarray(motion[name]) + 0.01 * noise.normal(size=41) for name in ("x", "heading")}
    values["x"][3] = np.nan
    data = jj.Measurements(TS, values, {"x": 0.01, "heading": None}, start=START)
    return jj.fit(truth.replace(offset=0.3), data, free=("offset", "inertia")), data


def tables(path) -> dict[str, list[list[str]]]:
    page = ElementTree.fromstring(path.read_text(encoding="utf-8").removeprefix("<!DOCTYPE html>").replace('<meta charset="utf-8">', ""))
    return {table.get("id"): [[cell.text or "" for cell in row] for row in table.iter("tr")] for table in page.iter("table")}


def test_report_holds_the_numbers_of_the_fit(fitted, tmp_path):
    fit, data = fitted
    fit.report(tmp_path / "fit.html", data)
    found = tables(tmp_path / "fit.html")
    for row in found["estimates"][1:]:
        e = fit[row[0]]
        np.testing.assert_allclose([float(x) for x in row[2:]], [e.value, e.standard_error, e.low, e.high], rtol=0.05)
        assert float(row[2]) == pytest.approx(float(e.value), rel=1e-5)
    assert float(found["correlations"][1][2]) == pytest.approx(float(fit.correlation[0, 1]), abs=0.0051)
    channels = {row[0]: row for row in found["channels"][1:]}
    assert channels["x"][2] == "40"
    assert float(channels["heading"][6]) == pytest.approx(float(fit.sigma["heading"]), rel=1e-3)
    motion = jj.simulate(fit.scene, START, ts=TS)
    value = np.asarray(data.values["heading"])
    r_squared = 1 - np.sum((np.asarray(motion["heading"]) - value) ** 2) / np.sum((value - value.mean()) ** 2)
    assert float(channels["heading"][7]) == pytest.approx(r_squared, abs=2e-6)


def test_predictions_drawn_are_those_of_a_simulation(fitted):
    fit, data = fitted
    motion = jj.simulate(fit.scene, START, ts=TS)
    for name in ("x", "heading"):
        found = prediction(fit, 0, data, name)
        known = np.isfinite(np.asarray(data.values[name]))
        np.testing.assert_allclose(found[known], np.asarray(motion[name])[known], atol=1e-5)


def test_report_loads_nothing_and_is_small(fitted, tmp_path):
    fit, data = fitted
    fit.report(tmp_path / "fit.html", data)
    text = (tmp_path / "fit.html").read_text(encoding="utf-8")
    assert text.count("<svg") == 4  # two channels with their data, and their autocorrelations
    assert not re.search(r"(https?:|src=|href=|url\(|@import|<script)", text)
    assert len(text) < 2e6


def test_report_answers_what_it_cannot_write(fitted, tmp_path):
    fit, data = fitted
    with pytest.raises(ValueError, match=r"is a \.html file"):
        fit.report(tmp_path / "fit.pdf")
    with pytest.raises(ValueError, match="expected those of the fit"):
        fit.report(tmp_path / "fit.html", [data, data])
