"""The largest value of a quantity between the times at which it is saved, and its integral."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import Oscillator
from test_mean_gradients import Thrown

import jourdain_jax as jj
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.studies import Integral, Largest, LargestMagnitude, Smallest

TIMES = np.linspace(0.0, 2.0, 41)
TIGHT = {"rtol": 1e-10, "atol": 1e-10}
SWINGING = Oscillator(mass=1.0, damping=0.0, stiffness=9.0)


def wave(phase, size=1.0):
    """A start of x = size sin(3 t + phase)."""
    return {"x": size * jnp.sin(phase), "x_rate": 3.0 * size * jnp.cos(phase)}


@pytest.fixture(scope="module")
def waves():
    """Over 2 s a sine of 3 rad/s, at any phase."""
    phases = np.linspace(0.0, 2 * np.pi, 97)
    return phases, jj.rollout(SWINGING, wave(phases), ts=TIMES, work=False, **TIGHT).lanes


def test_the_largest_value_is_found_to_the_fifth_order_wherever_it_lies(waves):
    """It is 1, or lies at an end."""
    phases, lanes = waves
    inside = (np.pi / 2 - phases) % (2 * np.pi) / 3.0 <= 2.0
    exact = np.where(inside, 1.0, np.maximum(np.sin(phases), np.sin(6.0 + phases)))
    assert_allclose(jax.jit(jax.vmap(Largest("x").of))(lanes), exact, rtol=0, atol=1e-6)
    assert np.max(np.abs(np.max(lanes["x"], axis=1) - exact)) > 2e-3  # what saved values alone give


def test_the_integral_is_found_to_the_fourth_order(waves):
    phases, lanes = waves
    exact = (np.cos(phases) - np.cos(6.0 + phases)) / 3.0
    assert_allclose(jax.jit(jax.vmap(Integral("x").of))(lanes), exact, rtol=0, atol=3e-6)
    assert np.max(np.abs(np.trapezoid(lanes["x"], TIMES, axis=1) - exact)) > 1e-4  # of the trapezoidal rule
    uneven = jj.simulate(SWINGING, {}, ts=np.sort(np.concatenate([TIMES, TIMES[1:30] - 0.02])))
    cubic = Integral(lambda motion: 1.0 + motion.ts - 2.0 * motion.ts**2 + 3.0 * motion.ts**3)
    assert_allclose(jax.jit(cubic.of)(uneven), 2.0 + 2.0 - 16.0 / 3.0 + 12.0, rtol=1e-13)


def test_values_that_were_not_reached_do_not_count():
    """A particle that falls from g T^2 / 2 lands at T, after 1 to 5 saved times and after 16; few of them
    give no more than finite derivatives.
    """
    landed = np.array([0.02, 0.065, 0.12, 0.17, 0.22, 1.54])

    def of(height):
        motion = jj.simulate(Thrown(), {"z": height, "z_rate": 0.0}, ts=TIMES, **TIGHT)
        found = Integral("z").of(motion), Largest("z").of(motion)
        return sum(found), found

    heights = 4.5 * landed**2
    slopes, found = jax.jit(jax.vmap(jax.grad(of, has_aux=True)))(heights)
    assert_allclose(found, [3.0 * landed**3, heights], atol=1e-4)
    assert np.isfinite(slopes).all()
    assert_allclose(slopes[3:], landed[3:] + 1.0, rtol=1e-6)


def test_the_derivative_is_that_of_the_largest_value():
    """Of a sin(3 t + phase): 1 by the amplitude, 0 by the phase."""

    def of(size, phase):
        return Largest("x").of(jj.simulate(SWINGING, wave(phase, size), ts=TIMES, work=False, **TIGHT))

    assert_allclose(jax.jit(jax.grad(of, argnums=(0, 1)))(1.3, 0.4), [1.0, 0.0], atol=2e-5)


def test_a_motion_that_runs_back_in_time_has_its_end_too():
    """What is at rest at 0.5 m left the ground 1 / 3 s before."""
    motion = jj.simulate(Thrown(), {"z": 0.5, "z_rate": 0.0}, ts=np.linspace(0.0, -1.0, 10), **TIGHT)
    left = -1.0 / 3.0
    assert motion.t_end == pytest.approx(left, abs=1e-9)
    outputs = Smallest("z"), LargestMagnitude("z_rate"), Integral("z")
    found = eval_numpy(lambda motion: [output.of(motion) for output in outputs])(motion)
    assert_allclose(found, [0.0, 3.0, 0.5 * left - 1.5 * left**3], rtol=1e-9, atol=1e-9)
    refused("the quantity of an output is", Integral(lambda motion: motion.t_end).of, motion)
