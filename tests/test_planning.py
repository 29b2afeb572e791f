"""What planned runs will tell: against the covariance of a fit, closed forms, and differences of the start
and the inputs.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from slopes import slope
from small_scenes import Cart

import jourdain_jax as jj
from jourdain_jax.identification import planned_information
from jourdain_jax.studies import Normal

TS, CART = np.linspace(0.1, 3.0, 16), Cart(damping=0.0)


def plan(x=0.3, force=0.0, unknown=(), values=TS):
    more = {"start": {"x": x}, "unknown_start": unknown, "inputs": {"push": force}, "t0": 0.0}
    return jj.Experiment(TS, {"x": values}, 0.01, **more)


def test_planned_covariance_is_that_of_a_fit():
    unknown = {"x": jj.Estimate(prior=Normal(0.3, 0.005))}
    values = jj.simulate(CART, {"x": 0.3}, t0=0.0, ts=TS, inputs={"push": 0.4})["x"]
    fit = jj.fit(CART, plan(0.3, 0.4, unknown, values), ("mass", "stiffness"))
    found = planned_information(CART, plan(0.3, 0.4, unknown), ("mass", "stiffness"))
    assert found.labels == fit.labels == ("mass", "stiffness", "run 0: x")
    assert_allclose(found.covariance, fit.covariance, rtol=1e-5)
    assert_allclose(found.log_det(), -np.linalg.slogdet(fit.covariance)[1], rtol=1e-6)
    assert_allclose(found.log_det("mass"), -np.log(fit.covariance[0, 0]), rtol=1e-6)
    assert "mass" in str(found)


def test_what_a_plan_will_not_tell_is_named():
    found = planned_information(CART, plan(), ("mass", "stiffness"))
    (sentence,) = found.not_identifiable
    assert "are not determined separately" in sentence
    assert sentence in str(found)
    assert [row.split()[-1] for row in str(found).splitlines()[2:4]] == ["-", "-"]
    assert not planned_information(CART, plan(), "mass").not_identifiable


def test_a_plan_is_one_program_which_serves_other_numbers(compilations):
    def told(mass, x):
        return float(planned_information(CART.replace(mass=mass), plan(x), ("stiffness",)).log_det())

    first = told(1.5, 0.2)
    assert len(compilations) <= 8
    compilations.clear()
    assert told(1.5, 0.4) == pytest.approx(first + np.log(4.0), abs=1e-5)
    assert not compilations


def stated(x):
    """`sum (d x / d stiffness)^2 / sigma^2` of x0 cos(w t)."""
    w = jnp.sqrt(5.0 / 2.0)
    return jnp.sum((x * jnp.sin(w * TS) * TS / (2 * jnp.sqrt(5.0 * 2.0)) / 0.01) ** 2)


def of_stiffness(x):
    return planned_information(CART, plan(x), ("stiffness",)).matrix[0, 0]


def test_information_has_a_closed_form():
    assert_allclose(of_stiffness(0.3), stated(0.3), rtol=1e-6)


def test_slope_in_the_samples_of_an_input_is_that_of_differences():
    knots = jnp.linspace(0.0, 3.0, 5)

    def told(values):
        planned = plan(0.1, jj.Sampled(knots, values))
        return planned_information(CART, planned, ("mass", "stiffness"), backend="xla").log_det()

    values, way = jnp.array([0.0, 0.5, -0.3, 0.8, 0.1]), jnp.array([0.3, -1.0, 0.5, 0.2, 0.0])
    _, found = jax.jit(lambda v, w: jax.jvp(told, (v,), (w,)))(values, way)
    assert_allclose(found, slope(lambda x: told(values + x * way), 0.0), rtol=1e-5)
