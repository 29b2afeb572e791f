"""The arguments of a scene's methods: poses, or poses with velocities, of all bodies at one instant.

`Pose` (t, q, bodies) is the argument of geometric constraints and contacts. `Motion` also has `u`, `qdot`,
inputs and velocities; it is the argument of loads, velocity constraints and events. Velocities are those of
the mass centres; angular velocities are in space components.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Scalar, checked_real, static
from jourdain_jax.calculus.rotations import skew
from jourdain_jax.scene.bodies import Body, RigidBody
from jourdain_jax.scene.coordinates import Named, UnknownNameError, check_name

Vectors = Float[Array, "*times 3"]


class Point(eqx.Module):
    """A point of a body, with its position and velocity. `body` is None for a point of the inertial frame."""

    position: Vectors  # m, inertial frame
    velocity: Vectors  # m/s, inertial frame
    arm: Vectors  # m, from the mass centre of the body to the point, inertial frame
    body: str | None = static(default=None)


def fixed_point(position: Any) -> Point:
    """Return a point at rest at `position` (3,) (m, inertial frame), for springs, dampers and rods."""
    position = checked_real(
        position, "position of a fixed point", (3,), advice="give three components in the inertial frame, m"
    )
    return Point(position, jnp.zeros_like(position), jnp.zeros_like(position))


class BodyPose(eqx.Module):
    """Pose of one body."""

    name: str = static()
    body: Body

    @property
    def mass(self) -> Float[Array, "*times"]:
        """Return the mass in kg."""
        return self.body.mass

    @property
    def position(self) -> Vectors:
        """Return the position of the mass centre, m, inertial frame."""
        return self.body.position

    @property
    def orientation(self) -> Float[Array, "*times 3 3"]:
        """Return the rotation matrix, body to space; the identity for a particle."""
        if isinstance(self.body, RigidBody):
            return self.body.orientation
        return jnp.broadcast_to(jnp.eye(3, dtype=self.position.dtype), (*self.position.shape, 3))

    def place(self, local: Any) -> Vectors:
        """Return the position (m, inertial frame) of the point with body-frame coordinates `local` (m,
        relative to the mass centre).
        """
        local = checked_real(
            local, f"point of body `{self.name}`", (3,), advice="give three components in its body frame, m"
        )
        return self.position + self.orientation @ local.astype(self.position.dtype)


class BodyMotion(eqx.Module):
    """Pose and velocity of one body."""

    name: str = static()
    body: Body
    velocity: Vectors  # m/s, mass centre, inertial frame
    angular_velocity: Vectors  # rad/s, inertial frame; zero for a particle

    mass = BodyPose.mass
    position = BodyPose.position
    orientation = BodyPose.orientation
    place = BodyPose.place

    @property
    def angular_velocity_body(self) -> Vectors:
        """Return the angular velocity in body components, rad/s."""
        return jnp.einsum("...ji,...j->...i", self.orientation, self.angular_velocity)

    def velocity_at(self, position) -> Vectors:
        """Return the velocity (m/s, inertial frame) of the material point at `position` (m, inertial frame):
        `v + omega x (position - r)`.

        `position`: three components, or three at each time of a motion.
        """
        where, advice = f"point of body `{self.name}`", "give three components in the inertial frame, m"
        position = checked_real(position, where, advice=advice)
        position = checked_real(
            position, where, self.position.shape if position.ndim > 1 else (3,), advice=advice
        )
        return self.velocity + jnp.cross(self.angular_velocity, position - self.position)

    def point(self, local=(0.0, 0.0, 0.0)) -> Point:
        """Return the material point with body-frame coordinates `local` (m, relative to the mass centre)."""
        position = self.place(local)
        return Point(position, self.velocity_at(position), position - self.position, self.name)

    def rate_of_pose(self) -> BodyPose:
        """Return the rate of the pose, per s: `rdot = v`, `Rdot = [omega]x R`, with constant mass."""
        rate = eqx.tree_at(lambda b: b.position, jax.tree.map(jnp.zeros_like, self.body), self.velocity)
        if isinstance(rate, RigidBody):
            rate = eqx.tree_at(lambda b: b.orientation, rate, skew(self.angular_velocity) @ self.orientation)
        return BodyPose(self.name, rate)


class Pose(eqx.Module):
    """Time, coordinates and the poses of all bodies; `pose["disc"]` is a body, `pose.q.yaw` a coordinate."""

    t: Scalar
    q: Named
    bodies: dict[str, BodyPose]

    def __getitem__(self, name: str) -> BodyPose:
        return _lookup(self.bodies, name)

    def __contains__(self, name: str) -> bool:
        return name in self.bodies


class Motion(eqx.Module):
    """Time, coordinates, speeds, inputs and the motion of all bodies, such as `motion.u.yaw_rate` and
    `motion["disc"].velocity`.
    """

    t: Scalar
    q: Named
    u: Named
    qdot: Named
    inputs: Named
    bodies: dict[str, BodyMotion]

    def __getitem__(self, name: str) -> BodyMotion:
        return _lookup(self.bodies, name)

    def __contains__(self, name: str) -> bool:
        return name in self.bodies

    @property
    def modes(self) -> Named:
        """Return the inputs, which include the modes. The number of a mode is the index of its value."""
        return self.inputs

    def pose(self) -> Pose:
        """Return time, coordinates and the poses of all bodies, without velocities."""
        return Pose(
            self.t, self.q, {name: BodyPose(name, motion.body) for name, motion in self.bodies.items()}
        )


def _lookup(bodies: dict, name: str):
    check_name(name, bodies, f"no body `{name}` in this scene", UnknownNameError)
    return bodies[name]
