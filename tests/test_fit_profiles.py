"""Profiles of unknowns against fits with the unknown held; shares of information against variances with changed sigmas; predictions of other runs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj

RISE = 3.841458820694124  # 95 % quantile of chi-square with one degree of freedom
START = {"x_rate": -0.6, "heading_rate": 0.9}
TS = np.linspace(0.0, 4.0, 41)
TRUTH = jj.models.ChaplyginSleigh(offset=0.25)


def run(start=START, sigma=0.01, noise: int | None = 0, unknown=("heading_rate",), **more) -> jj.Experiment:
    motion, generator = jj.simulate(TRUTH, start, ts=TS), np.random.default_rng(noise or 0)
    values = {name: np.asarray(motion[name]) + (0 if noise is None else 0.01 * generator.normal(size=41)) for name in ("x", "heading")}
    return jj.Experiment(TS, values, sigma, start=start, unknown_start=unknown, **more)


def test_the_profile_of_a_linear_unknown_is_the_parabola_of_its_standard_error():
    sensor = jj.Sensor("heading", gain=jj.Estimate(1.1), bias=jj.Estimate(0.1))
    motion, noise = jj.simulate(TRUTH, START, ts=TS), np.random.default_rng(2)
    data = jj.Experiment(TS, {"shown": np.asarray(motion["heading"]) + 0.05 * noise.normal(size=41)}, 0.05, start=START, sensors={"shown": sensor})
    fit = jj.fit(TRUTH, data)
    for one in fit.profiles(data).values():
        e = fit[one.name]
        assert one.kind == "bounded"
        assert_allclose(one.rise, ((one.values - e.value) / e.standard_error) ** 2, atol=2e-3)
        assert_allclose([one.low, one.high], [e.low, e.high], atol=0.01 * e.standard_error)
        assert "bounded" in str(one)


@pytest.mark.parametrize("sigma", [0.1, None], ids=["sigma known", "sigma estimated"])
def test_the_interval_ends_where_a_fit_with_the_unknown_held_is_that_much_worse(sigma):
    # few and noisy samples, so that the profile is no parabola; more of them where they are to tell the sigmas, too
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
            likeliest = [{e.channel: e.rms * float(found.sigma[e.channel]) for e in found.residual_summary()} for found in (held, fit)]
            rise = sum(2 * len(ts) * np.log(likeliest[0][name] / likeliest[1][name]) for name in names) / fit.statistics.of_rise[0]
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
    fit = jj.fit(TRUTH, data := run(), ("offset",))
    with pytest.raises(KeyError, match="`ofset` was not estimated; did you mean `offset`"):
        fit.profiles(data, "ofset")
    with pytest.raises(ValueError, match="are not those of the fit"):
        fit.profiles(run(noise=9))
    with pytest.raises(ValueError, match="expected those of the fit"):
        fit.profiles(run(unknown=()))


# What informs which unknown. --------------------------------------------------------------------------------------------


def shares(fit, runs):
    from jourdain_jax.analysis.resumed import informed, taken_up

    return informed(taken_up(fit, runs), 20)


@pytest.mark.parametrize("memory", [0.0, 0.3], ids=["white", "with a memory"])
def test_a_share_is_by_how_much_the_variance_falls_with_the_weight_of_the_samples(memory):
    """d log C_ii / d log w, by central differences of fits to exact data with changed sigmas."""
    other = {"x_rate": -0.8, "heading_rate": 0.4}

    def fitted(change: float, where: str):
        sigma = [{"x": np.full(41, 0.01), "heading": np.full(41, 0.02)} for _ in range(2)]
        slower = np.exp(-change / 2)  # sigma = w^(-1/2)
        if where == "run 1":
            sigma[1] = {name: slower * s for name, s in sigma[1].items()}
        elif where == "heading":
            for of_run in sigma:
                of_run["heading"] *= slower
        elif where == "a sample":
            sigma[0]["x"][25] *= slower
        runs = [run(start, s, None, correlation_time=memory) for start, s in zip((START, other), sigma, strict=True)]
        return jj.fit(TRUTH, runs, ("offset", "inertia")), runs

    fit, runs = fitted(0.0, "")
    found = shares(fit, runs)
    assert_allclose(found.of_runs.sum(axis=1), 1.0, rtol=1e-9)
    told = {"run 1": found.of_runs[:, 1], "heading": found.of_channels["heading"], "a sample": found.of_samples[0]["x"][:, 25]}
    for where, share in told.items():
        if memory and where == "a sample":
            continue  # with a memory, the sample after it is whitened with the sigma of this one
        more, less = (fitted(h, where)[0].standard_errors ** 2 for h in (0.01, -0.01))
        assert_allclose(share, -(np.log(more) - np.log(less)) / 0.02, rtol=1e-3, atol=1e-5, err_msg=where)


def test_a_prior_takes_what_the_data_do_not_tell():
    data = run(noise=None)
    alone = jj.fit(TRUTH, data, ("offset",))
    s = 2 * float(alone["offset"].standard_error)
    fit = jj.fit(TRUTH, data, {"offset": jj.Estimate(prior=jj.Normal(0.25, s))})
    found = shares(fit, data)
    assert found.of_priors[0] == pytest.approx(float(fit["offset"].standard_error) ** 2 / s**2, rel=1e-6)


def test_the_span_that_holds_half_of_the_information_is_the_shortest_one():
    fit = jj.fit(TRUTH, data := run(), ("offset",))
    found = shares(fit, data)
    told = sum(of[0] for of in found.of_samples[0].values())
    _, begin, end = found.half(0)
    inside = lambda a, b: told[(a - 1e-9 <= TS) & (b + 1e-9 >= TS)].sum()  # noqa: E731
    assert inside(begin, end) >= 0.5 * told.sum() * (1 - 1e-8)
    shorter = end - begin - 0.1
    assert max(inside(a, a + shorter) for a in TS) < 0.5 * told.sum()


# Runs held out. ---------------------------------------------------------------------------------------------------------


def test_a_run_held_out_is_predicted_with_its_own_start_fitted_to_it():
    gyro = jj.Sensor("heading_rate", gain=jj.Estimate(1.0), bias=jj.Estimate(0.0, per_run=True))

    def with_gyro(start, bias: float, seed: int):
        motion, noise = jj.simulate(TRUTH, start, ts=TS), np.random.default_rng(seed)
        values = {"x": np.asarray(motion["x"]) + 0.01 * noise.normal(size=41)}
        values["gyro"] = 1.1 * np.asarray(motion["heading_rate"]) + bias + 0.01 * noise.normal(size=41)
        begin = start | {"heading_rate": start["heading_rate"] + 0.05}
        return jj.Experiment(TS, values, {"x": 0.01, "gyro": None}, start=begin, unknown_start=("heading_rate",), sensors={"gyro": gyro})

    fit = jj.fit(TRUTH.replace(offset=0.3), [with_gyro(START, 0.02, 0), with_gyro({"x_rate": -0.8, "heading_rate": 0.4}, -0.03, 1)], ("offset",))
    other = with_gyro({"x_rate": -0.5, "heading_rate": 0.6}, 0.05, 2)
    (found,) = fit.predict(other)
    # the same by a fit whose shared unknowns are known
    known = jj.Sensor("heading_rate", gain=float(fit["gyro.gain"].value), bias=jj.Estimate(0.0))
    by_hand = jj.fit(
        fit.scene, jj.Experiment(TS, other.values, other.sigma | {"gyro": None}, start=other.start, unknown_start=("heading_rate",), sensors={"gyro": known})
    )
    for name, sigma in (("x", 0.01), ("gyro", float(by_hand.sigma["gyro"]))):
        assert_allclose(found[name].error, sigma * by_hand.residuals[0][name], atol=2e-5)
        assert found[name].rms == pytest.approx(float(np.sqrt(np.mean(found[name].error ** 2))))
        assert 0.99 < found[name].r_squared < 1
    assert 0.5 < found["x"].rms / 0.01 < 1.5
    assert_allclose(found["gyro"].sigma, float(fit.sigma["gyro"]))


def test_runs_held_out_that_cannot_be_predicted_are_answered():
    fit = jj.fit(TRUTH, run(unknown=()), ("offset",))
    scaled = jj.Experiment(TS, {"gyro": np.zeros(41)}, 0.01, start=START, sensors={"gyro": jj.Sensor("heading_rate", gain=jj.Estimate(1.0))})
    with pytest.raises(ValueError, match=r"runs held out share `gyro\.gain`, which was not estimated"):
        fit.predict(scaled)
