"""The disc as a free rigid body in space, as engines with contacts or joints hold it, and the way back to
yaw, lean, spin and the contact point.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

TURN = 2 * np.pi


def leant_frame(yaw, lean):
    """Heading, axle and the line from the contact to the centre, as columns."""
    return Rotation.from_euler("ZX", [yaw, lean]).as_matrix()


@dataclass(frozen=True)
class Body:
    """Centre (m), body-to-space rotation, velocity of the centre (m/s) and angular velocity (rad/s), both in
    space axes; body y is the axle.
    """

    centre: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray


def start(radius, minimal) -> Body:
    """A disc that rolls without slip, the lowest point of the rim at height zero; `minimal`: contact point,
    yaw, lean, spin, and the rates of these three.
    """
    x, y, yaw, lean, spin, *rates = minimal
    assert spin == 0.0, "the body's axes are those of the leant frame at the start"
    frame = leant_frame(yaw, lean)
    up, omega = radius * frame[:, 2], turning(frame, *rates)
    return Body(np.array([x, y, 0.0]) + up, frame, np.cross(omega, up), omega)


def turning(frame, yaw_rate, lean_rate, spin_rate):
    """Angular velocity of the disc, in space."""
    return np.array([0.0, 0.0, yaw_rate]) + lean_rate * frame[:, 0] + spin_rate * frame[:, 1]


def state(radius, body: Body, near):
    """Coordinates and speeds of the tilting disc; yaw and spin are known up to whole turns, and taken next to
    those in `near`.
    """
    yaw, lean, spin = Rotation.from_matrix(body.rotation).as_euler("ZXY")
    frame = leant_frame(yaw, lean)
    up = radius * frame[:, 2]
    along = frame.T @ body.angular_velocity  # lean_rate, spin_rate + yaw_rate sin(lean), yaw_rate cos(lean)
    yaw_rate = along[2] / np.cos(lean)
    lean_rate, spin_rate = along[0], along[1] - yaw_rate * np.sin(lean)
    contact_rate = body.velocity - np.cross(turning(frame, yaw_rate, lean_rate, 0.0), up)
    yaw += TURN * np.round((near["yaw"] - yaw) / TURN)
    spin += TURN * np.round((near["spin"] - spin) / TURN)
    q = np.array([*(body.centre - up)[:2], yaw, lean, spin])
    return q, np.array([*contact_rate[:2], yaw_rate, lean_rate, spin_rate])
