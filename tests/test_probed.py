"""What is found of a scene whose methods call what has no scalar form, or have derivatives of their own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from refusals import refused

import jourdain_jax as jj
from jourdain_jax import structure_of


class Called(jj.models.ChaplyginSleigh):
    """A sleigh with friction that asks Python, which has no derivative."""

    def loads(self, motion):
        friction = jax.pure_callback(
            lambda u: -0.1 * u,
            jax.ShapeDtypeStruct((), motion.t.dtype),
            motion.u.heading_rate,
            vmap_method="expand_dims",
        )
        return jj.generalized_force(motion, heading_rate=jax.lax.stop_gradient(friction))


class OnPath(jj.Scene):
    """A bead on a path that is found by an iteration, tied to a point by a rod: poses and rows are calls of
    JAX.
    """

    mass: Float[Array, ""] = jj.parameter(2.0)
    coordinates = jj.coordinates("x z")
    domain = {"x": (-1.0, 1.0), "z": (-1.0, 1.0)}

    def bodies(self, t, q):
        newton = lambda v: v - (v**3 + v - q.x) / (3 * v * v + 1)
        root = jax.lax.while_loop(lambda v: jnp.abs(newton(v) - v) > 1e-14, newton, jnp.zeros_like(q.x))
        return {"bead": jj.Particle(self.mass, [q.x, root, q.z])}

    def geometric_constraints(self, pose):
        return {"rod": pose["bead"].position @ pose["bead"].position - 0.5}


def test_what_a_call_in_a_pose_does_not_do_is_known():
    found = structure_of(OnPath())
    assert (found.rank, found.affine, found.homogeneous, found.driven) == (1, True, True, False)


def test_a_callback_in_a_load_changes_nothing_else():
    expected, found = structure_of(jj.models.ChaplyginSleigh()), structure_of(Called())
    assert (found.rank, found.independent, found.row_names) == (
        expected.rank,
        expected.independent,
        expected.row_names,
    )
    assert found.worst_pivot == pytest.approx(expected.worst_pivot, abs=1e-12)


def test_a_pose_that_jax_cannot_differentiate_is_named():
    class Asked(jj.models.ChaplyginSleigh):
        def velocity_constraints(self, motion):
            turn = jax.pure_callback(
                np.sin,
                jax.ShapeDtypeStruct((), motion.t.dtype),
                motion.q.heading + motion.u.heading_rate,
                vmap_method="expand_dims",
            )
            return {"blade": motion.u.y_rate - turn}

    refused(
        r"the motion of `Asked` needs the derivative of the operation `pure_callback`", structure_of, Asked()
    )


def test_a_derivative_rule_in_the_rates_of_coordinates_is_believed():
    @jax.custom_jvp
    def doubled(x):
        return x

    doubled.defjvp(lambda x, dx: (x[0], 2 * dx[0]))

    class Believed(jj.models.ChaplyginSleigh):
        def coordinate_rates(self, t, q, u):
            return doubled(u.array)

    assert structure_of(Believed()).rank == 1
