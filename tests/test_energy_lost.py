"""A motion whose energy changes by more than its steps explain has a result code, inside `jit` and in every lane; right motions never have it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from small_scenes import OnLine, OnPlane

import jourdain_jax as jj


class Step(OnPlane):
    """A particle that flies over an edge of the potential, `height` (J) high and `width` (m) wide, at x = 1 m."""

    height: float = jj.parameter(2.0, unit="J")
    width: float = jj.parameter(1e-9, unit="m")

    def potential(self, pose):
        return self.height * jax.nn.sigmoid((pose.q.x - 1.0) / self.width)


class Spring(OnLine):
    """An oscillator."""

    k: float = jj.parameter(4.0, unit="N/m")
    level: float = jj.parameter(0.0, unit="J")

    def potential(self, pose):
        return self.level + 0.5 * self.k * pose.q.x**2


class WrongPotential(Spring):
    """A load whose potential is not that of its force."""

    def potential(self, pose):
        return None

    def loads(self, motion):
        x = motion.q.x
        return (jj.Load(generalized={"x_rate": -self.k * x}, potential=self.k * x**2),)


WAYS = ({}, {"backend": "xla"}, {"backend": "dense"})
SPEEDS = np.array([0.5, 3.0, 4.0, -1.0])  # m/s; the first and the last never come to the edge


@pytest.mark.parametrize("way", WAYS)
def test_a_feature_that_steps_pass_over_is_told_by_the_energy(way):
    run = lambda v: jj.simulate(Step(), {"x_rate": v, "y_rate": 1.0}, ts=[1.5], **way)  # noqa: E731
    codes = [int(run(v).result) for v in SPEEDS]
    inside = jax.jit(jax.vmap(lambda v: run(v).result))(SPEEDS).tolist()
    lanes = jj.rollout(Step(), {"x_rate": SPEEDS, "y_rate": 1.0 + 0 * SPEEDS}, ts=[1.5], **way).result.tolist()
    assert codes == inside == lanes == [results.SUCCESS, results.ENERGY_LOST, results.ENERGY_LOST, results.SUCCESS]


def test_an_edge_that_steps_can_follow_is_passed():
    motion = jj.simulate(Step(width=0.05), {"x_rate": 3.0, "y_rate": 1.0}, ts=[1.5])
    assert int(motion.result) == results.SUCCESS
    assert_allclose(motion.u_end[0], np.sqrt(9.0 - 4.0), rtol=1e-6)


def test_a_potential_that_is_not_that_of_its_force_is_told():
    motion = jj.simulate(WrongPotential(), {"x": 1.0}, ts=[0.7])
    assert int(motion.result) == results.ENERGY_LOST
    with pytest.raises(jj.SimulationError, match="energy"):
        motion.raise_if_failed()


@pytest.mark.parametrize(("amplitude", "level", "tolerance"), [(1.0, 0.0, 1e-2), (1e-9, 0.0, 1e-6), (1e-3, 1e12, 1e-6), (0.0, 0.0, 1e-3), (1e6, -1e3, 1e-4)])
@pytest.mark.parametrize("k", [4.0, 1e6])
def test_errors_that_the_tolerance_allows_are_not_told(amplitude, level, tolerance, k):
    scene, turns = Spring(k, level), 40 * np.pi / np.sqrt(k)
    for ts in ([turns], np.linspace(0.1, 1.0, 7) * turns):
        motion = jj.simulate(scene, {"x": amplitude}, ts=ts, rtol=tolerance, atol=tolerance)
        assert int(motion.result) == results.SUCCESS


class Damped(Spring):
    """Overdamped: large powers, and little work in the end."""

    def potential(self, pose):
        return None

    def loads(self, motion):
        q, u = motion.q, motion.u
        return (jj.generalized_force(motion, x_rate=-self.k * q.x - 5.0 * jnp.sqrt(self.k) * u.x_rate),)


@pytest.mark.parametrize("k", [1e4, 1e7])
def test_where_work_is_integrated_nothing_is_told(k):
    assert int(jj.simulate(Damped(k), {"x": 0.7}, ts=[2.0, 6.0]).result) == results.SUCCESS


def test_steps_without_control_are_taken_as_they_are():
    motion = jj.simulate(Spring(), {"x": 1.0}, ts=[40.0], solver=jj.ImplicitMidpoint(step=0.5))
    assert int(motion.result) == results.SUCCESS


def test_the_derivative_of_a_motion_is_what_it_was_without_the_check():
    """x = a cos(w t), dx/dk = -a t sin(w t)/(2 w)."""
    slope = jax.grad(lambda k: jj.simulate(Spring(k), {"x": 0.3}, ts=[2.0], rtol=1e-11, atol=1e-11).q_end[0])(4.0)
    assert_allclose(slope, -0.3 * 2.0 * np.sin(4.0) / 4.0, rtol=1e-8)
