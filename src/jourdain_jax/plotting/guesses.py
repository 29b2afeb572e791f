"""What a body looks like that its scene says nothing of: by the line it was given, by what rolls in its contacts, or by its inertia.

An outline says what a body is: points at one distance from the mass centre are a ball, in a plane a wheel; closed lines in a plane are the rim of a plate;
a line through the mass centre or an open one is a bar along it; other points in space are the corners of a convex body.
"""

from itertools import pairwise

import numpy as np

from jourdain_jax.scene.bodies import Particle, RigidBody
from jourdain_jax.scene.contact_points import Ball, Ellipsoid, Shape, Wheel
from jourdain_jax.scene.visuals import Visual

_ROUND = 1e-6  # of a body's size: a difference of lengths that counts as none


def guessed(body: RigidBody | Particle, shapes: list[Shape], dot: float) -> list[Visual]:
    """Looks of a `body` at one time, which rolls by `shapes`; `dot` (m): radius of what has no size."""
    if isinstance(body, Particle):
        return [Visual.ball(dot)]
    outline = np.asarray(body.outline, float)
    if len(outline) > 1 and np.ptp(outline, axis=0).max() > 0.0:
        return _of_outline(outline)
    rolling = [look for shape in shapes for look in _of_contact(body, shape)]
    return rolling or _of_inertia(body) or [Visual.ball(dot)]


def _of_outline(points: np.ndarray) -> list[Visual]:
    lengths = np.linalg.norm(points, axis=1)
    size = lengths.max()
    rank = np.linalg.matrix_rank(points - points.mean(axis=0), tol=_ROUND * size)
    if rank == 3 and np.ptp(lengths) < _ROUND * size and len(points) > 20:
        return [Visual.ball(size)]
    if rank == 2 and len(points) > 20 and np.ptp(lengths[:40]) < _ROUND * size:
        return [Visual.wheel(size, 0.2 * size, axis="z", turn=across(np.cross(points[0], points[10])))]
    if rank == 3 and lengths.min() > _ROUND * size:
        return [_hull(points)]
    if rank == 2 and np.linalg.norm(points[-1] - points[0]) < _ROUND * size and lengths.min() > _ROUND * size:
        # thickness of a plate, of its size
        return [_plate(points[:-1], 0.5 * 0.01 * size)]
    kept = [points[0], *(b for a, b in pairwise(points) if np.linalg.norm(b - a) > _ROUND * size)]
    return [Visual.line(*kept)]


def _of_contact(body: RigidBody, shape: Shape) -> list[Visual]:
    """What rolls, in the frame of the body; a shape knows its own place in the inertial frame."""
    to_body = np.asarray(body.orientation).T
    at = to_body @ (np.asarray(shape.centre) - np.asarray(body.position))
    if isinstance(shape, Ball):
        return [Visual.ball(shape.radius, at=at)]
    if isinstance(shape, Ellipsoid):
        return [Visual.ellipsoid(shape.semi_axes, at=at, turn=to_body @ np.asarray(shape.orientation))]
    assert isinstance(shape, Wheel)
    width = 0.1 * shape.radius if shape.tyre is None else 2 * shape.tyre
    return [Visual.wheel(shape.radius, width, axis="z", at=at, turn=across(to_body @ np.asarray(shape.axle)))]


def _of_inertia(body: RigidBody) -> list[Visual]:
    """The uniform box of this mass and inertia: `a^2 = 6 (B + C - A)/m` from its principal moments A, B, C; none where one of its sides is not positive."""
    moments, axes = np.linalg.eigh(np.asarray(body.inertia))
    mass = float(body.mass)
    squares = 6 * (moments.sum() - 2 * moments) / mass if mass > 0 else np.zeros(3)
    if not squares.max() > 0:
        return []
    sides = np.sqrt(np.maximum(squares, 0.0025 * squares.max()))
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return [Visual.box(sides, turn=axes)]


def across(axis: np.ndarray) -> np.ndarray:
    """A rotation matrix whose last column is the direction `axis`."""
    z = axis / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _plate(rim: np.ndarray, half: float) -> Visual:
    normal = np.sum(np.cross(rim, np.roll(rim, -1, axis=0)), axis=0)
    normal *= half / np.linalg.norm(normal)
    n = len(rim)
    sides = [(k, (k + 1) % n, n + (k + 1) % n, n + k) for k in range(n)]
    return Visual.mesh(np.concatenate([rim - normal, rim + normal]), [tuple(range(n, 2 * n)), tuple(range(n))[::-1], *sides])


def _hull(points: np.ndarray) -> Visual:
    """The convex hull, of triangles that are anticlockwise seen from outside."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outwards = np.sum(normals * hull.equations[:, :3], axis=1) > 0
    return Visual.mesh(points, np.where(outwards[:, None], hull.simplices, hull.simplices[:, ::-1]))
