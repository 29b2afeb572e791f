"""The largest value of a quantity between the times at which it is saved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_mean_gradients import Thrown

import jourdain_jax as jj
from jourdain_jax.ensembles.extremes import largest

TIMES = jnp.linspace(0.0, 2.0, 41)
PHASES = jnp.linspace(0.0, 2 * jnp.pi, 97)
ALL = jnp.ones(41, bool)


def wave(phase, frequency=3.0):
    return jnp.sin(frequency * TIMES + phase)


def test_the_largest_value_is_found_to_the_fifth_order_wherever_it_lies():
    """Over 2 s a sine of 3 rad/s takes the value 1 at any phase, or is largest at an end."""
    found = jax.vmap(lambda phase: largest(TIMES, wave(phase), ALL, wave(phase)[-1]))(PHASES)
    inside = (jnp.pi / 2 - PHASES) % (2 * jnp.pi) / 3.0 <= 2.0
    exact = jnp.where(inside, 1.0, jnp.maximum(jnp.sin(PHASES), jnp.sin(6.0 + PHASES)))
    coarse = jax.vmap(lambda phase: jnp.max(wave(phase)))(PHASES)
    assert float(jnp.max(jnp.abs(found - exact))) < 1e-6
    assert float(jnp.max(jnp.abs(coarse - exact))) > 2e-3  # what saved values alone give


def test_values_that_were_not_reached_do_not_count():
    reached = TIMES < 0.8  # the wave is largest at 0.5 s, and after the end again
    found = largest(TIMES, jnp.where(reached, wave(0.07), 0.0), reached, jnp.array(-0.2))
    assert float(found) == pytest.approx(1.0, abs=1e-6)
    few = TIMES < 0.12
    assert float(largest(TIMES, jnp.where(few, wave(0.0), 0.0), few, jnp.array(0.5))) == 0.5


def test_the_derivative_is_that_of_the_largest_value():
    """Of a sin(3 t + phase): 1 by the amplitude, 0 by the phase."""
    by = jax.grad(lambda a, phase: largest(TIMES, a * wave(phase), ALL, a * wave(phase)[-1]), argnums=(0, 1))(1.3, 0.4)
    np.testing.assert_allclose(by, [1.0, 0.0], atol=2e-5)


def test_outputs_of_a_motion_find_its_turning_point():
    """A particle thrown upwards turns at v^2 / (2 g), between two saved times."""
    motion = jj.simulate(Thrown(), {"z": 1.0, "z_rate": 2.0}, t1=0.9, ts=np.linspace(0.0, 0.9, 8), rtol=1e-10, atol=1e-10)
    top = 1.0 + 4.0 / 18.0
    assert float(jnp.nanmax(motion["z"])) < top - 1e-3
    assert float(jj.Largest("z").of(motion)) == pytest.approx(top, abs=1e-9)
    assert float(jj.Smallest("z").of(motion)) == pytest.approx(0.0, abs=1e-9)  # it lands
    assert float(jj.LargestMagnitude("z_rate").of(motion)) == pytest.approx(np.sqrt(4.0 + 18.0), rel=1e-8)
