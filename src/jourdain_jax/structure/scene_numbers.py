"""Numbers of a scene at one state that `plausibility.py` checks: masses, inertias, unit vectors, lengths,
gaps, velocities of grounds.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Scalar, eps_of
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.contact.contact_points import Ball, Ellipsoid, Wheel
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.contact.grounds import Cylinder, Sphere
from jourdain_jax.scene.loads import Gravity, Load
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import contacts_of, held_rows_of, loads_of

# kind -> name of the owner -> values; at one state or, with a leading axis, at many; or nodes
Numbers = dict[str, dict[str, Float[Array, "*states_and_shape"]]]


def numbers_of(scene: Scene, motion: Motion) -> Numbers:
    """Return the numbers that `plausibility.py` checks, at the state of a motion."""
    pose = motion.pose()
    contacts = contacts_of(scene, pose)
    laws = {f"contact `{name}`": c.friction for name, c in contacts.items() if c.friction is not None}
    laws |= {f"`{name}`": row.friction for name, row in held_rows_of(scene, motion).items()}
    return stated_of(scene, pose, loads_of(scene, motion)) | {
        "position": {f"body `{name}`": body.position for name, body in pose.bodies.items()},
        "touch": {
            f"contact `{name}`": contact.point + contact.plane.normal for name, contact in contacts.items()
        },
        "friction": {f"the friction of {name}": law.sliding for name, law in laws.items()},
        "static": {
            f"the static friction of {name}": jnp.stack([law.static, law.sliding])
            for name, law in laws.items()
        },
        **_of_grounds(scene, motion),
    }


def stated_of(scene: Scene, pose: Pose, loads: tuple[Load, ...] = ()) -> Numbers:
    """Return the checked numbers that depend only on poses and loads."""
    bodies = {f"body `{name}`": body.body for name, body in pose.bodies.items()}
    contacts = {f"contact `{name}`": contact for name, contact in contacts_of(scene, pose).items()}
    rigid = {name: body for name, body in bodies.items() if isinstance(body, RigidBody)}
    closed = {name: c for name, c in contacts.items() if c.height == "coordinates"}
    size = lambda x: jnp.sum(jnp.abs(x))
    away = _round_off(pose)  # relative round-off, for contacts far from the origin
    return {
        "mass": {name: body.mass for name, body in bodies.items()},  # kg
        # kg m^2; the fourth row is round-off: moments of a body with a radius of gyration of 1e-9 m
        "inertia": {
            name: jnp.concatenate([body.inertia, jnp.full((1, 3), 1e-18 * body.mass)])
            for name, body in rigid.items()
        },
        "orientation": {name: body.orientation for name, body in rigid.items()},
        "unit": (
            {f"the normal of {name}": c.plane.normal @ c.plane.normal for name, c in contacts.items()}
            | {
                f"the axis of {name}": c.ground.axis @ c.ground.axis
                for name, c in contacts.items()
                if isinstance(c.ground, Cylinder)
            }
        ),
        # m; with the distance of the contact from the mass centre
        "gap": {
            name: jnp.stack([c.gap(), size(c.point - pose[c.body].position) + away * size(c.point)])
            for name, c in closed.items()
        },
        "length": {
            f"{what} of {name}": length
            for name, c in contacts.items()
            for what, length in _lengths(c).items()
        },  # m
        "tyre": {
            name: c.shape.tyre
            for name, c in contacts.items()
            if isinstance(c.shape, Wheel) and c.shape.tyre is not None
        },  # m
        "restitution": {
            f"the restitution of {name}": c.restitution
            for name, c in contacts.items()
            if c.restitution is not None
        },
        "gravity": {
            f"the direction of gravity in load {k}": load.direction @ load.direction
            for k, load in enumerate(loads, 1)
            if isinstance(load, Gravity)
        },
    }


def _round_off(pose: Pose):
    return 1e6 * eps_of(pose.q.array)


def _lengths(contact: Contact) -> dict[str, Scalar]:
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
        if ground.side == "inside" and isinstance(shape, Ball):
            found["ground radius minus ball radius"] = ground.radius - shape.radius
    return found


def _of_grounds(scene: Scene, motion: Motion) -> Numbers:
    """Return numbers on the motion of the ground of every contact.

    - "plane": two velocities (m/s) of the contact's plane along its normal, by rates of `origin` and
      `tilt`, and by the stated `velocity` and `angular_velocity`. The third number is the sum of the sizes
      of all terms.
    - "own plane": the same for a `Contact` with a user-defined point.
    - "ground": the rates of the ground's numbers if only other bodies move, relative to the speeds of these
      bodies; and the size of the ground's stated velocity.
    """
    found: Numbers = {"plane": {}, "own plane": {}, "ground": {}}
    pose, contacts = motion.pose(), contacts_of(scene, motion.pose())
    moving = {name: body.rate_of_pose() for name, body in motion.bodies.items()}
    size = lambda *parts: sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(parts))

    def rates(name: str, t_rate, q_rate, of_bodies):
        def where(t, q, bodies):
            contact, ground = (
                contacts_of(scene, Pose(t, scene.coordinate_names.view(q), bodies))[name],
                contacts[name].ground,
            )
            if ground is not None:
                ground = [
                    getattr(contact.ground, part)
                    for part in ("origin", "normal", "axis", "radius")
                    if hasattr(ground, part)
                ]
                ground.append(contact.ground.value(contacts[name].point))
            return contact.plane.normal, contact.plane.origin, ground

        return jax.jvp(where, (motion.t, motion.q.array, pose.bodies), (t_rate, q_rate, of_bodies))[1]

    for name, contact in contacts.items():
        plane, arm = contact.plane, contact.point - contact.plane.origin
        normal_rate, origin_rate, _ = rates(name, jnp.ones_like(motion.t), motion.qdot.array, moving)
        twice = (
            plane.normal @ origin_rate - normal_rate @ arm,
            plane.normal @ plane.velocity_at(contact.point),
        )
        could = size(origin_rate, plane.velocity) + size(arm) * size(normal_rate, plane.angular_velocity)
        could += _round_off(pose)  # of rates of 1 m/s that vanish at this state
        found["own plane" if contact.shape is None else "plane"][f"the plane of contact `{name}`"] = (
            jnp.stack([*twice, could])
        )
        if contact.ground is not None:
            others = {
                body: rate if body != contact.body else jax.tree.map(jnp.zeros_like, rate)
                for body, rate in moving.items()
            }
            carried = rates(name, jnp.zeros_like(motion.t), jnp.zeros_like(motion.q.array), others)[2]
            speeds = [
                (body.velocity, body.angular_velocity)
                for other, body in motion.bodies.items()
                if other != contact.body
            ]
            stated = plane.velocity, plane.angular_velocity
            found["ground"][f"the ground of contact `{name}`"] = jnp.stack(
                [size(carried) / (size(speeds) + 1e-8 + 0.0 * motion.t), size(stated)]
            )
    return found
