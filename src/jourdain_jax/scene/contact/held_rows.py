"""Velocity constraints that hold until their force exceeds a limit: friction in joints, and blades that may
slip sideways.

    w = 0 while |L| <= F_static;   otherwise L = -F w/|w|        w: slip,  L: constraint force, N or N m

Each is treated as a contact with friction, whose normal force is one newton and whose coefficients of
friction are the forces F. It then has the modes, events and derivatives of contacts (`equations/phases.py`).
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Scalar, checked_real
from jourdain_jax.scene.contact.contacts import Coulomb
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.names import check_names


class HeldRow(eqx.Module):
    """A velocity constraint `w` = 0 (m/s, rad/s) that holds until its force exceeds `friction` (N, N m)."""

    w: Scalar
    friction: Coulomb

    def __init__(self, w: Any, friction: Any, what: str):
        self.w = w
        known = isinstance(friction, Coulomb)
        self.friction = friction if known else Coulomb(checked_real(friction, f"friction of {what}", ()))

    @property
    def slip(self) -> Float[Array, "2"]:
        """Return the slip in the form of contacts, with two tangents; the second entry is zero."""
        return jnp.stack([self.w, jnp.zeros_like(self.w)])


class JointFriction(Load):
    """Friction on speeds. Each speed has a constraint that holds until its force exceeds a limit."""

    rows: dict[str, HeldRow]

    def __init__(self, rows: dict[str, HeldRow]):
        super().__init__()
        self.rows = rows


def joint_friction(motion: Motion, **friction: Any) -> JointFriction:
    """Return Coulomb friction on speeds by name: `joint_friction(motion, hinge_rate=0.3)`.

    - `friction`: speed -> force F in N or N m, a number or a function of the motion, or `jj.Coulomb(sliding,
      static)` with two forces.

    The force Q on a speed u is `-F u/|u|`. A speed of zero stays zero as long as a force with `|Q| <= F` can
    hold it. `motion.phase("hinge_rate")` returns whether the speed holds or slips. Raises ValueError for an
    unknown speed.

    **Examples**

        def loads(self, motion):
            return jj.gravity(motion, 9.81), jj.joint_friction(motion, angle_rate=self.stiction)
    """
    check_names(friction, motion.u.keys(), "friction on unknown speed `{}`")
    return JointFriction(
        {name: HeldRow(motion.u[name], force, f"`{name}`") for name, force in friction.items()}
    )


def held_rows(constraints: Any, loads: Any) -> dict[str, HeldRow]:
    """Return the constraints with a force limit, by name, among results of `velocity_constraints`
    and `loads`.
    """
    found = {name: row for name, row in dict(constraints).items() if isinstance(row, HeldRow)}
    for load in (loads,) if isinstance(loads, Load) else loads:
        found |= load.rows if isinstance(load, JointFriction) else {}
    return found
