"""Constraint rows: their names, values, Jacobian and drift.

    phi(t, q, u) = 0,   A = d phi/du,   A udot = -drift,   drift = d phi/dt at udot = 0

Geometric constraints `g(t, q) = 0` enter as `phi = dg/dt`, and keep their position residual `g`. Order:
prescribed coordinates, geometric constraints and contact heights, which have a position residual; then
no-slip and velocity constraints. Source: Wang and Pao (2003), eqs. (5)-(9), (19), (25).

Switching contacts, and constraints that hold until their force exceeds a limit, have gaps and speeds:

    w = (dg/dt, slip along the tangents)    of each contact with gap g
    w = A u + a,   dw/dt = A udot + drift

The names of the parts of a scene are found by tracing it once, without evaluation at a state.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.reals import Number, Numbers, PerContact, PerRow, Scalar
from jourdain_jax.equations.contact_laws import unit
from jourdain_jax.equations.kinematics import coordinate_rates, motion_at, pose_at, shapes_along_motion
from jourdain_jax.scene.arguments import as_coordinates, as_speeds, as_time
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.loads import HeldRow, Load
from jourdain_jax.scene.modes import SLIPS, switched, switching_of
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import (
    contacts_of,
    events_of,
    geometric_constraints_of,
    held_rows_of,
    invariants_of,
    loads_of,
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

    phi: PerRow  # velocity residual
    A: Float[Array, "rows speeds"]
    drift: PerRow
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
        if contact.height == "row" and (contact.friction is None or scene.switching.phase)
    }
    return rows | {f"{name} height": contact.gap() for name, contact in kept.items()}


def velocity_rows(scene: Scene, motion: Motion) -> dict[str, Array]:
    """Return values of all constraints at velocity level, by name."""
    rows = rates_along(scene, motion, lambda pose: position_rows(scene, pose))
    for name, contact in contacts_of(scene, motion.pose()).items():
        if contact.friction is not None:  # it may slip (`equations/phases.py`)
            continue
        rows[f"{name} slip"] = contact.slip(motion)
    for name, value in velocity_constraints_of(scene, motion).items():
        if name in rows:
            raise ValueError(
                f"constraint name `{name}` of `{type(scene).__name__}` is used twice; give every constraint "
                "its own name"
            )
        rows[name] = value
    return rows


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


def flatten_rows(rows: dict[str, Array], dtype) -> PerRow:
    """Return all rows in one vector."""
    return jnp.concatenate([value.reshape(-1) for value in rows.values()]) if rows else jnp.zeros(0, dtype)


def position_residual(scene: Scene, t: Number, q: Numbers) -> Float[Array, "geometric_rows"]:
    """Return `g(t, q)` of all geometric constraints, shape (geometric rows,), in their own units; zero on the
    constraints. Eq. (5).
    """
    return _position_residual(scene, as_time(t), as_coordinates(scene, q))


@eqx.filter_jit  # traced once for all derivatives
def _position_residual(scene: Scene, t: Scalar, q):
    return flatten_rows(position_rows(scene, pose_at(scene, t, q)), q.dtype)


def velocity_residual(scene: Scene, t: Number, q: Numbers, u: Numbers, inputs: Any = None) -> PerRow:
    """Return `phi(t, q, u)` of all constraints, shape (rows,), in their own units per s; zero on the
    constraints. Eqs. (6)-(9).

    `inputs`: values of the scene's inputs (default: zero).
    """
    return _velocity_residual(scene, as_time(t), as_coordinates(scene, q), as_speeds(scene, u), inputs)


@eqx.filter_jit
def _velocity_residual(scene: Scene, t: Scalar, q, u, inputs):
    return flatten_rows(velocity_rows(scene, motion_at(scene, t, q, u, inputs)), q.dtype)


class ContactRows(eqx.Module):
    """Gaps and speeds of all switching contacts at one state, with derivatives; three rows per contact."""

    gap: PerContact
    w: PerRow
    A: Float[Array, "rows speeds"]
    drift: PerRow


def switching_rows(scene: Scene, motion: Motion) -> dict[str, Contact | HeldRow]:
    """Return the contacts with friction and the constraints with a force limit, in the order of their
    modes.
    """
    found = contacts_of(scene, motion.pose()) | held_rows_of(scene, motion)
    return {name: found[name] for name in scene.switching.contacts}


def coefficients(scene: Scene, motion: Motion) -> tuple[PerContact, PerContact]:
    """Return the coefficients of sliding and of static friction of all rows that may switch."""
    laws = [row.friction for row in switching_rows(scene, motion).values() if row.friction]
    return jnp.stack([law.sliding for law in laws]), jnp.stack([law.static for law in laws])


def gaps_of(scene: Scene, pose: Pose) -> PerContact:
    """Return the gaps of switching contacts, in m; zero for constraints."""
    contacts = contacts_of(scene, pose)
    names, zero = scene.switching.contacts, jnp.zeros_like(pose.t)
    return jnp.stack([contacts[name].gap() if name in contacts else zero for name in names])


def contact_speeds(scene: Scene, motion: Motion) -> PerRow:
    """Return the rates of the gaps, and the slip along both tangents, of all switching contacts, in m/s."""
    rates = rates_along(scene, motion, lambda pose: {"gaps": gaps_of(scene, pose)})["gaps"]
    slips = [row.slip(motion) for row in switching_rows(scene, motion).values()]
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


def in_whole_scene(scene: Scene, motion: Motion) -> tuple[Scene, Motion, PerRow | float]:
    """Return the scene whose contacts may switch, its motion, and a factor for each contact force, from a
    scene in a phase: 1 for friction along slip, which is a load, and 0 for multipliers. If no contact slips,
    return the arguments and 1.
    """
    if SLIPS not in dict(phase := scene.switching.phase).values():
        return scene, motion, 1.0
    contacts = contacts_of(scene, motion.pose())
    slips = {name: unit(contacts[name].slip(motion)) for name, number in phase if number == SLIPS}
    whole, numbers = switched(scene, switching_of(scene)), jnp.array([number for _, number in phase])
    q = jnp.concatenate([motion.q.array, *(slips.get(name, jnp.zeros(2)) for name, _ in phase)])
    inputs = jnp.hstack([0.0, motion.inputs.array, numbers])
    motion = motion_at(whole, motion.t, q, motion.u.array, inputs)
    return whole, motion, jnp.outer(numbers == SLIPS, jnp.array([0.0, 1.0, 1.0])).ravel()


def contact_loads(
    scene: Scene, motion: Motion, A: Float[Array, "rows speeds"], forces: PerRow
) -> tuple[Load, ...]:
    """Return the normal and tangential forces of the ground as loads on the bodies. Constraints with a force
    limit give the forces `A' L` on the speeds.
    """
    loads, along, speeds = [], A[1::3], scene.speed_names.entries
    for i, (contact, (normal, *tangential)) in enumerate(
        zip(switching_rows(scene, motion).values(), forces.reshape(-1, 3), strict=True)
    ):
        if isinstance(contact, HeldRow):
            loads.append(Load(generalized=dict(zip(speeds, along[i] * tangential[0], strict=True))))
            continue
        force = normal * contact.plane.normal + jnp.stack(tangential) @ contact.plane.tangents
        torque = jnp.cross(contact.point - motion[contact.body].position, force)
        loads.append(Load(forces={contact.body: force}, torques={contact.body: torque}))
    return tuple(loads)


class _Listed(NamedTuple):
    bodies: tuple[str, ...]
    rows: tuple[str, ...]
    position_rows: tuple[str, ...]
    events: tuple[str, ...]
    stops: tuple[bool, ...]  # whether each event stops the motion
    has_load_without_potential: bool


def names_of_bodies(scene: Scene) -> tuple[str, ...]:
    """Return names of the bodies, sorted."""
    return _listed(scene).bodies


def names_of_rows(scene: Scene) -> tuple[str, ...]:
    """Return names of all constraint rows, in order."""
    return _listed(scene).rows


def names_of_position_rows(scene: Scene) -> tuple[str, ...]:
    """Return names of the geometric constraint rows, in order; they come first."""
    return _listed(scene).position_rows


def names_of_events(scene: Scene) -> tuple[str, ...]:
    """Return names of the events, sorted."""
    return _listed(scene).events


def stops(scene: Scene) -> tuple[bool, ...]:
    """Return whether each event stops the motion, in the order of their names."""
    return _listed(scene).stops


def has_load_without_potential(scene: Scene) -> bool:
    """Return whether some load has no potential."""
    return _listed(scene).has_load_without_potential


@once_per_class
def names_of_invariants(scene: Scene) -> tuple[str, ...]:
    """Return the sorted names of the scene's invariants. Motions do not call this, so errors in `invariants`
    appear only when invariants are used.
    """
    return tuple(shapes_along_motion(invariants_of, scene))  # JAX returns dictionaries sorted by name


@once_per_class
def _listed(scene: Scene) -> _Listed:
    """Return the names. They are recorded during the trace, because JAX returns only arrays and sorts
    dictionaries by name.
    """
    noted: list[_Listed] = []

    def look(scene: Scene, motion: Motion) -> None:
        rows = row_names(velocity_rows(scene, motion))
        first = row_names(position_rows(scene, motion.pose()))
        without = any(load.potential is None for load in loads_of(scene, motion))
        without = without or bool(scene.switching.contacts)
        stop = {name: event.stop for name, event in events_of(scene, motion).items()}
        stop |= dict.fromkeys(scene.switching.events, False)
        events, ends = zip(*sorted(stop.items()), strict=True) if stop else ((), ())
        noted.append(_Listed(tuple(motion.bodies), rows, first, events, ends, without))

    shapes_along_motion(look, scene)
    return noted[0]
