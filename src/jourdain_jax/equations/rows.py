"""Constraint rows: their names, values, Jacobian and drift.

    phi(t, q, u) = 0,   A = d phi/du,   A udot = -drift,   drift = d phi/dt at udot = 0

Geometric constraints `g(t, q) = 0` enter as `phi = dg/dt`, and keep their position residual `g`. Order:
prescribed coordinates, geometric constraints and contact heights, which have a position residual; then
no-slip and velocity constraints. Source: Wang and Pao (2003), eqs. (5)-(9), (19), (25).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.reals import Scalar
from jourdain_jax.equations.kinematics import motion_at, pose_at
from jourdain_jax.scene.arguments import as_coordinates, as_speeds, as_time
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import (
    contacts_of,
    geometric_constraints_of,
    prescribed_of,
    velocity_constraints_of,
)


class UsualRows(eqx.Module):
    """Typical lengths of a scene's constraint rows, and their rank: the reference for the rows
    at one state.
    """

    lengths: Float[Array | np.ndarray, "rows"]  # of `A` in scaled speeds
    rank: Int[Array | np.ndarray, ""]


class ConstraintRows(eqx.Module):
    """The constraints at one state, linearised: `A udot = -drift`."""

    phi: Float[Array, "rows"]  # velocity residual
    A: Float[Array, "rows speeds"]
    drift: Float[Array, "rows"]
    names: tuple[str, ...] = eqx.field(static=True)
    usual: UsualRows | None = None  # None: each row is scaled by its length at this state

    def judged_by(self, usual: UsualRows | None) -> "ConstraintRows":
        """Return the same rows with the reference `usual` (`structure.usual_rows`)."""
        return ConstraintRows(self.phi, self.A, self.drift, self.names, usual)


def position_rows(scene: Scene, pose: Pose) -> dict[str, Array]:
    """Return values of all geometric constraints by name: prescribed coordinates, geometric constraints,
    contact heights.
    """
    rows = {
        f"prescribed {name}": pose.q[_coordinate(scene, name)] - value
        for name, value in prescribed_of(scene, pose.t).items()
    }
    rows |= geometric_constraints_of(scene, pose)
    kept = {
        name: contact
        for name, contact in contacts_of(scene, pose).items()
        if contact.height == "row" and contact.friction is None
    }
    return rows | {f"{name} height": contact.gap() for name, contact in kept.items()}


def velocity_rows(scene: Scene, motion: Motion) -> dict[str, Array]:
    """Return values of all constraints at velocity level, by name."""
    rows = rates_along(scene, motion, lambda pose: position_rows(scene, pose))
    for name, contact in contacts_of(scene, motion.pose()).items():
        if contact.friction is not None:  # it may slip (`equations/phases.py`)
            continue
        rows[f"{name} slip"] = slip_of(contact, motion)
    for name, value in velocity_constraints_of(scene, motion).items():
        if name in rows:
            raise ValueError(
                f"constraint name `{name}` of `{type(scene).__name__}` is used twice; give every constraint "
                "its own name"
            )
        rows[name] = value
    return rows


def slip_of(contact: Contact, motion: Motion) -> Float[Array, "2"]:
    """Return the velocity (m/s) of a contact's body relative to the ground at its point, along both
    tangents.
    """
    v, ground = motion[contact.body].velocity_at(contact.point), contact.plane.velocity_at(contact.point)
    return contact.plane.tangents @ (v - ground)


def rates_along(scene: Scene, motion: Motion, values: Callable[[Pose], dict[str, Array]]) -> dict[str, Array]:
    """Return the rates of named `values` of a pose along the motion, computed from the velocities
    of the bodies.
    """

    names: list[str] = []

    def g(t, q, bodies):
        rows = values(Pose(t, scene.coordinate_names.view(q), bodies))
        names[:] = rows  # in original order; JAX sorts returned dictionaries by name
        return tuple(rows.values())

    pose = motion.pose()
    rates = {name: body.rate_of_pose() for name, body in motion.bodies.items()}
    found = jax.jvp(
        g, (motion.t, motion.q.array, pose.bodies), (jnp.ones_like(motion.t), motion.qdot.array, rates)
    )[1]
    return dict(zip(names, found, strict=True))


def _coordinate(scene: Scene, name: str) -> str:
    scene.coordinate_names.index(name, f"prescribed coordinate of `{type(scene).__name__}`:")
    return name


def row_names(rows: dict[str, Array | jax.ShapeDtypeStruct]) -> tuple[str, ...]:
    """Return one name per scalar row: the name of its constraint, with an index if the constraint has
    several rows.
    """
    names: list[str] = []
    for name, value in rows.items():
        names += [name] if value.ndim == 0 else [f"{name}[{i}]" for i in range(value.size)]
    return tuple(names)


def flatten_rows(rows: dict[str, Array], dtype) -> Float[Array, "rows"]:
    """Return all rows in one vector."""
    return jnp.concatenate([value.reshape(-1) for value in rows.values()]) if rows else jnp.zeros(0, dtype)


def position_residual(scene: Scene, t, q) -> Float[Array, "geometric_rows"]:
    """Return `g(t, q)` of all geometric constraints, shape (geometric rows,), in their own units; zero on the
    constraints. Eq. (5).
    """
    return _position_residual(scene, as_time(t), as_coordinates(scene, q))


@eqx.filter_jit  # traced once for all derivatives
def _position_residual(scene: Scene, t: Scalar, q):
    return flatten_rows(position_rows(scene, pose_at(scene, t, q)), q.dtype)


def velocity_residual(scene: Scene, t, q, u, inputs=None) -> Float[Array, "rows"]:
    """Return `phi(t, q, u)` of all constraints, shape (rows,), in their own units per s; zero on the
    constraints. Eqs. (6)-(9).

    `inputs`: values of the scene's inputs (default: zero).
    """
    return _velocity_residual(scene, as_time(t), as_coordinates(scene, q), as_speeds(scene, u), inputs)


@eqx.filter_jit
def _velocity_residual(scene: Scene, t: Scalar, q, u, inputs):
    return flatten_rows(velocity_rows(scene, motion_at(scene, t, q, u, inputs)), q.dtype)
