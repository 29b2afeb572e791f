"""Four scenes as someone writes them who has read nothing but the pages of the site; and the slips that cost this reader time."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj

G = 9.81


class RobotWithTrailer(jj.Scene):
    """A robot with two driven wheels that pulls a trailer."""

    radius: object = jj.parameter(0.08, unit="m", positive=True)
    half_track: object = jj.parameter(0.15, unit="m", positive=True)
    hitch: object = jj.parameter(0.12, unit="m", positive=True)
    bar: object = jj.parameter(0.5, unit="m", positive=True)

    coordinates = jj.coordinates("x y heading left right angle")
    inputs = jj.inputs("left_torque right_torque")
    domain = {"angle": (-1.5, 1.5)}
    carried = ("robot", "left wheel", "right wheel")

    def bodies(self, t, q):
        R, Rt = jj.rot_z(q.heading), jj.rot_z(q.heading + q.angle)
        centre = jnp.stack([q.x, q.y, self.radius])
        trailer = centre - self.hitch * R[:, 0] - self.bar * Rt[:, 0]
        made = {
            "robot": jj.RigidBody.box(5.0, (0.3, 0.2, 0.1), position=centre, orientation=R),
            "trailer": jj.RigidBody.box(3.0, (0.3, 0.2, 0.1), position=trailer, orientation=Rt),
        }
        for side, sign in (("left", 1.0), ("right", -1.0)):
            place = centre + sign * self.half_track * R[:, 1]
            made[f"{side} wheel"] = jj.RigidBody.thin_disc(0.3, self.radius, axis="y", position=place, orientation=R @ jj.rot_y(q[side]))
        return made

    def contacts(self, pose):
        return {side: jj.disc_contact(pose[f"{side} wheel"], self.radius, carried=self.carried) for side in ("left", "right")}

    def velocity_constraints(self, motion):
        trailer = motion["trailer"]
        return {"trailer wheels": jj.knife_edge(trailer, trailer.position, trailer.orientation[:, 1])}

    def loads(self, motion):
        axle = motion["robot"].orientation[:, 1]
        left, right = motion.inputs.left_torque, motion.inputs.right_torque
        motors = [jj.torque(motion, f"{side} wheel", value * axle, reaction="robot") for side, value in (("left", left), ("right", right))]
        return jj.gravity(motion, G), *motors


class Bowl(jj.Scene):
    """The page on contacts: a ball in a bowl; without a `domain`, as who has not read on writes it."""

    coordinates = jj.coordinates("x y", jj.quaternion("attitude"))

    def bodies(self, t, q):
        z = 0.4 - jnp.sqrt(0.35**2 - q.x**2 - q.y**2)
        centre, turned = jnp.stack([q.x, q.y, z]), jj.quaternion_to_matrix(q.attitude)
        return {"ball": jj.RigidBody.ball(0.7, 0.05, position=centre, orientation=turned)}

    def loads(self, motion):
        return (jj.gravity(motion, G),)

    def contacts(self, pose):
        return {"bowl": jj.ball_contact(pose["ball"], 0.05, ground=jj.Sphere(0.4, side="inside", origin=(0.0, 0.0, 0.4)))}


class BowlInItsDomain(Bowl):
    """The ball in a bowl with the domain that the page states."""

    domain = {"x": (-0.15, 0.15), "y": (-0.15, 0.15)}


def test_code_on_the_page_about_contacts_runs():
    page = (Path(__file__).parents[1] / "docs" / "contacts.md").read_text(encoding="utf-8")
    made = {"jj": jj, "jnp": jnp}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(code, made)
    scenes = {name: kind for name, kind in made.items() if isinstance(kind, type)}
    freedoms = {name: jj.build(kind()).freedoms.count for name, kind in scenes.items()}
    assert freedoms == {"Bowl": 3, "RobotWithTrailer": 2, "DiscOnHill": 3}
    assert made["motion"].q_end[2] > 0  # the right wheel is driven harder: it turns to the left


def test_a_trailer_that_is_carried_by_the_robot_lifts_a_wheel_and_the_summary_says_what_to_do():
    class Whole(RobotWithTrailer):
        carried = None

    asked = {"start": {"left_rate": 2.0, "right_rate": 3.0, "angle": 1.2}, "t1": 0.1, "ts": jnp.linspace(0.0, 0.1, 3)}
    lifted, right = (str(jj.simulate(kind(), **asked)) for kind in (Whole, RobotWithTrailer))
    assert "WOULD HAVE TO PULL" in lifted
    assert "name those that it does in `carried=`" in lifted
    assert "PULL" not in right
    assert "carried" not in right


def test_a_ball_swings_in_a_bowl_as_fast_as_the_page_says():
    swings = np.sort(np.abs(jj.linearize(BowlInItsDomain(), {}).state_eigenvalues().imag))[-4:]
    assert_allclose(swings, np.sqrt(5 * G / (7 * 0.35)), rtol=1e-9)


class Fresh(Bowl):
    """Of a class of its own: where a class has started once is remembered."""


def test_a_scene_that_is_a_number_in_a_small_part_of_space_asks_for_a_domain():
    with pytest.raises(ValueError, match=r"the rows of `Bowl` are numbers at none of .*`x` from -3.2 to 3.2.* state a `domain`"):
        jj.build(Bowl())
    with pytest.raises(ValueError, match=r"the rows of `Bowl` are numbers at none of .* state a `domain`"):
        jj.sample_states(Bowl(), 4)


def test_a_scene_without_a_domain_starts_where_it_is_told():
    start = {"x": 0.12, "attitude_omega_x": -8.0, "attitude_omega_y": 0.5, "attitude_omega_z": 0.0}
    told, stated = (jj.simulate(kind(), start, ts=jnp.array([0.0, 1.0])) for kind in (Fresh, BowlInItsDomain))
    assert_allclose(told.q_end, stated.q_end, atol=1e-8)
    _, q, u = jj.sample_states(Fresh(), 4)
    assert np.all(np.isfinite(u))
    assert np.all(q[:, 0] ** 2 + q[:, 1] ** 2 < 0.35**2)


class Stick(jj.Scene):
    """A particle on a rod that stands on its lower end, in speeds that serve while it stands."""

    coordinates = jj.coordinates("angle x z")
    inputs = jj.inputs("wind")
    domain = {"angle": (-0.6, 0.6)}
    privileged = ("x_rate",)

    def bodies(self, t, q):
        return {"mass": jj.Particle(1.0, jnp.stack([q.x, 0.0 * q.x, q.z]))}

    def geometric_constraints(self, pose):
        return {"x": pose.q.x - jnp.sin(pose.q.angle), "z": pose.q.z - jnp.cos(pose.q.angle)}

    def loads(self, motion):
        return jj.gravity(motion, G), jj.generalized_force(motion, x_rate=motion.inputs.wind)


def test_the_summary_says_which_coordinate_left_its_domain_and_what_the_inputs_were():
    fallen = jj.simulate(Stick(), {"x_rate": 0.5}, t1=2.0)
    first = int(np.argmax(np.asarray(fallen["angle"]) > 0.6))
    said = str(fallen)
    assert f"`angle` leaves its domain, -0.6 to 0.6: {float(fallen['angle'][first]):.4g} at t = {float(fallen.ts[first]):.4g} s" in said
    assert re.search(r"(?m)inputs +wind = 0$", said)
    swung = str(jj.simulate(Stick(), {"x_rate": 0.5}, t1=0.1, inputs={"wind": jj.Sampled((0.0, 1.0), (0.0, 1.0))}))
    assert "leaves its domain" not in swung
    assert re.search(r"inputs +wind of 2 samples\n?", swung)
    assert "wind a function of time" in str(jj.simulate(Stick(), t1=0.1, inputs={"wind": lambda t: jnp.sin(t)}))
