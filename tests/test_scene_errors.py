"""A wrong description of a scene is answered at build time, by name, with what to do."""

import jax.numpy as jnp
import pytest
from small_scenes import Bead

import jourdain_jax as jj


def described(**methods):
    """The bead with some methods replaced."""
    return type("Described", (Bead,), methods)()


def test_a_scene_without_coordinates_says_how_to_state_them():
    class Empty(jj.Scene):
        pass

    with pytest.raises(ValueError, match=r"`Empty` has no `coordinates`; state them"):
        Empty()


def test_a_scene_without_bodies_says_what_to_define():
    class Bare(jj.Scene):
        coordinates = jj.coordinates("x")

    with pytest.raises(NotImplementedError, match=r"define `bodies\(self, t, q\)`"):
        jj.simulate(Bare(), {}, t1=1.0)


def test_an_unknown_coordinate_in_a_method_lists_the_valid_ones():
    wrong = described(loads=lambda self, motion: (jj.generalized_force(motion, x_rate=motion.q.z),))
    with pytest.raises(AttributeError, match=r"no `z` here; .*`x`, `y`"):
        jj.accelerations(wrong, 0.0, jnp.zeros(2), jnp.zeros(2))


@pytest.mark.parametrize(
    ("loads", "sentence"),
    [
        (lambda self, motion: (jj.torque(motion, "bed", jnp.ones(3)),), "torque on unknown body `bed`; did you mean `bead`"),
        (lambda self, motion: (jj.generalized_force(motion, x_rat=1.0),), "unknown speed `x_rat`; did you mean `x_rate`"),
        (lambda self, motion: (jj.Load(forces={"bed": jnp.ones(3)}),), "acts on unknown body `bed`"),
    ],
)
def test_a_load_on_something_unknown_is_named(loads, sentence):
    with pytest.raises(ValueError, match=sentence):
        jj.accelerations(described(loads=loads), 0.0, jnp.zeros(2), jnp.zeros(2))


def test_an_unknown_body_is_answered_with_the_nearest_name():
    wrong = described(velocity_constraints=lambda self, motion: {"row": motion["baed"].velocity[0]})
    with pytest.raises(KeyError, match="did you mean `bead`"):
        jj.accelerations(wrong, 0.0, jnp.zeros(2), jnp.zeros(2))


def test_two_rows_of_one_name_are_refused():
    wrong = described(
        geometric_constraints=lambda self, pose: {"row": pose.q.x - pose.q.y},
        velocity_constraints=lambda self, motion: {"row": motion.u.x_rate},
    )
    with pytest.raises(ValueError, match="row name `row` of `Described` is used twice"):
        jj.accelerations(wrong, 0.0, jnp.zeros(2), jnp.zeros(2))


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: jj.Particle(1.0, jnp.zeros(2)), r"position of a particle has shape \(2,\), expected \(3,\)"),
        (lambda: jj.RigidBody(1.0, jnp.zeros((2, 2)), jnp.zeros(3), jnp.eye(3)), r"inertia .* has shape \(2, 2\)"),
        (lambda: jj.RigidBody(1.0, jnp.ones(3), jnp.zeros(3), jnp.eye(2)), r"orientation .* has shape \(2, 2\)"),
        (lambda: jj.RigidBody.thin_disc(1.0, 1.0, axis="w", position=jnp.zeros(3), orientation=jnp.eye(3)), "body axis `w` is unknown"),
        (lambda: jj.pin(jnp.zeros(3), jnp.zeros(3), axes="xw"), "pin along axes `xw`"),
    ],
)
def test_a_body_or_joint_of_the_wrong_shape_is_refused(build, sentence):
    with pytest.raises(ValueError, match=sentence):
        build()
