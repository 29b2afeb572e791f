"""Four scenes as someone writes them who has read nothing but the pages of the site; and the slips that cost
this reader time.
"""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import DOCS, code_of, run
from refusals import refused

import jourdain_jax as jj

G = 9.81


PAGE = DOCS / "contacts.md"


@pytest.fixture(scope="module")
def page():
    """The scenes and motions of the page on contacts."""
    return run(PAGE)


def bowl_without_domain(**stated):
    """The page's ball in a bowl without a `domain`, as who has not read on writes it."""
    exec(code_of(PAGE)[0], names := {})
    return type("Bowl", (names["Bowl"],), {"domain": {}} | stated)()


def test_code_on_the_page_about_contacts_runs(page):
    scenes = {name: kind for name, kind in page.items() if isinstance(kind, type)}
    freedoms = {name: jj.build(kind()).freedoms.count for name, kind in scenes.items()}
    assert freedoms == {"Bowl": 3, "BallOnPlank": 3, "RobotWithTrailer": 2, "DiscOnHill": 3}
    assert page["motion"].q_end[2] > 0  # the right wheel is driven harder: it turns to the left
    assert_allclose([page["pushed"][name][-1] for name in ("plank", "x")], [0.65625, 0.1875], rtol=1e-9)
    for name, contact, radius, values in (
        ("Bowl", "bowl", 0.05, {"x": 0.1, "y": -0.05}),
        ("DiscOnHill", "rim", 0.1, {"x": 0.1, "y": 0.2, "lean": 0.3}),
    ):
        scene = scenes[name]()
        pose = jj.pose_at(scene, 0.0, scene.named(**values)[0])
        found = scene.contacts(pose)[contact]
        assert abs(found.gap()) <= 1e-15
        assert_allclose(
            np.linalg.norm(found.point - next(iter(pose.bodies.values())).position), radius, rtol=1e-12
        )


def test_a_trailer_that_is_carried_by_the_robot_lifts_a_wheel_and_the_summary_says_what_to_do(page):
    class Whole(page["RobotWithTrailer"]):
        def contacts(self, pose):
            return {side: jj.disc_contact(pose[side], self.radius) for side in ("left", "right")}

    start = {"left_rate": 2.0, "right_rate": 3.0, "angle": 1.2}
    asked = {"start": start, "ts": jnp.linspace(0.0, 0.1, 3)}
    lifted, right = (str(jj.simulate(kind(), **asked)) for kind in (Whole, page["RobotWithTrailer"]))
    assert "WOULD HAVE TO PULL" in lifted
    assert "name those it carries in `carried=`" in lifted
    assert "PULL" not in right
    assert "carried" not in right


def test_a_ball_swings_in_a_bowl_as_fast_as_the_page_says(page):
    swings = np.sort(np.abs(jj.linearize(page["Bowl"](), {}).state_eigenvalues().imag))[-4:]
    assert_allclose(swings, np.sqrt(5 * G / (7 * 0.35)), rtol=1e-9)


def test_a_scene_that_is_a_number_in_a_small_part_of_space_asks_for_a_domain():
    refused(
        r"the constraints of `Bowl` are NaN at all of .*`x` from -3.2 to 3.2.* state a `domain`",
        jj.build,
        bowl_without_domain(),
    )
    refused(
        r"the constraints of `Bowl` are NaN at all of .* state a `domain`",
        jj.sample_states,
        bowl_without_domain(),
        4,
    )


def test_a_scene_without_a_domain_is_looked_at_near_its_example(page):
    start = {"x": 0.12, "attitude_omega_x": -8.0, "attitude_omega_y": 0.5, "attitude_omega_z": 0.0}
    scene = bowl_without_domain(example=start)
    told, stated = (
        jj.simulate(own, start, ts=[0.0, 1.0], retry=True) for own in (scene, page["Bowl"]())
    )  # near it attitudes differ little: other speeds
    assert_allclose(told.q_end, stated.q_end, atol=1e-8)
    _, q, u = jj.sample_states(scene, 4)
    assert np.all(np.isfinite(u))
    assert np.all(q[:, 0] ** 2 + q[:, 1] ** 2 < 0.35**2)


class Stick(jj.Scene):
    """A particle on a rod that stands on its lower end, in speeds that serve while it stands."""

    coordinates = jj.coordinates("angle x z")
    inputs = jj.inputs("wind")
    domain = {"angle": (-0.6, 0.6)}
    privileged = ("x_rate",)

    def bodies(self, t, q):
        return {"mass": jj.Particle(1.0, [q.x, 0.0, q.z])}

    def geometric_constraints(self, pose):
        return {"x": pose.q.x - jnp.sin(pose.q.angle), "z": pose.q.z - jnp.cos(pose.q.angle)}

    def loads(self, motion):
        return jj.gravity(motion, G), jj.generalized_force(motion, x_rate=motion.inputs.wind)


def test_the_summary_says_which_coordinate_left_its_domain_and_what_the_inputs_were():
    fallen = jj.simulate(Stick(), {"x_rate": 0.5}, t1=2.0)
    first = int(np.argmax(np.asarray(fallen["angle"]) > 0.6))
    said = str(fallen)
    assert (
        f"`angle` leaves its domain, -0.6 to 0.6: {float(fallen['angle'][first]):.4g} at t ="
        f" {float(fallen.ts[first]):.4g} s" in said
    )
    assert re.search(r"(?m)inputs +wind = 0$", said)
    swung = str(
        jj.simulate(Stick(), {"x_rate": 0.5}, t1=0.1, inputs={"wind": jj.Sampled((0.0, 1.0), (0.0, 1.0))})
    )
    assert "leaves its domain" not in swung
    assert re.search(r"inputs +wind of 2 samples\n?", swung)
    assert "wind a function of time" in str(
        jj.simulate(Stick(), t1=0.1, inputs={"wind": lambda t: jnp.sin(t)})
    )
