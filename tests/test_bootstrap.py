"""The parametric bootstrap: of problems that are linear its intervals are those of the closed form; what it cannot tell is refused or named."""

import numpy as np
import pytest
from scipy.special import stdtrit
from small_scenes import Bead, Oscillator

import jourdain_jax as jj
from jourdain_jax.analysis import bootstrap

TS, SIGMA = np.linspace(0.0, 6.0, 41), 0.02  # s, m
OSCILLATOR = Oscillator(damping=0.0)
W = float(np.sqrt(OSCILLATOR.stiffness / OSCILLATOR.mass))


def run(seed: int, ts=TS, sigma=SIGMA, tau=0.0, start=None, stated=SIGMA) -> jj.Experiment:
    """x = x0 cos(w t) + (v0 / w) sin(w t), read with a bias of 0.1 m; every fifth sample is missing."""
    e = sigma * np.random.default_rng(seed).normal(size=len(ts))
    rho = np.exp(-np.diff(ts) / tau) if tau else np.zeros(len(ts) - 1)
    for k, one in enumerate(rho, 1):
        e[k] = one * e[k - 1] + np.sqrt(1 - one**2) * e[k]
    x = 0.3 * np.cos(W * ts) + 0.2 / W * np.sin(W * ts) + 0.1 + e
    x[::5] = np.nan
    unknown = ("x", "x_rate") if start is None else start
    sensor = jj.Sensor("x", bias=jj.Estimate(0.05))
    return jj.Experiment(ts, {"gauge": x}, stated, start={"x": 0.25, "x_rate": 0.1}, unknown_start=unknown, sensors={"gauge": sensor}, correlation_time=tau)


def rows(ts) -> np.ndarray:
    """d gauge / d (bias, x, x_rate) of the samples that are there."""
    return np.stack([np.ones_like(ts), np.cos(W * ts), np.sin(W * ts) / W], axis=1)[np.arange(len(ts)) % 5 > 0]


@pytest.mark.parametrize(("tau", "prior"), [(0.0, None), (0.5, None), (0.0, 0.003), (0.5, 0.003)])
def test_intervals_of_a_linear_problem_are_those_of_the_closed_form(tau, prior):
    # two runs of unequal length, which share the bias; C = (sum A' V^-1 A + 1 / s^2)^-1
    start = None if prior is None else {"x": jj.Normal(0.3, prior), "x_rate": None}
    runs = [run(0, tau=tau, start=start), run(1, TS[:33], tau=tau)]
    fit = jj.fit(OSCILLATOR, runs, (), rtol=1e-9, atol=1e-9)
    found = fit.bootstrap(runs, 1500, seed=3)
    information = np.zeros((5, 5))
    for places, ts in (([0, 1, 2], TS), ([0, 3, 4], TS[:33])):
        known = ts[np.arange(len(ts)) % 5 > 0]
        V = np.exp(-np.abs(known[:, None] - known) / tau) if tau else np.eye(len(known))
        A = rows(ts) / SIGMA
        information[np.ix_(places, places)] += A.T @ np.linalg.solve(V, A)
    information[1, 1] += 0.0 if prior is None else prior**-2
    exact = np.sqrt(np.diag(np.linalg.inv(information)))
    assert found.fit.labels == ("gauge.bias", "run 0: x", "run 0: x_rate", "run 1: x", "run 1: x_rate")
    assert found.converged.all()
    np.testing.assert_allclose(fit.standard_errors, exact, rtol=1e-4)
    for name, value, error in zip(fit.labels, fit.values, exact, strict=True):
        e = found[name]
        assert e.standard_error == pytest.approx(error, rel=5 / np.sqrt(2 * 1500))
        assert abs(found.bias[name]) < 5 * error / np.sqrt(1500)
        for end, side in ((e.low, -1.96), (e.high, 1.96)):
            assert (end - value) / error == pytest.approx(side, abs=5 * 0.07)  # a quantile of 1500 is known to 0.07
    spread = np.corrcoef(found.values.T)
    np.testing.assert_allclose(spread, fit.correlation, atol=5 / np.sqrt(1500))
    assert not found.warnings


def test_the_same_seed_draws_the_same_repeats_and_many_are_fitted_in_parts(monkeypatch):
    data = run(0)
    fit = jj.fit(OSCILLATOR, data, ("stiffness",))
    first, again, other = (fit.bootstrap(data, 60, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.values, again.values)
    assert np.all(first.values[0] != other.values[0])
    assert str(first).startswith("Bootstrap of Oscillator: 60 fits of repeats, 60 converged\n")
    monkeypatch.setattr(bootstrap, "_ROOM", 25 * 8 * 41 * 6)
    parts = fit.bootstrap(data, 60, seed=1)
    assert parts.values.shape == (60, 4)
    assert len(np.unique(parts.values[:, 0])) == 60


def test_noise_of_residuals_has_their_spread_and_sigmas_that_are_estimated_allow_for_the_unknowns():
    data = run(0, TS[:16], stated=5 * SIGMA)
    fit = jj.fit(OSCILLATOR, data, ())
    by_sigmas, by_residuals = (fit.bootstrap(data, 1500, noise=noise)["gauge.bias"].standard_error for noise in ("sigmas", "residuals"))
    assert by_sigmas == pytest.approx(fit["gauge.bias"].standard_error, rel=0.1)
    assert by_residuals / by_sigmas == pytest.approx(np.sqrt(fit.reduced_chi_square), rel=0.12)
    data = run(0, TS[:16], stated=None)
    unknown = jj.fit(OSCILLATOR, data, ())  # its covariance has the factor samples / (samples - unknowns), here 1.33
    found = unknown.bootstrap(data, 1500)["gauge.bias"]
    assert found.standard_error == pytest.approx(unknown["gauge.bias"].standard_error, rel=0.1)
    # and its interval is that of Student's t, 1.15 times as wide as a normal one
    assert found.high - found.low == pytest.approx(unknown["gauge.bias"].high - unknown["gauge.bias"].low, rel=0.1)


def test_noise_of_residuals_allows_for_the_unknowns_of_each_channel_and_the_degrees_of_freedom_of_each_interval():
    # two straight lines, one with 20 samples, one with four
    ts, noise, start = np.linspace(0.0, 1.0, 20), np.random.default_rng(3), {"x": 1.0, "x_rate": 2.0, "y": 0.5, "y_rate": 1.0}
    x, y = 1 + 2 * ts + 0.1 * noise.normal(size=20), np.full(20, np.nan)
    few = [0, 6, 13, 19]
    y[few] = 0.5 + ts[few] + 0.3 * noise.normal(size=4)
    data = jj.Experiment(ts, {"x": x, "y": y}, 1.0, start=start, unknown_start=tuple(start))
    found = jj.fit(Bead(), data).bootstrap(data, 1500, noise="residuals")
    for name, t, z in (("x", ts, x), ("y", ts[few], y[few])):
        X = np.stack([np.ones(len(t)), t], axis=1)
        _, (rss,), *_ = np.linalg.lstsq(X, z)
        error, quantile = np.sqrt(rss / (len(t) - 2) * np.linalg.inv(X.T @ X)[1, 1]), stdtrit(len(t) - 2, 0.975)
        slope = found[f"run 0: {name}_rate"]
        assert slope.standard_error == pytest.approx(error, rel=0.1)
        assert slope.high - slope.low == pytest.approx(2 * quantile * error, rel=0.1)  # t of 2 degrees of freedom is 4.3


def test_intervals_stay_within_bounds_and_residuals_that_tell_no_noise_are_refused():
    ts, start = np.linspace(0.0, 1.0, 4), {"x": 1.0, "x_rate": 2.0}
    data = jj.Experiment(ts, {"x": [1.0, 1.8, 2.2, 3.1]}, None, start=start, unknown_start={"x": None, "x_rate": jj.bounds(1.9, 2.1)})
    rate = jj.fit(Bead(), data).bootstrap(data, 40)["run 0: x_rate"]
    assert 1.9 <= rate.low < rate.high <= 2.1
    data = jj.Experiment(ts, {"x": [1.0, 1.8, 2.2, 3.1], "y": [np.nan, 0.1, np.nan, np.nan]}, 0.1, start=start, unknown_start=tuple(start))
    with pytest.raises(ValueError, match="residuals of `y` tell nothing of its noise, with samples: 1"):
        jj.fit(Bead(), data).bootstrap(data, 40, noise="residuals")


def test_noise_is_students_t_under_that_loss_and_that_of_huber_comes_from_residuals():
    data = run(0)
    heavy = jj.fit(OSCILLATOR, data, (), loss=jj.student_t(3.0))
    # Fisher information of the location of Student's t: (nu + 1) / (nu + 3) / sigma^2
    exact = SIGMA * np.sqrt(np.linalg.inv(rows(TS).T @ rows(TS))[0, 0]) * np.sqrt(6 / 4)
    assert heavy.bootstrap(data, 1500)["gauge.bias"].standard_error == pytest.approx(exact, rel=0.15)
    huber = jj.fit(OSCILLATOR, data, (), loss=jj.huber())
    with pytest.raises(ValueError, match="`huber` does not say what noise there is"):
        huber.bootstrap(data)
    assert huber.bootstrap(data, 400, noise="residuals")["gauge.bias"].standard_error == pytest.approx(huber["gauge.bias"].standard_error, rel=0.2)


def test_what_the_data_do_not_tell_has_no_interval_and_a_bound_is_named():
    data = run(0, start=())
    fit = jj.fit(OSCILLATOR, data, ("stiffness", "mass"))  # only their ratio shows
    found = fit.bootstrap(data, 40)
    assert np.isnan([found["mass"].low, found["mass"].standard_error]).all()
    assert "none" in str(found)
    ratio = found.derived(lambda scene: scene.stiffness / scene.mass, "1/s^2")
    assert ratio.standard_error == pytest.approx(fit.derived(lambda scene: scene.stiffness / scene.mass).standard_error, rel=0.5)
    x = 0.3 * np.cos(W * TS) + 0.01 * np.random.default_rng(1).normal(size=41)
    undamped = jj.Experiment(TS, {"x": x}, 0.01, start={"x": 0.3})
    kept = jj.fit(Oscillator(), undamped, ("damping", "stiffness")).bootstrap(undamped, 40)
    assert "`damping` is at a bound in" in str(kept.warnings)
    assert 0 < kept.at_bound[:, 0].mean() < 1


def test_what_a_bootstrap_cannot_do_is_refused_by_name():
    data = run(0)
    fit = jj.fit(OSCILLATOR, data, ())
    with pytest.raises(ValueError, match="`repeats` is 10, expected a whole number of 40 or more"):
        fit.bootstrap(data, 10)
    with pytest.raises(ValueError, match="`noise` is 'pairs'"):
        fit.bootstrap(data, noise="pairs")
    with pytest.raises(ValueError, match="`data` are not those of the fit"):
        fit.bootstrap(run(1))
    with pytest.raises(ValueError, match="has not converged"):
        jj.fit(OSCILLATOR, data, (), max_iterations=0).bootstrap(data)
    runs = [run(seed) for seed in range(5)]
    with pytest.raises(ValueError, match='errors="runs"'):
        jj.fit(OSCILLATOR, runs, (), errors="runs").bootstrap(runs)
