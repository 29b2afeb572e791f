"""A stiff motion that ends at an event is as right there as on the way: it is located by steps of the solver that followed the motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from small_scenes import OnPlane

import jourdain_jax as jj

RATE = 1e6


class Following(OnPlane):
    """x is drawn to sin y by a stiff spring and damper, in about 1e-6 s to a speed, in about 1 s to the place; y falls to the floor by 1 m/s^2."""

    rate: object = jj.parameter(RATE)

    def loads(self, motion):
        q, u = motion.q, motion.u
        return (jj.generalized_force(motion, x_rate=-self.rate * (q.x - jnp.sin(q.y)) - self.rate * u.x_rate, y_rate=-1.0 + 0.0 * q.x),)

    def events(self, motion):
        return {"floor": motion.q.y}


def followed(height, x):
    """x at the floor: xdot = sin y - x to within 1e-6, by quadrature of exp(t - t_e) sin(y(t))."""
    end = np.sqrt(2 * height)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    t = end * (nodes + 1) / 2
    return x * np.exp(-end) + end / 2 * np.sum(weights * np.exp(t - end) * np.sin(height - t**2 / 2))


SOLVERS = {"default": {"retry": True}, "RadauIIA": {"solver": jj.RadauIIA()}}


@pytest.mark.parametrize("options", SOLVERS.values(), ids=SOLVERS)
def test_a_stiff_motion_is_right_at_an_event_by_every_solver_that_follows_it(options):
    for height, x in ((7.3, 0.85), (0.4, -1.0)):
        motion = jj.simulate(Following(), {"y": height, "x": x}, ts=[6.0], max_steps=20_000, **options)
        assert int(motion.result) == results.EVENT
        assert_allclose(motion.t_end, np.sqrt(2 * height), rtol=1e-10)
        expected = followed(height, x)
        assert_allclose(motion.q_end, [expected, 0.0], rtol=0, atol=5e-6)
        assert_allclose(motion.u_end, [-expected, -np.sqrt(2 * height)], rtol=0, atol=2e-5)


def test_stiff_lanes_of_a_rollout_are_right_at_their_events():
    heights, x = np.array([0.4, 2.0, 7.3]), np.array([-1.0, 0.3, 0.85])
    lanes = jj.rollout(Following(), {"y": heights, "x": x}, ts=[6.0], solver=jj.RadauIIA(), progress=False).lanes
    assert np.all(np.asarray(lanes.result) == results.EVENT)
    assert_allclose(lanes.t_end, np.sqrt(2 * heights), rtol=1e-10)
    assert_allclose(lanes.q_end[:, 0], [followed(*lane) for lane in zip(heights, x, strict=True)], rtol=0, atol=5e-6)


def test_the_derivative_of_a_stiff_motion_at_its_event_is_that_of_what_it_follows():
    def end(height):
        motion = jj.simulate(Following(), {"y": height, "x": 0.85}, ts=[6.0], solver=jj.RadauIIA())
        return jnp.stack([motion.t_end, motion.q_end[0]])

    slope = (followed(7.3 + 1e-5, 0.85) - followed(7.3 - 1e-5, 0.85)) / 2e-5
    assert_allclose(jax.jacrev(end)(7.3), [1 / np.sqrt(2 * 7.3), slope], rtol=0, atol=2e-5)
