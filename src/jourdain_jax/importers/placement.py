"""Constant rotation matrices from angles, quaternions and axes; combined masses; volumes and moments of
inertia of uniform solids. Sizes are those of MJCF: radii and half lengths.
"""

import math

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jourdain_jax.importers.tree import Mass, Matrix, Vector


def about(axis: Vector, angle: float) -> Matrix:
    """Return the rotation by `angle` (rad) about a unit vector."""
    return Rotation.from_rotvec(angle * axis).as_matrix()


def by_euler_angles(angles: Vector, sequence: str) -> Matrix:
    """Return the rotation of MJCF's `euler`, about successive axes (rad). Lower-case letters are axes of the
    rotated frame, upper-case letters axes of the fixed frame.
    """
    turn = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        one = Rotation.from_euler(letter.lower(), angle).as_matrix()
        turn = turn @ one if letter.islower() else one @ turn
    return turn


def by_quaternion(q: Float[np.ndarray, "4"]) -> Matrix:
    """Return the rotation of a quaternion (w, x, y, z) of any norm; NaN for the zero quaternion."""
    return Rotation.from_quat(np.roll(q, -1)).as_matrix() if np.any(q) else np.full((3, 3), np.nan)


def combined(masses: list[Mass]) -> Mass:
    """Return the combined mass properties of several masses in one frame, by the parallel-axis theorem,

    I = sum I_i + m_i (d_i.d_i - d_i d_i').
    """
    total = sum(one.mass for one in masses)
    centre = sum(one.mass * one.centre for one in masses) / total if total else masses[0].centre
    inertia = np.zeros((3, 3))
    for one in masses:
        d = one.centre - centre
        inertia += one.inertia + one.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Mass(total, centre, inertia)


SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}  # count of numbers in a size


def volume(kind: str, size: Float[np.ndarray, "_"]) -> float:
    """Return the volume of a solid, m^3."""
    if kind in ("sphere", "ellipsoid"):
        return 4 / 3 * math.pi * math.prod(np.broadcast_to(size, 3))
    if kind == "box":
        return 8 * math.prod(size)
    cylinder = 2 * math.pi * size[0] ** 2 * size[1]
    return cylinder + volume("sphere", size[:1]) if kind == "capsule" else cylinder


def moments(kind: str, size: Float[np.ndarray, "_"]) -> Float[np.ndarray, "3"]:
    """Return principal moments of inertia about the centre of a solid of 1 kg. The axis of cylinders and
    capsules is z.
    """
    if kind in ("sphere", "ellipsoid", "box"):
        squares = np.square(np.broadcast_to(size, 3))
        return (np.sum(squares) - squares) / (3 if kind == "box" else 5)
    radius, half = size
    straight = np.array([(3 * radius**2 + 4 * half**2) / 12] * 2 + [radius**2 / 2])
    if kind == "cylinder":
        return straight
    # two half balls, with mass centres 3 r/8 from their flat sides: 2 r^2/5 + h^2 + 3 h r/4
    ends = np.array([0.4 * radius**2 + half**2 + 0.75 * half * radius] * 2 + [0.4 * radius**2])
    share = volume("cylinder", size) / volume("capsule", size)
    return share * straight + (1 - share) * ends
