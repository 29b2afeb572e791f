"""Default looks of bodies: from their constructor, their outline, their contacts, or their inertia."""

import numpy as np

from jourdain_jax.calculus.rotations import onto_axis
from jourdain_jax.scene.bodies import Particle, RigidBody
from jourdain_jax.scene.contact_points import Ball, Ellipsoid, Shape, Wheel
from jourdain_jax.scene.visuals import Visual


def guessed(body: RigidBody | Particle, shapes: list[Shape], dot: float) -> list[Visual]:
    """Return looks of a `body` at one time, which rolls by `shapes`; `dot` (m): radius of a body without
    size.
    """
    if isinstance(body, Particle):
        return [Visual.ball(dot)]
    outline = np.asarray(body.outline)
    if body.solid:
        return [_solid(body.solid, outline[0])]
    if len(outline) > 1 and np.ptp(outline, axis=0).max() > 0.0:
        return [Visual.line(*outline)]
    rolling = [look for shape in shapes for look in _of_contact(body, shape)]
    return rolling or _of_inertia(body) or [Visual.ball(dot)]


def _solid(kind: str, corner: np.ndarray) -> Visual:
    """Return the solid within a box, from its corner."""
    if kind == "wheel":
        return Visual.wheel(corner.max(), 2 * corner.min(), axis="xyz"[int(np.argmin(corner))])
    return Visual.box(2 * corner) if kind == "box" else Visual.ellipsoid(corner)


def _of_contact(body: RigidBody, shape: Shape) -> list[Visual]:
    """Return the rolling shape, in the frame of the body; a shape knows its own place in the inertial frame.
    """
    to_body = np.asarray(body.orientation).T
    at = to_body @ (np.asarray(shape.centre) - np.asarray(body.position))
    if isinstance(shape, Ball):
        return [Visual.ball(shape.radius, at=at)]
    if isinstance(shape, Ellipsoid):
        return [Visual.ellipsoid(shape.semi_axes, at=at, turn=to_body @ np.asarray(shape.orientation))]
    assert isinstance(shape, Wheel)
    width = 0.1 * shape.radius if shape.tyre is None else 2 * shape.tyre
    return [Visual.wheel(shape.radius, width, axis="z", at=at, turn=onto_axis(to_body @ np.asarray(shape.axle)))]


def _of_inertia(body: RigidBody) -> list[Visual]:
    """Return the uniform box of this mass and inertia: `a^2 = 6 (B + C - A)/m` from its principal moments A,
    B, C; none where one of its sides is not positive.
    """
    moments, axes = np.linalg.eigh(np.asarray(body.inertia))
    mass = float(body.mass)
    squares = 6 * (moments.sum() - 2 * moments) / mass if mass > 0 else np.zeros(3)
    if not squares.max() > 0:
        return []
    sides = np.sqrt(np.maximum(squares, 0.0025 * squares.max()))
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return [Visual.box(sides, turn=axes)]
