"""Priors of parameters that were measured together: the posterior is that of Bayes' theorem, whichever way it
is asked.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal
from small_scenes import Cart

import jourdain_jax as jj
from jourdain_jax.bicycle import benchmark_from_measurements, measured_bicycle
from jourdain_jax.identification import (
    joint_normal,
    log_density,
    log_likelihood,
    planned_information,
    unbounded,
)
from jourdain_jax.studies import Normal

TS = np.linspace(0.1, 3.0, 16)
CART, PUSH = Cart(damping=0.0), {"push": 1.0}
NAMES, MEAN = ("mass", "stiffness"), {"mass": 2.02, "stiffness": 4.95}
COVARIANCE = np.array([[0.02**2, 0.9 * 0.02 * 0.05], [0.9 * 0.02 * 0.05, 0.05**2]])
TOGETHER = joint_normal(MEAN, COVARIANCE)
APART = {name: Normal(MEAN[name], float(np.sqrt(COVARIANCE[k, k]))) for k, name in enumerate(NAMES)}


def run():
    x = np.asarray(jj.simulate(CART, {"x": 0.3}, t0=0.0, ts=TS, inputs=PUSH)["x"])
    return jj.Experiment(
        TS,
        {"x": x + 0.01 * np.random.default_rng(3).normal(size=len(TS))},
        0.01,
        start={"x": 0.3},
        inputs=PUSH,
        t0=0.0,
    )


def planned(scene, data):
    """Information of the data about the names, without and with what is known of them before; one program,
    which compiles in half of the time of its parts.
    """
    return jax.jit(lambda: [planned_information(scene, data, free).matrix for free in (NAMES, TOGETHER)])()


def test_the_estimate_is_where_likelihood_and_prior_balance_and_its_information_is_their_sum():
    data, free = run(), dict(reversed(TOGETHER.items()))  # the order of the names does not matter
    found = jj.fit(CART, data, free, tolerance=1e-7)
    at = jnp.array([found[name].value for name in NAMES])
    slope = jax.jit(jax.grad(lambda x: log_likelihood(CART.replace(mass=x[0], stiffness=x[1]), data)))(at)
    pull = np.linalg.solve(COVARIANCE, at - np.array(list(MEAN.values())))
    scale = np.array([found[name].standard_error for name in NAMES])
    assert np.max(np.abs(scale * pull)) > 0.1  # the prior does pull
    assert_allclose(scale * slope, scale * pull, atol=2e-6)
    of_data, of_both = planned(found.scene, data)
    order = [found.labels.index(name) for name in NAMES]
    assert_allclose(
        found.covariance[np.ix_(order, order)], np.linalg.inv(of_data + np.linalg.inv(COVARIANCE)), rtol=1e-5
    )
    assert_allclose(of_both - of_data, np.linalg.inv(COVARIANCE), rtol=1e-6)


def test_it_counts_beside_an_unknown_start_of_one_run_and_of_two():
    one = run()
    start = {"x": jj.Estimate(prior=Normal(0.3, 0.01))}
    data = [
        jj.Experiment(TS, one.values, 0.01, start={"x": 0.3}, unknown_start=start, inputs=PUSH, t0=0.0)
    ] * 2
    for count in (1, 2):
        found = jj.fit(CART, data[:count], TOGETHER)
        of_data, of_both = planned(found.scene, data[:count])
        assert_allclose(found.covariance, np.linalg.inv(of_both), rtol=5e-3)
        assert_allclose((of_both - of_data)[:2, :2], np.linalg.inv(COVARIANCE), rtol=1e-6)


def test_without_correlation_it_is_a_prior_for_each():
    data, diagonal = run(), joint_normal(MEAN, np.diag(np.diag(COVARIANCE)))
    together, apart = jj.fit(CART, data, diagonal), jj.fit(CART, data, APART)
    assert_allclose(together.values, apart.values, rtol=1e-10)
    assert_allclose(together.standard_errors, apart.standard_errors, rtol=1e-8)


def test_of_one_of_the_names_the_marginal_counts():
    together, apart = (jj.fit(CART, run(), {"mass": prior["mass"]}) for prior in (TOGETHER, APART))
    assert_allclose(together.values, apart.values, rtol=1e-12)


def test_density_has_the_normal_density_of_all_names():
    data = run()
    flat, density = (log_density(CART, data, free) for free in (dict.fromkeys(NAMES, unbounded()), TOGETHER))
    points = ({"mass": 2.01, "stiffness": 5.02}, {"mass": 1.97, "stiffness": 4.96})

    @jax.jit
    def added(point):
        # densities of the unknowns themselves, without the slopes of transforms
        told = ((one, one.unconstrain(point)) for one in (density, flat))
        by_both, by_data = (one(z) - jnp.linalg.slogdet(jax.jacfwd(one.constrain)(z))[1] for one, z in told)
        return by_both - by_data

    for point in points:
        stated = multivariate_normal.logpdf(list(point.values()), list(MEAN.values()), COVARIANCE)
        assert added(point) == pytest.approx(stated, abs=1e-9)


def test_a_combination_that_is_known_exactly_stays():
    sigma = np.array([0.02, 0.05])
    found = jj.fit(CART, run(), joint_normal(MEAN, np.outer(sigma, sigma)))
    moved = (np.array([found[name].value for name in NAMES]) - list(MEAN.values())) / sigma
    assert abs(moved[0]) > 0.1
    assert moved[0] == pytest.approx(moved[1], abs=1e-4)


def test_pendulum_readings_give_a_joint_prior():
    bicycle = benchmark_from_measurements("Browser")
    joint = bicycle.joint_prior
    assert list(joint) == list(bicycle.prior)
    assert_allclose(
        [prior.sigma for prior in joint.values()],
        [prior.sigma for prior in bicycle.prior.values()],
        rtol=1e-12,
    )
    pair = [joint["IBxx"], joint["IBzz"]]
    (own,), which = (
        {id(prior.covariance): prior.covariance for prior in pair}.values(),
        [prior.place for prior in pair],
    )
    of = [list(bicycle.values).index(name) for name in ("IBxx", "IBzz")]
    assert_allclose(own[np.ix_(which, which)], bicycle.covariance[np.ix_(of, of)], rtol=1e-9)
    published = measured_bicycle("Browser")
    assert published.joint_prior == published.prior
