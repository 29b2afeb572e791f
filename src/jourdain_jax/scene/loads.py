"""Impressed forces: known functions of time, state and parameters, given as resultants on bodies or as
generalized forces on speeds.

A load has forces F at the mass centres (`forces`), torques L (`torques`), and generalized forces Q_k on the
speeds u_k (`generalized`). Its virtual power is `sum F . dv + sum L . domega + sum Q_k du_k`. A load with a
`potential` is conservative, and its potential is part of the potential energy V. The work of other loads is
integrated along the motion.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from jourdain_jax.calculus.reals import Scalar, Vector3, check_kind, checked_real, described
from jourdain_jax.scene.motion_state import Motion, Point
from jourdain_jax.scene.names import check_names


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
    """Return the load of generalized forces Q_k on speeds, by name: `generalized_force(motion,
    steer_rate=torque)`. Its power is `sum Q_k u_k`; it has no potential.

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
