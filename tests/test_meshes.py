"""Meshes of files in pictures: a tetrahedron, written here as OBJ and as both kinds of STL, is drawn where its body is."""

import struct

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_show import contents

import jourdain_jax as jj

pytest.importorskip("trimesh")
CORNERS = np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 50.0]])  # mm
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


def write_obj(path):
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS] + ["f " + " ".join(str(i + 1) for i in face) for face in FACES]
    path.write_text("\n".join(lines) + "\n")


def write_stl(path):
    facets = ["facet normal 0 0 0\nouter loop\n" + "\n".join("vertex {} {} {}".format(*CORNERS[i]) for i in face) + "\nendloop\nendfacet" for face in FACES]
    path.write_text("solid part\n" + "\n".join(facets) + "\nendsolid part\n")


def write_binary_stl(path):
    facets = b"".join(struct.pack("<12fH", 0, 0, 0, *CORNERS[list(face)].ravel(), 0) for face in FACES)
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(FACES)) + facets)


WRITERS = {"part.obj": write_obj, "part.stl": write_stl, "binary.stl": write_binary_stl}


def triangles(corners, faces):
    """Triangles as a set: each a set of corners given in m, as whole numbers of micrometres."""
    return {frozenset(tuple(np.rint(1e6 * corners[i]).astype(int).tolist()) for i in face) for face in faces}


@pytest.mark.parametrize("name", WRITERS)
def test_a_mesh_of_a_file_has_its_faces_in_metres(name, tmp_path):
    WRITERS[name](tmp_path / name)
    look = jj.Visual.from_file(tmp_path / name, scale=0.001, at=(0.0, 0.0, 0.1), colour="#ff8000")
    assert (look.kind, look.colour) == ("mesh", "#ff8000")
    assert_allclose(look.position, [0.0, 0.0, 0.1])
    assert triangles(look.faces.corners * np.asarray(look.size), look.faces.polygons) == triangles(0.001 * CORNERS, FACES)


def test_a_mesh_in_the_visuals_of_a_scene_is_drawn_with_its_body(tmp_path):
    write_stl(tmp_path / "part.stl")

    class Falling(jj.Scene):
        coordinates = jj.coordinates("z")

        def bodies(self, t, q):
            return {"part": jj.RigidBody(1.0, jnp.ones(3), jnp.stack([0.0 * q.z, 0.0 * q.z, q.z]), jj.rot_z(0.0 * q.z))}

        def visuals(self, pose):
            return {"part": jj.Visual.from_file(tmp_path / "part.stl", scale=0.001)}

    motion = jj.simulate(Falling(), {"z": 1.0, "z_rate": -1.0}, ts=jnp.linspace(0.0, 1.0, 3))
    page, numbers = contents(jj.show(motion).html)
    (part,) = page["motions"][0]["bodies"]
    (shape,) = part["shapes"]
    drawn = numbers(shape["mesh"]).reshape(-1, 3)
    assert triangles(drawn.astype(float), np.arange(12).reshape(4, 3)) == triangles(0.001 * CORNERS, FACES)
    assert_allclose(numbers(part["p"]).reshape(-1, 3)[:, 2], [1.0, 0.5, 0.0], atol=1e-6)
    jj.animate(motion, tmp_path / "fall.gif")
    assert (tmp_path / "fall.gif").stat().st_size > 1000


def test_a_file_without_a_mesh_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"cannot read a mesh from `.*gone\.stl`: there is no such file"):
        jj.Visual.from_file(tmp_path / "gone.stl")
    (tmp_path / "part.xyzw").write_text("1 2 3\n")
    with pytest.raises(ValueError, match=r"cannot read a mesh from `.*part\.xyzw`: .*not supported.*; give a file such as \.stl or \.obj"):
        jj.Visual.from_file(tmp_path / "part.xyzw")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(ValueError, match=r"`.*points\.obj` holds no faces, expected a mesh"):
        jj.Visual.from_file(tmp_path / "points.obj")
