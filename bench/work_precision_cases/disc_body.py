"""The disc as a free rigid body in space, as engines with contacts or joints hold it, and the way back to yaw, lean, spin and the contact point."""

from dataclasses import dataclass

import numpy as np

from work_precision_cases.problem import Problem

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
    """Centre (m), body-to-space rotation, velocity of the centre (m/s) and angular velocity (rad/s), both in space axes; body y is the axle."""

    centre: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray


def start(problem: Problem) -> Body:
    """The start of the problem: rolling without slip, the lowest point of the rim at height zero."""
    x, y, yaw, lean, spin, yaw_rate, lean_rate, spin_rate = problem.minimal_start
    frame = rot_z(yaw) @ rot_x(lean)
    up = float(problem.scene.radius) * frame[:, 2]
    omega = np.array([0.0, 0.0, yaw_rate]) + lean_rate * frame[:, 0] + spin_rate * frame[:, 1]
    assert spin == 0.0, "the body's axes are those of the leant frame at the start"
    return Body(np.array([x, y, 0.0]) + up, frame, np.cross(omega, up), omega)


def state(problem: Problem, body: Body) -> tuple[np.ndarray, np.ndarray]:
    """q and u of the scene. Yaw and spin are known up to whole turns, which are taken from the reference."""
    axle, radius = body.rotation[:, 1], float(problem.scene.radius)
    lean, yaw = np.arcsin(np.clip(axle[2], -1.0, 1.0)), np.arctan2(-axle[0], axle[1])
    frame = rot_z(yaw) @ rot_x(lean)
    turned = frame.T @ body.rotation
    spin = np.arctan2(turned[0, 2], turned[0, 0])
    along = frame.T @ body.angular_velocity  # lean_rate, spin_rate + yaw_rate sin(lean), yaw_rate cos(lean)
    yaw_rate = along[2] / np.cos(lean)
    lean_rate, spin_rate = along[0], along[1] - yaw_rate * np.sin(lean)
    up_rate = np.cross(np.array([0.0, 0.0, yaw_rate]) + lean_rate * frame[:, 0], radius * frame[:, 2])
    contact, contact_rate = body.centre - radius * frame[:, 2], body.velocity - up_rate
    true = problem.judge.reference.values
    yaw, spin = (angle + TURN * np.round((true[name] - angle) / TURN) for name, angle in (("yaw", yaw), ("spin", spin)))
    return np.array([*contact[:2], yaw, lean, spin]), np.array([*contact_rate[:2], yaw_rate, lean_rate, spin_rate])
