"""Constant rotation matrices from angles, quaternions and axes; and the combination of masses."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jourdain_jax.importers.tree import Mass, Matrix, Vector


def about(axis: Vector, angle: float) -> Matrix:
    """Rotation by `angle` (rad) about a unit vector."""
    return Rotation.from_rotvec(angle * axis).as_matrix()


def by_euler_angles(angles: Vector, sequence: str) -> Matrix:
    """Return the rotation of MJCF's `euler`: about successive axes (rad), of the turned frame in lower case,
    fixed ones in upper case.
    """
    turn = np.eye(3)
    for letter, angle in zip(sequence, angles, strict=True):
        one = Rotation.from_euler(letter.lower(), angle).as_matrix()
        turn = turn @ one if letter.islower() else one @ turn
    return turn


def by_quaternion(q: Float[np.ndarray, "4"]) -> Matrix:
    """Return a quaternion (w, x, y, z) of any norm; NaN for zero."""
    return Rotation.from_quat(np.roll(q, -1)).as_matrix() if np.any(q) else np.full((3, 3), np.nan)


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
