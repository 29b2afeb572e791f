"""The dense rates that scalar programs are compared with are those of `jj.accelerations`, state by state; they are NaN where these are not determined."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_scenes import OnPlane

import jourdain_jax as jj
from jourdain_jax import structure_of
from jourdain_jax.lowering.dense_rates import accelerations, dense_rates

STATES = 4


class Polar(jj.Scene):
    """A particle in polar coordinates."""

    coordinates = jj.coordinates("r angle")

    def bodies(self, t, q):
        return {"particle": jj.Particle(2.0, jnp.stack([q.r * jnp.cos(q.angle), q.r * jnp.sin(q.angle), 0.0 * q.r]))}


def rates(scene, independent, t, q, u, inputs):
    """Dense rates at some states of a scene, each with the scene's own parameters."""
    parameters = jax.tree.map(lambda x: np.broadcast_to(np.asarray(x, float), (len(t), *np.shape(x))), scene)
    return dense_rates(scene, structure_of(scene), independent, parameters, t, q, u, inputs)


@pytest.mark.parametrize(
    ("name", "every_speed"),
    [("two-wheel-axle-redundant", False), ("two-wheel-axle-redundant", True), ("ball-on-turntable", False), ("double-pendulum-rods", True)],
)
def test_they_are_those_of_the_accelerations(name, every_speed):
    scene = jj.models.MODELS[name]()
    independent = tuple(range(len(scene.speed_names))) if every_speed else structure_of(scene).independent
    t, q, u = jj.sample_states(scene, STATES)
    inputs = np.random.default_rng(0).normal(size=(STATES, len(scene.inputs)))
    qdot, ydot, _ = rates(scene, independent, t, q, u, inputs)
    for k in range(STATES):
        udot = jj.accelerations(scene, t[k], q[k], u[k], inputs[k]).udot
        assert_allclose(ydot[k], udot[np.array(independent)], rtol=1e-9, atol=1e-9 * (1 + np.max(np.abs(udot))))
        assert_allclose(qdot[k], jj.coordinate_rates(scene, t[k], q[k], u[k]), rtol=1e-12, atol=1e-12)


def test_they_are_nan_where_a_speed_has_no_inertia():
    q = np.array([[0.0, 0.3], [2.0, 0.3]])
    _, ydot, _ = rates(Polar(), (0, 1), np.zeros(2), q, np.array([[1.0, 0.5], [1.0, 0.5]]), np.zeros((2, 0)))
    assert np.all(np.isnan(ydot[0]))
    assert_allclose(ydot[1], [2.0 * 0.5**2, -2 * 1.0 * 0.5 / 2.0], rtol=1e-12)


class SaidTwice(OnPlane):
    """A particle on a circle, by two rows that depend on each other on the circle alone."""

    def geometric_constraints(self, pose):
        circle = (pose.q.x**2 + pose.q.y**2 - 1.0) / 2
        return {"circle": circle, "once more": (2.0 + pose.q.x + 3.0 * pose.q.y) * circle}


def test_rows_that_follow_from_others_are_left_out_where_rounded_coordinates_make_them_independent():
    scene = SaidTwice()
    t, q, u = jj.sample_states(scene, STATES)
    _, ydot, _ = rates(scene, (0, 1), t, q.astype(np.float32).astype(float), u, np.zeros((STATES, 0)))
    assert_allclose(ydot, -np.sum(u**2, axis=1, keepdims=True) * q, atol=1e-5)


def test_rows_that_rounding_makes_independent_count_once():
    A, row_lengths = np.array([[[1.0, 0.0, 0.0], [1.0, 1e-8, 0.0]]]), np.ones(2)
    found = accelerations(np.eye(3)[None], np.array([[5.0, 2.0, 3.0]]), A, -np.ones((1, 2)), row_lengths, rank=1)
    assert_allclose(found, [[1.0, 2.0, 3.0]], atol=1e-7)
