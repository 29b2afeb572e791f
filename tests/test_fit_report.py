"""What a fit tells beyond its estimates: profiles, what informs which unknown, predictions of other runs, and
its HTML report.
"""

import pickle
import re
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

import jourdain_jax as jj
from jourdain_jax.identification import Sensor
from jourdain_jax.studies import Normal

# The HTML report of a fit: its numbers are those of the fit, its drawings those of data and simulation, and
# it loads nothing.


START, OTHER = {"x_rate": -0.6, "heading_rate": 0.9}, {"x_rate": -0.4, "heading_rate": 0.6}
TS = np.linspace(0.0, 4.0, 41)
TRUTH = jj.models.ChaplyginSleigh(offset=0.25)


def measured(seed, start=START, ts=TS):
    motion, noise = jj.simulate(TRUTH, start, ts=ts), np.random.default_rng(seed)
    values = {name: np.asarray(motion[name]) + 0.01 * noise.normal(size=len(ts)) for name in ("x", "heading")}
    values["x"][3] = np.nan
    return jj.Experiment(ts, values, {"x": 0.01, "heading": None}, start=start)


def offset_of(data):
    return jj.fit(TRUTH, data, ("offset",))


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
    assert not offset_of(data).warnings
    twice = offset_of([data, data])
    assert "`x` of run 0 and `x` of run 1 hold equal numbers" in str(twice.warnings)
    both = jj.Experiment(
        data.ts,
        {"x": data.values["x"], "odometer": data.values["x"]},
        0.01,
        start=data.start,
        sensors={"odometer": "x"},
    )
    assert offset_of(both).warning.startswith("`odometer` of run 0 and `x` of run 0 hold equal numbers")


def page(path):
    return ElementTree.fromstring(
        path.read_text(encoding="utf-8").removeprefix("<!DOCTYPE html>").replace('<meta charset="utf-8">', "")
    )


def sections(path):
    """Title -> first cell -> the other cells of lines; cells stand two blanks apart. The text of the fit
    itself comes first, without a title.
    """
    found, title = {}, ""
    for part in page(path).iter():
        if part.tag == "h2":
            title = part.text
        elif part.tag == "pre":
            found[title] = {
                cells[0]: cells[1:]
                for line in part.text.split("\n")
                if (cells := re.split(r"\s{2,}", line.strip()))
            }
    return found


def captions(path):
    """Those of all figures."""
    return [figure.findtext("figcaption") for figure in page(path).iter("figure")]


@pytest.fixture(scope="module")
def written(fitted, tmp_path_factory):
    """A report with a run held out and profiles: its file, the run, and what was drawn."""
    fit, data = fitted
    path, held_out, figures, save = (
        tmp_path_factory.mktemp("report") / "fit.html",
        measured(1, OTHER),
        [],
        Figure.savefig,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Figure,
            "savefig",
            lambda self, *given, **named: figures.append(self) or save(self, *given, **named),
        )
        fit.report(path, data, held_out=held_out, profiles=True, units={"x": "m"})
    return path, held_out, figures


def test_report_holds_the_numbers_of_the_fit(fitted, written):
    (fit, data), (path, _, _) = fitted, written
    found = sections(path)
    assert page(path).find(".//pre").text == str(fit)
    assert float(found["Correlations"]["offset"][1]) == pytest.approx(
        float(fit.correlation[0, 1]), abs=0.0051
    )
    value = np.asarray(data.values["heading"])
    error = np.asarray(jj.simulate(fit.scene, START, ts=TS)["heading"]) - value
    (told,) = (line for line in found["Data (dots) and prediction (line)"] if "`heading`" in line)
    samples, rms, r_squared = re.search(r": (\d+) samples .* rms of (\S+); R\^2 (\S+)", told).groups()
    assert samples == "41"
    assert float(r_squared) == pytest.approx(
        1 - np.sum(error**2) / np.sum((value - value.mean()) ** 2), abs=2e-6
    )
    assert_allclose(float(rms), np.sqrt(np.mean(error**2)), rtol=5e-3)
    for name, (rho, _) in fit.autocorrelation.items():
        cells = found["Are the residuals white?"][name]
        assert float(cells[0]) == pytest.approx(rho, abs=6e-4)
        assert cells[2] == "yes"


def test_what_is_drawn_are_the_data_and_a_simulation(fitted, written):
    (fit, data), (path, _, figures) = fitted, written
    panels, motion = {}, jj.simulate(fit.scene, START, ts=TS)
    for figure in figures:
        panels.setdefault(figure.axes[0].get_ylabel(), figure)
    assert {f"{run}: {name}" for run in ("run 0", "held out, run 0") for name in ("x", "heading")} <= set(
        captions(path)
    )
    for name, label, sigma in (
        ("x", "x in m", 0.01),
        ("heading", "heading in SI units", float(fit.sigma["heading"])),
    ):
        above, below = panels[label].axes
        dots, line = (of.get_xydata() for of in above.lines)
        assert_array_equal(dots, np.stack([TS, data.values[name]], axis=1))  # a missing sample has no dot
        assert np.isfinite(dots).all() == (name == "heading")
        assert_allclose(line[:, 1], np.asarray(motion[name])[np.isin(TS, line[:, 0])], rtol=0, atol=1e-7)
        assert len(line) >= np.isfinite(data.values[name]).sum()
        assert_allclose(
            below.lines[-1].get_ydata(), (np.asarray(motion[name]) - data.values[name]) / sigma, atol=1e-3
        )


def test_report_loads_nothing_and_is_small(written):
    text = written[0].read_text(encoding="utf-8")
    # two channels with data and two held out, two profiles, widths of intervals
    assert text.count("<img") == text.count('src="data:image/png;base64,') == 7
    assert not re.search(r"(https?:|src=\"(?!data:)|href=|url\(|@import|<script)", text)
    assert len(text) < 1e6


def test_runs_held_out_are_predicted(fitted, written):
    path, other, _ = written
    lines, motion = sections(path)["Runs held out"], jj.simulate(fitted[0].scene, OTHER, ts=TS)
    for name, line in zip(("heading", "x"), lines, strict=True):
        error = np.asarray(motion[name]) - np.asarray(other.values[name])
        assert line.startswith(f"`{name}` of held out, run 0")
        assert_allclose(float(re.search(r"rms of (\S+);", line)[1]), np.sqrt(np.nanmean(error**2)), rtol=6e-3)


def test_a_report_without_matplotlib_has_all_words_and_says_what_to_install(fitted, tmp_path, monkeypatch):
    fit, data = fitted
    fit.report(tmp_path / "fit.html", data)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    fit.report(tmp_path / "plain.html", data)
    assert sections(tmp_path / "plain.html") == sections(tmp_path / "fit.html")
    text = (tmp_path / "plain.html").read_text(encoding="utf-8")
    assert "<img" not in text
    assert "install it with: pip install &#x27;jourdain-jax[plot]&#x27;" in text


def test_profiles_stand_in_the_report_and_the_bootstrap_has_gone(fitted, tmp_path):
    fit, data = fitted
    along = fit.profiles(data, "offset")
    fit.report(tmp_path / "fit.html", profiles=along)
    assert list(sections(tmp_path / "fit.html")["Profile likelihood"]) == [str(along["offset"])]
    with pytest.raises(AttributeError, match=r"`Fit\.profiles`.*`fit_batch`"):
        fit.bootstrap  # noqa: B018


def test_residuals_that_are_not_white_are_told_with_what_that_means(tmp_path):
    noise, motion = np.random.default_rng(0), jj.simulate(TRUTH, START, ts=TS)
    e = 0.01 * noise.normal(size=41)
    for k in range(1, 41):
        e[k] = 0.9 * e[k - 1] + np.sqrt(1 - 0.9**2) * e[k]
    data = jj.Experiment(TS, {"heading": np.asarray(motion["heading"]) + e}, 0.01, start=START)
    fit = offset_of(data)
    fit.report(tmp_path / "fit.html", data)
    _, _, white, time, narrow = sections(tmp_path / "fit.html")["Are the residuals white?"]["heading"]
    rho = fit.autocorrelation["heading"][0]
    assert white == "NO"
    assert_allclose(float(time.split()[1]), -0.1 / np.log(rho), rtol=0.06)
    assert_allclose(float(narrow.split()[1]), np.sqrt((1 + rho) / (1 - rho)), rtol=0.06)
    assert "intervals from the sigmas are too narrow" in (tmp_path / "fit.html").read_text(encoding="utf-8")


def test_a_notebook_shows_how_well_each_unknown_is_known(fitted, drawn):
    fit, _ = fitted
    shown = fit._repr_html_()
    assert shown.startswith("<pre>Fit of ChaplyginSleigh")
    assert len(shown) < 1e5
    (axes,) = drawn[0].axes
    for bar, e in zip(axes.patches, fit.estimates.values(), strict=True):
        assert_allclose(bar.get_width(), 100 * (e.high - e.value) / e.value, rtol=0.01)


def test_report_answers_what_it_cannot_write(fitted, tmp_path):
    fit, data = fitted
    refused(r"is a \.html file", fit.report, tmp_path / "fit.pdf")
    refused("expected the fit's", fit.report, tmp_path / "fit.html", [data, data])
    refused("are not the data of the fit", fit.report, tmp_path / "fit.html", measured(7))
    refused("computed from the fitted runs", fit.report, tmp_path / "fit.html", profiles=True)


# Profiles of unknowns against fits with the unknown held; shares of information against variances with
# changed sigmas; predictions of other runs.


RISE = 3.841458820694124  # 95 % quantile of chi-square with one degree of freedom


def run(start=START, sigma=0.01, noise=0, unknown=("heading_rate",), **more):
    motion, generator = jj.simulate(TRUTH, start, ts=TS), np.random.default_rng(noise or 0)
    values = {
        name: np.asarray(motion[name]) + (0 if noise is None else 0.01 * generator.normal(size=41))
        for name in ("x", "heading")
    }
    return jj.Experiment(TS, values, sigma, start=start, unknown_start=unknown, **more)


def test_the_profile_of_a_linear_unknown_is_the_parabola_of_its_standard_error():
    sensor = Sensor("heading", gain=jj.Estimate(1.1), bias=jj.Estimate(0.1))
    motion, noise = jj.simulate(TRUTH, START, ts=TS), np.random.default_rng(2)
    data = jj.Experiment(
        TS,
        {"shown": np.asarray(motion["heading"]) + 0.05 * noise.normal(size=41)},
        0.05,
        start=START,
        sensors={"shown": sensor},
    )
    fit = jj.fit(TRUTH, data)
    for one in fit.profiles(data).values():
        e = fit[one.name]
        assert one.kind == "bounded"
        assert_allclose(one.rise, ((one.values - e.value) / e.standard_error) ** 2, atol=2e-3)
        assert_allclose([one.low, one.high], [e.low, e.high], atol=0.01 * e.standard_error)
        assert "bounded" in str(one)


@pytest.mark.parametrize("sigma", [0.1, None], ids=["sigma known", "sigma estimated"])
def test_the_interval_ends_where_a_fit_with_the_unknown_held_is_that_much_worse(sigma):
    # few and noisy samples, so that the profile is no parabola; more of them where they are to tell the
    # sigmas, too
    ts, names, skew = (TS[::10], ("x",), 0.1) if sigma else (TS[::5], ("x", "heading"), 0.04)
    motion, noise = jj.simulate(TRUTH, START, ts=ts), np.random.default_rng(4)
    values = {name: np.asarray(motion[name]) + (sigma or 0.05) * noise.normal(size=len(ts)) for name in names}
    data = jj.Experiment(ts, values, sigma, start=START)
    fit = jj.fit(TRUTH, data, ("offset", "inertia"))
    (one,) = fit.profiles(data, "offset").values()
    assert abs((one.high - one.estimate) / (one.estimate - one.low) - 1) > skew
    for end, closed in zip((one.low, one.high), one.is_closed, strict=True):
        if not closed:
            continue
        held = jj.fit(fit.scene.replace(offset=end), data, ("inertia",), tolerance=1e-6)
        if sigma:
            rise = float(held.chi_square - fit.chi_square)
        else:  # 2 F = 2 sum n log sigma, of sigmas that allow for no unknowns
            likeliest = [
                {e.channel: e.rms * float(found.sigma[e.channel]) for e in found.residual_summary()}
                for found in (held, fit)
            ]
            rise = (
                sum(2 * len(ts) * np.log(likeliest[0][name] / likeliest[1][name]) for name in names)
                / fit.statistics.of_rise[0]
            )
        assert rise == pytest.approx(RISE, rel=0.02)
    assert any(one.is_closed)


def test_what_does_not_show_has_a_flat_profile():
    fit = jj.fit(TRUTH.replace(offset=0.3), data := run(), ("offset", "inertia", "mass"))
    found = fit.profiles(data)
    assert [one.kind for one in found.values()] == ["bounded", "flat", "flat"]
    assert found["mass"].high == np.inf
    assert np.max(found["mass"].rise) < 0.05
    assert np.ptp(np.log(found["mass"].values)) > np.log(100)


def test_profiles_answer_wrong_names_and_other_data():
    fit = offset_of(data := run())
    with pytest.raises(KeyError, match="`ofset` was not estimated; did you mean `offset`"):
        fit.profiles(data, "ofset")
    refused("are not the data of the fit", fit.profiles, run(noise=9))
    refused("expected the fit's", fit.profiles, run(unknown=()))


# Information on each unknown. -------------------------------------------------------------------------------


def shares(fit, runs):
    from jourdain_jax.identification.report.resumed_fit import informed, taken_up

    return informed(*taken_up(fit, runs), 20)


@pytest.mark.parametrize("memory", [0.0, 0.3], ids=["white", "with a memory"])
def test_a_share_is_by_how_much_the_variance_falls_with_the_weight_of_the_samples(memory):
    """d log C_ii / d log w, by central differences of fits to exact data with changed sigmas."""
    other = {"x_rate": -0.8, "heading_rate": 0.4}

    def fitted(change, where):
        sigma = [{"x": np.full(41, 0.01), "heading": np.full(41, 0.02)} for _ in range(2)]
        slower = np.exp(-change / 2)  # sigma = w^(-1/2)
        if where == "run 1":
            sigma[1] = {name: slower * s for name, s in sigma[1].items()}
        elif where == "heading":
            for of_run in sigma:
                of_run["heading"] *= slower
        elif where == "a sample":
            sigma[0]["x"][25] *= slower
        runs = [
            run(start, s, None, correlation_time=memory)
            for start, s in zip((START, other), sigma, strict=True)
        ]
        return jj.fit(TRUTH, runs, ("offset", "inertia")), runs

    fit, runs = fitted(0.0, "")
    found = shares(fit, runs)
    assert_allclose(found.of_runs.sum(axis=1), 1.0, rtol=1e-9)
    told = {
        "run 1": found.of_runs[:, 1],
        "heading": found.of_channels["heading"],
        "a sample": found.of_samples[0]["x"][:, 25],
    }
    for where, share in told.items():
        if memory and where == "a sample":
            continue  # with a memory, the sample after it is whitened with the sigma of this one
        more, less = (fitted(h, where)[0].standard_errors ** 2 for h in (0.01, -0.01))
        assert_allclose(share, -(np.log(more) - np.log(less)) / 0.02, rtol=1e-3, atol=1e-5, err_msg=where)


def test_a_prior_takes_what_the_data_do_not_tell():
    data = run(noise=None)
    alone = offset_of(data)
    s = 2 * float(alone["offset"].standard_error)
    fit = jj.fit(TRUTH, data, {"offset": jj.Estimate(prior=Normal(0.25, s))})
    found = shares(fit, data)
    assert_allclose(found.of_priors[0], float(fit["offset"].standard_error) ** 2 / s**2, rtol=1e-6)


def test_the_span_that_holds_half_of_the_information_is_the_shortest_one():
    fit = offset_of(data := run())
    found = shares(fit, data)
    told = sum(of[0] for of in found.of_samples[0].values())
    _, begin, end = found.half(0)
    inside = lambda a, b: told[(a - 1e-9 <= TS) & (b + 1e-9 >= TS)].sum()
    assert inside(begin, end) >= 0.5 * told.sum() * (1 - 1e-8)
    shorter = end - begin - 0.1
    assert max(inside(a, a + shorter) for a in TS) < 0.5 * told.sum()


# Runs held out. ---------------------------------------------------------------------------------------------


def test_a_run_held_out_is_predicted_with_its_own_start_fitted_to_it():
    gyro = Sensor("heading_rate", gain=jj.Estimate(1.0), bias=jj.Estimate(0.0, per_run=True))

    def with_gyro(start, bias, seed):
        motion, noise = jj.simulate(TRUTH, start, ts=TS), np.random.default_rng(seed)
        values = {"x": np.asarray(motion["x"]) + 0.01 * noise.normal(size=41)}
        values["gyro"] = 1.1 * np.asarray(motion["heading_rate"]) + bias + 0.01 * noise.normal(size=41)
        begin = start | {"heading_rate": start["heading_rate"] + 0.05}
        return jj.Experiment(
            TS,
            values,
            {"x": 0.01, "gyro": None},
            start=begin,
            unknown_start=("heading_rate",),
            sensors={"gyro": gyro},
        )

    fit = jj.fit(
        TRUTH.replace(offset=0.3),
        [with_gyro(START, 0.02, 0), with_gyro({"x_rate": -0.8, "heading_rate": 0.4}, -0.03, 1)],
        ("offset",),
    )
    other = with_gyro({"x_rate": -0.5, "heading_rate": 0.6}, 0.05, 2)
    (found,) = fit.predict(other)
    # the same by a fit whose shared unknowns are known
    known = Sensor("heading_rate", gain=float(fit["gyro.gain"].value), bias=jj.Estimate(0.0))
    by_hand = jj.fit(
        fit.scene,
        jj.Experiment(
            TS,
            other.values,
            other.sigma | {"gyro": None},
            start=other.start,
            unknown_start=("heading_rate",),
            sensors={"gyro": known},
        ),
    )
    for name, sigma in (("x", 0.01), ("gyro", float(by_hand.sigma["gyro"]))):
        assert_allclose(found[name].error, sigma * by_hand.residuals[0][name], atol=2e-5)
        assert found[name].rms == pytest.approx(float(np.sqrt(np.mean(found[name].error ** 2))))
        assert 0.99 < found[name].r_squared < 1
    assert 0.5 < found["x"].rms / 0.01 < 1.5
    assert_allclose(found["gyro"].sigma, float(fit.sigma["gyro"]))


def test_runs_held_out_that_cannot_be_predicted_are_answered():
    fit = offset_of(run(unknown=()))
    scaled = jj.Experiment(
        TS,
        {"gyro": np.zeros(41)},
        0.01,
        start=START,
        sensors={"gyro": Sensor("heading_rate", gain=jj.Estimate(1.0))},
    )
    refused(r"runs held out share `gyro\.gain`, which was not estimated", fit.predict, scaled)
