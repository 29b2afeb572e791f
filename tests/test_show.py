"""3D views: what the page says is what the scene says, it needs no network, and a browser draws it."""

import base64
import json
import re
import zlib

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from browser import needs_browser, screenshot
from numpy.testing import assert_allclose
from refusals import refused
from rolling_scenes import Rolls

import jourdain_jax as jj
from jourdain_jax.views.looks import guessed

RED = "#ff0000"


class Rolling(jj.Scene):
    """A ball that rolls along x on a level table, with a flag on a rope from the origin."""

    radius: object = jj.parameter(0.1, unit="m", positive=True)
    coordinates = jj.coordinates("x turn")
    example = {"x": -0.5, "x_rate": 0.5}

    def bodies(self, t, q):
        place = jnp.stack([q.x, 0.0, self.radius])
        moments = 0.4 * 2.0 * self.radius**2 * jnp.ones(3)
        return {"ball": jj.RigidBody(2.0, moments, place, jj.rot_y(q.turn))}

    def loads(self, motion):
        return jj.gravity(motion, 9.81)

    def contacts(self, pose):
        return {"table": jj.ball_contact(pose["ball"], self.radius)}

    def visuals(self, pose):
        return {
            "": [
                jj.Visual.line(jnp.zeros(3), pose["ball"].position, radius=0.01),
                jj.Visual.box((1.4, 0.5, 0.02), at=(0.0, 0.0, -0.01)),
            ]
        }


@pytest.fixture(scope="module")
def motion():
    return jj.simulate(Rolling(), Rolling.example, ts=jnp.linspace(0.0, 2.0, 9))


@pytest.fixture(scope="module")
def shown(motion):
    return jj.show(motion, title="Ball & rope", colours={"ball": RED})


def contents(shown):
    """Description and numbers of a page."""
    held = dict(re.findall(r'<script id="(\w+)"[^>]*>(.*?)</script>', shown.html, re.DOTALL))
    floats = np.frombuffer(zlib.decompress(base64.b64decode(held["numbers"])), "<f4")
    return json.loads(held["scene"]), lambda at: floats[at[0] : at[0] + at[1]]


def matrix(q):
    x, y, z, w = q
    return np.asarray(jj.quaternion_to_matrix(jnp.array([w, x, y, z])))


def test_a_page_holds_the_poses_that_the_scene_has(motion, shown):
    page, numbers = contents(shown)
    assert page["title"] == "Ball & rope"
    assert "<title>Ball &amp; rope</title>" in shown.html
    assert page["names"] == [{"name": "ball", "colour": RED}]
    assert page["span"] == [0.0, 2.0]
    (one,) = page["motions"]
    assert_allclose(numbers(one["ts"]), motion.ts, atol=1e-6)
    ball, frame = one["bodies"]
    expected = motion.motions()["ball"]
    assert_allclose(numbers(ball["p"]).reshape(-1, 3), expected.position, atol=1e-6)
    for q, R in zip(numbers(ball["q"]).reshape(-1, 4), expected.orientation, strict=True):
        assert_allclose(matrix(q), R, atol=1e-6)
    assert [(shape["kind"], shape["size"]) for shape in ball["shapes"]] == [
        ("ellipsoid", [0.1, 0.1, 0.1])
    ]  # known from its contact
    rope, table = frame["shapes"]
    assert_allclose(numbers(rope["points"]).reshape(-1, 2, 3)[:, 1], expected.position, atol=1e-6)
    assert (table["kind"], len(numbers(table["p"]))) == ("box", 3)
    (path,), (force,) = one["paths"], one["forces"]
    assert_allclose(
        numbers(path["points"]).reshape(-1, 3), np.asarray(expected.position) - [0, 0, 0.1], atol=1e-6
    )
    arrows = numbers(force["vectors"]).reshape(-1, 3)
    assert_allclose(
        arrows / np.linalg.norm(arrows, axis=1)[:, None], np.tile([0.0, 0.0, 1.0], (9, 1)), atol=1e-6
    )
    assert "longest arrow: 19.6 N" in page["note"]  # 2 kg
    (ground,) = page["grounds"]
    assert (ground["kind"], ground["p"][2]) == ("plane", 0.0)


def test_a_page_asks_for_nothing_beyond_itself_and_is_small(shown):
    assert len(shown.html) < 1e6
    code = zlib.decompress(
        base64.b64decode(re.search(r'id="three" type="text/plain">(.*?)<', shown.html)[1])
    ).decode()
    assert set(re.findall(r"https?://[^\"'` )]*", shown.html + code)) == {
        "http://www.w3.org/1999/xhtml"
    }  # the name of a format, no address
    assert set(re.findall(r'(?:src|href)="([^"]*)"', shown.html)) == {"data:,"}
    assert not re.search(r"\bimport\(|XMLHttpRequest|@import", shown.html + code)


def test_a_notebook_shows_the_page_in_a_frame(shown):
    frame = shown._repr_html_()
    assert frame.startswith('<iframe srcdoc="&lt;!doctype html&gt;')
    assert frame.count('"') == 6  # everything in the page is escaped
    assert "View of Ball & rope, 0." in repr(shown)


def test_whole_turns_between_saved_times_are_kept():
    turned_by = 2 * np.pi * np.array([0.1, 0.6, 0.9, 2.7, -1.3])
    from jourdain_jax.views.page_data import _whole_turns, quaternions_of

    attitudes = quaternions_of(np.array([jj.rot_y(a) for a in [0.0, *np.cumsum(turned_by)]]))
    for k, turned in enumerate(turned_by):
        one = _whole_turns(attitudes[k : k + 2], np.array([[0, turned, 0]] * 2), np.array([0.0, 1.0]))[0]
        a, b = attitudes[k : k + 2]
        shortest = 2 * np.arctan2(np.linalg.norm(a[3] * b[:3] - b[3] * a[:3] - np.cross(b[:3], a[:3])), a @ b)
        assert abs(shortest + 2 * np.pi * one) == pytest.approx(abs(turned), abs=1e-6), k


def test_bodies_are_guessed_from_contacts_lines_and_inertias():
    place, turned = jnp.array([1.0, 2.0, 3.0]), jj.rot_z(0.4) @ jj.rot_x(0.3)

    def look(body, *shapes):
        (found,) = guessed(body, list(shapes), 0.01)
        return found

    box = jj.RigidBody.box(2.0, (0.2, 0.3, 0.5), position=place, orientation=turned)
    by_inertia = look(jj.RigidBody(box.mass, box.inertia, place, turned))
    assert by_inertia.kind == "box"
    assert_allclose(np.sort(by_inertia.size), [0.2, 0.3, 0.5], rtol=1e-6)
    assert_allclose(look(box).size, [0.2, 0.3, 0.5])
    assert look(jj.RigidBody(box.mass, box.inertia, place, turned, np.eye(3))).kind == "line"
    wheel = look(jj.RigidBody.thin_disc(1.0, 0.4, axis="x", position=place, orientation=turned))
    assert (wheel.kind, float(wheel.size[0])) == ("wheel", pytest.approx(0.4))
    assert_allclose(np.abs(wheel.orientation[:, 2]), [1, 0, 0], atol=1e-9)
    scene = jj.models.Rattleback()
    pose = jj.pose_at(scene, 0.0, jnp.array([0.0, 0.0, 0.1, 0.2, 0.3]))
    egg = look(pose["stone"].body, scene.contacts(pose)["sole"].shape)
    assert egg.kind == "ellipsoid"
    assert_allclose(egg.position, [0, 0, -0.01], atol=1e-12)
    assert_allclose(egg.orientation, np.eye(3), atol=1e-12)
    assert look(jj.Particle(1.0, place)).size[0] == 0.01


@pytest.mark.parametrize("name", jj.models.MODELS)
def test_every_model_is_shown_with_shapes_on_its_ground(name):
    scene = jj.models.model(name)
    motion = jj.simulate(scene, scene.example, ts=jnp.linspace(0.0, 0.2, 3))
    page, _ = contents(jj.show(motion))
    shapes = {body["name"]: len(body["shapes"]) for body in page["motions"][0]["bodies"]}
    assert all(shapes.values())
    assert set(motion.motions().bodies) <= set(shapes)


@pytest.mark.parametrize(
    ("make", "lowest"),
    [
        (lambda: jj.Sphere(1.0, side="inside", origin=(0.0, 0.0, 1.0)), 0.0),
        (lambda: jj.Cylinder(1.0, (0.0, 1.0, 0.0), side="outside", origin=(0.0, 0.0, -1.0)), -2.0),
        (lambda: jj.HeightMap(lambda x, y: 0.1 * x**2 + 0.2 * y**2), 0.0),
        (lambda: jj.Surface(lambda x, y, z: z - 0.1 * x**2), 0.0),
    ],
    ids=["sphere", "cylinder", "height map", "surface"],
)
def test_grounds_of_every_kind_are_drawn_where_they_are(make, lowest):
    ball = Rolls(radius=0.1, make_ground=lambda scene, pose: make())
    motion = jj.simulate(ball, {"x": 0.05, "x_rate": 0.1}, ts=jnp.linspace(0.0, 0.3, 3))
    page, numbers = contents(jj.show(motion))
    (drawn,) = page["grounds"]
    corners = numbers(drawn["mesh"]).reshape(-1, 3)
    assert corners[:, 2].min() == pytest.approx(lowest, abs=2e-3)
    assert_allclose(
        [float(make().value(corner)) for corner in corners[:: len(corners) // 20]], 0.0, atol=1e-5
    )


@needs_browser
def test_a_browser_draws_the_ball_where_it_is(shown, motion, tmp_path):
    # seen along y, the ball goes from left to right through the middle of the picture
    jj.show(motion, tmp_path / "ball.html", colours={"ball": RED}, view=(30.0, -90.0), forces=False, paths=[])
    places = []
    for t in (0.0, 1.0, 2.0):
        pixels = screenshot(f"file://{tmp_path}/ball.html#t={t}", tmp_path / f"{t}.png")[
            80:
        ]  # below the labels, which have the body's colour too
        red = (pixels[..., 0] > 0.15) & (pixels[..., 1:].max(axis=-1) < 0.5 * pixels[..., 0])
        assert 200 < red.sum() < 0.1 * red.size
        columns = np.flatnonzero(red.sum(axis=0) > 2)
        places.append((columns[0] + columns[-1]) / 2 / pixels.shape[1])
    assert places[1] == pytest.approx(0.5, abs=0.02)
    assert places[0] == pytest.approx(1.0 - places[2], abs=0.02)
    assert places[0] < 0.3


@pytest.mark.parametrize(
    ("view", "hidden"), [("above", "z"), ("side", "y"), ("space", ""), ((20.0, -50.0), "")]
)
def test_a_still_picture_holds_all_bodies_within_axes_in_metres(motion, tmp_path, drawn, view, hidden):
    jj.animate(motion, tmp_path / "ball.png", view=view, at=2)
    (axes,) = drawn[0].axes
    corners = np.concatenate([path.vertices for path in axes.collections[-1].get_paths()])
    shown = axes.transAxes.inverted().transform(axes.transData.transform(corners))
    assert np.all((shown > 0.0) & (shown < 1.0))
    for name in "xyz":
        assert getattr(axes, f"get_{name}label")() == ("" if name == hidden else f"{name} in m")


def test_a_floor_is_drawn_under_what_has_weight_alone():
    free, pendulum = jj.models.FreeRigidBody(), jj.models.DoublePendulumAngles()
    grounds = [
        contents(jj.show(jj.simulate(scene, scene.example, t1=0.5)))[0]["grounds"]
        for scene in (free, pendulum)
    ]
    assert [len(found) for found in grounds] == [0, 1]


CORNERS = np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 50.0]])  # mm
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


def write(path, form):
    trimesh.Trimesh(CORNERS, FACES).export(path, file_type=form)


FORMS = {"part.obj": "obj", "part.stl": "stl_ascii", "binary.stl": "stl"}


def triangles(corners, faces):
    """Triangles as a set: each a set of corners given in m, as whole numbers of micrometres."""
    return {frozenset(tuple(np.rint(1e6 * corners[i]).astype(int).tolist()) for i in face) for face in faces}


@pytest.mark.parametrize("name", FORMS)
def test_a_mesh_of_a_file_has_its_faces_in_metres(name, tmp_path):
    write(tmp_path / name, FORMS[name])
    look = jj.Visual.from_file(tmp_path / name, scale=0.001, at=(0.0, 0.0, 0.1), colour="#ff8000")
    assert (look.kind, look.colour) == ("mesh", "#ff8000")
    assert_allclose(look.position, [0.0, 0.0, 0.1])
    assert triangles(look.faces.corners * np.asarray(look.size), look.faces.polygons) == triangles(
        0.001 * CORNERS, FACES
    )


def test_a_mesh_in_the_visuals_of_a_scene_is_drawn_with_its_body(tmp_path):
    write(tmp_path / "part.stl", "stl")

    class Falling(jj.Scene):
        coordinates = jj.coordinates("z")

        def bodies(self, t, q):
            return {"part": jj.RigidBody(1.0, jnp.ones(3), [0.0, 0.0, q.z], jj.rot_z(0.0 * q.z))}

        def visuals(self, pose):
            return {"part": jj.Visual.from_file(tmp_path / "part.stl", scale=0.001)}

    motion = jj.simulate(Falling(), {"z": 1.0, "z_rate": -1.0}, ts=jnp.linspace(0.0, 1.0, 3))
    page, numbers = contents(jj.show(motion))
    (part,) = page["motions"][0]["bodies"]
    (shape,) = part["shapes"]
    drawn = numbers(shape["mesh"]).reshape(-1, 3)
    assert triangles(drawn.astype(float), np.arange(12).reshape(4, 3)) == triangles(0.001 * CORNERS, FACES)
    assert_allclose(numbers(part["p"]).reshape(-1, 3)[:, 2], [1.0, 0.5, 0.0], atol=1e-6)
    jj.animate(motion, tmp_path / "fall.gif")
    assert (tmp_path / "fall.gif").stat().st_size > 1000


def test_a_file_without_a_mesh_is_refused(tmp_path):
    (tmp_path / "part.xyzw").write_text("1 2 3\n")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    for name, said in {
        "gone.stl": r"cannot read a mesh from `.*gone\.stl`: there is no such file",
        "part.xyzw": r"a mesh from `.*part\.xyzw`: .*not supported.*; give a file such as \.stl or \.obj",
        "points.obj": r"`.*points\.obj` has no faces, expected a mesh",
    }.items():
        refused(said, jj.Visual.from_file, tmp_path / name)
