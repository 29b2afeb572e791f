"""Velocity rows that depend on each other and follow inputs or time: motions on which they contradict each other have a result code, others do not."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from small_scenes import OnPlane

import jourdain_jax as jj


class TwoBelts(OnPlane):
    """A block on two belts, which must run equally fast."""

    inputs = jj.inputs("first second")
    mass: float = jj.parameter(1.0, unit="kg", positive=True)

    def velocity_constraints(self, motion):
        return {"first": motion.u.x_rate - motion.inputs.first, "second": 10.0 * (motion.u.x_rate - motion.inputs.second)}


class Circling(OnPlane):
    """A point whose speed is held twice: at one, and at what an input says."""

    inputs = jj.inputs("speed")

    def velocity_constraints(self, motion):
        squared = motion.u.x_rate**2 + motion.u.y_rate**2
        return {"one": squared - 1.0, "said": squared - motion.inputs.speed**2}


def belts(off):
    return {"first": lambda t: jnp.sin(t), "second": lambda t: jnp.sin(t) + off * t}


@pytest.mark.parametrize("way", [{}, {"formulation": jj.Formulation("full")}])
def test_rows_that_contradict_each_other_later_are_told(way):
    run = lambda off: jj.simulate(TwoBelts(), {"y_rate": 1.0}, ts=[0.5, 1.0], inputs=belts(off), **way)  # noqa: E731
    codes = [int(run(off).result) for off in (0.0, 0.5)]
    inside = jax.jit(jax.vmap(lambda off: run(off).result))(np.array([0.0, 0.5])).tolist()
    assert codes == inside == [results.SUCCESS, results.CONTRADICTORY_ROWS]
    assert_allclose(run(0.0).q_end, [1.0 - np.cos(1.0), 1.0], rtol=1e-7)


def test_lanes_are_told_each_by_itself():
    rollout = jj.rollout(TwoBelts(), {"y_rate": np.array([1.0, 2.0])}, ts=[1.0], inputs=belts(0.5))
    assert rollout.result.tolist() == [results.CONTRADICTORY_ROWS] * 2
    with pytest.raises(jj.SimulationError, match="contradict"):
        rollout.lane(1).raise_if_failed()


def test_nonlinear_rows_are_told_as_well():
    run = lambda speed: jj.simulate(Circling(), {"x_rate": 1.0}, ts=[1.0], inputs={"speed": speed})  # noqa: E731
    assert int(run(lambda t: 1.0 + 0.0 * t).result) == results.SUCCESS
    assert int(run(lambda t: 1.0 + t).result) != results.SUCCESS


def test_what_long_steps_violate_is_no_contradiction():
    formulation = jj.Formulation("full", stabilisation=None)
    long = {"solver": diffrax.Heun(), "rtol": 1e3, "atol": 1e3, "max_step": np.inf, "work": False}
    motion = jj.simulate(TwoBelts(), {"y_rate": 1.0}, ts=[1.0], inputs=belts(0.0), formulation=formulation, **long)
    assert float(jnp.max(jnp.abs(motion.residuals()[1]))) > 0.3  # of 10 sin(1)
    assert int(motion.result) == results.SUCCESS


def test_derivatives_are_as_without_the_check():
    end = lambda speed: jj.simulate(TwoBelts(), {"y_rate": speed}, ts=[1.0], inputs=belts(0.0)).q_end[1] ** 2  # noqa: E731
    assert_allclose([jax.grad(end)(1.0), jax.jit(jax.grad(end))(2.0)], [2.0, 4.0], rtol=1e-7)
