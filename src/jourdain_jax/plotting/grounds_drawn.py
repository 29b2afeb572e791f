"""The grounds of a motion, to be drawn: the planes that its contacts roll on, meshes of other surfaces, or a floor below the bodies."""

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.equations.kinematics import pose_at
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.looks import Curved, Drawn
from jourdain_jax.scene.contacts import Contact
from jourdain_jax.scene.grounds import Cylinder, HeightMap, Plane, Sphere
from jourdain_jax.scene.validated import contacts_of

_CELLS = 48  # of a mesh, along each of its two parameters
_NEWTON = 12  # steps from the height of the bodies to a surface f(x, y, z) = 0


def grounds_of(trajectory: Trajectory, drawn: Drawn, low: np.ndarray, high: np.ndarray) -> list[dict]:
    """Planes {kind, origin, axes} and meshes {kind, triangles (n, 3, 3)} within or around the box from `low` to `high`, m, as they are at the first time."""
    found: list[dict] = []
    for name, contact in drawn.contacts.items():
        if _moves(contact):  # the body that carries it shows it, or the tangent planes of a ground that was not given
            continue
        ground = _ground(trajectory, drawn, name, contact, low, high)
        if not any(_same(ground, other) for other in found):
            found.append(ground)
    return found or [_floor(low, high)]


def _ground(trajectory: Trajectory, drawn: Drawn, name: str, contact: Contact, low, high) -> dict:
    ground = contact.ground
    if isinstance(ground, Sphere):
        return _mesh(_sphere(float(ground.radius[0]), ground.side), np.asarray(ground.origin)[0])
    if isinstance(ground, Cylinder):
        axis, origin = np.asarray(ground.axis)[0], np.asarray(ground.origin)[0]
        corners = np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        ends = (corners - origin) @ axis
        return _mesh(_cylinder(float(ground.radius[0]), axis, ends.min(), ends.max()), origin)
    if isinstance(ground, Curved):
        return _surface(trajectory, drawn, name, contact, low, high)
    plane = contact.plane
    return _plane(np.asarray(plane.origin)[0], np.stack([*np.asarray(plane.tangents)[0], np.asarray(plane.normal)[0]], axis=1), low, high)


def _moves(contact: Contact) -> bool:
    """Whether the contact is with a plane that changes its place."""
    normals, offsets = np.asarray(contact.plane.normal), np.sum(np.asarray(contact.plane.origin) * np.asarray(contact.plane.normal), axis=1)
    return isinstance(contact.ground, Plane | None) and bool(np.ptp(normals, axis=0).max() > 1e-9 or np.ptp(offsets) > 1e-9 * (1 + np.abs(offsets).max()))


def _plane(origin, axes, low, high) -> dict:
    """The plane, its middle below the middle of the box."""
    normal, middle = axes[:, 2], (low + high) / 2
    return {"kind": "plane", "origin": middle - ((middle - origin) @ normal) * normal, "axes": axes}


def _floor(low, high) -> dict:
    """A floor: z = 0 where bodies stand on it, else below them."""
    side = float(max(high - low))
    base = 0.0 if -0.01 * side < low[2] < 0.2 * side else low[2] - 0.05 * side
    return _plane(np.array([0.0, 0.0, base]), np.eye(3), low, high)


def _same(one: dict, other: dict) -> bool:
    if one["kind"] != other["kind"]:
        return False
    key = "origin" if one["kind"] == "plane" else "triangles"
    same_axes = one["kind"] == "mesh" or np.allclose(one["axes"][:, 2], other["axes"][:, 2])
    return one[key].shape == other[key].shape and np.allclose(one[key], other[key]) and same_axes


def _mesh(grid: np.ndarray, origin) -> dict:
    """Triangles of a grid of points (rows, columns, 3); those with a corner that is NaN are left out."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    triangles = np.concatenate([np.stack([a, b, c], axis=2).reshape(-1, 3, 3), np.stack([a, c, d], axis=2).reshape(-1, 3, 3)])
    return {"kind": "mesh", "triangles": triangles[np.isfinite(triangles).all(axis=(1, 2))] + origin}


def _sphere(radius: float, side: str) -> np.ndarray:
    """A sphere, or the lower half of one that bodies are in."""
    across = np.linspace(np.pi / 2 if side == "inside" else 0.0, np.pi, _CELLS // 2 + 1)[:, None]
    around = np.linspace(0, 2 * np.pi, _CELLS + 1)
    return radius * np.stack([np.sin(across) * np.cos(around), np.sin(across) * np.sin(around), np.cos(across) + 0 * around], axis=-1)


def _cylinder(radius: float, axis: np.ndarray, first: float, last: float) -> np.ndarray:
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    around = np.linspace(0, 2 * np.pi, 2 * _CELLS + 1)[:, None]
    ring = radius * (np.cos(around) * side + np.sin(around) * np.cross(axis, side))
    return np.stack([ring + first * axis, ring + last * axis])


def _surface(trajectory: Trajectory, drawn: Drawn, name: str, contact: Contact, low, high) -> dict:
    """A surface or height map over the box, and a margin around it, at the first time."""
    margin = 0.15 * max(high - low)
    x, y = np.meshgrid(*(np.linspace(low[k] - margin, high[k] + margin, _CELLS + 1) for k in range(2)), indexing="ij")
    k, from_height = drawn.reached[0], float(np.asarray(contact.point)[0, 2])

    def heights(scene, t, q, x, y):
        ground = contacts_of(scene, pose_at(scene, t, q))[name].ground
        if isinstance(ground, HeightMap):
            return jax.vmap(ground.height_at)(x, y)

        def height(x, y):
            z = jnp.asarray(from_height)
            for _ in range(_NEWTON):
                value, slope = jax.value_and_grad(lambda z: ground.value(jnp.stack([x, y, z])))(z)
                z = z - value / slope
            left = ground.value(jnp.stack([x, y, z]))
            return jnp.where(jnp.abs(left) < 1e-6 * jnp.abs(slope), z, jnp.nan)

        return jax.vmap(height)(x, y)

    z = np.asarray(jax.jit(heights)(trajectory.scene, trajectory.ts[k], trajectory.q[k], x.ravel(), y.ravel())).reshape(x.shape)
    return _mesh(np.stack([x, y, z], axis=-1), np.zeros(3))
