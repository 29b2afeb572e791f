"""Draws of a posterior as ArviZ's InferenceData."""

import sys

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused

import jourdain_jax as jj
from jourdain_jax.identification import huber, log_density, log_likelihood

TRUTH, START = jj.models.ChaplyginSleigh(offset=0.25), {"x_rate": -0.6, "heading_rate": 0.9}
TS = np.linspace(0.0, 4.0, 41)


def runs(count, **about):
    noise, found = np.random.default_rng(1), []
    for k in range(count):
        start = START | {"heading_rate": 0.9 + 0.1 * k}
        x = np.array(jj.simulate(TRUTH, start, ts=TS)["x"]) + 0.01 * noise.normal(size=41)
        x[[3, 7 + k]] = np.nan
        found.append(jj.Experiment(TS, {"x": x}, 0.01, start=start, **about))
    return found


@pytest.fixture(scope="module")
def fitted():
    data = runs(1)
    return data, jj.fit(TRUTH.replace(offset=0.4), data, free=("offset", "inertia"))


def test_draws_of_a_fit_have_its_estimates_and_errors(fitted):
    arviz = pytest.importorskip("arviz")
    data, fit = fitted
    found = fit.to_arviz(data)
    assert found.posterior.sizes["chain"] == 4
    assert found.posterior["inertia"].attrs["units"] == "kg m^2"
    table = arviz.summary(found, round_to="none")
    for name in fit.labels:
        error = fit[name].standard_error
        assert abs(table["mean"][name] - fit[name].value) < 4 * error / np.sqrt(4000) + 0.05 * error
        assert table["sd"][name] == pytest.approx(error, rel=0.05)
        assert table["r_hat"][name] < 1.01
    assert_allclose(found.observed_data["x"], data[0].values["x"][np.isfinite(data[0].values["x"])])


@pytest.mark.parametrize("about", [{}, {"correlation_time": 0.2}])
def test_log_likelihoods_of_the_samples_add_up_to_that_of_the_runs(about):
    pytest.importorskip("arviz")
    data = runs(2, **about)
    density = log_density(TRUTH, data, free=("offset",))
    z = jnp.stack([density.unconstrain({"offset": x}) for x in (0.24, 0.25, 0.26, 0.27)]).reshape(2, 2, 1)
    found = density.to_arviz(z)
    assert set(found.observed_data) == {"run 0: x", "run 1: x"}
    total = sum(found.log_likelihood[name].sum(axis=-1) for name in found.observed_data)
    assert found.log_likelihood["run 1: x"].shape == (2, 2, 39)
    expected = [float(log_likelihood(TRUTH.replace(offset=x), data)) for x in (0.24, 0.25, 0.26, 0.27)]
    assert_allclose(np.ravel(total), expected, rtol=1e-9)
    assert_allclose(np.ravel(found.posterior["offset"]), [0.24, 0.25, 0.26, 0.27], rtol=1e-12)


def test_draws_need_chains_a_density_and_arviz(fitted, monkeypatch):
    data, fit = fitted
    robust = jj.fit(TRUTH, data, free=("offset",), loss=huber())
    refused("a robust loss has no probability density", robust.to_arviz, data)
    with monkeypatch.context() as missing:
        missing.setitem(sys.modules, "arviz", None)
        with pytest.raises(ImportError, match=r"needs the package `arviz`, .* 'jourdain-jax\[interop\]'"):
            fit.to_arviz(data)
    pytest.importorskip("arviz")
    refused(r"shape \(5, 2\), expected \(chains, draws, 2\)", fit.to_arviz, data, np.zeros((5, 2)))
