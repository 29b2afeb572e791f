"""How contacts that switch move: gaps, their rates, and slip, with the derivatives that their forces need.

    w = (dg/dt, slip along the tangents)    of each contact;   w = A u + a,   dw/dt = A udot + drift
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.equations.kinematics import coordinate_rates, motion_at
from jourdain_jax.equations.rows import rates_along, slip_of
from jourdain_jax.scene.contacts import Contact
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.validated import contacts_of


class ContactRows(eqx.Module):
    """The rows of all contacts that switch, at one state: three for each of them."""

    gap: Float[Array, "contacts"]
    w: Float[Array, "rows"]
    A: Float[Array, "rows speeds"]
    drift: Float[Array, "rows"]


def switching_contacts(scene: Scene, pose: Pose) -> dict[str, Contact]:
    """Return the contacts that have friction, in the order of their modes."""
    contacts = contacts_of(scene, pose)
    return {name: contacts[name] for name in scene.switching.contacts}


def contact_speeds(scene: Scene, motion: Motion) -> Float[Array, "rows"]:
    """Rates of the gaps, and slip along both tangents, of all contacts that switch, m/s."""
    rates = rates_along(scene, motion, lambda pose: {name: contact.gap() for name, contact in switching_contacts(scene, pose).items()})
    contacts = switching_contacts(scene, motion.pose())
    return jnp.concatenate([jnp.append(rates[name], slip_of(contact, motion)) for name, contact in contacts.items()])


def contact_rows(scene: Scene, motion: Motion) -> ContactRows:
    """Return the rows at the state of a motion."""
    t, q, u, inputs = motion.t, motion.q.array, motion.u.array, motion.inputs.array

    def speeds(t, q, u):
        return contact_speeds(scene, motion_at(scene, t, q, u, inputs))

    gap = jnp.stack([contact.gap() for contact in switching_contacts(scene, motion.pose()).values()])
    A = jax.jacfwd(lambda u: speeds(t, q, u))(u)
    w, drift = jax.jvp(lambda t, q: speeds(t, q, u), (t, q), (jnp.ones_like(t), coordinate_rates(scene, t, q, u)))
    return ContactRows(gap, w, A, drift)


def contact_loads(scene: Scene, motion: Motion, forces: Float[Array, "rows"]) -> tuple[Load, ...]:
    """The forces of the ground on the bodies as loads: normal ones, and along both tangents."""
    loads = []
    for (_, contact), (normal, *tangential) in zip(switching_contacts(scene, motion.pose()).items(), forces.reshape(-1, 3), strict=True):
        force = normal * contact.plane.normal + jnp.stack(tangential) @ contact.plane.tangents
        torque = jnp.cross(contact.point - motion[contact.body].position, force)
        loads.append(Load(forces={contact.body: force}, torques={contact.body: torque}))
    return tuple(loads)
