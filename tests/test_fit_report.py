"""The HTML report of a fit: its numbers are those of the fit, its drawings those of data and simulation, and it loads nothing."""

import pickle
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jourdain_jax as jj
from jourdain_jax.analysis.information import hidden_combinations, weak_combinations

START = {"x_rate": -0.6, "heading_rate": 0.9}
TS = jnp.linspace(0.0, 4.0, 41)
TRUTH = jj.models.ChaplyginSleigh(offset=0.25)


def measured(seed: int, start=START, ts=TS) -> jj.Experiment:
    motion, noise = jj.simulate(TRUTH, start, ts=ts), np.random.default_rng(seed)
    values = {name: np.asarray(motion[name]) + 0.01 * noise.normal(size=len(ts)) for name in ("x", "heading")}
    values["x"][3] = np.nan
    return jj.Experiment(ts, values, {"x": 0.01, "heading": None}, start=start)


@pytest.fixture(scope="module")
def fitted():
    data = measured(0)
    return jj.fit(TRUTH.replace(offset=0.3), data, free=("offset", "inertia")), data


def test_a_fit_comes_back_from_a_pickle_with_all_that_it_tells(fitted):
    fit, data = fitted
    again = pickle.loads(pickle.dumps(fit))
    assert str(again) == str(fit)
    assert again.profiles(data, "offset")["offset"].high == fit.profiles(data, "offset")["offset"].high


def test_measurements_that_count_twice_are_named(fitted):
    _, data = fitted
    assert not jj.fit(TRUTH, data, free=("offset",)).warnings
    twice = jj.fit(TRUTH, [data, data], free=("offset",))
    assert "`x` of run 0 and `x` of run 1 hold the same numbers" in str(twice.warnings)
    both = jj.Experiment(data.ts, {"x": data.values["x"], "odometer": data.values["x"]}, 0.01, start=data.start, sensors={"odometer": "x"})
    assert jj.fit(TRUTH, both, free=("offset",)).warning.startswith("`odometer` of run 0 and `x` of run 0 hold the same numbers")


def page(path: Path) -> ElementTree.Element:
    return ElementTree.fromstring(path.read_text(encoding="utf-8").removeprefix("<!DOCTYPE html>").replace('<meta charset="utf-8">', ""))


def sections(path: Path) -> dict[str, dict[str, list[str]]]:
    """Title -> first cell -> the other cells of lines; cells stand two blanks apart. The text of the fit itself comes first, without a title."""
    found, title = {}, ""
    for part in page(path).iter():
        if part.tag == "h2":
            title = part.text
        elif part.tag == "pre":
            found[title] = {cells[0]: cells[1:] for line in part.text.split("\n") if (cells := re.split(r"\s{2,}", line.strip()))}
    return found


def captions(path: Path) -> list[str | None]:
    """Those of all figures."""
    return [figure.findtext("figcaption") for figure in page(path).iter("figure")]


def test_report_holds_the_numbers_of_the_fit(fitted, tmp_path):
    fit, data = fitted
    fit.report(tmp_path / "fit.html", data)
    found = sections(tmp_path / "fit.html")
    assert (page(tmp_path / "fit.html").find(".//pre").text) == str(fit)
    assert float(found["Correlations"]["offset"][1]) == pytest.approx(float(fit.correlation[0, 1]), abs=0.0051)
    error = np.asarray(jj.simulate(fit.scene, START, ts=TS)["heading"]) - np.asarray(data.values["heading"])
    value = np.asarray(data.values["heading"])
    (told,) = (line for line in found["Data (dots) and prediction (line)"] if "`heading`" in line)
    samples, rms, r_squared = re.search(r": (\d+) samples .* rms of (\S+); R\^2 (\S+)", told).groups()
    assert samples == "41"
    assert float(r_squared) == pytest.approx(1 - np.sum(error**2) / np.sum((value - value.mean()) ** 2), abs=2e-6)
    assert float(rms) == pytest.approx(np.sqrt(np.mean(error**2)), rel=5e-3)
    for name, (rho, _) in fit.autocorrelation.items():
        cells = found["Are the residuals white?"][name]
        assert float(cells[0]) == pytest.approx(rho, abs=6e-4)
        assert cells[2] == "yes"


def test_what_is_drawn_are_the_data_and_a_simulation(fitted, tmp_path, drawn):
    fit, data = fitted
    fit.report(tmp_path / "fit.html", data, units={"x": "m"})
    panels, motion = {figure.axes[0].get_ylabel(): figure for figure in drawn}, jj.simulate(fit.scene, START, ts=TS)
    assert {"run 0: x", "run 0: heading"} <= set(captions(tmp_path / "fit.html"))
    for name, label, sigma in (("x", "x in m", 0.01), ("heading", "heading in SI units", float(fit.sigma["heading"]))):
        above, below = panels[label].axes
        dots, line = (of.get_xydata() for of in above.lines)
        assert_array_equal(dots, np.stack([TS, data.values[name]], axis=1))  # a missing sample has no dot
        assert np.isfinite(dots).all() == (name == "heading")
        predicted = np.asarray(motion[name])[np.isin(TS, line[:, 0])]
        assert_allclose(line[:, 1], predicted, rtol=0, atol=1e-7)
        assert len(line) >= np.isfinite(data.values[name]).sum()
        assert_allclose(below.lines[-1].get_ydata(), (np.asarray(motion[name]) - data.values[name]) / sigma, atol=1e-3)


def test_report_loads_nothing_and_is_small(fitted, tmp_path):
    fit, data = fitted
    fit.report(tmp_path / "fit.html", data, held_out=measured(1), profiles=True, units={"x": "m"})
    text = (tmp_path / "fit.html").read_text(encoding="utf-8")
    # two channels with data and two held out, two autocorrelations, two profiles, widths of intervals, what informs, the way to the minimum
    assert text.count("<img") == text.count('src="data:image/png;base64,') == 11
    assert not re.search(r"(https?:|src=\"(?!data:)|href=|url\(|@import|<script)", text)
    assert len(text) < 1e6


def test_a_report_without_matplotlib_has_all_words_and_says_what_to_install(fitted, tmp_path, monkeypatch):
    fit, data = fitted
    fit.report(tmp_path / "fit.html", data)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    fit.report(tmp_path / "plain.html", data)
    assert sections(tmp_path / "plain.html") == sections(tmp_path / "fit.html")
    text = (tmp_path / "plain.html").read_text(encoding="utf-8")
    assert "<img" not in text
    assert "install it with: pip install &#x27;jourdain-jax[plot]&#x27;" in text


def test_many_long_runs_stay_below_two_megabytes(tmp_path):
    runs = [measured(seed, {"x_rate": -0.5 - 0.01 * seed, "heading_rate": 0.9}, jnp.linspace(0.0, 4.0, 3001)) for seed in range(30)]
    fit = jj.fit(TRUTH.replace(offset=0.26), runs, free=("offset",))
    fit.report(tmp_path / "fit.html", runs[:30], held_out=measured(40))
    assert (tmp_path / "fit.html").stat().st_size < 2e6
    # span, eight runs of thirty, two channels, priors
    assert len(sections(tmp_path / "fit.html")["What informs which unknown"]["unknown"]) == 1 + 8 + 2 + 1
    assert "20 more are not drawn" in (tmp_path / "fit.html").read_text(encoding="utf-8")


def test_runs_held_out_are_predicted_in_table_and_drawing(fitted, tmp_path):
    fit, data = fitted
    other_start = {"x_rate": -0.4, "heading_rate": 0.6}
    other = measured(1, other_start)
    fit.report(tmp_path / "fit.html", data, held_out=other)
    lines, motion = sections(tmp_path / "fit.html")["Runs held out"], jj.simulate(fit.scene, other_start, ts=TS)
    for name, line in zip(("heading", "x"), lines, strict=True):
        error = np.asarray(motion[name]) - np.asarray(other.values[name])
        assert line.startswith(f"`{name}` of held out, run 0")
        assert float(re.search(r"rms of (\S+);", line)[1]) == pytest.approx(np.sqrt(np.nanmean(error**2)), rel=6e-3)
    assert {"held out, run 0: x", "held out, run 0: heading"} <= set(captions(tmp_path / "fit.html"))


def test_profiles_stand_in_the_report_and_the_bootstrap_has_gone(fitted, tmp_path):
    fit, data = fitted
    along = fit.profiles(data, "offset")
    fit.report(tmp_path / "fit.html", profiles=along)
    assert list(sections(tmp_path / "fit.html")["Profile likelihood"]) == [str(along["offset"])]
    with pytest.raises(AttributeError, match=r"`Fit\.profiles`.*`fit_batch`"):
        fit.bootstrap  # noqa: B018


def test_report_tells_the_way_to_the_minimum(tmp_path):
    data = jj.Experiment(TS, measured(0).values, 0.01, start=START)
    guess = TRUTH.replace(offset=0.3)
    fit = jj.fit(guess, data, free={"offset": jj.bounds(0.05, 1.0)}, guesses=4)
    (what, costs), logs = fit.trace[0], np.log(0.01 * np.sqrt(2 * np.pi)) * 81
    assert what == "whole runs"
    assert len(costs) == int(fit.steps) + 1
    assert costs[-1] == pytest.approx(0.5 * float(fit.chi_square), rel=1e-9)
    alone = jj.fit(guess, data, free=("offset",))
    assert alone.trace[0][1][0] == pytest.approx(-float(jj.log_likelihood(guess, data)) - logs, rel=1e-6)
    assert np.all(np.diff(alone.trace[0][1]) <= 1e-6)
    fit.report(tmp_path / "fit.html")
    text = (tmp_path / "fit.html").read_text(encoding="utf-8")
    assert f"{int(fit.agreeing)} of 4 first guesses led to this minimum" in text
    assert sections(tmp_path / "fit.html")["The way to the minimum"]["whole runs"][0] == str(int(fit.steps))


def test_residuals_that_are_not_white_are_told_with_what_that_means(tmp_path):
    noise, motion = np.random.default_rng(0), jj.simulate(TRUTH, START, ts=TS)
    e = 0.01 * noise.normal(size=41)
    for k in range(1, 41):
        e[k] = 0.9 * e[k - 1] + np.sqrt(1 - 0.9**2) * e[k]
    data = jj.Experiment(TS, {"heading": np.asarray(motion["heading"]) + e}, 0.01, start=START)
    fit = jj.fit(TRUTH, data, free=("offset",))
    fit.report(tmp_path / "fit.html", data)
    _, _, white, time, narrow = sections(tmp_path / "fit.html")["Are the residuals white?"]["heading"]
    rho = fit.autocorrelation["heading"][0]
    assert white == "NO"
    assert float(time.split()[1]) == pytest.approx(-0.1 / np.log(rho), rel=0.06)
    assert float(narrow.split()[1]) == pytest.approx(np.sqrt((1 + rho) / (1 - rho)), rel=0.06)
    assert "intervals from the sigmas are too narrow" in (tmp_path / "fit.html").read_text(encoding="utf-8")


def test_weak_directions_are_named_by_what_changes_along_them():
    sizes, labels = np.array([2.0, 4.0, 1.0]), ("a", "b", "c")
    values = np.array([2.0, -4.0, 0.0])
    poor, good = np.array([3.0, 4.0, 0.0]) / 5, np.array([[4.0, -3.0, 0.0], [0.0, 0.0, 5.0]]) / 5
    relative = 0.5**2 * np.outer(poor, poor) + 0.01**2 * good.T @ good
    (told,) = weak_combinations(relative * sizes * sizes[:, None], values, sizes, labels)
    assert told.startswith("a change of `b` by 40 % and a change of `a` by 30 % together")
    lone = np.diag([1e-6, 1e-6, 0.2**2])
    (told,) = weak_combinations(lone * sizes * sizes[:, None], values, sizes, labels)
    assert told.startswith("a change of `c` by 0.2 is one standard error")
    assert weak_combinations(np.full((3, 3), np.nan), values, sizes, labels) == ()


def test_two_hidden_directions_and_a_parameter_that_does_nothing():
    # d theta_0/theta_0 = d theta_2/theta_2, with theta_1 = 0 counted in its own unit; theta_3 does nothing
    directions = np.linalg.qr(np.array([[1.0, 0.5, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]).T)[0].T
    turned = np.array([[0.6, 0.8], [-0.8, 0.6]]) @ directions
    sentences = hidden_combinations(turned, 1e-3, np.ones(4), np.array([1.0, 0.0, 1.0, 1.0]), tuple("abcd"))
    assert len(sentences) == 2
    assert "`d` does not show in any channel" in sentences
    assert any("`a` and `b` and `c`" in s and "d a/a : d b : d c/c = 1 : 0.5 : 1" in s for s in sentences)
    # where two directions share an unknown, no product of powers of two unknowns shows
    rows = np.linalg.qr(np.array([[1.0, 0.0, 0.4], [0.0, 1.0, 0.3]]).T)[0].T
    assert all("`c` do not show separately" in s and "what shows" not in s for s in hidden_combinations(rows, 1e-3, np.ones(3), np.ones(3), tuple("abc")))


def test_names_that_no_data_tell_stand_in_the_report(tmp_path, drawn):
    data = measured(0)
    fit = jj.fit(TRUTH.replace(offset=0.3), data, free=("offset", "inertia", "mass"))
    fit.report(tmp_path / "fit.html", data, profiles=("mass",))
    text = (tmp_path / "fit.html").read_text(encoding="utf-8")
    assert "`inertia` and `mass` do not show separately" in text
    assert any(text.get_text() == "the data do not tell" for text in drawn[0].axes[0].texts)
    assert "profile flat" in text
    assert list(sections(tmp_path / "fit.html")["What informs which unknown"]) == ["unknown", "offset"]


def test_a_notebook_shows_how_well_each_unknown_is_known(fitted, drawn):
    fit, _ = fitted
    shown = fit._repr_html_()
    assert shown.startswith("<pre>Fit of ChaplyginSleigh")
    assert len(shown) < 1e5
    (axes,) = drawn[0].axes
    for bar, e in zip(axes.patches, fit.estimates.values(), strict=True):
        assert bar.get_width() == pytest.approx(100 * (e.high - e.value) / e.value, rel=0.01)


def test_report_answers_what_it_cannot_write(fitted, tmp_path):
    fit, data = fitted
    with pytest.raises(ValueError, match=r"is a \.html file"):
        fit.report(tmp_path / "fit.pdf")
    with pytest.raises(ValueError, match="expected those of the fit"):
        fit.report(tmp_path / "fit.html", [data, data])
    with pytest.raises(ValueError, match="are not those of the fit"):
        fit.report(tmp_path / "fit.html", measured(7))
    with pytest.raises(ValueError, match="computed from the runs that were fitted"):
        fit.report(tmp_path / "fit.html", profiles=True)
