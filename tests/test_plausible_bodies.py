"""Numbers that no body and no moving plane can have are refused by name where they are known, and left alone
where they are traced.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused
from rolling_scenes import Rolls

import jourdain_jax as jj


class Top(jj.Scene):
    """A body that turns about z, with its inertia open to mistakes."""

    moments: object = jj.parameter((1.0, 2.0, 2.5))
    product: object = jj.parameter(0.0)
    coordinates = jj.coordinates("x turn")

    def bodies(self, t, q):
        inertia = jnp.diag(self.moments) + self.product * (jnp.ones((3, 3)) - jnp.eye(3))
        return {"top": jj.RigidBody(1.0, inertia, [q.x, 0.0, 0.0], jj.rot_z(q.turn))}


@pytest.mark.parametrize("moments", [(0.0, 2.0, 2.0), (0.0, 0.0, 2.0), (1.0, 1.0, 2.0), (1e-3, 2.0, 2.001)])
def test_rods_plates_and_bodies_with_a_moment_about_one_axis_can_be(moments):
    assert jj.check(Top(moments=moments)).passed


def test_traced_parameters_are_not_judged_by_the_numbers_that_stand_in_for_them():
    # the stand-in of `product` is 0.1, that of a scene without defaults could be anything
    made = lambda product: Top(moments=(0.05, 0.05, 0.05), product=product)
    end = lambda product: jnp.sum(jj.simulate(made(product), {"turn_rate": 1.0}, t1=0.1).q_end)
    assert np.isfinite(jax.grad(end)(0.01))


class BallOnPlate(Rolls):
    """A ball on a plate that rises and tilts as given functions of time, its motion stated again as
    velocities.
    """

    rise: object = jj.parameter(0.0)
    stated_rise: object = jj.parameter(0.0)
    turn: object = jj.parameter(0.0)
    stated_turn: object = jj.parameter(0.0)
    belt: object = jj.parameter(0.0)

    def contacts(self, pose):
        o = 0.0 * pose.t
        velocity = jnp.stack([o, o + self.belt, o + self.stated_rise])
        plate = jj.Plane(
            jnp.stack([o, o, self.rise * pose.t]),
            self.turn * pose.t,
            velocity,
            jnp.stack([o, o + self.stated_turn, o]),
        )
        return {"plate": self.contact(pose, plate)}


@pytest.mark.parametrize(
    "motion", [{}, {"belt": 1.0}, {"rise": 0.3, "stated_rise": 0.3}, {"turn": 0.2, "stated_turn": 0.2}]
)
def test_a_moving_plane_whose_velocities_are_the_rates_of_its_pose_is_accepted(motion):
    assert jj.structure_of(BallOnPlate(**motion)).faults == ()


class OnSledge(jj.Scene):
    """A ball on the back of a sledge, whose contact takes the sledge for its ground."""

    ground: Callable = eqx.field(static=True, default=lambda pose, back: jj.Plane(back))
    coordinates = jj.coordinates("sledge x roll")

    def bodies(self, t, q):
        o = 0.0 * q.x
        return {
            "sledge": jj.RigidBody.box(
                2.0, (1.0, 0.3, 0.1), position=[q.sledge, o, o], orientation=jnp.eye(3)
            ),
            "post": jj.Particle(1.0, jnp.zeros(3)),
            "ball": jj.RigidBody.ball(1.0, 0.1, position=[q.x, o, o + 0.15], orientation=jj.rot_y(q.roll)),
        }

    def contacts(self, pose):
        ground = self.ground(pose, pose["sledge"].place(jnp.array([0.0, 0.0, 0.05])))
        return {"back": jj.ball_contact(pose["ball"], 0.1, ground=ground)}


@pytest.mark.parametrize(
    "ground",
    [
        lambda pose, back: jj.Plane(
            pose["post"].position + jnp.array([0.0, 0.0, 0.05])
        ),  # a body that stands still
        lambda pose, back: jj.Plane(
            pose["ball"].position - jnp.array([0.0, 0.0, 0.1])
        ),  # the plane that touches, where the coordinates know it
        lambda pose, back: jj.Plane(back, velocity=(0.3, 0.0, 0.0)),  # its velocity is stated
    ],
)
def test_a_ground_that_no_other_body_carries_unsaid_is_accepted(ground):
    assert jj.structure_of(OnSledge(ground)).faults == ()


class OnLift(OnSledge):
    """The ball on a sledge that is lifted or tilted, on a ground that is built of the coordinate that does
    it, not of the sledge's pose.
    """

    coordinates = jj.coordinates("sledge x roll rise")
    domain = {"rise": (-0.3, 0.3)}

    def bodies(self, t, q):
        made = super().bodies(t, q)
        up = jnp.stack([0.0, 0.0, q.rise])
        ball = self.ground(q, up).plane_at(up)
        at = ball.origin + q.x * ball.axes[:, 0] + 0.1 * ball.normal
        return made | {"ball": jj.RigidBody.ball(1.0, 0.1, position=at, orientation=jj.rot_y(q.roll))}

    def contacts(self, pose):
        ground = self.ground(pose.q, jnp.stack([0.0, 0.0, pose.q.rise]))
        return {"back": jj.ball_contact(pose["ball"], 0.1, ground=ground)}


def test_a_check_names_grounds_and_bodies_and_passes_all_models():
    assert "moves with another body" in jj.check(OnSledge()).found["grounds"][0]
    top = Top(moments=(1.0, 1.0, 3.0))
    assert "above the sum of the others" in jj.check(top).found["bodies"][0]
    rounded = top.replace(moments=(1.0, 1.0, 2.06))
    assert jj.simulate(rounded, {"turn_rate": 1.0}, ts=[0.1]).result == 0
    for use in (jj.build, jj.report, lambda top: jj.linearize(top, {"turn_rate": 1.0})):
        refused("above the sum of the others", use, top)
    assert all(jj.check(model()).passed for model in (jj.models.TiltingDisc, jj.models.Suslov))
