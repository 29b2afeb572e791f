"""Spans, saved times, solvers of `simulate`; what stands in for traced parameters."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from small_scenes import Upright

import jourdain_jax as jj
from jourdain_jax.models import MODELS


class Falling(Upright):
    """A particle in the plane, under gravity."""

    mass: jnp.ndarray = jj.parameter(1.0, positive=True)

    def loads(self, motion):
        return (jj.gravity(motion, 9.81),)


def test_a_step_that_ends_a_little_before_a_saved_time_leaves_no_sliver():
    motion = jj.simulate(MODELS["ball-on-turntable"]())  # ended at 4.9 of 10 s with a step size that shrank to nothing
    assert int(motion.result) == results.SUCCESS
    assert float(motion.t_end) == 10.0


@pytest.mark.parametrize("solver", [diffrax.Bosh3(), jj.ImplicitMidpoint(step=0.01)])
def test_any_solver_lands_on_the_saved_times(solver):
    ts = jnp.array([0.11, 0.123, 0.3])
    motion = jj.simulate(Falling(), {"x_rate": 2.0}, ts=ts, solver=solver)
    assert int(motion.result) == results.SUCCESS
    assert_allclose(motion["x"], 2.0 * ts, rtol=1e-12)


def test_an_implicit_solver_serves_a_projected_scene():
    scene = MODELS["double-pendulum-rods"]()
    options = {"t1": 0.5, "rtol": 1e-8, "atol": 1e-8}
    implicit, explicit = jj.simulate(scene, solver=diffrax.Kvaerno5(), **options), jj.simulate(scene, **options)
    assert int(implicit.result) == results.SUCCESS
    assert_allclose(implicit.q_end, explicit.q_end, atol=1e-6)


def test_a_motion_starts_at_the_time_of_its_state():
    start = jj.start(Falling(), t0=3.0, x_rate=1.0)
    motion = jj.simulate(Falling(), start, t1=3.5)
    assert float(motion.ts[0]) == 3.0
    assert_allclose(motion.q_end[0], 0.5, rtol=1e-12)


def test_a_start_given_by_names_says_how_far_it_was_moved():
    motion = jj.simulate(MODELS["skate"](), {"heading": 0.5, "x_rate": 1.0}, t1=0.1)
    assert_allclose(motion.moved_u, np.tan(0.5), rtol=1e-9)  # y_rate, from zero


class Tied(jj.Scene):
    """A bead at height z, tied to the origin by a rod and to the line y = 3: its default rod is too short to be assembled."""

    mass: jnp.ndarray = jj.parameter(1.0, positive=True)
    length: jnp.ndarray = jj.parameter(1.0, positive=True)
    coordinates = jj.coordinates("x y z")
    domain = {"x": (3.0, 6.0), "y": (2.0, 4.0)}

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, q.array)}

    def geometric_constraints(self, pose):
        return {"rod": pose.q.x**2 + pose.q.y**2 - self.length**2, "line": pose.q.y - 3.0}


def test_a_batch_is_probed_near_its_own_parameters():
    lanes = jj.rollout(Tied(length=6.0), {"x": np.array([4.0, 5.2]), "z_rate": 1.0}, parameters={"length": np.array([5.0, 6.0])}, t1=0.5)
    assert list(lanes.result) == [results.SUCCESS, results.SUCCESS]
    assert_allclose(lanes.lanes.q_end, [[4.0, 3.0, 0.5], [np.sqrt(27.0), 3.0, 0.5]], atol=1e-9)
