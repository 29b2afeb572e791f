"""The switching contacts at one state: their modes and their response to forces."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.equations.contact_laws import Modes, responses
from jourdain_jax.equations.contact_rows import switching_rows
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.virtual_power import (
    ContactResponse,
    contact_modes,
    contact_response,
    switching_forces,
)
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene

FLAT_BELOW = 1e-8  # squared sine of the lean below which a disc counts as flat


class At:
    """The switching contacts at the state of a motion, and their response to forces.

    `found`: the response, if already known. `responses`: all responses computed so far, with their
    coordinates, speeds and inputs.
    """

    def __init__(
        self,
        scene: Scene,
        motion: Motion,
        found: ContactResponse | None = None,
        responses: list | None = None,
    ):
        self.scene, self.motion, self.responses = scene, motion, [] if responses is None else responses
        self.found = contact_response(scene, motion) if found is None else found
        if found is None:
            self.responses.append((motion.q.array, motion.u.array, motion.inputs.array, self.found))
        rows = switching_rows(scene, motion).values()
        self.friction = jnp.stack([row.friction.sliding for row in rows])
        self.static = jnp.stack([row.friction.static for row in rows])
        self.restitution = jnp.stack([row.restitution for row in rows])
        self.impacts = [row.impact for row in rows]
        leans = [row.lean() for row in rows]
        self.above_flat = [None if x is None else x - FLAT_BELOW for x in leans]
        self.modes: Modes = contact_modes(scene, motion)
        self.w = self.found.rows.w.reshape(-1, 3)
        self.number = jnp.stack([motion.modes[name] for name in scene.switching.contacts])

    @property
    def forces(self) -> Float[Array, "contacts 3"]:
        """Return the normal and the two tangential forces, N."""
        return switching_forces(self.scene, self.motion, self.found).reshape(-1, 3)

    def alone(self, i: int, b: Float[Array, "rows"], modes: Modes | None = None) -> "Alone":
        """Return the response of contact i while the others stay in `modes` (default: the current ones)."""
        modes, mine = self.modes if modes is None else modes, slice(3 * i, 3 * i + 3)
        others = modes._replace(closed=modes.closed.at[i].set(0.0), rolls=modes.rolls.at[i].set(0.0))
        right = jnp.concatenate([self.found.G[:, mine], b[:, None]], axis=1)
        borne = responses(self.found.G, right, others, self.friction)
        total = (right + self.found.G @ borne)[mine]
        return Alone(total[:, :3], total[:, 3], borne)


class Alone(NamedTuple):
    """The response of one contact while the others stay in their modes."""

    G: Float[Array, "3 3"]
    b: Float[Array, "3"]
    # forces of all contacts: three columns per unit force of this one, one without it
    borne: Float[Array, "rows 4"]

    def every(self, i: int, own: Float[Array, "3"]) -> Float[Array, "contacts 3"]:
        """Return the forces of all contacts if contact i has the force `own`."""
        return (self.borne[:, :3] @ own + self.borne[:, 3]).reshape(-1, 3).at[i].set(own)


def switched(scene: Scene, motion: Motion, numbers: Float[Array, "contacts"], q, u) -> Motion:
    """Return the motion at other coordinates and speeds, with contacts in the modes `numbers`."""
    inputs = jnp.concatenate([motion.inputs.array[: len(scene.inputs) - len(numbers)], numbers])
    return motion_at(scene, motion.t, q, u, inputs)
