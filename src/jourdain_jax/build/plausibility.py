"""Whether the numbers that a scene gives for its bodies and contacts can be those of bodies and contacts; looked at while it is probed.

m >= 0,   I = I' >= 0,   R' R = 1,   det R = 1
n.n = 1,   e.e = 1 of gravity,   gap = 0 where the coordinates keep a body on the ground
d[n.(p - o)]/dt at a fixed point p = - n.(v + w x (p - o))        a plane's motion, stated twice: by o(t, q), n(t, q) and by v, w
dg/dt along the motion of the other bodies = 0  or  v, w != 0      g: all that says where the ground of a contact is
"""

from functools import reduce
from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import inertias_of, pose_at
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.contacts import Contact
from jourdain_jax.scene.loads import Gravity
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.validated import contacts_of, loads_of

TOLERANCE = 1e-4  # relative: constants may be typed with a few digits, mistakes are larger
_POINT = 1e-9**2  # m^2: of bodies whose radius of gyration is smaller, moments are round-off
_ROUNDED = 1e-2  # relative: of thin wheels the last moment is the sum of the others, and published moments have three digits
_ROWS_INSTEAD = "write its rows in `velocity_constraints`: tangents @ (rolling.velocity_at(point) - ground.velocity_at(point))"


class PoseNumbers(eqx.Module):
    """Numbers of all bodies and contacts at one state (or, with a leading axis, at many), by name."""

    mass: dict[str, Float[Array, "*states"]]
    position: dict[str, Float[Array, "*states 3"]]
    inertia: dict[str, Float[Array, "*states 3 3"]]  # of rigid bodies only
    orientation: dict[str, Float[Array, "*states 3 3"]]
    planes: dict[str, Float[Array, "*states 3"]]  # normal velocity by origin and tilt, by velocity and angular velocity; size of both, m/s
    carried: dict[str, Float[Array, "*states 3"]]  # rates of a ground along the motion of other bodies; size of that motion, and of the stated one, m/s
    normals: dict[str, Float[Array, "*states 2"]]  # squares of the lengths of the normals of contacts; and how far out the contact is, m
    downwards: dict[str, Float[Array, "*states"]]  # squares of the lengths of directions of gravity
    gaps: dict[str, Float[Array, "*states 2"]]  # where the coordinates keep them closed; and the distance of the contact from the mass centre, m


def numbers_of(scene: Scene, motion: Motion) -> PoseNumbers:
    """What the scene gives for its bodies and planes, from known poses and velocities."""
    pose = motion.pose()
    rigid = {name: body.body for name, body in pose.bodies.items() if isinstance(body.body, RigidBody)}
    contacts = contacts_of(scene, pose)
    return PoseNumbers(
        mass={name: body.mass for name, body in pose.bodies.items()},
        position={name: body.position for name, body in pose.bodies.items()},
        inertia={name: body.inertia for name, body in rigid.items()},
        orientation={name: body.orientation for name, body in rigid.items()},
        planes=_normal_velocities(scene, motion, contacts),
        carried={name: _carried_speeds(scene, motion, name, contact) for name, contact in contacts.items() if contact.ground is not None},
        normals={name: jnp.stack([contact.plane.normal @ contact.plane.normal, jnp.sum(jnp.abs(contact.point))]) for name, contact in contacts.items()},
        downwards={str(k): load.direction @ load.direction for k, load in enumerate(loads_of(scene, motion)) if isinstance(load, Gravity)},
        gaps={
            name: jnp.stack([contact.gap(), jnp.sum(jnp.abs(contact.point - pose[contact.body].position))])
            for name, contact in contacts.items()
            if contact.height == "coordinates"
        },
    )


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


def body_faults(scene: Scene, t, q) -> dict[str, Bool[Array, ""]]:
    """Body name -> whether its mass is negative, or its inertia has a negative principal moment; also under jit and vmap. What is NaN is no fault of a body."""
    pose = pose_at(scene, t, q)
    weights = inertias_of(pose)
    return dict(zip(pose.bodies, are_negative(weights.mass, weights.inertia), strict=True))


def impossible_bodies(scene: Scene, q) -> tuple[str, ...]:
    """Bodies that no distribution of mass can make, one sentence each; bodies without thickness whose other moments are zero are passed over.

    m >= 0,   0 <= I_1 <= I_2 <= I_3 <= I_1 + I_2
    """
    found = []
    for name, (mass, inertia) in _masses_and_inertias(scene, q).items():
        what = f"body `{name}` of `{type(scene).__name__}`"
        found.append(_of_mass(what, np.atleast_1d(mass)))
        if inertia is not None:
            found.append(_of_inertia(what, np.atleast_1d(mass), inertia[None]))
            least, middle, largest = np.linalg.eigvalsh(inertia)
            if least > TOLERANCE * largest and largest > (1 + _ROUNDED) * (least + middle):
                found.append(
                    f"{what} has principal moments of inertia {least:.4g}, {middle:.4g} and {largest:.4g} kg m^2, the last above the sum of the others: no "
                    "distribution of mass has them; bound the parameters of its inertia, or free fewer"
                )
    return tuple(sentence for sentence in found if sentence)


@eval_numpy
def _masses_and_inertias(scene: Scene, q) -> dict:
    bodies = {name: placed.body for name, placed in pose_at(scene, 0.0, q).bodies.items()}
    return {name: (body.mass, body.inertia if isinstance(body, RigidBody) else None) for name, body in bodies.items()}


def are_negative(mass: Float[Array, "bodies"], inertia: Float[Array, "bodies 3 3"]) -> Bool[Array, "bodies"]:
    """Whether a mass is below zero, or an eigenvalue of a symmetric inertia: by its principal minors, relative to its largest entry, or that of a point."""
    I = jnp.moveaxis(inertia, 0, 2)
    size = reduce(jnp.maximum, (jnp.abs(x) for row in I for x in row), _POINT * mass)
    I = I / jnp.where(size > 0, size, 1.0) + TOLERANCE * jnp.eye(3, dtype=I.dtype)[..., None]

    def minor(i: int, j: int, k: int, m: int):
        return I[i, k] * I[j, m] - I[i, m] * I[j, k]

    whole = sum(I[0, i] * minor(1, 2, (i + 1) % 3, (i + 2) % 3) for i in range(3))
    return reduce(jnp.logical_or, (x < 0 for x in (mass, *(I[i, i] for i in range(3)), *(minor(i, j, i, j) for i, j in combinations(range(3), 2)), whole)))


def implausible(scene: Scene, numbers: PoseNumbers) -> tuple[str, ...]:
    """What cannot be, one sentence each; `numbers` at many states, those that are not finite are passed over."""
    who = type(scene).__name__
    pieces = {"mass": numbers.mass, "inertia": numbers.inertia, "position": numbers.position, "orientation": numbers.orientation}
    sentences = [_of_nothing(f"body `{name}` of `{who}`", what, x) for what, part in pieces.items() for name, x in part.items()]
    sentences += [_of_mass(f"body `{name}` of `{who}`", mass) for name, mass in numbers.mass.items()]
    sentences += [_of_inertia(f"body `{name}` of `{who}`", numbers.mass[name], I) for name, I in numbers.inertia.items()]
    sentences += [_of_orientation(f"body `{name}` of `{who}`", R) for name, R in numbers.orientation.items()]
    sentences += [_of_carried(f"the ground of contact `{name}` of `{who}`", speeds) for name, speeds in numbers.carried.items()]
    sentences += [_of_plane(f"the plane of contact `{name}` of `{who}`", speeds) for name, speeds in numbers.planes.items()]
    sentences += [_of_normal(f"contact `{name}` of `{who}`", squares) for name, squares in numbers.normals.items()]
    sentences += [_of_gap(f"contact `{name}` of `{who}`", gaps) for name, gaps in numbers.gaps.items()]
    return tuple(sentence for sentence in sentences if sentence)


def odd_gravity(scene: Scene, numbers: PoseNumbers) -> tuple[str, ...]:
    """Directions of gravity that are no unit vectors, one sentence each; `numbers` as in `implausible`."""
    off = [np.max(np.abs(np.sqrt(_finite(squares)) - 1), initial=0.0) for squares in numbers.downwards.values()]
    who = f"the direction of gravity of `{type(scene).__name__}`"
    return tuple(f"{who} has a length that differs from 1 by {x:.2g}, expected a unit vector; divide it by its length" for x in off if x > TOLERANCE)


def _of_nothing(what: str, piece: str, values: np.ndarray) -> str:
    if not len(values) or len(_finite(values)):
        return ""
    return f"{what} has no finite {piece} at any probed state, expected finite numbers; check what its {piece} is computed from"


def _of_mass(what: str, mass: np.ndarray) -> str:
    lowest = np.min(_finite(mass), initial=0.0)
    return f"{what} has a mass of {lowest:.4g} kg, expected a number that is not negative; check what its mass is computed from" if lowest < 0 else ""


def _of_inertia(what: str, mass: np.ndarray, I: np.ndarray) -> str:
    I, heaviest = _finite(I), np.max(_finite(mass), initial=0.0)
    size = np.max(np.abs(I), axis=(1, 2), initial=max(_POINT * heaviest, np.finfo(float).tiny))
    if np.any(np.max(np.abs(I - np.swapaxes(I, 1, 2)), axis=(1, 2), initial=0.0) > TOLERANCE * size):
        return f"{what} has an inertia that is not symmetric; give the same products of inertia above and below the diagonal"
    least = np.linalg.eigvalsh(I)[:, 0]
    if np.any(least < -TOLERANCE * size):
        return f"{what} has a principal moment of inertia of {least.min():.4g} kg m^2, expected none below zero; check signs and products of inertia"
    return ""


def _of_orientation(what: str, R: np.ndarray) -> str:
    R = _finite(R)
    off = np.max(np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)), initial=0.0)
    if off > TOLERANCE:
        return (
            f"{what} has an orientation R that is no rotation: R' R differs from the identity by {off:.2g}; build it from jj.rot_x, jj.rot_y, jj.rot_z "
            "or jj.quaternion_to_matrix"
        )
    if np.any(np.linalg.det(R) < 0):
        return f"{what} has an orientation of determinant -1, a reflection and no rotation; turn one of its axes round"
    return ""


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
        f"{what} moves with another body, but its `velocity` and `angular_velocity` are zero; where it is a body of the scene, leave the contact away and "
        f"{_ROWS_INSTEAD}"
    )


def _of_normal(what: str, squares: np.ndarray) -> str:
    if len(squares) and not len(_finite(squares)):
        return (
            f"{what} finds no point where body and ground touch at any probed state; a ball must be smaller than the cylinder or sphere that it rolls in, "
            "a surface needs a gradient that does not vanish, coordinates a `domain` that lies near it"
        )
    off = np.max(np.abs(np.sqrt(_finite(squares)[:, 0]) - 1), initial=0.0)
    return f"{what} has a normal whose length differs from 1 by {off:.2g}, expected a unit vector; divide it by its length" if off > TOLERANCE else ""


def _of_gap(what: str, gaps: np.ndarray) -> str:
    gap, size = _finite(gaps).T
    off = np.abs(gap) - TOLERANCE * size
    if not np.any(off > 0):
        return ""
    k = int(np.argmax(off))
    return (
        f'{what} has height="coordinates", but at a probed state its body is {gap[k]:.4g} m off the ground; let the coordinates keep it there, '
        'or write height="row"'
    )


def _finite(values: np.ndarray) -> np.ndarray:
    """The states at which all entries are finite, with a leading axis of states."""
    return values[np.all(np.isfinite(values.reshape(len(values), -1)), axis=1)]
