"""What a scene's methods return, and what is handed to the equations, is checked by kind and shape; the error
names the method and the thing.
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from small_scenes import Bead

import jourdain_jax as jj
from jourdain_jax.models import TrailerChain


def described(**members):
    """The bead with some members replaced."""
    return type("Described", (Bead,), members)()


def at_rest(scene, **options):
    """Accelerations at the origin, from rest."""
    return jj.accelerations(scene, 0.0, jnp.zeros(2), jnp.zeros(2), **options)


def test_one_load_counts_as_a_tuple_of_one():
    one = described(loads=lambda self, motion: jj.generalized_force(motion, x_rate=3.0))
    assert_allclose(at_rest(one).udot, [3.0, 0.0])
    jj.simulate(one, {}, t1=0.1)


def test_a_direction_of_gravity_that_is_computed_is_looked_at_when_the_scene_is_probed():
    tilted = described(loads=lambda self, m: (jj.gravity(m, 9.81, self.mass * jnp.array([0.6, 0.8, 0.0])),))
    jj.simulate(tilted, {}, t1=0.1)
    refused(
        (
            r"the direction of gravity in load 1 of `Described` has a length that differs from 1 by .*,"
            r" expected a unit vector"
        ),
        jj.simulate,
        tilted.replace(mass=1.5),
        {},
        t1=0.1,
    )
    refused(
        r"the direction of gravity in load 1 of `Described`",
        jj.accelerations,
        tilted.replace(mass=1.5),
        0.0,
        np.zeros(2),
        np.zeros(2),
    )
    (failed,) = [check for check in jj.verify(tilted.replace(mass=1.5)).checks if check.name == "inertia"]
    assert not failed.passed
    assert failed.culprit == "the direction of gravity in load 1 is not a unit vector"


def test_a_direction_of_gravity_that_is_traced_hides_nothing_else():
    class Ghost(Bead):
        direction: object = jj.parameter((0.0, -1.0, 0.0))
        coordinates = jj.coordinates("x y z")

        def loads(self, motion):
            return jj.gravity(motion, 9.81, self.direction)

    refused(
        "nothing in `Ghost` has inertia along `z_rate`",
        jax.jit(lambda e: jj.simulate(Ghost(direction=e), {}, t1=0.1).q_end),
        jnp.array([0.0, -1.0, 0.0]),
    )


def test_a_body_of_integers_has_velocities():
    whole = described(
        bodies=lambda self, t, q: {
            "bead": jj.Particle(1, [q.x, q.y, 0]),
            "post": jj.RigidBody(1, [1, 1, 1], [0, 0, 0], np.eye(3, dtype=int)),
        }
    )
    assert_allclose(at_rest(whole).udot, [0.0, 0.0])


def test_inputs_are_given_by_name_or_as_a_vector():
    chain = TrailerChain(trailers=1)
    q, u, _ = chain.named(**chain.example)
    by_name = jj.accelerations(chain, 0.0, q, u, {"turn": 2.0}).udot
    assert_array_equal(by_name, jj.accelerations(chain, 0.0, q, u, [0, 2]).udot)
