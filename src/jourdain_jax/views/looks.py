"""Drawings of a motion: shapes of the bodies and their contacts at all saved times that were reached. A body
without `visuals` is drawn with the shape that its constructor, outline, contacts or inertia suggest.

`grounds_of` returns the ground: contact planes, meshes of curved surfaces, or a floor below heavy bodies.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.rotations import onto_axis
from jourdain_jax.equations.kinematics import motion_at, pose_at
from jourdain_jax.integrate.state import State
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.trajectories.values_in_time import map_over_times
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.bodies import Particle, RigidBody, Visual
from jourdain_jax.scene.contact.contact_points import Ball, Ellipsoid, Shape, Wheel
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.contact.grounds import Cylinder, HeightMap, Plane, Sphere, Surface
from jourdain_jax.scene.loads import Gravity
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import contacts_of, loads_of, visuals_of
from jourdain_jax.views.solids import arc, quads, revolved

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
    heavy: bool  # whether gravity acts

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
    bodies, velocities, visuals, contacts, heavy = seen
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
    return Drawn(ts, reached, drawn, contacts, sized, bool(np.any(heavy)))


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
        jnp.array(any(isinstance(load, Gravity) for load in loads_of(scene, motion))),
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


_CELLS = 48  # tuning: mesh cells along each of the two surface parameters


def grounds_of(trajectory: Trajectory, drawn: Drawn, low: np.ndarray, high: np.ndarray) -> list[dict]:
    """Return the grounds in and near the box from `low` to `high` (m) at the first time: planes {kind,
    origin, axes} and meshes {kind, triangles (n, 3, 3)}.
    """
    found: dict[bytes, dict] = {}
    for name, contact in drawn.contacts.items():
        # skip moving planes: they belong to a body, or are tangent planes of an unknown ground
        if _moves(contact):
            continue
        ground = _ground(trajectory, drawn, name, contact, low, high)
        numbers = (
            [ground["triangles"]] if ground["kind"] == "mesh" else [ground["origin"], ground["axes"][:, 2]]
        )
        # draw the same ground once for all its contacts
        found.setdefault(b"".join((np.round(x, 9) + 0.0).tobytes() for x in numbers), ground)
    floor = _plane(np.array([0.0, 0.0, floor_under(low, high)]), np.eye(3), low, high)
    return [*found.values()] or [floor] * drawn.heavy


def _ground(trajectory: Trajectory, drawn: Drawn, name: str, contact: Contact, low, high) -> dict:
    ground = contact.ground
    if isinstance(ground, Sphere):  # if bodies are inside the sphere, draw only its lower half
        profile = float(ground.radius[0]) * arc(
            np.pi / 2 if ground.side == "inside" else np.pi, _CELLS // 2 + 1
        )
        return _mesh(revolved(profile, _CELLS) + np.asarray(ground.origin)[0])
    if isinstance(ground, Cylinder):
        axis, origin = np.asarray(ground.axis)[0], np.asarray(ground.origin)[0]
        corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1)), axis=-1)
        along, radius = (corners - origin) @ axis, float(ground.radius[0])
        return _mesh(
            revolved(np.array([[radius, along.min()], [radius, along.max()]]), 2 * _CELLS) @ onto_axis(axis).T
            + origin
        )
    if isinstance(ground, Curved):
        return _surface(trajectory, drawn, name, contact, low, high)
    plane = contact.plane
    axes = np.stack([*np.asarray(plane.tangents)[0], np.asarray(plane.normal)[0]], axis=1)
    return _plane(np.asarray(plane.origin)[0], axes, low, high)


def _moves(contact: Contact) -> bool:
    """Return whether the contact plane moves."""
    normals = np.asarray(contact.plane.normal)
    offsets = np.sum(np.asarray(contact.plane.origin) * np.asarray(contact.plane.normal), axis=1)
    return isinstance(contact.ground, Plane | None) and bool(
        np.ptp(normals, axis=0).max() > 1e-9 or np.ptp(offsets) > 1e-9 * (1 + np.abs(offsets).max())
    )


def _plane(origin, axes, low, high) -> dict:
    """Return the plane, centred below the middle of the box."""
    normal, middle = axes[:, 2], (low + high) / 2
    return {"kind": "plane", "origin": middle - ((middle - origin) @ normal) * normal, "axes": axes}


def floor_under(low, high) -> float:
    """Return the height (m) of a floor under the box from `low` to `high`: 0 if the lowest body is near z =
    0, otherwise just below it.
    """
    side = float(max(high - low))
    return 0.0 if -0.05 * side < low[2] < 0.2 * side else low[2] - 0.05 * side


def _mesh(grid: np.ndarray) -> dict:
    """Return the triangles between neighbouring points of a grid, without those with a NaN corner."""
    triangles = quads(grid)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3, 3)
    return {"kind": "mesh", "triangles": triangles[np.isfinite(triangles).all(axis=(1, 2))]}


def _surface(trajectory: Trajectory, drawn: Drawn, name: str, contact: Contact, low, high) -> dict:
    """Return a surface or height map over the box plus a margin at the first time."""
    margin = 0.15 * max(high - low)
    x, y = np.meshgrid(
        *(np.linspace(low[k] - margin, high[k] + margin, _CELLS + 1) for k in range(2)), indexing="ij"
    )
    k, from_height = drawn.reached[0], float(np.asarray(contact.point)[0, 2])

    def heights(scene, t, q, x, y):
        ground = contacts_of(scene, pose_at(scene, t, q))[name].ground
        if isinstance(ground, HeightMap):
            return jax.vmap(ground.height_at)(x, y)

        def height(x, y):
            z = jnp.asarray(from_height)
            # Newton's method from the height of the bodies to a surface f(x, y, z) = 0
            for _ in range(12):
                value, slope = jax.value_and_grad(lambda z: ground.value(jnp.stack([x, y, z])))(z)
                z = z - value / slope
            left = ground.value(jnp.stack([x, y, z]))
            return jnp.where(jnp.abs(left) < 1e-6 * jnp.abs(slope), z, jnp.nan)

        return jax.vmap(height)(x, y)

    z = np.asarray(
        jax.jit(heights)(trajectory.scene, trajectory.ts[k], trajectory.q[k], x.ravel(), y.ravel())
    ).reshape(x.shape)
    return _mesh(np.stack([x, y, z], axis=-1))
