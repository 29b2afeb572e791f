"""Normal forces of contacts that are built into the coordinates: by the forces and moments of the bodies that
they carry.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from rolling_scenes import GRAVITY, Cart

import jourdain_jax as jj
from jourdain_jax.dynamics.reactions import contact_forces
from jourdain_jax.program.eager import eval_numpy


def forces(scene, **values):
    """Contact forces of a scene at a state that rolls."""
    q, u, _ = scene.named(**values)
    return eval_numpy(lambda q, u: contact_forces(scene, 0.0, q, u, jj.accelerations(scene, 0.0, q, u)))(q, u)


class Row(Cart):
    """A cart on up to four balls, at rest, not turned."""

    coordinates = jj.coordinates("x y heading", *(jj.quaternion(f"ball{i}") for i in range(4)))


@pytest.mark.parametrize("shift", [0.0, 0.15])
def test_four_wheels_share_the_weight_by_minimum_norm_and_say_that_they_do(shift):
    corners = ((0.5, 0.3), (0.5, -0.3), (-0.5, 0.3), (-0.5, -0.3))
    cart = Row(places=corners, load=(shift, 0.0, 0.0), slope=0.0, push=(0.0, 0.0, 0.0), balls=4)
    found = forces(cart)
    weight = 14.0 * GRAVITY
    normal = np.array([found[f"ball{i}"].normal for i in range(4)])
    # of all that carry the weight and its moment, the shortest vector: one plane through the four
    ahead = 10.0 * GRAVITY * shift / (4 * 0.5)
    assert np.allclose(normal, weight / 4 + ahead * np.array([1, 1, -1, -1]), rtol=1e-12)
    assert not any(bool(force.determined) for force in found.values())


class TwoBalls(Cart):
    """A cart on two balls."""

    coordinates = jj.coordinates("x y heading", *(jj.quaternion(f"ball{i}") for i in range(2)))


def test_a_moment_that_no_contact_can_bear_marks_the_shares_but_not_their_sum():
    # pushed upwards beside the line of its balls: a guide must keep it from tilting
    cart = TwoBalls(
        places=((0.5, 0.0), (-0.5, 0.0)), load=(0.0, 0.1, 0.0), slope=0.0, push=(0.0, 0.0, 0.0), balls=2
    )
    found = forces(cart)
    assert np.isclose(sum(float(force.normal) for force in found.values()), 12.0 * GRAVITY, rtol=1e-12)
    assert not any(bool(force.determined) for force in found.values())


class Robot(jj.Scene):
    """Two driven discs on an axle and a body above it that may pitch: balanced on two wheels."""

    coordinates = jj.coordinates("x y heading pitch left right")

    def bodies(self, t, q):
        frame, o = jj.rot_z(q.heading), 0.0 * q.x
        middle = jnp.stack([q.x, q.y, o + 0.12])
        turned = frame @ jj.rot_y(q.pitch)
        made = {"body": jj.RigidBody(9.0, jnp.array([0.3, 0.25, 0.1]), middle + 0.4 * turned[:, 2], turned)}
        for name, side in (("left", 1.0), ("right", -1.0)):
            centre = middle + 0.25 * side * frame[:, 1]
            made[name] = jj.RigidBody.thin_disc(
                1.5, 0.12, axis="y", position=centre, orientation=frame @ jj.rot_y(q[name])
            )
        return made

    def loads(self, motion):
        return jj.gravity(motion, GRAVITY)

    def contacts(self, pose):
        return {name: jj.disc_contact(pose[name], 0.12) for name in ("left", "right")}


@pytest.mark.parametrize(("v", "turn"), [(0.0, 0.0), (1.2, 0.0), (1.5, 0.8), (-1.0, 1.3)])
def test_the_wheels_of_a_robot_carry_half_of_it_and_lean_on_the_outer_one_in_a_turn(v, turn):
    robot = Robot()
    rates = {"x_rate": v, "heading_rate": turn}
    rates |= {"left_rate": (v - 0.25 * turn) / 0.12, "right_rate": (v + 0.25 * turn) / 0.12}
    found = forces(robot, **rates)
    left, right = (float(found[name].normal) for name in ("left", "right"))
    weight = 12.0 * GRAVITY
    # the body stands upright: its own pitch and the weight hold the balance; the centripetal forces and the
    # wheels' momentum turn it outwards
    spin = 0.5 * 1.5 * 0.12**2 * turn * (rates["left_rate"] + rates["right_rate"])
    outwards = (9.0 * 0.52 + 3.0 * 0.12) * v * turn + spin
    assert np.isclose(left + right, weight, rtol=1e-9)
    assert np.isclose(right - left, 2 * outwards / 0.5, rtol=1e-9, atol=1e-9)


def test_contacts_that_carry_bodies_of_their_own_share_nothing():
    scene = jj.models.TwoWheelAxleCoordinates()
    found = forces(scene)
    for force in found.values():
        assert np.isclose(force.normal, scene.mass * GRAVITY * np.cos(scene.slope), rtol=1e-12)
