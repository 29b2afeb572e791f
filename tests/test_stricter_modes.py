"""Modes of JAX that a user sets for their own code, and threads of their own, leave the package's results as they are."""

import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj

RATE = 2.0  # rad/s


class Spring(jj.Scene):
    """A particle on a spring, whose numbers are of several types and ranks."""

    mass: object = jj.parameter(1)
    stiffness: object = jj.parameter(RATE**2)
    coordinates = jj.coordinates("x y")

    def bodies(self, t, q):
        return {"bead": jj.Particle(self.mass, (q.x, q.y, 0))}

    def loads(self, motion):
        return (jj.point_force(motion["bead"].point(), -self.stiffness * jnp.eye(3, dtype=jnp.float32) @ jnp.stack([motion.q.x, motion.q.y, 0.0])),)

    def velocity_constraints(self, motion):
        return {"along x": motion.u.y_rate}


def _end(stiffness, **options):
    return jj.simulate(Spring(stiffness=stiffness), {"x": 1}, ts=jnp.array([0.0, 1.0]), **options)["x"][-1]


SLOPE = -np.sin(RATE) / (2 * RATE)  # d/dk of cos(sqrt(k)) at k = RATE^2


def test_motions_and_their_derivatives_are_found_where_types_and_ranks_of_the_users_own_lines_must_fit():
    modes = {"jax_numpy_dtype_promotion": "strict", "jax_numpy_rank_promotion": "raise"}
    before = {name: getattr(jax.config, name) for name in modes}
    for name, mode in modes.items():
        jax.config.update(name, mode)
    try:
        motion = jj.simulate(Spring(), {"x": 1}, t1=1)
        assert_allclose(motion["x"][-1], np.cos(RATE), atol=1e-7)
        assert "reached" in str(motion)
        assert motion.accelerations().udot.shape == (201, 2)
        lanes = jj.rollout(Spring(), {"x": np.ones(2)}, parameters={"stiffness": np.array([1.0, 4.0])}, t1=1.0)
        assert_allclose(lanes["x"][:, -1], np.cos([1.0, 2.0]), atol=1e-7)
        assert_allclose(jax.grad(jax.jit(_end))(RATE**2), SLOPE, atol=1e-6)  # rules of derivatives are asked for once `simulate` has returned
        assert {name: getattr(jax.config, name) for name in modes} == modes
    finally:
        for name, mode in before.items():
            jax.config.update(name, mode)


def test_classes_of_scenes_may_be_written_in_several_threads_at_once():
    together, many = Barrier(4), 25
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:

        def write(number):
            together.wait(timeout=60)
            for _ in range(many):
                kind = type("Kind", (Spring,), {"conventions": str(number), "__annotations__": {}})
                assert kind().conventions == str(number)
            return number

        with ThreadPoolExecutor(4) as threads:
            assert list(threads.map(write, range(4))) == [0, 1, 2, 3]
    finally:
        sys.setswitchinterval(before)


def test_numbers_of_extended_precision_are_rounded_and_complex_ones_named():
    wide = np.array([1.0, 4.0], np.longdouble)
    lanes = jj.rollout(Spring(), {"x": wide[:1].repeat(2)}, parameters={"stiffness": wide}, ts=wide - 1)
    assert_allclose(lanes["x"][:, -1], np.cos([3.0, 6.0]), atol=1e-6)
    assert jj.Sampled(wide, wide)(2.0) == 2.0
    assert all(scene.stiffness.dtype == np.float64 for scene in (Spring(stiffness=wide[1]), Spring().replace(stiffness=np.array(4.0, np.longdouble))))
    with pytest.raises(ValueError, match="`ts` of `Sampled` is of type complex256, expected real numbers"):
        jj.Sampled(wide.astype(np.clongdouble), wide)
