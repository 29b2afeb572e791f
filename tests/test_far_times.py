"""What does not depend on time is as right far from t = 0 as near it, in both loops (and in single precision:
`test_float32.py`).
"""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from small_scenes import OnLine

import jourdain_jax as jj

LOOPS = {
    "lean": {},
    "diffrax": {"solver": diffrax.Bosh3(), "rtol": 1e-5, "atol": 1e-5, "work": False},
    "equal steps": {"solver": jj.ImplicitMidpoint(step=1e-3)},
}
FAR = (1.7e9, -3.0e8, 86400.0)


class Oscillator(OnLine):
    """An oscillator that a force of the clock drives, and that stops where it passes x = -0.999."""

    stiffness: object = jj.parameter(1e4)
    driven: object = jj.parameter(0.0)
    stops: object = jj.parameter(2.0)
    example = {"x": 1.0}

    def loads(self, motion):
        return (
            jj.generalized_force(
                motion, x_rate=self.driven * jnp.cos(2.0 * motion.t) - self.stiffness * motion.q.x
            ),
        )

    def events(self, motion):
        return {"passed": motion.q.x + self.stops}


@pytest.mark.parametrize("options", LOOPS.values(), ids=LOOPS)
def test_an_oscillator_far_in_time_is_the_one_at_zero(options):
    since = np.array([0.25, 0.5, 1.0])  # exact in binary
    near = jj.simulate(Oscillator(), ts=since, t0=0.0, **options).raise_if_failed()
    for t0 in FAR:
        far = jj.simulate(Oscillator(), ts=t0 + since, t0=t0, **options).raise_if_failed()
        assert_array_equal(far.q, near.q)
        assert_array_equal(far.ts, t0 + since)
        assert far.accepted == int(near.accepted)
        assert float(far.t_end) == t0 + 1.0


def test_the_state_and_the_time_advance_together():
    """xdot = 1 in steps that do not divide the span: x is the time, to the last digit of the clock."""
    motion = jj.simulate(
        Oscillator(stiffness=0.0),
        {"x": 0.0, "x_rate": 1.0},
        t0=1e9,
        ts=1e9 + np.linspace(0.0, 3.0, 7),
        t1=1e9 + 3.0,
    )
    assert_allclose(motion["x"], np.asarray(motion.ts) - 1e9, rtol=1e-14, atol=1e-14)


def test_a_clock_that_is_coarse_beside_the_steps_is_warned_of():
    near, far = (
        jj.simulate(Oscillator(stiffness=1e8, driven=1.0), t0=t0, ts=[t0, t0 + 2.0**-7])
        for t0 in (0.0, 1.7e9)
    )
    assert near.warnings == ()
    (text,) = far.warnings
    assert text.startswith("times are resolved to 2e-07 s, but steps are ")
