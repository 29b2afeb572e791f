"""Rolling contacts without slip, of discs and balls, on planes at rest, moving or tilted.

A contact contributes two velocity rows (no slip along the plane's two tangents) and, with `height="row"`, one geometric row (the gap
is zero). With `height="coordinates"` the coordinates keep the contact point on the plane by construction; then the normal force is
found from Newton's equation (row S1) instead of from a multiplier.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Vector, as_real
from jourdain_jax.scene.bodies import RigidBody, _axis_index
from jourdain_jax.scene.motion_state import BodyPose
from jourdain_jax.scene.numbers import checked_real, described

_HEIGHTS = ("coordinates", "row")


class Plane(eqx.Module):
    """A plane through `origin` (m), at rest or in rigid motion: velocity of its point at p is `velocity + angular_velocity x (p - origin)`.

    `Plane(origin, tilt, velocity, angular_velocity)`: the plane z = 0, turned by `tilt` (rad) about the y axis so that positive tilt slopes down
    along x. `velocity` in m/s, `angular_velocity` in rad/s; all vectors in the inertial frame.

    A moving plane states its motion twice: `origin` and `tilt` as functions of time, and `velocity` and `angular_velocity`, their rates and
    what moves within the plane itself (a belt, a turntable). Along the normal both must agree, which is checked when a scene is probed.
    """

    origin: Float[Array, "3"]  # m
    normal: Float[Array, "3"]  # unit vector, out of the ground
    tangents: Float[Array, "2 3"]  # unit vectors along the no-slip rows
    velocity: Float[Array, "3"]  # m/s, of the point at the origin
    angular_velocity: Float[Array, "3"]  # rad/s

    def __init__(self, origin=(0.0, 0.0, 0.0), tilt=0.0, velocity=(0.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 0.0)):
        """The plane z = 0, turned by `tilt` (rad) about the y axis so that positive tilt slopes down along x."""
        tilt = checked_real(tilt, "tilt of a plane", (), advice="give one angle in rad")
        c, s = jnp.cos(tilt), jnp.sin(tilt)
        o, i = jnp.zeros_like(c), jnp.ones_like(c)
        self.origin = checked_real(origin, "origin of a plane", (3,))
        self.normal = jnp.stack([s, o, c])
        self.tangents = jnp.stack([jnp.stack([c, o, -s]), jnp.stack([o, i, o])])
        self.velocity = checked_real(velocity, "velocity of a plane", (3,))
        self.angular_velocity = checked_real(angular_velocity, "angular velocity of a plane", (3,))

    def velocity_at(self, position: Vector) -> Float[Array, "3"]:
        """Velocity (m/s, inertial frame) of the plane's material point at `position` (m, inertial frame)."""
        return self.velocity + jnp.cross(self.angular_velocity, as_real(position) - self.origin)

    def height_of(self, position: Vector) -> Float[Array, ""]:
        """Signed distance (m) of the point at `position` (m, inertial frame) from the plane, positive along the normal."""
        return self.normal @ (as_real(position) - self.origin)


class Contact(eqx.Module):
    """A point contact of a body with a plane, rolling without slip."""

    body: str = eqx.field(static=True)
    point: Float[Array, "3"]  # m, inertial frame
    plane: Plane
    height: str = eqx.field(static=True)  # "coordinates" or "row"
    carried: tuple[str, ...] | None = eqx.field(static=True, default=None)  # bodies this contact alone holds up; None: all of them

    def gap(self) -> Float[Array, ""]:
        """Signed distance of the contact point from the plane, m."""
        return self.plane.height_of(self.point)


def disc_contact(
    body: BodyPose, radius, *, axis: str = "y", plane: Plane | None = None, height: str = "coordinates", carried: tuple[str, ...] | None = None
) -> Contact:
    """Rolling of the edge of a thin disc (centre: the mass centre) on a plane, without slip.

    The contact is the lowest point of the circle, `r - a (n - (n.k) k)/|n - (n.k) k|` with plane normal n and disc axis k. Undefined for
    a disc lying flat.

    - `body`: `pose["name"]`; `radius` a in m; `axis`: the body axis k, "x", "y" or "z".
    - `plane`: default z = 0 at rest. `height`: "coordinates" where they keep the body on the plane by themselves, "row" for a geometric row.
    - `carried`: names of the bodies that this contact holds up (default: all), for the normal force where `height="coordinates"`.

    Two velocity rows (m/s), along the plane's tangents; ValueError for an unknown axis or height.
    """
    _check_height(height)
    radius, plane = _rolling(body, radius, plane)
    k = body.orientation[:, _axis_index(axis)]
    up = plane.normal - (plane.normal @ k) * k
    point = body.position - radius * up / jnp.sqrt(up @ up)
    return Contact(body.name, point, plane, height, carried)


def ball_contact(body: BodyPose, radius, *, plane: Plane | None = None, height: str = "coordinates", carried: tuple[str, ...] | None = None) -> Contact:
    """Rolling of a ball (centre: the mass centre) on a plane, without slip; the contact point is `r - a n`.

    - `body`: `pose["name"]`; `radius` a in m.
    - `plane`: default z = 0 at rest. `height`: "coordinates" where they keep the body on the plane by themselves, "row" for a geometric row.
    - `carried`: names of the bodies that this contact holds up (default: all), for the normal force where `height="coordinates"`.

    Two velocity rows (m/s), along the plane's tangents; ValueError for an unknown height.
    """
    _check_height(height)
    radius, plane = _rolling(body, radius, plane)
    return Contact(body.name, body.position - radius * plane.normal, plane, height, carried)


def _rolling(body, radius, plane) -> tuple[Float[Array, ""], Plane]:
    """Radius and plane of the contact of a body that can roll; a ValueError otherwise."""
    if not isinstance(body, BodyPose):
        raise ValueError(f'the body of a contact is {described(body)}, expected the pose of a body; write pose["name"]')
    if not isinstance(body.body, RigidBody):
        raise ValueError(f"body `{body.name}` of a contact is a particle, which cannot roll; make it a `jj.RigidBody`")
    if plane is not None and not isinstance(plane, Plane):
        raise ValueError(f"`plane` of the contact of `{body.name}` is {described(plane)}, expected a `jj.Plane(...)`, or None for z = 0 at rest")
    return checked_real(radius, f"radius of the contact of `{body.name}`", ()), Plane() if plane is None else plane


def _check_height(height: str) -> None:
    if height not in _HEIGHTS:
        raise ValueError(f"contact height `{height}` is unknown; expected `coordinates` (kept by the coordinates) or `row` (a geometric row)")
