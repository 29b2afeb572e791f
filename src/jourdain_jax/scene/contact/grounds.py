"""The grounds that bodies roll on: planes, cylinders, spheres, surfaces `f(x, y, z) = 0` and height maps, at
rest or in rigid motion.

    n = grad f/|grad f|     unit normal out of the ground, on the side of the bodies, where f > 0
    n x p = t1, t2          two unit tangents: the directions of the no-slip constraints

The motion of a ground must be given twice: by its shape as a function of time, and by `velocity` and
`angular_velocity`. The two vectors also include motion within the ground, such as that of a belt or a
turntable. Along the normal they must agree with the motion of the shape; this is checked when the
scene is probed.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, TypedDict, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Matrix3,
    Number,
    Scalar,
    Vector,
    Vector3,
    as_real,
    checked_positive,
    checked_real,
    described,
    known_numbers,
    real_type,
    static,
)
from jourdain_jax.calculus.rotations import rot_y

Tangents = Float[Array, "2 3"]


class RigidMotion(TypedDict, total=False):
    """Pose and motion of a ground; zero by default."""

    origin: Vector  # m
    velocity: Vector  # m/s, of the material point at the origin
    angular_velocity: Vector  # rad/s


class _Ground(eqx.Module):
    """Pose and motion of a ground."""

    origin: Vector3  # m
    velocity: Vector3  # m/s, of the point at the origin
    angular_velocity: Vector3  # rad/s

    def velocity_at(self, position: Vector) -> Vector3:
        """Return the velocity (m/s, inertial frame) of the ground's material point at `position` (m, inertial
        frame).
        """
        return self.velocity + jnp.cross(self.angular_velocity, as_real(position) - self.origin)

    def _moves(
        self, what: str, origin=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 0.0)
    ) -> None:
        """Check and store the motion."""
        self.origin = checked_real(origin, f"origin of {what}", (3,))
        self.velocity = checked_real(velocity, f"velocity of {what}", (3,))
        self.angular_velocity = checked_real(angular_velocity, f"angular velocity of {what}", (3,))

    def _tangent(self, origin, normal, tangents) -> "Plane":
        """Return a plane with the given axes that moves with the ground."""
        parts = lambda p: (p.origin, p.normal, p.tangents, p.velocity, p.angular_velocity)
        return eqx.tree_at(
            parts, Plane(), (origin, normal, tangents, self.velocity_at(origin), self.angular_velocity)
        )


class Plane(_Ground):
    """A plane through `origin` (m), at rest or in rigid motion.

    - `tilt`: rotation of the plane z = 0, an angle (rad) about the y axis or a rotation matrix (3, 3), such
      as `jj.rot_x(0.1)`. A plane with a positive angle slopes down along x.
    - `normal`: the unit normal n, instead of `tilt`.
    - `velocity` (m/s) at the origin and `angular_velocity` (rad/s): the velocity of the plane's point at p is
      `velocity + angular_velocity x (p - origin)`. All vectors are in the inertial frame.
    - `along`: a vector that is not normal to the plane. The no-slip constraints act along its projection onto
      the plane, and across it. By default they act along the x and y axes, rotated by `tilt`, or by the
      shortest rotation of z to the given normal n (of -z if n points down).

    The motion of a plane must be given twice: by `origin` and `tilt` or `normal` as functions of time, and by
    `velocity` and `angular_velocity`. The two vectors also include motion within the plane, such as that of a
    belt or a turntable. Along the normal they must agree with the motion of the plane; this is checked when
    the scene is probed.

    Raises ValueError for an `along` normal to the plane, for both `tilt` and `normal`, and, when the scene is
    built, for a normal that is not a unit vector.
    """

    normal: Vector3  # unit vector, out of the ground
    tangents: Tangents  # unit vectors along the no-slip constraints

    def __init__(
        self,
        origin: Vector = (0.0, 0.0, 0.0),
        tilt: Any = None,
        velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
        *,
        normal=None,
        along=None,
    ):
        """Make the plane z = 0, rotated by `tilt` (rad, about y; or a rotation matrix), or the plane with
        this `normal` and the first tangent `along`.
        """
        if tilt is not None and normal is not None:
            raise ValueError("a plane has both a `tilt` and a `normal`, expected one of them; omit one")
        if tilt is not None:
            axes = _turned(tilt)
            self.normal, tangents = axes[:, 2], axes[:, :2].T
        elif normal is None:
            self.normal, tangents = (jnp.asarray(x, real_type()) for x in (np.eye(3)[2], np.eye(3)[:2]))
        else:
            self.normal = checked_real(normal, "normal of a plane", (3,), advice="give a unit vector")
            tangents = tangents_of(self.normal)
        self.tangents = tangents if along is None else _tangents_along(self.normal, along)
        self._moves("a plane", origin, velocity, angular_velocity)

    @property
    def axes(self) -> Matrix3:
        """Return the rotation matrix from components in the plane to the inertial frame: its columns are the
        two tangents and the normal.
        """
        return jnp.vstack([self.tangents, self.normal]).T

    def height_of(self, position: Vector) -> Scalar:
        """Return the signed distance (m) of the point at `position` (m, inertial frame) from the plane,
        positive along the normal.
        """
        return self.normal @ (as_real(position) - self.origin)

    def value(self, point: Vector) -> Scalar:
        """Return f (m) at a `point` (m, inertial frame): its height above the plane."""
        return self.height_of(point)

    def plane_at(self, point: Vector) -> "Plane":
        """Return the tangent plane at a `point` (m, inertial frame): the plane itself."""
        checked_real(point, "point of a plane", (3,))
        return self


class _Round(_Ground):
    """A ground at a constant distance from an axis or a centre."""

    radius: Scalar  # m
    side: str = static()  # "inside" or "outside"

    @abstractmethod
    def arm_to(self, point: Vector) -> Vector3:
        """Return the vector to the `point` (m, inertial frame) from the nearest point of the axis, or from
        the centre.
        """

    @abstractmethod
    def _tangents(self, normal: Vector3) -> Tangents:
        """Return unit vectors along the no-slip constraints."""

    def _is(self, what: str, radius, side: str, motion: RigidMotion) -> None:
        """Check and store radius, side and motion."""
        if side not in ("inside", "outside"):
            raise ValueError(
                f"side `{side}` is unknown; expected `inside` or `outside`, where the bodies are"
            )
        self.radius, self.side = checked_positive(radius, f"radius of {what}"), side
        self._moves(what, **motion)

    def value(self, point: Vector) -> Scalar:
        """Return f = (d^2 - r^2)/(2 r) (m) at a `point` (m, inertial frame) with the distance d from the axis
        or centre, and the radius r; -f if the bodies are inside.
        """
        arm = self.arm_to(point)
        outward = (arm @ arm - self.radius**2) / (2 * self.radius)
        return -outward if self.side == "inside" else outward

    def plane_at(self, point: Vector) -> Plane:
        """Return the tangent plane at the ground's point nearest to the `point` (m, inertial frame)."""
        arm = self.arm_to(point)
        out = arm / jnp.sqrt(arm @ arm)
        normal = -out if self.side == "inside" else out
        return self._tangent(as_real(point) - arm + self.radius * out, normal, self._tangents(normal))


class Cylinder(_Round):
    """A circular cylinder of the given `radius` (m) about the line through `origin` (m) along the unit
    vector `axis`.

    `side`: "inside" or "outside", where the bodies are. `velocity` (m/s): of its material point at the
    origin; `angular_velocity` (rad/s): `rate * axis` for a turning drum. All vectors are in the inertial
    frame. The no-slip constraints act along the axis and around it.

    Raises ValueError for a radius that is not positive, for an unknown side, and, when the scene is built,
    for an axis that is not a unit vector.
    """

    axis: Vector3  # unit vector

    def __init__(self, radius, axis, *, side: str, **motion: Unpack[RigidMotion]):
        """Make a cylinder of `radius` (m) about the line through `origin` along the unit vector `axis`,
        touched from its `side`. `motion`: origin and motion of the ground.
        """
        self._is("a cylinder", radius, side, motion)
        self.axis = checked_real(axis, "axis of a cylinder", (3,), advice="give a unit vector")

    def arm_to(self, point: Vector) -> Vector3:
        """Return the vector from the nearest point of the axis to the `point` (m, inertial frame)."""
        arm = as_real(point) - self.origin
        return arm - (arm @ self.axis) * self.axis

    def _tangents(self, normal: Vector3) -> Tangents:
        return jnp.stack([self.axis, jnp.cross(normal, self.axis)])


class Sphere(_Round):
    """A sphere of the given `radius` (m) about `origin` (m), touched from `side`: "inside" (a bowl)
    or "outside".

    `velocity` (m/s): of its material point at the origin; `angular_velocity` in rad/s. All vectors are in the
    inertial frame. Raises ValueError for a radius that is not positive or an unknown side.
    """

    def __init__(self, radius, *, side: str, **motion: Unpack[RigidMotion]):
        """Make a sphere of `radius` (m), touched from its `side`; `motion`: its origin and motion."""
        self._is("a sphere", radius, side, motion)

    def arm_to(self, point: Vector) -> Vector3:
        """Return the vector from the sphere's centre to the `point` (m, inertial frame)."""
        return as_real(point) - self.origin

    def _tangents(self, normal: Vector3) -> Tangents:
        return tangents_of(normal)


class Surface(_Ground):
    """The smooth surface `f(x, y, z) = 0`; f is positive on the side of the bodies.

    `f`: a function of three numbers (m, inertial frame) that returns one. JAX must be able to differentiate
    it twice, and its gradient must not vanish at points of contact. It may depend on traced numbers, as for a
    moving surface: `lambda x, y, z: z - rise * pose.t`. `velocity` (m/s) of the material point at `origin`
    (m) and `angular_velocity` (rad/s): motion of the surface, in the inertial frame. Raises ValueError for an
    `f` that is not callable.
    """

    f: Callable = static()  # (x, y, z) -> number, positive on the side of the bodies

    def __init__(self, f, **motion: Unpack[RigidMotion]):
        """Make the surface on which `f(x, y, z)` is zero. `motion`: origin and motion of the ground."""
        self.f = _function(f, "a surface", "lambda x, y, z: z - 0.1 * x**2")
        self._moves("a surface", **motion)

    def value(self, point: Vector) -> Scalar:
        """Return f at a `point` (m, inertial frame)."""
        x, y, z = as_real(point)
        return checked_real(
            self.f(x, y, z),
            "f(x, y, z) of a surface",
            (),
            advice="return one number, positive on the side of the bodies",
        )

    def plane_at(self, point: Vector) -> Plane:
        """Return the tangent plane at a `point` (m, inertial frame) of the surface."""
        point = as_real(point)
        normal = normal_at(self, point)
        return self._tangent(point, normal, tangents_of(normal))


class HeightMap(_Ground):
    """The surface `z = h(x, y)`, with the bodies above it.

    `h`: a function of two numbers (m, inertial frame) that returns one (m), twice differentiable by JAX.
    `velocity` (m/s) of the material point at `origin` (m) and `angular_velocity` (rad/s): motion of the
    surface, in the inertial frame. The first no-slip constraint acts along the projection of x onto the
    surface. Raises ValueError for an `h` that is not callable.
    """

    h: Callable = static()  # (x, y) -> height, m

    def __init__(self, h, **motion: Unpack[RigidMotion]):
        """Make the surface of height `h(x, y)`. `motion`: origin and motion of the ground."""
        self.h = _function(h, "a height map", "lambda x, y: 0.1 * x**2")
        self._moves("a height map", **motion)

    def height_at(self, x: Number, y: Number) -> Scalar:
        """Return h (m) at `x`, `y` (m)."""
        return checked_real(self.h(x, y), "h(x, y) of a height map", (), advice="return one height, m")

    def value(self, point: Vector) -> Scalar:
        """Return `z - h(x, y)` (m) at a `point` (m, inertial frame)."""
        x, y, z = as_real(point)
        return z - self.height_at(x, y)

    def plane_at(self, point: Vector) -> Plane:
        """Return the tangent plane at the surface point above or below a `point` (m, inertial frame)."""
        x, y, _ = as_real(point)
        o, i = jnp.zeros_like(x), jnp.ones_like(x)
        height, along_x = jax.jvp(self.height_at, (x, y), (i, o))
        _, along_y = jax.jvp(self.height_at, (x, y), (o, i))
        first, normal = jnp.stack([i, o, along_x]), jnp.stack([-along_x, -along_y, i])
        first = first / jnp.sqrt(1 + along_x * along_x)
        normal = normal / jnp.sqrt(1 + along_x * along_x + along_y * along_y)
        return self._tangent(jnp.stack([x, y, height]), normal, jnp.stack([first, jnp.cross(normal, first)]))

    def point_at(self, x: Number, y: Number) -> Vector3:
        """Return the point (m, inertial frame) of the surface at `x`, `y` (m)."""
        return jnp.stack([as_real(x), as_real(y), self.height_at(x, y)])


Ground = Plane | Cylinder | Sphere | Surface | HeightMap


def normal_at(ground: Ground, point: Vector3) -> Vector3:
    """Return `grad f/|grad f|` at a point; NaN where the gradient vanishes."""
    gradient = jnp.stack([jax.jvp(ground.value, (point,), (e,))[1] for e in jnp.eye(3, dtype=point.dtype)])
    return gradient / jnp.sqrt(gradient @ gradient)


def tangents_of(n: Vector3) -> Tangents:
    """Return two unit vectors normal to the unit vector n and to each other, with `t1 x t2 = n`: the x and y
    axes after the shortest rotation of z (or -z) to n.

    No field of tangents is continuous on a whole sphere. These tangents, and with them the no-slip
    constraints, jump at n_z = 0; solutions do not. Source: T. Duff et al., J. Computer Graphics Techniques 6
    (2017) 1.
    """
    x, y, z = n
    s = jnp.where(z >= 0, jnp.ones_like(z), -jnp.ones_like(z))
    a = -1 / (s + z)
    return jnp.stack(
        [jnp.stack([1 + s * x * x * a, s * x * y * a, -s * x]), jnp.stack([x * y * a, s + y * y * a, -y])]
    )


def _turned(tilt) -> Matrix3:
    """Return the rotation matrix of a tilt, an angle (rad) about y or the matrix itself; its columns are the
    rotated axes.
    """
    advice = "give one angle in rad, or a rotation matrix, such as jj.rot_x(0.1)"
    tilt = checked_real(tilt, "tilt of a plane", advice=advice)
    return tilt if tilt.shape == (3, 3) else rot_y(checked_real(tilt, "tilt of a plane", (), advice=advice))


def _tangents_along(n, along) -> Tangents:
    along = checked_real(along, "`along` of a plane", (3,), advice="give a vector not normal to the plane")
    first = along - (n @ along) * n
    if not np.all(known_numbers((first @ first) / (along @ along)) > 1e-8):
        raise ValueError(
            "`along` of a plane is normal to it, expected a direction within it; give another vector"
        )
    first = first / jnp.sqrt(first @ first)
    return jnp.stack([first, jnp.cross(n, first)])


def _function(f, what: str, example: str) -> Callable:
    if not callable(f):
        raise ValueError(
            f"{what} is given by {described(f)}, expected a function of numbers; write {example}"
        )
    return f
