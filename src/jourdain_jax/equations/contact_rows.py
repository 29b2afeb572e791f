"""Kinematics of switching contacts, and of constraints that hold until their force exceeds a limit: gaps,
speeds, and derivatives.

    w = (dg/dt, slip along the tangents)    of each contact with gap g
    w = A u + a,   dw/dt = A udot + drift
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Scalar
from jourdain_jax.equations.kinematics import coordinate_rates, motion_at
from jourdain_jax.equations.rows import rates_along, slip_of
from jourdain_jax.scene.contact.contacts import Contact, Coulomb
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import contacts_of, held_rows_of


class ContactRows(eqx.Module):
    """Gaps and speeds of all switching contacts at one state, with derivatives; three rows per contact."""

    gap: Float[Array, "contacts"]
    w: Float[Array, "rows"]
    A: Float[Array, "rows speeds"]
    drift: Float[Array, "rows"]


class SwitchingRow(NamedTuple):
    """A contact with friction, or a constraint that holds until its force exceeds a limit."""

    friction: Coulomb
    slip: Float[Array, "2"]  # m/s or rad/s
    contact: Contact | None  # None: a constraint, with unit normal force

    @property
    def restitution(self) -> Scalar:
        """Return Newton's coefficient of restitution; zero for constraints."""
        return jnp.zeros_like(self.slip[0]) if self.contact is None else jnp.asarray(self.contact.restitution)

    @property
    def impact(self) -> str:
        """Return the law of impacts."""
        return "moreau" if self.contact is None else self.contact.impact

    def lean(self) -> Scalar | None:
        """Return the lean of a disc or wheel (`Contact.lean`)."""
        return None if self.contact is None else self.contact.lean()


def switching_rows(scene: Scene, motion: Motion) -> dict[str, SwitchingRow]:
    """Return the contacts with friction and the constraints with a force limit, in the order of
    their modes.
    """
    contacts = contacts_of(scene, motion.pose())
    found = {
        name: SwitchingRow(c.friction, slip_of(c, motion), c) for name, c in contacts.items() if c.friction
    }
    rows = held_rows_of(scene, motion).items()
    found |= {name: SwitchingRow(row.friction, row.slip, None) for name, row in rows}
    return {name: found[name] for name in scene.switching.contacts}


def gaps_of(scene: Scene, pose: Pose) -> Float[Array, "contacts"]:
    """Return the gaps of switching contacts, in m; zero for constraints."""
    contacts = contacts_of(scene, pose)
    names, zero = scene.switching.contacts, jnp.zeros_like(pose.t)
    return jnp.stack([contacts[name].gap() if name in contacts else zero for name in names])


def contact_speeds(scene: Scene, motion: Motion) -> Float[Array, "rows"]:
    """Return the rates of the gaps, and the slip along both tangents, of all switching contacts, in m/s."""
    rates = rates_along(scene, motion, lambda pose: {"gaps": gaps_of(scene, pose)})["gaps"]
    slips = [row.slip for row in switching_rows(scene, motion).values()]
    return jnp.concatenate([rates[:, None], jnp.stack(slips)], axis=1).ravel()


def contact_rows(scene: Scene, motion: Motion) -> ContactRows:
    """Return gaps, speeds, A and drift of the switching contacts at the state of a motion."""
    t, q, u, inputs = motion.t, motion.q.array, motion.u.array, motion.inputs.array

    def speeds(t, q, u):
        return contact_speeds(scene, motion_at(scene, t, q, u, inputs))

    gap = gaps_of(scene, motion.pose())
    A = jax.jacfwd(lambda u: speeds(t, q, u))(u)
    w, drift = jax.jvp(
        lambda t, q: speeds(t, q, u), (t, q), (jnp.ones_like(t), coordinate_rates(scene, t, q, u))
    )
    return ContactRows(gap, w, A, drift)


def contact_loads(
    scene: Scene, motion: Motion, A: Float[Array, "rows speeds"], forces: Float[Array, "rows"]
) -> tuple[Load, ...]:
    """Return the normal and tangential forces of the ground as loads on the bodies. Constraints with a force
    limit give the forces A' L on the speeds.
    """
    loads, along, speeds = [], A[1::3], scene.speed_names.entries
    for i, (row, (normal, *tangential)) in enumerate(
        zip(switching_rows(scene, motion).values(), forces.reshape(-1, 3), strict=True)
    ):
        if (contact := row.contact) is None:
            loads.append(Load(generalized=dict(zip(speeds, along[i] * tangential[0], strict=True))))
            continue
        force = normal * contact.plane.normal + jnp.stack(tangential) @ contact.plane.tangents
        torque = jnp.cross(contact.point - motion[contact.body].position, force)
        loads.append(Load(forces={contact.body: force}, torques={contact.body: torque}))
    return tuple(loads)
