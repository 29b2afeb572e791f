"""Known rotation matrices: by angles about fixed or turned axes, by quaternions, by axes; and masses put together."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jourdain_jax.importers.tree import Mass, Matrix, Vector


def about(axis: Vector, angle: float) -> Matrix:
    """Rotation by `angle` (rad) about a unit vector."""
    return Rotation.from_rotvec(angle * axis).as_matrix()


def cross_matrix(v: Vector) -> Matrix:
    """The matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def by_euler_angles(angles: Vector, sequence: str) -> Matrix:
    """MJCF's `euler`: about axes in turn (rad), those of the turned frame in lower case, fixed ones in upper case."""
    turn = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        one = Rotation.from_euler(letter.lower(), angle).as_matrix()
        turn = turn @ one if letter.islower() else one @ turn
    return turn


def by_quaternion(q: Float[np.ndarray, "4"]) -> Matrix:
    """A quaternion (w, x, y, z) of any norm; NaN for zero."""
    return Rotation.from_quat(np.roll(q, -1)).as_matrix() if np.any(q) else np.full((3, 3), np.nan)


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
    centre = sum(one.mass * one.centre for one in masses) / total if total else masses[0].centre
    inertia = np.zeros((3, 3))
    for one in masses:
        d = one.centre - centre
        inertia += one.inertia + one.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Mass(total, centre, inertia)
