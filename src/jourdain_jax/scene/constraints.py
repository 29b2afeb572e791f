"""Ready-made constraints.

Each function returns a value that is zero while the constraint holds. A geometric constraint is a function of
a `Pose`; return it by name from `geometric_constraints` of a scene. The engine differentiates it with respect
to time. A velocity constraint is a function of a `Motion`; return it by name from `velocity_constraints`.
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
    """Return the velocity constraint of a blade or skate, `v(contact) . lateral` in m/s, eq. (7): the point
    of `body` at `contact` does not move along `lateral`.

    - `body`: `motion["name"]`; `contact` (m) and the unit vector `lateral`, both in the inertial frame. The
      body axis y is `body.orientation[:, 1]`, a column.
    - `holds`: the largest sideways force F in N, a number or a function of the motion, or
      `jj.Coulomb(sliding, static)` with two forces. If the constraint needs a larger force, the blade slips,
      opposed by F, until its sideways velocity is zero again (`motion.phase`). None: the blade never slips.
    """
    what = f"the knife edge of `{body.name}`"
    contact = _point(contact, f"contact of {what}")
    lateral = checked_real(lateral, f"lateral direction of {what}", (3,), advice="give a unit vector")
    w = body.velocity_at(contact) @ lateral
    return w if holds is None else HeldRow(w, holds, what)


def rod(a: Vector, b: Vector, length: Number) -> Scalar:
    """Return the geometric constraint of a massless rod of the given `length` (m) between two points `a`, `b`
    (m, inertial frame): `(|b - a|^2 - l^2)/(2 l)`, in m. Eq. (5).

    To first order the value is the excess length. The multiplier is the thrust in the rod (N, positive in
    compression). The value is smooth even where the points coincide.
    """
    apart = _point(b, "second point of a rod") - _point(a, "first point of a rod")
    length = checked_positive(
        length, "length of a rod", advice="give it in m; to keep two points together use `jj.pin`"
    )
    return (apart @ apart - length**2) / (2 * length)


def pin(a: Vector, b: Vector, *, axes: str = "xyz") -> Float[Array, "axes"]:
    """Return the geometric constraints `b - a` of a joint that keeps two points `a`, `b` (m,
    inertial frame) together. Eq. (5).

    `axes`: letters of the constrained inertial axes (`"xy"` in a plane). Raises ValueError for other letters.
    """
    if not isinstance(axes, str) or set(axes) - set("xyz") or not axes:
        raise ValueError(f"`axes` of a pin is `{axes}`, expected letters out of `xyz`, such as `xyz` or `xy`")
    apart = _point(b, "second point of a pin") - _point(a, "first point of a pin")
    return apart[jnp.array(["xyz".index(axis) for axis in axes])]


def weld(
    first: BodyPose, second: BodyPose, *, at_first=(0.0, 0.0, 0.0), at_second=(0.0, 0.0, 0.0), turn=None
) -> Float[Array, "6"]:
    """Return the geometric constraints (6,) of a weld of two bodies `first`, `second` (`pose["name"]`).

    The points `at_first`, `at_second` (m, body frames, from the mass centres) coincide. The orientations R
    satisfy `R_second = R_first turn`, with the rotation matrix `turn` (3, 3), by default the identity. The
    rotation constraints are `vee(turn' R_first' R_second)`, to first order the vector of the excess rotation.
    """
    for body, which in ((first, "first"), (second, "second")):
        check_kind(body, BodyPose, f"the {which} body of a weld", 'the pose of a body; write pose["name"]')
    turn = jnp.eye(3, dtype=first.position.dtype) if turn is None else turn
    turn = checked_real(turn, "turn of a weld", (3, 3), advice="give a rotation matrix")
    apart = second.place(at_second) - first.place(at_first)
    return jnp.concatenate([apart, vee(turn.T @ first.orientation.T @ second.orientation)])
