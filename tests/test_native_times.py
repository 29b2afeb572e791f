"""Derivatives with respect to the times of a motion that starts beyond an event, and what is refused."""

import jax
import jax.numpy as jnp
import machine_code
import pytest
from numpy.testing import assert_array_equal
from small_scenes import OnLine

import jourdain_jax as jj

pytestmark = machine_code.needed

MODES = "jacfwd", "jacrev"


class Driven(OnLine):
    """A particle on a spring whose push changes with time, by a formula and by an input, and a wall at x =
    -1.2.
    """

    mass = 1.5
    inputs = jj.inputs("push")
    example = {"x": 1.1, "x_rate": 0.7}

    def loads(self, motion):
        push = motion.inputs.push + jnp.cos(2.0 * motion.t) - 0.3 * motion.u.x_rate
        return jj.generalized_force(motion, x_rate=push - 6.0 * motion.q.x)

    def events(self, motion):
        return {"wall": 1.2 + motion.q.x}


@pytest.mark.parametrize("mode", MODES)
def test_a_motion_that_starts_beyond_an_event_ends_where_and_when_it_starts(mode):
    def end(t):
        motion = jj.simulate(Driven(), {"x": -1.3, "x_rate": 0.2}, t0=t[0], ts=t[1:])
        return jnp.concatenate([motion.q_end, motion.u_end, motion.t_end[None]])

    found = jax.jit(getattr(jax, mode)(end))(jnp.array([0.2, 0.5]))
    assert_array_equal(found, [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])


def test_third_derivatives_with_respect_to_times_are_refused():
    def end(x, time):
        return jj.simulate(Driven(), {"x": x, "x_rate": 0.2}, ts=[time], backend="xla", events=False).q_end[0]

    along = lambda f: lambda a: jax.jvp(f, (a,), (1.0,))[1]
    with pytest.raises(jj.DifferentiationModeError, match="no third derivatives with respect to times"):
        jax.jit(along(along(along(lambda a: end(a, a))))).lower(0.3)
