"""The disc as a free rigid body in space, as engines with contacts or joints hold it, and the way back to
yaw, lean, spin and the contact point.
"""

from dataclasses import dataclass

import numpy as np

TURN = 2 * np.pi


def rot_x(angle: float) -> np.ndarray:
    """Turn about x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def rot_z(angle: float) -> np.ndarray:
    """Turn about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Body:
    """Centre (m), body-to-space rotation, velocity of the centre (m/s) and angular velocity (rad/s), both in
    space axes; body y is the axle.
    """

    centre: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray


def start(radius: float, minimal) -> Body:
    """A disc that rolls without slip, the lowest point of the rim at height zero; `minimal`: contact point,
    yaw, lean, spin, and the rates of these three.
    """
    x, y, yaw, lean, spin, yaw_rate, lean_rate, spin_rate = minimal
    frame = rot_z(yaw) @ rot_x(lean)
    up = radius * frame[:, 2]
    omega = np.array([0.0, 0.0, yaw_rate]) + lean_rate * frame[:, 0] + spin_rate * frame[:, 1]
    assert spin == 0.0, "the body's axes are those of the leant frame at the start"
    return Body(np.array([x, y, 0.0]) + up, frame, np.cross(omega, up), omega)


def state(radius: float, body: Body, near: dict) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates and speeds of the tilting disc; yaw and spin are known up to whole turns, and taken next to
    those in `near`.
    """
    axle = body.rotation[:, 1]
    lean, yaw = np.arcsin(np.clip(axle[2], -1.0, 1.0)), np.arctan2(-axle[0], axle[1])
    frame = rot_z(yaw) @ rot_x(lean)
    turned = frame.T @ body.rotation
    spin = np.arctan2(turned[0, 2], turned[0, 0])
    along = frame.T @ body.angular_velocity  # lean_rate, spin_rate + yaw_rate sin(lean), yaw_rate cos(lean)
    yaw_rate = along[2] / np.cos(lean)
    lean_rate, spin_rate = along[0], along[1] - yaw_rate * np.sin(lean)
    up_rate = np.cross(np.array([0.0, 0.0, yaw_rate]) + lean_rate * frame[:, 0], radius * frame[:, 2])
    contact, contact_rate = body.centre - radius * frame[:, 2], body.velocity - up_rate
    yaw, spin = (
        angle + TURN * np.round((near[name] - angle) / TURN) for name, angle in (("yaw", yaw), ("spin", spin))
    )
    return np.array([*contact[:2], yaw, lean, spin]), np.array(
        [*contact_rate[:2], yaw_rate, lean_rate, spin_rate]
    )
