"""Constraint forces by row and by body, and the forces in rolling contacts (rows S1 and S4).

    force    R_j^s = lambda_s d phi_s/d v_j          on body j
    torque   T_j^s = lambda_s d phi_s/d omega_j      about its mass centre
    direct   lambda_s d phi_s/d u at fixed v, omega  on the speeds themselves

The rows are evaluated from the velocities that a `Motion` carries, so one reverse pass per row gives the force on every body.
Everything is in the inertial frame. Source: Wang and Pao (2003), eqs. (1)-(3), (68)-(73).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.pseudo_inverse import pseudo_inverse, rank_cutoff
from jourdain_jax.equations.kinematics import coordinate_rates, motion_at
from jourdain_jax.equations.probing import at_once
from jourdain_jax.equations.reductions import Accelerations
from jourdain_jax.equations.rows import flatten_rows, names_of_rows, velocity_residual, velocity_rows
from jourdain_jax.equations.scaling import row_scale
from jourdain_jax.equations.structure import plain_row_lengths
from jourdain_jax.equations.virtual_power import newton_residual, resultants
from jourdain_jax.scene.answers import contacts_of
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.motion_state import BodyMotion, Motion
from jourdain_jax.scene.names import Named, UnknownNameError, nearest
from jourdain_jax.scene.scene import Scene


class RowReactions(eqx.Module):
    """The constraint force of every row on every body, and what it does directly on the speeds."""

    multipliers: Float[Array, "rows"]
    force: Float[Array, "rows bodies 3"]  # N
    torque: Float[Array, "rows bodies 3"]  # N m, about the mass centre; zero for particles
    direct: Float[Array, "rows speeds"]  # on speeds, from rows written in coordinates, rates or speeds
    determined: Bool[Array, "rows"]  # whether the multiplier is unique; False where rows are dependent and it is of minimum norm
    row_names: tuple[str, ...] = eqx.field(static=True)
    body_names: tuple[str, ...] = eqx.field(static=True)

    def forces_on(self, body: str) -> dict[str, Float[Array, "3"]]:
        """Force on one body (N), by row."""
        return self._by_row(self.force, body)

    def torques_on(self, body: str) -> dict[str, Float[Array, "3"]]:
        """Torque on one body about its mass centre (N m), by row."""
        return self._by_row(self.torque, body)

    def _by_row(self, values, body):
        if body not in self.body_names:
            raise UnknownNameError(f"no body `{body}` in this scene; {nearest(body, self.body_names)}")
        return {row: values[s, self.body_names.index(body)] for s, row in enumerate(self.row_names)}


class ContactForce(eqx.Module):
    """The force of the ground on the body at one rolling contact."""

    normal: Float[Array, ""]  # N, along the plane's normal; negative where the contact would have to pull
    tangential: Float[Array, "2"]  # N, along the plane's tangents
    friction_needed: Float[Array, ""]  # |tangential| / normal; infinite where the contact would have to pull, zero where it bears nothing
    pulls: Bool[Array, ""]  # whether the normal force is negative beyond round-off: the body would lift off
    determined: Bool[Array, ""]  # whether the rows at hand determine these numbers


@at_once
def row_reactions(scene: Scene, t, q, u, accelerations: Accelerations, inputs=None) -> RowReactions:
    """Constraint forces per row and per body at (t, q, u), from the multipliers of known `accelerations`.

    Their generalized forces add up to `A' lambda`: `sum_s beta' R^s + gamma' T^s + direct^s`.
    """
    motion = motion_at(scene, t, q, u, inputs)
    names, bodies = names_of_rows(scene), tuple(motion.bodies)
    multipliers = accelerations.multipliers
    if not names:
        nothing = jnp.zeros((0, len(bodies), 3), q.dtype)
        return RowReactions(multipliers, nothing, nothing, jnp.zeros((0, u.shape[0]), q.dtype), jnp.zeros(0, bool), names, bodies)

    def rows(v, omega, u):
        return flatten_rows(velocity_rows(scene, _moving(scene, motion, v, omega, u)), q.dtype)

    v = jnp.stack([body.velocity for body in motion.bodies.values()])
    omega = jnp.stack([body.angular_velocity for body in motion.bodies.values()])
    by_velocity, by_turning, direct = jax.jacrev(rows, argnums=(0, 1, 2))(v, omega, u)
    rigid = jnp.array([isinstance(body.body, RigidBody) for body in motion.bodies.values()])
    by_turning = jnp.where(rigid[:, None], by_turning, 0.0)  # a particle takes no torque
    force, torque = (multipliers[:, None, None] * d for d in (by_velocity, by_turning))
    A = jax.jacfwd(lambda u: velocity_residual(scene, t, q, u, inputs))(u)
    return RowReactions(multipliers, force, torque, multipliers[:, None] * direct, determined_rows(A, plain_row_lengths(scene)), names, bodies)


def _moving(scene: Scene, motion: Motion, v, omega, u) -> Motion:
    """The motion with other velocities of the bodies, and other speeds, each on its own."""
    bodies = {name: BodyMotion(name, body.body, v[j], omega[j]) for j, (name, body) in enumerate(motion.bodies.items())}
    qdot = coordinate_rates(scene, motion.t, motion.q.array, u)
    return Motion(motion.t, motion.q, Named(u, motion.u.slots), Named(qdot, motion.qdot.slots), motion.inputs, bodies)


def determined_rows(A: Float[Array, "rows speeds"], typical: Float[Array | np.ndarray, "rows"] | None = None) -> Bool[Array, "rows"]:
    """Which multipliers are unique: those whose row is no combination of the others, `(A A+)_ss = 1`; `typical`: lengths of the rows, as in `row_scale`."""
    A = jax.lax.stop_gradient(row_scale(A, typical)[:, None] * A)
    alone = jnp.diagonal(A @ pseudo_inverse(A))
    return alone > 1 - jnp.sqrt(jnp.finfo(A.dtype).eps)


@at_once
def contact_forces(scene: Scene, t, q, u, accelerations: Accelerations, inputs=None) -> dict[str, ContactForce]:
    """Normal and tangential force of every rolling contact, and the friction coefficient it needs to roll without slip.

    The tangential force is the multiplier of the no-slip rows. With `height="row"` the normal force is the multiplier of the
    height row; with `height="coordinates"` it comes from Newton's equation (row S1): `n . sum (m a - F - R_rows)` over the bodies
    that the contact carries. Forces given directly on speeds (`generalized_force`) are taken to have no resultant along n. Two
    such contacts that carry the same body share a sum that nothing here can split; they are marked as not determined.
    """
    motion = motion_at(scene, t, q, u, inputs)
    contacts = contacts_of(scene, motion.pose())
    if not contacts:
        return {}
    rows = row_reactions(scene, t, q, u, accelerations, inputs)
    total = newton_residual(scene, t, q, u, accelerations.udot, inputs).linear
    hidden = total - jnp.sum(rows.force, axis=0)  # what the coordinates hold by construction
    margin = _round_off_of_forces(scene, motion, total)
    by_coordinates = {name: contact for name, contact in contacts.items() if contact.height == "coordinates"}
    carried = {name: _carried(contact, name, rows.body_names) for name, contact in by_coordinates.items()}
    forces = {}
    for name, contact in contacts.items():
        slip = jnp.array([rows.row_names.index(f"{name} slip[{i}]") for i in range(2)])
        tangential, determined = rows.multipliers[slip], jnp.all(rows.determined[slip])
        if contact.height == "row":
            height = rows.row_names.index(f"{name} height")
            normal, determined = rows.multipliers[height], determined & rows.determined[height]
        else:
            normal = contact.plane.normal @ jnp.sum(hidden[jnp.array(carried[name])], axis=0)
            shared = any(set(carried[name]) & set(other) for rival, other in carried.items() if rival != name)
            determined = determined & (not shared)
        forces[name] = _contact_force(normal, tangential, determined, margin)
    return forces


def _round_off_of_forces(scene: Scene, motion: Motion, total) -> Float[Array, ""]:
    """Forces below this are round-off of those at hand: of `m a - F`, of F and of `m |v| |omega|` on the bodies (N)."""
    size = jnp.max(jnp.abs(total)) + jnp.max(jnp.abs(resultants(scene, motion).force))
    for body in motion.bodies.values():
        size = size + body.mass * jnp.max(jnp.abs(body.velocity)) * jnp.max(jnp.abs(body.angular_velocity))
    return jax.lax.stop_gradient(rank_cutoff(size.dtype) * size)


def _carried(contact, name: str, bodies: tuple[str, ...]) -> tuple[int, ...]:
    """Numbers of the bodies that a contact holds up."""
    for body in contact.carried or ():
        if body not in bodies:
            raise ValueError(f"contact `{name}` carries unknown body `{body}`; {nearest(body, bodies)}")
    return tuple(range(len(bodies))) if contact.carried is None else tuple(bodies.index(body) for body in contact.carried)


def _contact_force(normal, tangential, determined, margin) -> ContactForce:
    squared = tangential @ tangential
    sliding = squared > 0
    size = jnp.where(sliding, jnp.sqrt(jnp.where(sliding, squared, 1.0)), 0.0)
    pushes, idle = normal > margin, (jnp.abs(normal) <= margin) & (size <= margin)
    friction = jnp.where(pushes, size / jnp.where(pushes, normal, 1.0), jnp.where(idle, 0.0, jnp.inf))
    return ContactForce(normal, tangential, friction, normal < -margin, determined)
