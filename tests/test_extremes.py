"""The largest value of a quantity between the times at which it is saved, and its integral."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_mean_gradients import Thrown

import jourdain_jax as jj
from jourdain_jax.ensembles.along import integral, largest

ALL = jnp.asarray(41)
TIMES = jnp.linspace(0.0, 2.0, 41)
PHASES = jnp.linspace(0.0, 2 * jnp.pi, 97)
LARGEST, INTEGRAL = (jax.jit(jax.value_and_grad(lambda values, times, count, f=f: f(times, values, count))) for f in (largest, integral))


def wave(phase, frequency=3.0):
    return jnp.sin(frequency * TIMES + phase)


def test_the_largest_value_is_found_to_the_fifth_order_wherever_it_lies():
    """Over 2 s a sine of 3 rad/s takes the value 1 at any phase, or is largest at an end."""
    found = jax.jit(jax.vmap(lambda phase: largest(TIMES, wave(phase), ALL)))(PHASES)
    inside = (jnp.pi / 2 - PHASES) % (2 * jnp.pi) / 3.0 <= 2.0
    exact = jnp.where(inside, 1.0, jnp.maximum(jnp.sin(PHASES), jnp.sin(6.0 + PHASES)))
    coarse = jax.vmap(lambda phase: jnp.max(wave(phase)))(PHASES)
    assert float(jnp.max(jnp.abs(found - exact))) < 1e-6
    assert float(jnp.max(jnp.abs(coarse - exact))) > 2e-3  # what saved values alone give


def test_the_integral_is_found_to_the_fourth_order():
    found = jax.jit(jax.vmap(lambda phase: integral(TIMES, wave(phase), ALL)))(PHASES)
    exact = (jnp.cos(PHASES) - jnp.cos(6.0 + PHASES)) / 3.0
    assert float(jnp.max(jnp.abs(found - exact))) < 3e-6
    assert float(jnp.max(jnp.abs(jax.vmap(lambda phase: jnp.trapezoid(wave(phase), TIMES))(PHASES) - exact))) > 1e-4  # of the trapezoidal rule
    uneven = jnp.sort(jnp.concatenate([TIMES, TIMES[1:30] - 0.02]))
    cubic = 1.0 + uneven - 2.0 * uneven**2 + 3.0 * uneven**3
    assert float(integral(uneven, cubic, jnp.asarray(70))) == pytest.approx(2.0 + 2.0 - 16.0 / 3.0 + 12.0, rel=1e-13)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 16])
def test_values_that_were_not_reached_do_not_count(count):
    """A motion that ended at value number `count` - 1; all later ones repeat the end, as `sampled` has them."""
    kept = jnp.arange(41) < count
    times, values = jnp.where(kept, TIMES, TIMES[count - 1]), jnp.where(kept, wave(0.07), wave(0.07)[count - 1])
    exact = 1.0 if 3.0 * TIMES[count - 1] + 0.07 > np.pi / 2 else float(values[count - 1])
    found, by = LARGEST(values, times, jnp.asarray(count))
    assert float(found) == pytest.approx(exact, abs=1e-6)
    assert np.isfinite(by).all()
    total, by = INTEGRAL(values, times, jnp.asarray(count))
    exact = (np.cos(0.07) - np.cos(3.0 * float(TIMES[count - 1]) + 0.07)) / 3.0
    assert float(total) == pytest.approx(exact, abs=5e-6 if count > 3 else 1e-4)
    assert np.isfinite(by).all()


def test_the_derivative_is_that_of_the_largest_value():
    """Of a sin(3 t + phase): 1 by the amplitude, 0 by the phase."""
    by = jax.jit(jax.grad(lambda a, phase: largest(TIMES, a * wave(phase), ALL), argnums=(0, 1)))(1.3, 0.4)
    assert_allclose(by, [1.0, 0.0], atol=2e-5)


def test_outputs_of_a_motion_find_its_turning_point_and_what_adds_up():
    """A particle thrown upwards turns at v^2 / (2 g), between two saved times, and lands between two others."""
    motion = jj.simulate(Thrown(), {"z": 1.0, "z_rate": 2.0}, t1=0.9, ts=np.linspace(0.0, 0.9, 8), rtol=1e-10, atol=1e-10)
    top, landed = 1.0 + 4.0 / 18.0, (2.0 + np.sqrt(22.0)) / 9.0
    assert float(jnp.nanmax(motion["z"])) < top - 1e-3
    assert float(jj.Largest("z").of(motion)) == pytest.approx(top, abs=1e-9)
    assert float(jj.Smallest("z").of(motion)) == pytest.approx(0.0, abs=1e-9)
    assert float(jj.LargestMagnitude("z_rate").of(motion)) == pytest.approx(np.sqrt(4.0 + 18.0), rel=1e-8)
    assert float(jj.Largest(lambda motion: motion["z"] - motion.ts).of(motion)) == pytest.approx(1.0 + 1.0 / 18.0, abs=1e-9)
    height = landed + landed**2 - 1.5 * landed**3
    assert float(jj.Integral("z", "m s").of(motion)) == pytest.approx(height, rel=1e-9)
    assert float(jj.Integral(lambda motion: jnp.ones_like(motion.ts), "s").of(motion)) == pytest.approx(landed, rel=1e-9)
    with pytest.raises(ValueError, match=r"the quantity of an output is .*, expected its real values at all 9 times of the motion"):
        jj.Integral(lambda motion: motion.t_end).of(motion)


def test_an_end_just_after_a_saved_time_is_no_node_of_its_own():
    """A particle that falls from g T^2 / 2 lands at T: 1e-3 to 1e-15 s after a saved time, and at one. A polynomial through both times would swing."""
    after = 1.0 + jnp.asarray([1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13, 1e-15, 0.0])
    options = {"t1": 2.0, "ts": np.linspace(0.0, 2.0, 21), "rtol": 1e-8, "atol": 1e-8}
    lanes = jj.rollout(Thrown(), {"z": 4.5 * after**2, "z_rate": 0.0}, **options).lanes
    for output, exact in ((jj.Integral("z"), 3.0 * after**3), (jj.Integral(lambda m: m["z_rate"] ** 2), 27.0 * after**3), (jj.Largest("z"), 4.5 * after**2)):
        assert_allclose(jax.vmap(output.of)(lanes), exact, rtol=1e-9)


def test_a_motion_that_runs_back_in_time_has_its_end_too():
    """What is at rest at 0.5 m left the ground 1 / 3 s before."""
    motion = jj.simulate(Thrown(), {"z": 0.5, "z_rate": 0.0}, ts=np.linspace(0.0, -1.0, 10), rtol=1e-10, atol=1e-10)
    left = -1.0 / 3.0
    assert float(motion.t_end) == pytest.approx(left, abs=1e-9)
    assert float(jj.Smallest("z").of(motion)) == pytest.approx(0.0, abs=1e-9)
    assert float(jj.LargestMagnitude("z_rate").of(motion)) == pytest.approx(3.0, rel=1e-9)
    assert float(jj.Integral("z").of(motion)) == pytest.approx(0.5 * left - 1.5 * left**3, rel=1e-9)
