"""A wrong description of a scene is answered at build time, by name, with what to do."""

import jax.numpy as jnp
import pytest
from small_scenes import Bead

import jourdain_jax as jj


def described(**methods):
    """The bead with some methods replaced."""
    return type("Described", (Bead,), methods)()


def test_a_scene_without_bodies_says_what_to_define():
    class Bare(jj.Scene):
        coordinates = jj.coordinates("x")

    with pytest.raises(NotImplementedError, match=r"define `bodies\(self, t, q\)`"):
        jj.simulate(Bare(), {}, t1=1.0)


def test_two_rows_of_one_name_are_refused():
    wrong = described(
        geometric_constraints=lambda self, pose: {"row": pose.q.x - pose.q.y},
        velocity_constraints=lambda self, motion: {"row": motion.u.x_rate},
    )
    with pytest.raises(ValueError, match="row name `row` of `Described` is used twice"):
        jj.accelerations(wrong, 0.0, jnp.zeros(2), jnp.zeros(2))
