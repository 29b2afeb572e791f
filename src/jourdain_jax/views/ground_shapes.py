"""Ground to draw: contact planes, meshes of curved surfaces, or a floor below the bodies."""

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.rotations import onto_axis
from jourdain_jax.equations.kinematics import pose_at
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.contact.grounds import Cylinder, HeightMap, Plane, Sphere
from jourdain_jax.scene.user_methods import contacts_of
from jourdain_jax.views.looks import Curved, Drawn
from jourdain_jax.views.solids import arc, quads, revolved

_CELLS = 48  # mesh cells along each of the two surface parameters


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
    return [*found.values()] or [_plane(np.array([0.0, 0.0, floor_under(low, high)]), np.eye(3), low, high)]


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
