"""Shapes as quadrilateral faces. A triangle is a face whose last two corners are equal."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from jourdain_jax.calculus.rotations import onto_axis
from jourdain_jax.scene.bodies import Visual

Quads = Float[np.ndarray, "faces 4 3"]  # m; corners counterclockwise as seen from outside


def faces_of(visual: Visual, k: int, thin: float) -> tuple[Quads, Float[np.ndarray, "faces"]]:
    """Return the faces of a shape at time index `k` and their darkness, 0 to 1, in the shape's own axes; a
    line is in the body frame.

    `thin`: radius (m) of lines without a radius.
    """
    size, dark = np.asarray(visual.size)[0], np.zeros(())
    if visual.kind == "line":
        points, radius = np.asarray(visual.size)[k], radius_of(visual) or thin
        found = np.concatenate(
            [_bar(a, b, radius) for a, b in pairwise(points) if np.any(a != b)] or [np.zeros((0, 4, 3))]
        )
    elif visual.kind == "ellipsoid":  # alternate octants are dark, so that rolling is visible
        found = size * quads(revolved(arc(np.pi, 13), 24))
        dark = np.kron(0.35 * np.eye(2)[[0, 1, 0, 1]].T, np.ones((6, 6))).ravel()
    elif visual.kind == "mesh":
        found = size * triangles_of(visual)
    elif visual.kind == "box":
        found = size * _box()
    elif visual.kind == "capsule":
        bow = arc(np.pi / 2, 5) * size[0]
        found = quads(
            revolved(np.concatenate([bow - [0, size[1] / 2], [1, -1] * bow[::-1] + [0, size[1] / 2]]), 24)
        )
    else:
        around = 40 if visual.kind == "wheel" else 24
        found = quads(revolved(_cylinder(size[0], size[1]), around))
        if visual.kind == "wheel":  # a dark tread and alternating dark quarters on the sides
            quarters = np.repeat([0.0, 0.35, 0.0, 0.35], around // 4)
            dark = np.concatenate([quarters, np.full(around, 0.5), quarters])
    return found, np.broadcast_to(dark, len(found))


def radius_of(line: Visual) -> float:
    """Return the radius of a line, m; 0 means thin."""
    return 0.0 if line.radius is None else float(np.asarray(line.radius)[0])


def quads(grid: Float[np.ndarray, "rows columns 3"]) -> Quads:
    """Return the faces between neighbouring points of a grid."""
    return np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2).reshape(-1, 4, 3)


def revolved(profile: Float[np.ndarray, "rows 2"], around: int) -> Float[np.ndarray, "rows columns 3"]:
    """Return the points of a body of revolution about z from a profile (radius, z) with increasing z."""
    radius, z = np.asarray(profile).T[..., None]
    angle = np.linspace(0, 2 * np.pi, around + 1)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z + 0 * angle], axis=-1)


def triangles_of(mesh: Visual) -> Quads:
    """Return the faces of a mesh, in which each polygon is split into a fan of triangles."""
    assert mesh.faces is not None
    return mesh.faces.corners[
        [(p[0], p[k], p[k + 1], p[k + 1]) for p in mesh.faces.polygons for k in range(1, len(p) - 1)]
    ]


def arc(last: float, count: int) -> Float[np.ndarray, "rows 2"]:
    """Return points (radius, z) on the unit circle, from its lowest point to the angle `last`."""
    angle = np.linspace(0.0, last, count)
    return np.stack([np.sin(angle), -np.cos(angle)], axis=1)


def _cylinder(radius: float, length: float) -> Float[np.ndarray, "4 2"]:
    return np.array([[0.0, -length / 2], [radius, -length / 2], [radius, length / 2], [0.0, length / 2]])


def _box() -> Quads:
    """Return the faces of a cube of side 1."""
    square = np.array([[[-1.0, -1.0], [1.0, -1.0]], [[-1.0, 1.0], [1.0, 1.0]]]) / 2
    ends = [
        (side, np.concatenate([np.full((2, 2, 1), side), square * [2 * side, 1.0]], axis=-1))
        for side in (-0.5, 0.5)
    ]
    return np.concatenate([quads(np.roll(end, k, axis=-1)) for k in range(3) for _, end in ends])


def _bar(a: np.ndarray, b: np.ndarray, radius: float) -> Quads:
    """Return a round bar from a to b."""
    length = float(np.linalg.norm(b - a))
    return quads(revolved(_cylinder(radius, length), 8)) @ onto_axis(b - a).T + (a + b) / 2


def split(faces: Quads, longest: float) -> tuple[Float[np.ndarray, "parts 4 3"], Int[np.ndarray, "parts"]]:
    """Divide faces into parts with edges of at most about `longest`, so that sorting by depth is accurate.
    Return the parts, and the index of the face to which each part belongs.
    """
    # edge k runs from corner k - 1 to corner k
    edges = np.linalg.norm(faces - np.roll(faces, 1, axis=1), axis=2)
    rows, columns = np.clip(
        np.ceil(edges.reshape(-1, 2, 2).max(axis=(0, 1), initial=0.0) / longest), 1, 20
    ).astype(int)
    r, s = np.linspace(0, 1, rows + 1)[:, None], np.linspace(0, 1, columns + 1)
    weights = np.stack([(1 - r) * (1 - s), (1 - r) * s, r * s, r * (1 - s)], axis=-1)
    parts = [quads(weights @ face) for face in faces]
    return np.concatenate([faces[:0], *parts]), np.repeat(np.arange(len(faces)), rows * columns)
