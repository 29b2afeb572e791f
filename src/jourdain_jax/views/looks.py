"""Drawings of a motion: shapes of the bodies and their contacts at all saved times that were reached. A body
without `visuals` is drawn with the shape that its constructor, outline, contacts or inertia suggest.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import numpy as np

from jourdain_jax.calculus.rotations import onto_axis
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.integrate.state_projection import State
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.trajectories.values_in_time import map_over_times
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.bodies import Particle, RigidBody
from jourdain_jax.scene.contact.contact_points import Ball, Ellipsoid, Shape, Wheel
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.contact.grounds import HeightMap, Surface
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import contacts_of, visuals_of
from jourdain_jax.scene.visuals import Visual

_COLOURS = "#1f77b4 #ff7f0e #2ca02c #d62728 #9467bd #8c564b #e377c2 #7f7f7f #bcbd22 #17becf"
PALETTE = _COLOURS.split()
PLAIN = "#8a8a86"  # colour of visuals that belong to no body


@dataclass(frozen=True)
class DrawnBody:
    """A body at all drawn times. The inertial frame is drawn as a body at rest named `""`."""

    name: str
    colour: str
    positions: np.ndarray  # (times, 3), m
    orientations: np.ndarray  # (times, 3, 3)
    angular_velocities: np.ndarray  # (times, 3), rad/s, inertial frame
    looks: list[Visual]  # all arrays have a leading axis of times; sizes at the first time are used

    def extents(self) -> np.ndarray:
        """Return points (times, points, 3) in space, m, whose bounding box contains the body."""
        local = [
            np.broadcast_to(points, (len(self.positions), *points.shape[-2:]))
            for points in map(_corners_of, self.looks)
        ]
        return (
            np.einsum("tij,tpj->tpi", self.orientations, np.concatenate(local, axis=1))
            + self.positions[:, None]
        )


@dataclass(frozen=True)
class Drawn:
    """The drawing of one motion."""

    ts: np.ndarray  # (times,), s; only times that were reached
    reached: np.ndarray  # indices of `ts` among all saved times
    bodies: dict[str, DrawnBody]
    contacts: dict[str, Contact]  # leading axis: times
    sized: bool  # whether any body has a known size; otherwise the picture determines the size of particles

    @property
    def size(self) -> float:
        """Return the longest side (m) of the bounding box of all bodies at the first time."""
        corners = np.concatenate([body.extents()[0] for body in self.bodies.values()])
        return float(max(np.ptp(corners, axis=0).max(), 1e-3))

    @property
    def thin(self) -> float:
        """Return the default radius of lines, m."""
        return 0.011 * self.size


def looks_of(trajectory: Trajectory, what: str = "draw", most: int | None = None) -> Drawn:
    """Return the drawing of a motion at up to `most` evenly spaced saved times. Raises ValueError if it
    reached none.
    """
    reached = np.flatnonzero(np.asarray(trajectory.valid))
    if reached.size == 0:
        raise ValueError(
            f"the motion reached none of its saved times, so there is nothing to {what}; pass earlier `ts`"
        )
    if most is not None and most < reached.size:
        reached = reached[np.linspace(0, reached.size - 1, most).astype(int)]
    return _drawn(
        np.asarray(trajectory.ts)[reached], reached, _at(map_over_times(_seen, trajectory), reached)
    )


def looks_at(scene: Scene, state: State) -> Drawn:
    """Return the drawing of one state, computed without compilation."""
    seen = eager_if_concrete(_seen)(scene, state.t, state.q, state.u, None)
    return _drawn(
        np.asarray(state.t)[None], np.zeros(1, int), jax.tree.map(lambda x: np.asarray(x)[None], seen)
    )


def _drawn(ts: np.ndarray, reached: np.ndarray, seen) -> Drawn:
    bodies, velocities, visuals, contacts = seen
    paths = np.concatenate([np.asarray(body.position) for body in bodies.values()])
    first = {name: _at(body, 0) for name, body in bodies.items()}
    # radius of particles, relative to the extent of the whole motion
    dot = 0.02 * max(float(np.ptp(paths, axis=0).max()), 1e-3)
    stated = {name: list(looks) for name, looks in visuals.items()}
    sized = any(isinstance(body, RigidBody) or name in stated for name, body in first.items())
    for name, body in first.items():
        if name not in stated:
            shapes = [
                _at(contact.shape, 0)
                for contact in contacts.values()
                if contact.body == name and contact.shape is not None
            ]
            at_all = lambda x: np.broadcast_to(x, (len(reached), *np.shape(x)))
            stated[name] = [jax.tree.map(at_all, look) for look in guessed(body, shapes, dot)]
    drawn, upright = {}, np.broadcast_to(np.eye(3), (len(reached), 3, 3))
    for k, (name, body) in enumerate(bodies.items()):
        turned = np.asarray(body.orientation) if isinstance(body, RigidBody) else upright
        drawn[name] = DrawnBody(
            name, PALETTE[k % len(PALETTE)], np.asarray(body.position), turned, velocities[name], stated[name]
        )
    if stated.get(""):
        still = np.zeros((len(reached), 3))
        drawn[""] = DrawnBody("", PLAIN, still, upright, still, stated[""])
    return Drawn(ts, reached, drawn, contacts, sized)


def _seen(scene, t, q, u, inputs):
    motion = motion_at(scene, t, q, u, inputs)
    pose = motion.pose()
    contacts = dict(contacts_of(scene, pose))
    for name, contact in contacts.items():
        if isinstance(contact.ground, Surface | HeightMap):
            contacts[name] = eqx.tree_at(lambda c: c.ground, contact, Curved())
    bodies = {name: found.body for name, found in motion.bodies.items()}
    return (
        bodies,
        {name: found.angular_velocity for name, found in motion.bodies.items()},
        visuals_of(scene, pose),
        contacts,
    )


class Curved(eqx.Module):
    """Placeholder for a ground that a function of a point defines. The function is evaluated again when the
    ground is drawn.
    """


def _at(tree, index):
    return jax.tree.map(lambda x: np.asarray(x)[index], tree)


def _corners_of(visual: Visual) -> np.ndarray:
    """Return points (points, 3) in the body frame, m, whose bounding box contains the shape at the first
    time. For a line, return its points with a leading axis of times.
    """
    if visual.kind == "line":
        return np.asarray(visual.size)
    size = np.asarray(visual.size)[0]
    if visual.kind == "mesh":
        own = visual.faces.corners * size  # type: ignore[union-attr]
    else:
        half = {"ellipsoid": size, "box": size / 2}.get(visual.kind)
        if half is None:
            half = np.array([size[0], size[0], size[1] / 2 + (size[0] if visual.kind == "capsule" else 0.0)])
        own = half * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return own @ np.asarray(visual.orientation)[0].T + np.asarray(visual.position)[0]


def guessed(body: RigidBody | Particle, shapes: list[Shape], dot: float) -> list[Visual]:
    """Return shapes for a `body` without visuals, whose contacts have the rolling `shapes`. `dot`: radius (m)
    of a body without size.
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
    """Return the solid of this kind that fills the box around the mass centre with this corner."""
    if kind == "wheel":
        return Visual.wheel(corner.max(), 2 * corner.min(), axis="xyz"[int(np.argmin(corner))])
    return Visual.box(2 * corner) if kind == "box" else Visual.ellipsoid(corner)


def _of_contact(body: RigidBody, shape: Shape) -> list[Visual]:
    """Return the rolling shape in the body frame; `shape` is given in the inertial frame."""
    to_body = np.asarray(body.orientation).T
    at = to_body @ (np.asarray(shape.centre) - np.asarray(body.position))
    if isinstance(shape, Ball):
        return [Visual.ball(shape.radius, at=at)]
    if isinstance(shape, Ellipsoid):
        return [Visual.ellipsoid(shape.semi_axes, at=at, turn=to_body @ np.asarray(shape.orientation))]
    assert isinstance(shape, Wheel)
    width = 0.1 * shape.radius if shape.tyre is None else 2 * shape.tyre
    return [
        Visual.wheel(shape.radius, width, axis="z", at=at, turn=onto_axis(to_body @ np.asarray(shape.axle)))
    ]


def _of_inertia(body: RigidBody) -> list[Visual]:
    """Return the uniform box with the body's mass and inertia; empty if no side is positive. The sides follow
    from the principal moments A, B, C by `a^2 = 6 (B + C - A)/m`.
    """
    moments, axes = np.linalg.eigh(np.asarray(body.inertia))
    mass = float(body.mass)
    squares = 6 * (moments.sum() - 2 * moments) / mass if mass > 0 else np.zeros(3)
    if not squares.max() > 0:
        return []
    sides = np.sqrt(np.maximum(squares, 0.0025 * squares.max()))
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return [Visual.box(sides, turn=axes)]
