"""Checks of the numbers that a scene gives for its bodies, contacts and gravity.

m >= 0,   I = I' >= 0,   R' R = 1,   det R = 1
n.n = 1,   e.e = 1 of gravity,   gap = 0 where the coordinates keep a body on the ground,   0 < r of what rolls and of its ground,   0 <= tyre < r

These are one table of functions of numbers, `CHECKS`: evaluated at the states at which a scene is probed, where a fault is an error with its text, and at the
start of each motion, in the compiled program, where it is a result code. What takes the motion of several bodies is looked at while a scene is probed:

d[n.(p - o)]/dt at a fixed point p = - n.(v + w x (p - o))        a plane's motion, stated twice: by o(t, q), n(t, q) and by v, w
dg/dt along the motion of the other bodies = 0  or  v, w != 0      g: all that says where the ground of a contact is
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import reduce
from itertools import combinations
from operator import or_

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import motion_at, pose_at
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.contact_points import Ball, Ellipsoid, Wheel
from jourdain_jax.scene.contacts import Contact
from jourdain_jax.scene.grounds import Cylinder, Sphere
from jourdain_jax.scene.loads import Gravity, Load
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.validated import contacts_of, loads_of

TOLERANCE = 1e-4  # relative: constants may be typed with a few digits, mistakes are larger
_ROWS_INSTEAD = "write its rows in `velocity_constraints`: tangents @ (rolling.velocity_at(point) - ground.velocity_at(point))"


class Stated(eqx.Module):
    """Numbers that the table judges, by names of bodies and contacts, at one state or, with a leading axis, at many; or nodes of a graph."""

    mass: dict[str, Float[Array, "*states"]]
    inertia: dict[str, Float[Array, "*states 4 3"]]  # of rigid bodies only; the fourth row is the round-off that a point of their mass may have
    orientation: dict[str, Float[Array, "*states 3 3"]]
    normal: dict[str, Float[Array, "*states 2"]]  # squares of the lengths of the normals of contacts; and how far out the contact is, m
    gap: dict[str, Float[Array, "*states 2"]]  # where the coordinates keep them closed; and the distance of the contact from the mass centre, m
    length: dict[str, Float[Array, "*states"]]  # of what rolls and of its ground, m, by what and of which contact
    tyre: dict[str, Float[Array, "*states"]]  # m
    gravity: dict[str, Float[Array, "*states"]]  # squares of the lengths of directions


class PoseNumbers(eqx.Module):
    """Numbers of all bodies and contacts at one state (or, with a leading axis, at many), by name."""

    stated: Stated
    position: dict[str, Float[Array, "*states 3"]]
    planes: dict[str, Float[Array, "*states 3"]]  # normal velocity by origin and tilt, by velocity and angular velocity; size of both, m/s
    carried: dict[str, Float[Array, "*states 3"]]  # rates of a ground along the motion of other bodies; size of that motion, and of the stated one, m/s


def numbers_of(scene: Scene, motion: Motion) -> PoseNumbers:
    """What the scene gives for its bodies and planes, from known poses and velocities."""
    contacts = contacts_of(scene, motion.pose())
    return PoseNumbers(
        stated=stated_of(scene, motion.pose(), loads_of(scene, motion)),
        position={name: body.position for name, body in motion.pose().bodies.items()},
        planes=_normal_velocities(scene, motion, contacts),
        carried={name: _carried_speeds(scene, motion, name, contact) for name, contact in contacts.items() if contact.ground is not None},
    )


def stated_of(scene: Scene, pose: Pose, loads: tuple[Load, ...] = ()) -> Stated:
    """Return the numbers that the table judges, for known poses and loads."""
    bodies, contacts = {name: body.body for name, body in pose.bodies.items()}, contacts_of(scene, pose)
    rigid = {name: body for name, body in bodies.items() if isinstance(body, RigidBody)}
    away = 1e6 * jnp.finfo(pose.q.array.dtype).eps  # of round-off in the places of contacts that are far out
    size = lambda x: jnp.sum(jnp.abs(x))  # noqa: E731
    tyres = {f"contact `{name}`": c.shape.tyre for name, c in contacts.items() if isinstance(c.shape, Wheel) and c.shape.tyre is not None}
    return Stated(
        mass={f"body `{name}`": body.mass for name, body in bodies.items()},
        # moments of bodies whose radius of gyration is below 1e-9 m are round-off
        inertia={f"body `{name}`": jnp.concatenate([body.inertia, jnp.full((1, 3), 1e-18 * body.mass)]) for name, body in rigid.items()},
        orientation={f"body `{name}`": body.orientation for name, body in rigid.items()},
        normal={f"contact `{name}`": jnp.stack([c.plane.normal @ c.plane.normal, size(c.point)]) for name, c in contacts.items()},
        gap={
            f"contact `{name}`": jnp.stack([c.gap(), size(c.point - pose[c.body].position) + away * size(c.point)])
            for name, c in contacts.items()
            if c.height == "coordinates"
        },
        length={f"{what} of contact `{name}`": length for name, contact in contacts.items() for what, length in _lengths(contact).items()},
        tyre=tyres,
        gravity={f"load {k}": load.direction @ load.direction for k, load in enumerate(loads, 1) if isinstance(load, Gravity)},
    )


def _lengths(contact: Contact) -> dict[str, Float[Array, ""]]:
    """Return the lengths (m) that must be positive."""
    found, shape, ground = {}, contact.shape, contact.ground
    if isinstance(shape, Ball | Wheel):
        found["the radius"] = shape.radius
    if isinstance(shape, Wheel) and shape.tyre is not None:
        found["the radius less the tyre"] = shape.circle
    if isinstance(shape, Ellipsoid):
        found["the smallest semi-axis"] = jnp.min(shape.semi_axes)
    if isinstance(ground, Cylinder | Sphere):
        found["the radius of the ground"] = ground.radius
    return found


@dataclass(frozen=True)
class Check:
    """One line of the table: a field of `Stated`, a label, the test (axes of states and names first), and the sentence for one state."""

    of: str
    label: str
    wrong: Callable
    says: Callable[[np.ndarray], str]


def _size(x):
    return abs(x).max((-2, -1))


def _lopsided(x):
    I = x[..., :3, :]
    return _size(I - I.swapaxes(-1, -2)) > TOLERANCE * _size(x)


def _negative(x):
    """Return whether an eigenvalue of a symmetric inertia is negative, by its principal minors, relative to its largest entry or to a point's."""
    I, size = x[..., :3, :], _size(x)
    I = (I + I.swapaxes(-1, -2)) / (2 * (size + (size == 0)))[..., None, None]
    at = lambda i, k: I[..., i, k] + (TOLERANCE if i == k else 0.0)  # noqa: E731
    minor = lambda i, j, k, m: at(i, k) * at(j, m) - at(i, m) * at(j, k)  # noqa: E731
    whole = sum(at(0, i) * minor(1, 2, (i + 1) % 3, (i + 2) % 3) for i in range(3))
    return reduce(or_, (x < 0 for x in (*(at(i, i) for i in range(3)), *(minor(i, j, i, j) for i, j in combinations(range(3), 2)), whole)))


def _from_identity(R):
    return _size(R.swapaxes(-1, -2) @ R - np.eye(3))


def _volume(R):
    at = lambda i, k: R[..., i, k]  # noqa: E731
    return sum(at(0, i) * (at(1, (i + 1) % 3) * at(2, (i + 2) % 3) - at(1, (i + 2) % 3) * at(2, (i + 1) % 3)) for i in range(3))


def _off(square):
    return abs(square**0.5 - 1)


CHECKS = (
    Check(
        "mass",
        "a negative mass",
        lambda m: m < 0,
        lambda m: f"has a mass of {m:.4g} kg, expected a number that is not negative; check what its mass is computed from",
    ),
    Check(
        "inertia",
        "an inertia that is not symmetric",
        _lopsided,
        lambda x: "has an inertia that is not symmetric; give the same products of inertia above and below the diagonal",
    ),
    Check(
        "inertia",
        "a negative moment of inertia",
        _negative,
        lambda x: (
            f"has a principal moment of inertia of {np.linalg.eigvalsh(x[:3])[0]:.4g} kg m^2, expected none below zero; check signs and products of inertia"
        ),
    ),
    Check(
        "orientation",
        "an orientation that is no rotation",
        lambda R: _from_identity(R) > TOLERANCE,
        lambda R: (
            f"has an orientation R that is no rotation: R' R differs from the identity by {_from_identity(R):.2g}; build it from jj.rot_x, jj.rot_y, jj.rot_z "
            "or jj.quaternion_to_matrix"
        ),
    ),
    Check(
        "orientation",
        "a reflected orientation",
        lambda R: _volume(R) < 0,
        lambda R: "has an orientation of determinant -1, a reflection and no rotation; turn one of its axes round",
    ),
    Check(
        "normal",
        "a normal that is no unit vector",
        lambda x: _off(x[..., 0]) > TOLERANCE,
        lambda x: f"has a normal whose length differs from 1 by {_off(x[0]):.2g}, expected a unit vector; divide it by its length",
    ),
    Check("length", "no positive length", lambda x: x <= 0, lambda x: f"is {x:.4g} m, expected a positive number; check what it is computed from"),
    Check("tyre", "a negative tyre", lambda x: x < 0, lambda x: f"has a tyre of {x:.4g} m, expected a radius of its section that is not negative"),
    Check(
        "gap",
        "a body off its ground",
        lambda x: abs(x[..., 0]) > TOLERANCE * x[..., 1],
        lambda x: (
            f'has height="coordinates", but at a probed state its body is {x[0]:.4g} m off the ground; let the coordinates keep it there, or write height="row"'
        ),
    ),
    Check(
        "gravity",
        "a direction of gravity that is no unit vector",
        lambda square: _off(square) > TOLERANCE,
        lambda square: f"has a length that differs from 1 by {_off(square):.2g}, expected a unit vector; divide it by its length",
    ),
)


def faults_at(scene: Scene, t, q, u, inputs) -> dict[str, Bool[Array, ""]]:
    """Return fault -> whether the scene has it at this state; also under jit and vmap. NaN is no fault."""
    motion = motion_at(scene, t, q, u, inputs)
    stated = stated_of(scene, motion.pose(), loads_of(scene, motion))
    return {f"{check.label}: {name}": check.wrong(x) for check in CHECKS for name, x in getattr(stated, check.of).items()}


known_faults_at = eval_numpy(faults_at)


def any_wrong(stacked: dict[str, Array]) -> Bool[Array, ""]:
    """Return whether the table finds a fault in numbers stacked along a first axis, by the names of the fields of `Stated`."""
    return jnp.any(jnp.concatenate([jnp.zeros(1, bool), *(check.wrong(stacked[check.of]) for check in CHECKS if check.of in stacked)]))


def _normal_velocities(scene: Scene, motion: Motion, contacts: dict[str, Contact]) -> dict[str, Float[Array, "3"]]:
    """Velocity of every contact's plane along its normal at the contact point, twice; and how large either could be.

    A plane that is tangent to a ground at rest has none, wherever on it the contact moves.
    """

    def planes(t, q, bodies):
        contacts = contacts_of(scene, Pose(t, scene.coordinate_names.view(q), bodies))
        return {name: (contact.plane.normal, contact.plane.origin) for name, contact in contacts.items()}

    found = {}
    along = jnp.ones_like(motion.t), motion.qdot.array, {name: body.rate_of_pose() for name, body in motion.bodies.items()}
    _, rates = jax.jvp(planes, (motion.t, motion.q.array, motion.pose().bodies), along)
    for name, contact in contacts.items():
        plane, arm, (normal_rate, origin_rate) = contact.plane, contact.point - contact.plane.origin, rates[name]
        by_pose = plane.normal @ origin_rate - normal_rate @ arm
        by_velocity = plane.normal @ plane.velocity_at(contact.point)
        lengths = [jnp.sum(jnp.abs(x)) for x in (origin_rate, plane.velocity, arm, normal_rate, plane.angular_velocity)]
        found[name] = jnp.stack([by_pose, by_velocity, lengths[0] + lengths[1] + lengths[2] * (lengths[3] + lengths[4])])
    return found


def _carried_speeds(scene: Scene, motion: Motion, name: str, contact: Contact) -> Float[Array, "3"]:
    """How fast a ground moves with bodies other than the one that rolls on it, how fast these move, and how fast the ground is stated to move."""
    others = {other: body for other, body in motion.bodies.items() if other != contact.body}
    if not others:
        return jnp.zeros(3, motion.t.dtype)
    pose = motion.pose()

    def where(bodies):
        ground = contacts_of(scene, Pose(pose.t, pose.q, pose.bodies | bodies))[name].ground
        return [getattr(ground, part) for part in ("origin", "normal", "axis", "radius") if hasattr(ground, part)], ground.value(contact.point)

    rates = {other: body.rate_of_pose() for other, body in others.items()}
    _, moves = jax.jvp(where, ({other: pose.bodies[other] for other in others},), (rates,))
    turns = [body.angular_velocity for body in others.values()]
    parts = jax.tree.leaves(moves), [body.velocity for body in others.values()] + turns, [contact.plane.velocity, contact.plane.angular_velocity]
    return jnp.stack([sum(jnp.sum(jnp.abs(x)) for x in part) for part in parts])


def impossible_bodies(scene: Scene, q) -> tuple[str, ...]:
    """Bodies that no distribution of mass can make, one sentence each; bodies without thickness whose other moments are zero are passed over.

    m >= 0,   0 <= I_1 <= I_2 <= I_3 <= I_1 + I_2
    """
    stated, who = _bodies_stated(scene, q), type(scene).__name__
    found = _sentences(who, jax.tree.map(lambda x: x[None], stated), CHECKS)
    for name, inertia in stated.inertia.items():
        least, middle, largest = np.linalg.eigvalsh(inertia[:3])
        # the last moment of thin wheels is the sum of the others, and published moments have three digits
        if least > TOLERANCE * largest and largest > (1 + 1e-2) * (least + middle):
            found.append(
                f"{name} of `{who}` has principal moments of inertia {least:.4g}, {middle:.4g} and {largest:.4g} kg m^2, the last above the sum of the others: "
                "no distribution of mass has them; bound the parameters of its inertia, or free fewer"
            )
    return tuple(found)


@eval_numpy
def _bodies_stated(scene: Scene, q) -> Stated:
    found = stated_of(scene, pose_at(scene, 0.0, q))
    return Stated(found.mass, found.inertia, *({} for _ in range(6)))


def _sentences(who: str, stated: Stated, checks: Iterable[Check]) -> list[str]:
    """Return one sentence for each fault that the table finds at many states, about the first state that has it."""
    found = []
    for check in checks:
        for name, x in getattr(stated, check.of).items():
            wrong = np.flatnonzero(check.wrong(x))
            found += [f"{name} of `{who}` {check.says(x[wrong[0]])}"] if wrong.size else []
    return found


def implausible(scene: Scene, numbers: PoseNumbers) -> tuple[str, ...]:
    """What cannot be, one sentence each; `numbers` at many states, those that are not finite are passed over."""
    who, stated = type(scene).__name__, numbers.stated
    pieces = {"mass": stated.mass, "inertia": stated.inertia, "orientation": stated.orientation}
    pieces["position"] = {f"body `{name}`": x for name, x in numbers.position.items()}
    sentences = [_of_nothing(f"{name} of `{who}`", what, x) for what, part in pieces.items() for name, x in part.items()]
    sentences += [_of_touch(f"{name} of `{who}`", x) for name, x in stated.normal.items()]
    return tuple(sentence for sentence in (*sentences, *_sentences(who, stated, CHECKS[:-1])) if sentence)


def odd_grounds(scene: Scene, numbers: PoseNumbers) -> tuple[str, ...]:
    """Grounds that move in another way than they are stated to, one sentence each; `numbers` as in `implausible`."""
    who = type(scene).__name__
    sentences = [_of_carried(f"the ground of contact `{name}` of `{who}`", speeds) for name, speeds in numbers.carried.items()]
    sentences += [_of_plane(f"the plane of contact `{name}` of `{who}`", speeds) for name, speeds in numbers.planes.items()]
    return tuple(sentence for sentence in sentences if sentence)


def odd_gravity(scene: Scene, numbers: PoseNumbers) -> tuple[str, ...]:
    """Directions of gravity that are no unit vectors, one sentence each; `numbers` as in `implausible`."""
    return tuple(f"the direction of gravity in {sentence}" for sentence in _sentences(type(scene).__name__, numbers.stated, CHECKS[-1:]))


def _of_nothing(what: str, piece: str, values: np.ndarray) -> str:
    if not len(values) or len(_finite(values)):
        return ""
    return f"{what} has no finite {piece} at any probed state, expected finite numbers; check what its {piece} is computed from"


def _of_plane(what: str, speeds: np.ndarray) -> str:
    by_pose, by_velocity, size = _finite(speeds).T
    off = np.abs(by_pose - by_velocity) - TOLERANCE * size
    if not np.any(off > 0):
        return ""
    k = int(np.argmax(off))
    return (
        f"{what} moves along its normal at {by_pose[k]:.4g} m/s by `origin` and `tilt`, but at {by_velocity[k]:.4g} m/s by `velocity` and "
        "`angular_velocity`; state the motion in both: velocity = d origin/dt, angular_velocity = (0, d tilt/dt, 0); where coordinates move it, leave the "
        f"contact away and {_ROWS_INSTEAD}"
    )


def _of_carried(what: str, speeds: np.ndarray) -> str:
    moves, bodies, stated = _finite(speeds).T
    if np.any(stated > 0) or not np.any(moves > TOLERANCE * bodies + 1e-12):
        return ""
    return (
        f"{what} moves with another body, but its `velocity` and `angular_velocity` are zero; where it is a body of the scene, omit the contact and "
        f"{_ROWS_INSTEAD}"
    )


def _of_touch(what: str, squares: np.ndarray) -> str:
    if not len(squares) or len(_finite(squares)):
        return ""
    return (
        f"{what} finds no point where body and ground touch at any probed state; a ball must be smaller than the cylinder or sphere that it rolls in, "
        "a surface needs a gradient that does not vanish, coordinates a `domain` that lies near it"
    )


def _finite(values: np.ndarray) -> np.ndarray:
    """The states at which all entries are finite, with a leading axis of states."""
    return values[np.all(np.isfinite(values.reshape(len(values), -1)), axis=1)]
