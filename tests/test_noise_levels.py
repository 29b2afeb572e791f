"""Sigmas that nobody stated and robust losses, against closed forms: what the unknowns take of the samples,
and intervals of Student's t.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from scipy.special import stdtrit
from small_scenes import Bead

import jourdain_jax as jj
from jourdain_jax.identification import Sensor, huber, student_t
from jourdain_jax.studies import Normal

START = {"x": 1.0, "x_rate": 2.0, "y": 0.0, "y_rate": 0.0}
BOTH = ("x", "x_rate")


# a noisy straight line at six times, its regression, sum of squares and standard errors for a sigma of one
TS = np.linspace(0.0, 1.0, 6)
LINE = 1.0 + 2.0 * TS + 0.1 * np.random.default_rng(0).normal(size=6)
X = np.stack([np.ones(6), TS], axis=1)
FITTED, (RSS,), *_ = np.linalg.lstsq(X, LINE)
UNIT = np.sqrt(np.diag(np.linalg.inv(X.T @ X)))
ERRORS = np.sqrt(RSS / 4) * UNIT
STUDENT, NORMAL = stdtrit(4, 0.975), 1.959964


def run(values, sigma, unknown=BOTH, ts=TS, **options):
    return jj.Experiment(ts, values, sigma, start=START, unknown_start=unknown, **options)


def test_few_samples_of_unknown_noise_give_the_textbook_intervals_of_regression():
    data = run({"x": LINE}, None)
    found = jj.fit(Bead(), data)
    assert_allclose(found.sigma["x"], np.sqrt(RSS / 4), rtol=1e-6)
    assert found.reduced_chi_square == pytest.approx(1.0)
    assert_allclose(found.values, FITTED, rtol=1e-6)
    assert_allclose(found.standard_errors, ERRORS, rtol=1e-6)
    assert_allclose(found.high - found.values, STUDENT * ERRORS, rtol=1e-6)
    profile = found.profiles(data)["run 0: x_rate"]  # its ends are found to 1 % of the rise
    assert_allclose(profile.high - FITTED[1], STUDENT * ERRORS[1], rtol=0.02)


def test_what_priors_tell_is_not_taken_from_the_samples():
    prior = {"x": Normal(1.0, 0.03), "x_rate": Normal(2.0, 0.1)}

    def told(sigma):
        """The covariance, and how many samples are left."""
        A = X.T @ X / sigma**2
        C = np.linalg.inv(A + np.diag([0.03**-2, 0.1**-2]))
        return C, 6 - np.trace(C @ A)

    known, found = (jj.fit(Bead(), run({"x": LINE}, sigma, prior)) for sigma in (0.1, None))
    assert_allclose(known.degrees_of_freedom, told(0.1)[1], rtol=1e-9)
    s, residuals = float(found.sigma["x"]), LINE - X @ found.values
    C, left = told(s)
    assert_allclose(s**2, residuals @ residuals / left, rtol=1e-6)
    assert_allclose(found.covariance, C, rtol=1e-6)
    # more priors than samples are enough
    few = jj.fit(Bead(), run({"x": np.where(np.arange(6) < 2, LINE, np.nan)}, 0.1, prior))
    assert 0 < few.reduced_chi_square < 5


@pytest.mark.parametrize("own", [(), ("x_rate",)], ids=["all shared", "a start of each run"])
def test_channels_that_share_unknowns_have_the_sigmas_of_restricted_likelihood(own):
    # two sensors of one place in three runs, with a bias that all share
    noise, runs, all_rows = np.random.default_rng(2), [], []
    for k, count in enumerate((4, 6, 5)):
        ts = np.linspace(0.1, 1.0 + k, count)
        values = {
            "far": 1.3 + 2 * ts + 0.1 * noise.normal(size=count),
            "near": 2.0 + 4 * ts + 0.05 * noise.normal(size=count),
        }
        sensors = {"far": Sensor("x", bias=jj.Estimate(0.1)), "near": Sensor("x", gain=2.0)}
        runs.append(run(values, None, ("x", *own) if own else (), ts, sensors=sensors, t0=0.0))
        rows = np.zeros((2, count, 1 + 3 * 2))
        rows[0, :, 0], rows[0, :, 1 + 2 * k], rows[0, :, 2 + 2 * k] = 1.0, 1.0, ts
        rows[1] = 2 * rows[0]
        rows[1, :, 0] = 0.0
        all_rows.append(rows)
    found = jj.fit(Bead(), runs)
    every = np.concatenate(all_rows, axis=1)[..., : None if own else 1]
    J = dict(zip(("far", "near"), every, strict=True))
    s = {name: float(found.sigma[name]) for name in J}
    C = np.linalg.inv(sum(J[name].T @ J[name] / s[name] ** 2 for name in J))
    doubt, more = 0.0, 0.0
    for name in J:
        A = J[name].T @ J[name] / s[name] ** 2
        residuals = np.concatenate([of[name] for of in found.residuals]) * s[name]
        left = 15 - np.trace(C @ A)
        assert_allclose(s[name] ** 2, residuals @ residuals / left, rtol=1e-6)
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
    y = np.full(6, np.nan)
    y[[1, 4]] = 0.1, 0.3
    found = jj.fit(Bead(), run({"x": LINE, "y": y}, None, (*BOTH, "y", "y_rate")))
    assert "channel `y` has no degrees of freedom left" in found.warning
    assert np.isnan(found["run 0: y"].standard_error)
    assert_allclose(found["run 0: x"].high - found["run 0: x"].value, STUDENT * ERRORS[0], rtol=1e-5)


@pytest.mark.parametrize("loss", [huber(), student_t(4.0)])
def test_errors_of_runs_under_a_robust_loss_hold_where_sigmas_are_far_too_small(loss):
    noise, ts = np.random.default_rng(3), np.linspace(0.1, 1.0, 30)
    gain = {"x": Sensor("x", gain=jj.Estimate(1.0))}
    ys = [(1 + 2 * ts) * (1 + 0.05 * noise.normal()) + 0.1 * noise.normal(size=30) for _ in range(6)]
    found = jj.fit(
        Bead(), [run({"x": y}, 0.02, (), ts, sensors=gain, t0=0.0) for y in ys], errors="runs", loss=loss
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
    own = [run({"x": y}, 0.1, ("x",), ts, t0=0.0) for y in ys]
    errors = [jj.fit(Bead(), own, errors=whence, loss=loss).standard_errors for whence in ("runs", "sigmas")]
    assert_allclose(*errors, rtol=1e-6)


@pytest.mark.parametrize(
    ("value", "sigma"), [(np.finfo(float).max, 0.1), (1.0, 1e-300)], ids=["value", "sigma"]
)
def test_residuals_beyond_all_measure_are_not_called_a_motion_that_fails(value, sigma):
    found = jj.fit(Bead(), run({"x": np.where(np.arange(6) == 2, value, LINE)}, sigma))
    assert found.warning.startswith("residuals overflow at the first guess")


def test_a_memory_needs_neighbours():
    runs = [run({"x": [2.0 + 0.01 * k]}, 0.1, ("x",), [0.5], t0=0.0, correlation_time=None) for k in range(3)]
    refused("each run has only one sample", jj.fit, Bead(), runs)


SLOPES = {
    None: ERRORS[1],
    0.1: 0.1 * UNIT[1],
}  # standard errors of the slope for each sigma that may be stated


def test_limits_at_a_bound_and_profiles_from_it_are_those_of_students_t_where_sigmas_are_estimated():
    # of a straight line whose slope may not be less than it is found to be without a bound
    slope = FITTED[1]
    for sigma, reach in ((None, STUDENT * ERRORS[1]), (0.1, NORMAL * SLOPES[0.1])):
        data = run({"x": LINE}, sigma, {"x": None, "x_rate": jj.bounds(slope + 1e-3 * ERRORS[1], 9.0)})
        found = jj.fit(Bead(), data)
        assert found.at_bound.tolist() == [False, True]
        high = found["run 0: x_rate"].high  # found to 2 % of the rise
        assert_allclose(high - slope, reach, rtol=0.02)
        profile = found.profiles(data)["run 0: x_rate"]
        assert (profile.kind, profile.is_closed) == ("one-sided", (False, True))
        assert_allclose(profile.high - slope, reach, rtol=0.02)
