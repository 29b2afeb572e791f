"""Known rotation matrices: by angles about fixed or turned axes, by quaternions, by axes; and masses put together."""

import numpy as np
from jaxtyping import Float

from jourdain_jax.importers.tree import Mass, Matrix, Vector


def about(axis: Vector, angle: float) -> Matrix:
    """Rotation by `angle` (rad) about a unit vector: `cos I + sin [k]x + (1 - cos) k k'`."""
    return np.cos(angle) * np.eye(3) + np.sin(angle) * cross_matrix(axis) + (1 - np.cos(angle)) * np.outer(axis, axis)


def cross_matrix(v: Vector) -> Matrix:
    """The matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def by_roll_pitch_yaw(angles: Vector) -> Matrix:
    """URDF's `rpy`: about the fixed x, y, z axes in turn (rad)."""
    return about(np.eye(3)[2], angles[2]) @ about(np.eye(3)[1], angles[1]) @ about(np.eye(3)[0], angles[0])


def by_euler_angles(angles: Vector, sequence: str) -> Matrix:
    """MJCF's `euler`: about axes in turn (rad), those of the turned frame in lower case, fixed ones in upper case."""
    turn = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        one = about(np.eye(3)["xyz".index(letter.lower())], angle)
        turn = turn @ one if letter.islower() else one @ turn
    return turn


def by_quaternion(q: Float[np.ndarray, "4"]) -> Matrix:
    """A quaternion (w, x, y, z) of any norm but zero."""
    w, v = q[0] / np.linalg.norm(q), q[1:] / np.linalg.norm(q)
    return np.eye(3) + 2 * (w * cross_matrix(v) + cross_matrix(v) @ cross_matrix(v))


def onto_axis(direction: Vector) -> Matrix:
    """The shortest rotation that takes z to a direction k: `1 + [v]x + (1 - c)/s^2 [v]x [v]x` with v = z x k, s = |v|, c = z.k; half a turn about x to -z."""
    k = direction / np.linalg.norm(direction)
    v = np.cross([0.0, 0.0, 1.0], k)
    if k[2] < 0 and np.linalg.norm(v) < 1e-10:
        return np.diag([1.0, -1.0, -1.0])
    factor = 1 / (1 + k[2]) if k[2] > 0 else (1 - k[2]) / (v @ v)
    return np.eye(3) + cross_matrix(v) + factor * cross_matrix(v) @ cross_matrix(v)


def combined(masses: list[Mass]) -> Mass:
    """Several masses in one frame as one: mass centre, and inertia by the parallel axes,

    I = sum I_i + m_i (d_i.d_i - d_i d_i').
    """
    total = sum(one.mass for one in masses)
    centre = sum(one.mass * one.centre for one in masses) / total
    inertia = np.zeros((3, 3))
    for one in masses:
        d = one.centre - centre
        inertia += one.inertia + one.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Mass(total, centre, inertia)
