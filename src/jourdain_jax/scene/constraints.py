"""Ready-made constraints.

Geometric constraints are functions of a `Pose` that vanish; the engine differentiates them in time. Velocity
constraints are functions of a `Motion` that vanish. Each function returns the value of its constraint or
constraints, to be named in `geometric_constraints` or `velocity_constraints` of a scene.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Number,
    Scalar,
    Vector,
    Vector3,
    check_kind,
    checked_positive,
    checked_real,
)
from jourdain_jax.calculus.rotations import vee
from jourdain_jax.scene.contact.held_rows import HeldRow
from jourdain_jax.scene.motion_state import BodyMotion, BodyPose


def _point(position: Vector, what: str) -> Vector3:
    return checked_real(position, what, (3,), advice="give three components in the inertial frame, m")


def knife_edge(body: BodyMotion, contact: Vector, lateral: Vector, *, holds: Any = None) -> Scalar | HeldRow:
    """Return the velocity constraint of a blade or skate, `v(contact) . lateral` in m/s: the point of `body`
    at `contact` does not move along `lateral`.

    - `body`: `motion["name"]`; `contact` (m) and the unit vector `lateral`, both in the inertial frame. Eq.
      (7). The body axis y is `body.orientation[:, 1]`, a column.
    - `holds`: the largest sideways force F in N, a number or a function of the motion, or
      `jj.Coulomb(sliding, static)` with two forces. Beyond it the blade slips against F, and holds again when
      it comes to rest (`motion.phase`). None: it holds any force.
    """
    what = f"the knife edge of `{body.name}`"
    contact = _point(contact, f"contact of {what}")
    lateral = checked_real(lateral, f"lateral direction of {what}", (3,), advice="give a unit vector")
    w = body.velocity_at(contact) @ lateral
    return w if holds is None else HeldRow(w, holds, what)


def rod(a: Vector, b: Vector, length: Number) -> Scalar:
    """Return the geometric constraint of a massless rod of the given `length` (m) between two points `a`, `b`
    (m, inertial frame): `(|b - a|^2 - l^2)/(2 l)`, in m.

    To first order the value is the excess length. The multiplier is the thrust in the rod (N, positive in
    compression). The value is smooth even if the points meet. Eq. (5).
    """
    apart = _point(b, "second point of a rod") - _point(a, "first point of a rod")
    length = checked_positive(
        length, "length of a rod", advice="give it in m; to keep two points together use `jj.pin`"
    )
    return (apart @ apart - length**2) / (2 * length)


def pin(a: Vector, b: Vector, *, axes: str = "xyz") -> Float[Array, "axes"]:
    """Return the geometric constraints `b - a` of a joint that keeps two points `a`, `b` (m, inertial frame)
    together.

    `axes`: letters of the constrained inertial axes (`"xy"` in a plane). Raises ValueError for others. Eq.
    (5).
    """
    if not isinstance(axes, str) or set(axes) - set("xyz") or not axes:
        raise ValueError(f"pin along axes `{axes}`, expected letters out of `xyz`, such as `xyz` or `xy`")
    return (_point(b, "second point of a pin") - _point(a, "first point of a pin"))[
        jnp.array(["xyz".index(axis) for axis in axes])
    ]


def weld(
    first: BodyPose, second: BodyPose, *, at_first=(0.0, 0.0, 0.0), at_second=(0.0, 0.0, 0.0), turn=None
) -> Float[Array, "6"]:
    """Return the geometric constraints (6,) of a weld of two bodies `first`, `second` (`pose["name"]`).

    The points `at_first`, `at_second` (m, body frames, from the mass centres) coincide, and `R_second =
    R_first turn` (`turn`: (3, 3), the identity by default). The rotation constraints are `vee` of the
    antisymmetric part of `turn' R_first' R_second`, the rotation vector to first order.
    """
    for body, which in ((first, "first"), (second, "second")):
        check_kind(body, BodyPose, f"the {which} body of a weld", 'the pose of a body; write pose["name"]')
    turn = (
        jnp.eye(3, dtype=first.position.dtype)
        if turn is None
        else checked_real(turn, "turn of a weld", (3, 3), advice="give a rotation matrix")
    )
    return jnp.concatenate(
        [
            second.place(at_second) - first.place(at_first),
            vee(turn.T @ first.orientation.T @ second.orientation),
        ]
    )
