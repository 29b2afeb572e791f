"""What cannot be a contact is refused by name: where it is known at once, otherwise when a scene is looked at."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rolling_scenes import BallInBowl, Rolls

import jourdain_jax as jj


@pytest.mark.parametrize(
    ("ground", "sentence"),
    [
        (
            lambda scene, pose: jj.Plane(normal=jnp.stack([0.0 * scene.size, 0.0 * scene.size, 2.4 * scene.size])),
            "contact `touch` of `Rolls` has a normal whose length differs from 1 by 0.2",
        ),
        (
            lambda scene, pose: jj.Sphere(0.09 * scene.size, side="inside"),
            "a ball is larger than the cylinder or sphere that it rolls in",
        ),
    ],
    ids=["normal", "room"],
)
def test_what_turns_out_to_be_no_ground_is_named_when_its_scene_is_looked_at(ground, sentence):
    with pytest.raises(ValueError, match=sentence):
        jj.structure_of(Rolls(make_ground=ground))


class BesideTheBowl(BallInBowl):
    """A ball whose coordinates keep it at a wrong height above the bowl."""

    def bodies(self, t, q):
        ball = super().bodies(t, q)["ball"]
        return {"ball": jj.RigidBody.ball(ball.mass, self.radius, position=ball.position + jnp.array([0.0, 0.0, 0.01]), orientation=ball.orientation)}


class TooLarge(BallInBowl):
    """A ball that is larger than its bowl."""

    def contacts(self, pose):
        return {"bowl": jj.ball_contact(pose["ball"], self.radius, ground=jj.Sphere(0.9 * self.radius, side="inside"))}


class OnACusp(BallInBowl):
    """A ball at a point of a surface where its gradient vanishes."""

    def contacts(self, pose):
        point = pose["ball"].position
        return {"bowl": jj.Contact(pose["ball"], point, jj.Surface(lambda x, y, z: (z - point[2]) ** 3).plane_at(point))}


@pytest.mark.parametrize(
    ("scene", "sentence"),
    [
        (TooLarge(), "contact `bowl` of `TooLarge` finds no point where body and ground touch at any probed state; a ball must be smaller"),
        (OnACusp(), "contact `bowl` of `OnACusp` (finds no point|has a normal whose length differs from 1)"),
    ],
)
def test_a_contact_that_touches_nowhere_is_named(scene, sentence):
    with pytest.raises(ValueError, match=sentence):
        jj.structure_of(scene)


def test_coordinates_that_do_not_keep_a_body_on_its_ground_are_named():
    with pytest.raises(ValueError, match=r'contact `bowl` of `BesideTheBowl` has height="coordinates", but at a probed state its body is -?0.0.* m off'):
        jj.simulate(BesideTheBowl(), {}, t1=0.1)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_plane_turned_by_a_rotation_is_the_plane_of_its_normal(axis):
    R = {"x": jj.rot_x, "y": jj.rot_y, "z": jj.rot_z}[axis](0.4) @ jj.rot_y(0.2)
    turned, by_normal = jj.Plane(tilt=R), jj.Plane(normal=R[:, 2], along=R[:, 0])
    for part in ("normal", "tangents", "axes"):
        assert np.allclose(getattr(turned, part), getattr(by_normal, part), atol=1e-15)


def test_the_tangents_of_any_normal_are_a_right_handed_frame():
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals = np.vstack([normals / np.linalg.norm(normals, axis=1)[:, None], np.eye(3), -np.eye(3)])
    axes = jax.vmap(lambda n: jj.Plane(normal=n).axes)(normals)
    assert np.allclose(np.swapaxes(axes, 1, 2) @ axes, np.eye(3), atol=1e-14)
    assert np.allclose(np.linalg.det(axes), 1.0)
    assert np.allclose(axes[:, :, 2], normals)


def test_the_scenes_of_the_guide_to_contacts_roll_on_their_grounds():
    text = (Path(__file__).parents[1] / "docs" / "contacts.md").read_text()
    names = {"jj": jj, "jnp": jnp}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(block, names)
    assert np.allclose([names["pushed"][name][-1] for name in ("plank", "x")], [0.65625, 0.1875], rtol=1e-9)
    for scene, contact, values in ((names["Bowl"](), "bowl", {"x": 0.1, "y": -0.05}), (names["DiscOnHill"](), "rim", {"x": 0.1, "y": 0.2, "lean": 0.3})):
        pose = jj.pose_at(scene, 0.0, scene.named(**values)[0])
        found = scene.contacts(pose)[contact]
        assert abs(float(found.gap())) <= 1e-15
        assert np.isclose(np.linalg.norm(found.point - next(iter(pose.bodies.values())).position), {"bowl": 0.05, "rim": 0.1}[contact], rtol=1e-12)
