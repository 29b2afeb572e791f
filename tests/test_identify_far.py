"""Fits from first guesses that are far from the minimum: over growing spans."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from small_scenes import Cart, OnLine

import jourdain_jax as jj
from jourdain_jax.identification import Sensor

TS, SIGMA = np.linspace(0.0, 40.0, 201), 0.01


class Oscillator(Cart):
    damping: object = jj.parameter(0.1, positive=True)
    stiffness: object = jj.parameter(18.0, positive=True)


def exact(t):
    """x of the default oscillator, which begins at 0.5 at rest: decay 0.025/s."""
    decay, w = 0.025, np.sqrt(9.0 - 0.025**2)
    return 0.5 * np.exp(-decay * t) * (np.cos(w * t) + decay / w * np.sin(w * t))


def data(seed, repeats=(), more=0.0):
    noise = SIGMA * np.random.default_rng(seed).normal(size=(*repeats, len(TS)))
    return jj.Experiment(TS, {"x": exact(TS) + more + noise}, SIGMA, start={"x": 0.5})


FREE = ("stiffness",)


@pytest.mark.parametrize("factor", [0.35, 3.0])
def test_a_frequency_far_from_the_guess_is_found_over_growing_spans(factor):
    found = jj.fit(Oscillator(stiffness=18.0 * factor), data(0), FREE)
    assert found.converged
    assert found.grown
    assert not found.warnings
    assert abs(found["stiffness"].value - 18.0) < 4 * found["stiffness"].standard_error
    assert "found over growing spans" in str(found)
    near = jj.fit(Oscillator(stiffness=18.5), data(0), FREE)
    assert not near.grown
    assert_allclose(found.values, near.values, atol=1e-3 * near.standard_errors.min())


def test_repeats_that_end_in_a_local_minimum_are_fitted_again_alone():
    measured = data(1, (5,), more=3.0 * (np.arange(5) == 3)[:, None])  # no parameters give the fourth
    found = jj.fit_batch(Oscillator(stiffness=50.0), measured, FREE)
    assert found.grown[[0, 1, 2, 4]].all()
    good = [0, 1, 2, 4]
    assert_allclose(
        found["stiffness"].value[good], 18.0, atol=4 * found["stiffness"].standard_error[good].max()
    )
    assert found.reduced_chi_square[3] > 100
    alone = jj.fit(
        Oscillator(stiffness=50.0),
        jj.Experiment(TS, {"x": measured.values["x"][2]}, SIGMA, start={"x": 0.5}),
        FREE,
    )
    assert_allclose(found.values[2], alone.values, rtol=1e-9)


def test_a_scene_that_is_not_right_is_warned_of_all_the_same():
    found = jj.fit(Oscillator(stiffness=50.0), data(2, more=0.3 * np.sin(7.0 * TS)), FREE)
    assert "larger than the sigmas allow" in " ".join(found.warnings)


def test_the_lowest_minimum_of_many_first_guesses_counts():
    asked = Oscillator(stiffness=23.0), data(0), {"stiffness": jj.bounds(12.0, 24.0)}
    found, near = jj.fit(*asked, guesses=24), jj.fit(Oscillator(stiffness=18.5), data(0), FREE)
    assert found.converged
    assert not found.grown
    assert found.guesses == 24
    assert 2 <= found.agreeing < 24
    assert not found.warnings
    assert f"{int(found.agreeing)} of 24 first guesses led to this minimum" in str(found)
    assert_allclose(found.values, near.values, atol=1e-3 * near.standard_errors.min())
    assert_array_equal(jj.fit(*asked, guesses=24).values, found.values)


def test_a_minimum_that_one_guess_alone_leads_to_is_warned_of():
    found = jj.fit(Oscillator(stiffness=18.5), data(0), {"stiffness": jj.bounds(2.0, 80.0)}, guesses=2)
    assert found.agreeing == 1
    assert "only one of 2 first guesses led to this minimum" in found.warning


@pytest.mark.parametrize("guesses", [0, -3, True])
def test_a_number_of_guesses_that_is_none_is_refused(guesses):
    refused(
        r"`guesses` is .*, expected a whole number of at least 1",
        jj.fit,
        Oscillator(),
        data(0),
        FREE,
        guesses=guesses,
    )


class Resting(OnLine):
    """A mass that stays where it is."""


@pytest.mark.parametrize(("curvature", "large"), [(3.0, 100.0), (5.0, 4.0)])
def test_a_minimum_that_undamped_steps_overshoot_is_found(curvature, large):
    """F = (x - 0.1)^2 + (R + a x^2 + a x^3 / 3)^2: at the minimum its second derivative is `curvature` times
    that of the linear problem.
    """
    a = (curvature - 1) / 2 / large
    sensors = {"curved": Sensor(lambda motion: large + a * motion.q.x**2 + a * motion.q.x**3 / 3)}
    run = jj.Experiment(
        jnp.ones(1),
        {"x": [0.1], "curved": [0.0]},
        1.0,
        start={"x": 0.3},
        unknown_start=("x",),
        sensors=sensors,
        t0=0.0,
    )
    found = jj.fit(Resting(), run, ())
    slope = np.polynomial.Polynomial([-0.1, 1.0]) + np.polynomial.Polynomial(
        [large, 0.0, a, a / 3]
    ) * np.polynomial.Polynomial([0.0, 2 * a, a])
    least = min(slope.roots()[np.abs(slope.roots().imag) < 1e-9].real, key=abs)
    assert found.converged
    assert found.steps < 90
    assert abs(found["run 0: x"].value - least) < 5e-4 * found["run 0: x"].standard_error
