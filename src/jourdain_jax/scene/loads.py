"""Loads and ready-made constraints.

Loads are impressed forces: known functions of time, state and parameters, given as resultants on bodies or as
generalized forces on speeds.

A load has forces F at the mass centres (`forces`), torques L (`torques`), and generalized forces Q_k on the
speeds u_k (`generalized`). The virtual power of a load is `sum F . dv + sum L . domega + sum Q_k du_k`. A
load with a `potential` is conservative, and its potential is part of the potential energy V. The work of
other loads is integrated along the motion.

Ready-made constraints are functions whose value is zero while the constraint holds. A geometric constraint is
a function of a `Pose`; return it by name from `geometric_constraints` of a scene. The engine differentiates
it with respect to time. A velocity constraint is a function of a `Motion`; return it by name from
`velocity_constraints`.

Friction in joints, and blades that may slip sideways, are velocity constraints that hold until their force
exceeds a limit:

    w = 0 while |L| <= F_static;   otherwise L = -F w/|w|        w: slip,  L: constraint force, N or N m

Each is treated as a contact with friction, whose normal force is one newton and whose coefficients of
friction are the forces F. It then has the modes, events and derivatives of contacts (`equations/phases.py`).
"""

from typing import Any, ClassVar

import equinox as eqx
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
    described,
)
from jourdain_jax.calculus.rotations import vee
from jourdain_jax.scene.contact.contacts import Coulomb
from jourdain_jax.scene.coordinates import check_names
from jourdain_jax.scene.motion_state import BodyMotion, BodyPose, Motion, Point


class Load(eqx.Module):
    """One impressed force system, with virtual power `sum F . dv + sum L . domega + sum Q_k du_k`.

    - `forces`: body -> (3,) in N, inertial frame, at the mass centre; `torques`: body -> (3,) in N m,
      inertial frame, about the mass centre.
    - `generalized`: speed -> force on it, in N or N m.
    - `potential` in J, whose negative gradient is the force (`verify` checks this). None: the load is not
      conservative, and its work is integrated along the motion.
    """

    forces: dict[str, Vector3]  # N, inertial frame, at the mass centre
    torques: dict[str, Vector3]  # N m, inertial frame, about the mass centre
    generalized: dict[str, Scalar]  # N or N m, on the named speed
    potential: Scalar | None  # J; None: not conservative, its work is integrated along the motion

    def __init__(
        self, forces: Any = None, torques: Any = None, generalized: Any = None, potential: Any = None
    ):
        given = {"forces": forces, "torques": torques, "generalized": generalized}
        self.forces, self.torques, self.generalized = (
            _real_parts(kind, part) for kind, part in given.items()
        )
        self.potential = None if potential is None else checked_real(potential, "potential of a load")


class Gravity(Load):
    """Uniform gravity. Its `direction` is checked when the scene is probed."""

    direction: Vector3

    def __init__(self, forces, potential, direction):
        super().__init__(forces, potential=potential)
        self.direction = direction


def _real_parts(kind: str, parts: dict | None) -> dict[str, Array]:
    if parts is None:
        return {}
    check_kind(parts, dict, f"`{kind}` of a load", 'a dictionary by name, such as {"disc": force}')
    return {name: checked_real(value, f"load on `{name}`") for name, value in parts.items()}


def gravity(motion: Motion, strength: Any, direction: Any = (0.0, 0.0, -1.0)) -> Load:
    """Return uniform gravity `m g e` on every body of a `motion`, with its potential `- sum m g e . r`.

    `strength`: g in m/s^2; `direction`: e, a unit vector of the inertial frame. Raises ValueError when the
    scene is built if `direction` is not of unit length.
    """
    motion = _motion(motion, "gravity")
    e = checked_real(direction, "direction of gravity", (3,), advice="give a unit vector")
    g = checked_real(strength, "strength of gravity", ()) * e
    forces = {name: body.mass * g for name, body in motion.bodies.items()}
    potential = -sum(body.mass * (g @ body.position) for body in motion.bodies.values())
    return Gravity(forces, potential, e)


def point_force(point: Point, force: Any) -> Load:
    """Return the load of a `force` (3,) (N, inertial frame) on a `point` of a body,
    `motion["body"].point(local)`. It has no potential.
    """
    point = _as_point(point, "point of a force")
    advice = "give three components in the inertial frame, N"
    return _on_point(point, checked_real(force, f"force on a point of `{point.body}`", (3,), advice=advice))


def torque(motion: Motion, body: str, moment: Any, *, reaction: str | None = None) -> Load:
    """Return a torque `moment` (3,) (N m, inertial frame) on a `body` of a `motion`, and the opposite torque
    on the body `reaction`, if given.

    It has no potential. Raises ValueError for an unknown body.
    """
    motion = _motion(motion, "torque")
    moment = checked_real(
        moment, f"torque on `{body}`", (3,), advice="give three components in the inertial frame, N m"
    )
    names = [body] if reaction is None else [body, reaction]
    check_names(names, motion.bodies, "torque on unknown body `{}`")
    return Load(torques={name: sign * moment for name, sign in zip(names, (1.0, -1.0), strict=False)})


def spring(a: Point, b: Point, stiffness: Any, rest_length: Any = 0.0) -> Load:
    """Return a linear spring between two points `a`, `b`: tension `k (l - l0)`, potential `k (l - l0)^2 / 2`.

    Points: `motion["body"].point(local)` or `fixed_point(position)`. `stiffness` k in N/m, `rest_length` l0
    in m.
    """
    apart, length, direction = _line(a, b, "spring")
    stiffness = checked_real(stiffness, "stiffness of a spring", ())
    rest_length = checked_real(rest_length, "rest length of a spring", ())
    extension = length - rest_length
    # k (l - l0) e, written so that a spring of zero rest length is smooth where its ends meet
    pull = stiffness * (apart - rest_length * direction)
    return _between(a, b, pull, 0.5 * stiffness * extension**2)


def damper(a: Point, b: Point, damping: Any) -> Load:
    """Return a linear damper between two points `a`, `b`, with the tension `c dl/dt` along the line. It has
    no potential.

    Points: `motion["body"].point(local)` or `fixed_point(position)`. `damping` c in N s/m.
    """
    _, _, direction = _line(a, b, "damper")
    damping = checked_real(damping, "damping of a damper", ())
    return _between(a, b, damping * ((b.velocity - a.velocity) @ direction) * direction, None)


def generalized_force(motion: Motion, **forces: Any) -> Load:
    """Return the load of generalized forces Q_k on speeds, by name:
    `generalized_force(motion, steer_rate=torque)`. Its power is `sum Q_k u_k`; it has no potential.

    `forces`: speed -> force, in N or N m. Raises ValueError for an unknown speed.
    """
    motion = _motion(motion, "generalized_force")
    check_names(forces, motion.u.keys(), "generalized force on unknown speed `{}`")
    found = {name: checked_real(x, f"generalized force on `{name}`", ()) for name, x in forces.items()}
    return Load(generalized=found)


def _motion(motion: Motion, what: str) -> Motion:
    if not isinstance(motion, Motion):
        raise ValueError(
            f"`{what}` was given {described(motion)}, expected a motion: the argument of "
            "`loads(self, motion)`"
        )
    return motion


def _as_point(point: Point, what: str) -> Point:
    check_kind(point, Point, what, 'a point: motion["name"].point(local) or jj.fixed_point(position)')
    return point


def _line(a: Point, b: Point, what: str):
    a, b = _as_point(a, f"first end of a {what}"), _as_point(b, f"second end of a {what}")
    apart = b.position - a.position
    squared = apart @ apart
    is_apart = squared > 0
    length = jnp.where(is_apart, jnp.sqrt(jnp.where(is_apart, squared, 1.0)), 0.0)
    return apart, length, apart / jnp.where(is_apart, length, 1.0)


def _on_point(point: Point, force) -> Load:
    if point.body is None:
        return Load()
    return Load({point.body: force}, {point.body: jnp.cross(point.arm, force)})


def _between(a: Point, b: Point, pull, potential) -> Load:
    """Return the load of the force `pull` on `a` towards `b` and the opposite force on `b`."""
    if a.body is not None and a.body == b.body:
        return Load(potential=potential)  # internal forces of a rigid body do no virtual power
    first, second = _on_point(a, pull), _on_point(b, -pull)
    return Load(first.forces | second.forces, first.torques | second.torques, {}, potential)


class HeldRow(eqx.Module):
    """A velocity constraint `w` = 0 (m/s, rad/s) that holds until its force exceeds `friction` (N, N m)."""

    w: Scalar
    friction: Coulomb
    restitution: Scalar  # as of a contact: zero
    impact: ClassVar[str] = "moreau"

    def __init__(self, w: Any, friction: Any, what: str):
        self.w, self.restitution = w, jnp.zeros_like(w)
        known = isinstance(friction, Coulomb)
        self.friction = friction if known else Coulomb(checked_real(friction, f"friction of {what}", ()))

    def slip(self, motion: Motion) -> Float[Array, "2"]:
        """Return the slip in the form of contacts, with two tangents; the second entry is zero."""
        return jnp.stack([self.w, self.restitution])

    def lean(self) -> None:
        """Return None: a constraint cannot lie flat."""


class JointFriction(Load):
    """Friction on speeds. Each speed has a constraint that holds until its force exceeds a limit."""

    rows: dict[str, HeldRow]

    def __init__(self, rows: dict[str, HeldRow]):
        super().__init__()
        self.rows = rows


def joint_friction(motion: Motion, **friction: Any) -> JointFriction:
    """Return Coulomb friction on speeds by name: `joint_friction(motion, hinge_rate=0.3)`.

    - `friction`: speed -> force F in N or N m, a number or a function of the motion, or
      `jj.Coulomb(sliding, static)` with two forces.

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
    first: BodyPose,
    second: BodyPose,
    *,
    at_first: Any = (0.0, 0.0, 0.0),
    at_second: Any = (0.0, 0.0, 0.0),
    turn: Any = None,
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
