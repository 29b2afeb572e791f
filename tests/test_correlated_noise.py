"""Noise with a memory: whitening against the dense covariance, correlation times known and estimated, and
advice on bad input.
"""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import chaplygin_sleigh as sleigh_oracle
from small_scenes import OnLine

import jourdain_jax as jj
from jourdain_jax.identification import log_likelihood

SIGMA, TAU = 0.02, 0.4  # m, rad; s: neighbours at 0.1 s correlate at 0.78
TS = np.linspace(0.0, 8.0, 41)
GUESS = jj.models.ChaplyginSleigh(inertia=0.45, offset=0.28)
START = {"x_rate": -0.6, "heading_rate": 0.9}
TRUTH = {"inertia": 0.4, "offset": 0.25}


def coloured(generator, ts, tau, shape=()):
    """Draws of a process of variance one with covariance exp(-|t - t'| / tau), by a Cholesky factor."""
    factor = np.linalg.cholesky(np.exp(-np.abs(ts[:, None] - ts) / tau))
    return generator.normal(size=(*shape, len(ts))) @ factor.T


def sleigh_run(seed, correlation_time, sigma=SIGMA, ts=TS, repeats=(), missing=()):
    motion = sleigh_oracle.motion(ts, mass=1.3, inertia=0.4, a=0.25, v0=-0.6, w0=0.9)
    generator = np.random.default_rng(seed)
    values = {
        name: motion[key] + SIGMA * coloured(generator, ts, TAU, repeats)
        for name, key in (("x", "x"), ("y", "y"), ("heading", "th"))
    }
    values["x"][..., list(missing)] = np.nan
    return jj.Experiment(ts, values, sigma, start=START, correlation_time=correlation_time)


UNEVEN = np.cumsum(np.random.default_rng(3).uniform(0.02, 0.5, 30))


@pytest.mark.parametrize("tau", [0.05, 0.9, 30.0])
def test_the_likelihood_is_the_dense_normal_one_at_uneven_times_and_across_gaps(tau):
    motion = sleigh_oracle.motion(UNEVEN - UNEVEN[0], mass=1.3, inertia=0.4, a=0.25, v0=-0.6, w0=0.9)
    e = SIGMA * coloured(np.random.default_rng(0), UNEVEN, 0.9)
    known = np.ones(30, bool)
    known[[0, 7, 8, 20]] = False
    data = jj.Experiment(
        UNEVEN, {"x": np.where(known, motion["x"] + e, np.nan)}, SIGMA, start=START, correlation_time=tau
    )
    truth = jj.models.ChaplyginSleigh(mass=1.3, inertia=0.4, offset=0.25)
    ts, r = UNEVEN[known], e[known]
    V = SIGMA**2 * np.exp(-np.abs(ts[:, None] - ts) / tau)
    expected = -0.5 * r @ np.linalg.solve(V, r) - 0.5 * np.linalg.slogdet(2 * np.pi * V)[1]
    # the simulation's error of 1e-8 m is multiplied where neighbours nearly agree
    found = jax.jit(lambda scene: log_likelihood(scene, data, rtol=1e-10, atol=1e-10))
    assert found(truth) == pytest.approx(expected, abs=1e-4 * abs(expected))


@pytest.mark.parametrize("sigma", [SIGMA, None], ids=["sigmas known", "sigmas estimated"])
def test_a_memory_of_the_noise_is_found_and_the_warning_goes(sigma):
    ts = np.linspace(0.0, 8.0, 161)
    white = jj.fit(GUESS, sleigh_run(2, 0.0, sigma, ts), ("inertia", "offset"))
    found = jj.fit(GUESS, sleigh_run(2, None, sigma, ts, missing=(7, 8, 9)), ("inertia", "offset"))
    assert "not white" in white.warning
    assert "correlation_time" in white.warning
    assert found.converged
    assert not found.warning
    for name, tau in found.correlation_time.items():
        assert TAU / 3 < float(tau) < 3 * TAU, name
    assert "correlation time of the noise of `x`, estimated" in str(found)
    for name, truth in TRUTH.items():
        assert found[name].low < truth < found[name].high
        assert found[name].standard_error > 1.5 * white[name].standard_error
    assert np.isnan(found.whitened[0]["x"][7:10]).all()
    assert np.isfinite(found.whitened[0]["x"][10])


class Coasting(OnLine):
    """`x = x0 + v t`: linear in what is unknown."""

    mass: object = jj.parameter(1.0, positive=True)


def test_intervals_are_those_of_all_correlation_times_by_their_restricted_likelihood():
    ts, start = np.linspace(0.0, 8.0, 81), {"x": 0.5, "x_rate": -0.2}
    x = 0.5 - 0.2 * ts + SIGMA * coloured(np.random.default_rng(5), ts, TAU)
    found = jj.fit(
        Coasting(),
        jj.Experiment(ts, {"x": x}, SIGMA, start=start, unknown_start=("x", "x_rate"), correlation_time=None),
    )
    # the same by dense covariances, on a fine grid of arcsin rho
    J, logs, estimates, variances = np.stack([np.ones(81), ts], axis=1), [], [], []
    angles = np.linspace(0.01, 1.5, 600)
    for rho in np.sin(angles):
        V = SIGMA**2 * rho ** (np.abs(ts[:, None] - ts) / 0.1)
        Vi = np.linalg.inv(V)
        C = np.linalg.inv(J.T @ Vi @ J)
        theta = C @ J.T @ Vi @ x
        logs.append(
            -0.5
            * ((x - J @ theta) @ Vi @ (x - J @ theta) + np.linalg.slogdet(V)[1] - np.linalg.slogdet(C)[1])
        )
        estimates.append(theta)
        variances.append(np.diag(C))
    weight, estimates, variances = (
        np.exp(np.array(logs) - max(logs)),
        np.array(estimates),
        np.array(variances),
    )
    weight /= weight.sum()
    whole = weight @ variances + weight @ estimates**2 - (weight @ estimates) ** 2
    best = int(np.argmax(logs))
    assert_allclose(found.standard_errors, np.sqrt(variances[best]), rtol=0.01)
    assert_allclose(found.high - found.values, 1.98 * np.sqrt(whole), rtol=0.02)
