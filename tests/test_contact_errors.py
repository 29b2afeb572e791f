"""What cannot be a contact is refused by name: where it is known at once, otherwise when a scene is looked at."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rolling_scenes import BallInBowl, Rolls

import jourdain_jax as jj

BODY = jj.pose_at(Rolls(make_ground=lambda scene, pose: None), 0.0, jnp.array([0.0, 0.0, 0.3, 1.0, 0.0, 0.0, 0.0]))["body"]


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: jj.Plane(normal=(0.0, 0.0, 2.0)), "normal of a plane has length 2, expected a unit vector; divide it by its length"),
        (lambda: jj.Plane(normal=(0.0, 0.0, 1.0), tilt=0.1), "a plane has both a `tilt` and a `normal`"),
        (lambda: jj.Plane(normal=(0.0, 0.0, 1.0), along=(0.0, 0.0, 3.0)), "`along` of a plane is normal to it"),
        (lambda: jj.Plane(tilt=(0.1, 0.2)), r"tilt of a plane has shape \(2,\), expected one number; give one angle in rad, or a rotation matrix"),
        (lambda: jj.Cylinder(0.3, (1.0, 1.0, 0.0), side="inside"), "axis of a cylinder has length 1.414, expected a unit vector"),
        (lambda: jj.Cylinder(-0.3, (1.0, 0.0, 0.0), side="inside"), "radius of a cylinder is -0.3 m, expected a positive number"),
        (lambda: jj.Sphere(0.3, side="within"), "side `within` is unknown; expected `inside` or `outside`"),
        (lambda: jj.Surface(1.0), "a surface is given by a float, expected a function of numbers; write lambda x, y, z"),
        (lambda: jj.HeightMap("hill"), "a height map is given by the text 'hill', expected a function of numbers"),
        (lambda: jj.HeightMap(lambda x, y: jnp.stack([x, y])).plane_at((0.0, 0.0, 0.0)), r"h\(x, y\) of a height map has shape \(2,\), expected one number"),
        (lambda: jj.ball_contact(BODY, 0.3, ground=jj.Sphere(0.25, side="inside")), "radius of the contact of `body` is 0.3 m inside a sphere of 0.25 m"),
        (lambda: jj.ball_contact(BODY, 0.3, ground=jj.Cylinder(0.3, (1.0, 0.0, 0.0), side="inside")), "inside a cylinder of 0.3 m, expected a smaller one"),
        (lambda: jj.ball_contact(BODY, -0.3), "radius of the contact of `body` is -0.3 m, expected a positive number"),
        (lambda: jj.wheel_contact(BODY, 0.3, 0.4), "tyre of the contact of `body` is 0.4 m at a wheel of 0.3 m, expected 0 <= r < R"),
        (lambda: jj.ellipsoid_contact(BODY, (0.1, 0.0, 0.2)), r"semi-axes of the contact of `body` are \[0.1, 0.0, 0.2\] m, expected positive"),
        (lambda: jj.ball_contact(BODY, 0.3, height="rows"), "contact height `rows` is unknown; expected `coordinates`"),
        (lambda: jj.Contact(BODY, (0.0, 0.0, 0.0), height="line"), "contact height `line` is unknown"),
        (lambda: jj.Contact(BODY, (0.0, 0.0)), r"point of the contact of `body` has shape \(2,\), expected \(3,\)"),
        (lambda: jj.Contact(3.0, (0.0, 0.0, 0.0)), "the body of a contact is a float, expected the pose of a body"),
        (lambda: jj.Contact(BODY, (0.0, 0.0, 0.0), jj.Sphere(1.0, side="inside")), r"expected a `jj.Plane\(...\)`, .*write ground=\.\.\."),
        (lambda: jj.Contact(BODY, (0.0, 0.0, 0.0), shape="ball"), "`shape` of the contact of `body` is the text 'ball', .*state the body's look in `visuals`"),
        (lambda: jj.Contact(BODY, (0.0, 0.0, 0.0), ground=0.0), "`ground` of the contact of `body` is a float, expected a `jj.Plane"),
    ],
)
def test_what_is_no_contact_is_refused_by_name(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        make()


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
