"""Sigmas that nobody stated and robust losses, against closed forms: what the unknowns take of the samples,
and intervals of Student's t.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import stdtrit
from small_scenes import Bead

import jourdain_jax as jj
from jourdain_jax.identification import Sensor, huber, student_t
from jourdain_jax.studies import Normal

START = {"x": 1.0, "x_rate": 2.0, "y": 0.0, "y_rate": 0.0}
BOTH = ("x", "x_rate")


def lines(count=6, seed=0, sigma=0.1) -> tuple[np.ndarray, np.ndarray]:
    """Times, and a noisy straight line."""
    ts = np.linspace(0.0, 1.0, count)
    return ts, 1.0 + 2.0 * ts + sigma * np.random.default_rng(seed).normal(size=count)


def run(ts, values, sigma, unknown=BOTH, **options) -> jj.Experiment:
    return jj.Experiment(ts, values, sigma, start=START, unknown_start=unknown, **options)


def test_few_samples_of_unknown_noise_give_the_textbook_intervals_of_regression():
    count = 6
    ts, y = lines()
    data = run(ts, {"x": y}, None)
    found = jj.fit(Bead(), data)
    X = np.stack([np.ones(count), ts], axis=1)
    b, (rss,), *_ = np.linalg.lstsq(X, y)
    errors = np.sqrt(rss / (count - 2) * np.diag(np.linalg.inv(X.T @ X)))
    assert found.sigma["x"] == pytest.approx(np.sqrt(rss / (count - 2)), rel=1e-6)
    assert found.reduced_chi_square == pytest.approx(1.0)
    assert_allclose(found.values, b, rtol=1e-6)
    assert_allclose(found.standard_errors, errors, rtol=1e-6)
    assert_allclose(found.high - found.values, stdtrit(count - 2, 0.975) * errors, rtol=1e-6)
    profile = found.profiles(data)["run 0: x_rate"]
    assert profile.high - b[1] == pytest.approx(
        stdtrit(count - 2, 0.975) * errors[1], rel=0.02
    )  # ends of profiles are found to 1 % of the rise


def test_a_channel_with_a_known_sigma_keeps_its_own_beside_one_that_has_none():
    ts, y = lines()
    other = 0.4 * np.random.default_rng(1).normal(size=6)
    found = jj.fit(Bead(), run(ts, {"x": y, "y": other}, {"x": None, "y": 0.4}, (*BOTH, "y", "y_rate")))
    X = np.stack([np.ones(6), ts], axis=1)
    errors, (_, (rss,), *_) = np.sqrt(np.diag(np.linalg.inv(X.T @ X))), np.linalg.lstsq(X, y)
    reach = np.concatenate([stdtrit(4, 0.975) * np.sqrt(rss / 4) * errors, 1.959964 * 0.4 * errors])
    assert_allclose(found.high - found.values, reach, rtol=1e-5)


def test_what_priors_tell_is_not_taken_from_the_samples():
    ts, y = lines()
    prior = {"x": Normal(1.0, 0.03), "x_rate": Normal(2.0, 0.1)}
    X, P = np.stack([np.ones(6), ts], axis=1), np.diag([0.03**-2, 0.1**-2])
    known = jj.fit(Bead(), run(ts, {"x": y}, 0.1, prior))
    C = np.linalg.inv(X.T @ X / 0.1**2 + P)
    assert known.degrees_of_freedom == pytest.approx(6 - np.trace(C @ X.T @ X) / 0.1**2, rel=1e-9)
    found = jj.fit(Bead(), run(ts, {"x": y}, None, prior))
    s, residuals = float(found.sigma["x"]), y - X @ found.values
    C = np.linalg.inv(X.T @ X / s**2 + P)
    left = 6 - np.trace(C @ X.T @ X) / s**2
    assert s**2 == pytest.approx(residuals @ residuals / left, rel=1e-6)
    assert_allclose(found.covariance, C, rtol=1e-6)
    # more priors than samples are enough
    few = jj.fit(Bead(), run(ts, {"x": np.where(np.arange(6) < 2, y, np.nan)}, 0.1, prior))
    assert 0 < float(few.reduced_chi_square) < 5


@pytest.mark.parametrize("own", [(), ("x_rate",)], ids=["all shared", "a start of each run"])
def test_channels_that_share_unknowns_have_the_sigmas_of_restricted_likelihood(own):
    # two sensors of one place in three runs, with a bias that all share
    noise, runs, X = np.random.default_rng(2), [], []
    for k, count in enumerate((4, 6, 5)):
        ts = np.linspace(0.1, 1.0 + k, count)
        values = {
            "far": 1.3 + 2 * ts + 0.1 * noise.normal(size=count),
            "near": 2.0 + 4 * ts + 0.05 * noise.normal(size=count),
        }
        sensors = {"far": Sensor("x", bias=jj.Estimate(0.1)), "near": Sensor("x", gain=2.0)}
        runs.append(
            run(ts, values, None, ("x", *own)[k == 0 and not own :] if own else (), sensors=sensors, t0=0.0)
        )
        rows = np.zeros((2, count, 1 + 3 * 2))
        rows[0, :, 0], rows[0, :, 1 + 2 * k], rows[0, :, 2 + 2 * k] = 1.0, 1.0, ts
        rows[1] = 2 * rows[0]
        rows[1, :, 0] = 0.0
        X.append(rows)
    found = jj.fit(Bead(), runs)
    columns = [0, 1, 2, 3, 4, 5, 6] if own else [0]
    J = {
        "far": np.concatenate([x[0] for x in X])[:, columns],
        "near": np.concatenate([x[1] for x in X])[:, columns],
    }
    s = {name: float(found.sigma[name]) for name in J}
    C = np.linalg.inv(sum(J[name].T @ J[name] / s[name] ** 2 for name in J))
    doubt, more = 0.0, 0.0
    for name in J:
        A = J[name].T @ J[name] / s[name] ** 2
        residuals = np.concatenate([of[name] for of in found.residuals]) * s[name]
        left = 15 - np.trace(C @ A)
        assert s[name] ** 2 == pytest.approx(residuals @ residuals / left, rel=1e-6)
        doubt = doubt + (np.diag(C @ A @ C) / np.diag(C)) ** 2 / left
        # - sigma^4 d^2 C / d (sigma^2)^2, of C = (sum A)^-1
        more = more + 2 / left * 2 * np.diag(C @ A @ C - C @ A @ C @ A @ C) / np.diag(C)
    assert_allclose(found.standard_errors, np.sqrt(np.diag(C)), rtol=1e-6)
    assert_allclose(
        (found.high - found.values) / found.standard_errors,
        stdtrit(1 / doubt, 0.975) * np.sqrt(1 + more),
        rtol=1e-5,
    )


def test_a_channel_that_is_met_exactly_does_not_tell_its_sigma():
    ts, x = lines()
    y = np.full(6, np.nan)
    y[[1, 4]] = 0.1, 0.3
    found = jj.fit(Bead(), run(ts, {"x": x, "y": y}, None, (*BOTH, "y", "y_rate")))
    assert "channel `y` has no degrees of freedom left" in found.warning
    assert np.isnan(found["run 0: y"].standard_error)
    X = np.stack([np.ones(6), ts], axis=1)
    _, (rss,), *_ = np.linalg.lstsq(X, x)
    error = np.sqrt(rss / 4 * np.linalg.inv(X.T @ X)[0, 0])
    assert float(found["run 0: x"].high - found["run 0: x"].value) == pytest.approx(
        stdtrit(4, 0.975) * error, rel=1e-5
    )


@pytest.mark.parametrize("loss", [huber(), student_t(4.0)])
def test_errors_of_runs_under_a_robust_loss_hold_where_sigmas_are_far_too_small(loss):
    noise, ts = np.random.default_rng(3), np.linspace(0.1, 1.0, 30)
    gain = {"x": Sensor("x", gain=jj.Estimate(1.0))}
    ys = [(1 + 2 * ts) * (1 + 0.05 * noise.normal()) + 0.1 * noise.normal(size=30) for _ in range(6)]
    found = jj.fit(
        Bead(), [run(ts, {"x": y}, 0.02, (), sensors=gain, t0=0.0) for y in ys], errors="runs", loss=loss
    )
    slope, scores, bend, weights = (1 + 2 * ts) / 0.02, [], [], []
    for y in ys:
        r = (found.values[0] * (1 + 2 * ts) - y) / 0.02
        scores.append(np.sum(loss.weight(r) * r * slope))
        weights.append(loss.weight(r))
        bend.append(
            (np.abs(r) <= loss.parameter) if loss.kind == "huber" else 5 * (4 - r**2) / (4 + r**2) ** 2
        )
    # H = J'J mean psi', with J'J from the weighted one
    H = sum(np.sum(w * slope**2) for w in weights) * np.mean(bend) / np.mean(weights)
    assert_allclose(found.standard_errors, [np.sqrt(np.sum(np.square(scores)) * 6 / 5) / H], rtol=1e-6)
    # how runs differ says nothing of what is a run's own
    own = [run(ts, {"x": y}, 0.1, ("x",), t0=0.0) for y in ys]
    errors = [jj.fit(Bead(), own, errors=whence, loss=loss).standard_errors for whence in ("runs", "sigmas")]
    assert_allclose(*errors, rtol=1e-6)


def test_a_robust_loss_does_not_widen_what_a_prior_tells():
    ts, noise = np.linspace(0.0, 1.0, 12), np.random.default_rng(4)
    y, sure = 1 + 2 * ts + 0.1 * noise.standard_t(4, size=12), Normal(2.0, 1e-3)
    found = jj.fit(Bead(), run(ts, {"x": y}, 0.05, {"x": None, "x_rate": sure}), loss=student_t())
    assert found["run 0: x_rate"].standard_error == pytest.approx(1e-3, rel=1e-3)
    r = np.asarray(found.residuals[0]["x"])
    psi, slope = 5 * r / (4 + r**2), 5 * (4 - r**2) / (4 + r**2) ** 2
    p = 12 - float(found.degrees_of_freedom)
    assert p == pytest.approx(1.0, rel=1e-2)
    # Huber and Ronchetti (2009), section 7.6, of a mean; J'J from the weighted one
    K = 1 + p / 12 * np.var(slope) / np.mean(slope) ** 2
    variance = (
        K**2
        * np.sum(psi**2)
        / (12 - p)
        / np.mean(slope) ** 2
        * np.mean(5 / (4 + r**2))
        / np.sum(5 / (4 + r**2))
        * 0.05**2
    )
    assert found["run 0: x"].standard_error == pytest.approx(np.sqrt(variance), rel=1e-2)


@pytest.mark.parametrize("sigma", [0.1, None], ids=["sigma known", "sigma estimated"])
def test_a_repeat_without_samples_has_not_converged(sigma):
    ts, y = lines()
    found = jj.fit_batch(Bead(), run(ts, {"x": np.stack([y, np.full(6, np.nan)])}, sigma))
    assert found.converged.tolist() == [True, False]
    assert_allclose(
        found.standard_errors[0], jj.fit(Bead(), run(ts, {"x": y}, sigma)).standard_errors, rtol=1e-6
    )


@pytest.mark.parametrize(
    ("value", "sigma"), [(np.finfo(float).max, 0.1), (1.0, 1e-300)], ids=["value", "sigma"]
)
def test_residuals_beyond_all_measure_are_not_called_a_motion_that_fails(value, sigma):
    ts, y = lines()
    y[2] = value
    assert jj.fit(Bead(), run(ts, {"x": y}, sigma)).warning.startswith(
        "residuals overflow at the first guess"
    )


def test_a_memory_needs_neighbours():
    runs = [run([0.5], {"x": [2.0 + 0.01 * k]}, 0.1, ("x",), t0=0.0, correlation_time=None) for k in range(3)]
    with pytest.raises(ValueError, match="each run has only one sample"):
        jj.fit(Bead(), runs)


def line_with_slope():
    """Times and a noisy straight line, the slope that fits it best, and its standard error for each sigma
    that may be stated.
    """
    ts, y = lines()
    X = np.stack([np.ones(6), ts], axis=1)
    (_, slope), (rss,), *_ = np.linalg.lstsq(X, y)
    unit = np.sqrt(np.linalg.inv(X.T @ X)[1, 1])
    return ts, y, slope, {None: np.sqrt(rss / 4) * unit, 0.1: 0.1 * unit}


def test_limits_at_a_bound_and_profiles_from_it_are_those_of_students_t_where_sigmas_are_estimated():
    # of a straight line whose slope may not be less than it is found to be without a bound
    ts, y, slope, errors = line_with_slope()
    error = errors[None]
    for sigma, reach in ((None, stdtrit(4, 0.975) * error), (0.1, 1.959964 * errors[0.1])):
        data = run(ts, {"x": y}, sigma, {"x": None, "x_rate": jj.bounds(slope + 1e-3 * error, 9.0)})
        found = jj.fit(Bead(), data)
        assert found.at_bound.tolist() == [False, True]
        assert float(found["run 0: x_rate"].high) - slope == pytest.approx(
            reach, rel=0.02
        )  # found to 2 % of the rise
        profile = found.profiles(data)["run 0: x_rate"]
        assert (profile.kind, profile.is_closed) == ("one-sided", (False, True))
        assert profile.high - slope == pytest.approx(reach, rel=0.02)


def test_a_bound_that_decides_is_named_where_its_misfit_counts_as_noise():
    ts, y, slope, errors = line_with_slope()
    for sigma, error in errors.items():
        for far in (2.0, 8.0):
            bounded = jj.Estimate(slope + 10 * error, range=jj.bounds(slope + far * error, 90.0))
            found = jj.fit(Bead(), run(ts, {"x": y}, sigma, {"x": None, "x_rate": bounded}))
            assert found.beyond[1] == pytest.approx(far, rel=1e-4)
            assert any("decides its value" in sentence for sentence in found.warnings) == (far > 3)
