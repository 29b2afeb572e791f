"""Particles and rigid bodies: mass, inertia and pose as functions of the coordinates. Velocities follow by
automatic differentiation.

A body states its pose in the inertial frame; `outline` is a line in the body frame, for drawing only.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Matrix3, Scalar, Vector3, checked_real, real_type, static

_AXES = {"x": 0, "y": 1, "z": 2}


class Particle(eqx.Module):
    """A point mass: `mass` in kg, `position` (3,) in m, inertial frame.

    Raises ValueError for other shapes. Its velocity is the derivative of the position. A mass that depends on
    time or coordinates enters `m a` with its instantaneous value; add the thrust of ejected mass as a load.
    """

    mass: Scalar  # kg
    position: Vector3  # m, inertial frame

    def __init__(self, mass: Any, position: Any):
        self.mass = checked_real(mass, "mass of a particle", ())
        self.position = checked_real(position, "position of a particle", (3,))


class RigidBody(eqx.Module):
    """A rigid body.

    - `mass` in kg; `inertia`: (3, 3), or three principal moments, in kg m^2, about the mass centre, body
      axes.
    - `position` (3,) of the mass centre in m, inertial frame; `orientation` R (3, 3): body components to
      space components. Column k, `R[:, k]`, is body axis k in the inertial frame. Do not take the row
      `R[k]` for an axis: it is a different vector, and no check detects the mistake.
    - `outline`: (points, 3) in m, a line in the body frame, relative to the mass centre; for drawing only
      (default: none). If `solid` is "box", "ellipsoid" or "wheel", the only point is the corner of the
      solid's bounding box.

    Raises ValueError for other shapes. Velocities are derivatives of the pose. A mass or inertia that
    depends on time or coordinates enters `m a` and `I alpha + omega x I omega` with its instantaneous value,
    as if mass that leaves or joins moved with the body. Add a thrust as a load. Use several bodies for a
    skater who draws in the arms.
    """

    mass: Scalar  # kg
    inertia: Matrix3  # kg m^2, about the mass centre, body axes
    position: Vector3  # m, mass centre, inertial frame
    orientation: Matrix3  # body components to space components
    outline: Float[Array, "points 3"]  # m, body frame, relative to the mass centre; for drawing only
    solid: str = static()

    def __init__(
        self, mass: Any, inertia: Any, position: Any, orientation: Any, outline: Any = None, solid: str = ""
    ):
        self.mass = checked_real(mass, "mass of a rigid body", ())
        what, advice = (
            "inertia of a rigid body",
            "give three principal moments or a 3x3 matrix, kg m^2, about the mass centre",
        )
        matrix = checked_real(inertia, what, advice=advice)
        matrix = jnp.diag(matrix) if matrix.shape == (3,) else matrix
        self.inertia = checked_real(matrix, what, (3, 3), advice=advice)
        self.position = checked_real(position, "position of a rigid body", (3,))
        advice = "give a rotation matrix, body to space: jj.rot_z(q.yaw)"
        self.orientation = checked_real(orientation, "orientation of a rigid body", (3, 3), advice=advice)
        outline = jnp.zeros((0, 3)) if outline is None else outline
        self.outline = checked_real(outline, "outline of a rigid body")
        if self.outline.ndim != 2 or self.outline.shape[1] != 3:
            raise ValueError(
                f"outline of a rigid body has shape {self.outline.shape}, expected (points, 3); "
                "give points of a line in its body frame, m"
            )
        self.solid = solid

    @staticmethod
    def thin_disc(
        mass, radius, *, axis: str, position, orientation, axial=None, diametral=None
    ) -> "RigidBody":
        """Return a disc of the given `radius` (m) about the body axis `axis` ("x", "y" or "z").

        The default moments are those of a uniform disc, `C = m a^2/2` (axial) and `A = m a^2/4` (diametral);
        `axial` and `diametral`, in kg m^2, replace them. `mass` in kg; `position` (m, mass centre) and
        `orientation` as in `RigidBody`. Raises ValueError for another axis.
        """
        mass, radius = checked_real(mass, "mass of a disc", ()), checked_real(radius, "radius of a disc", ())
        axial = mass * radius**2 / 2 if axial is None else axial
        diametral = mass * radius**2 / 4 if diametral is None else diametral
        k = _axis_index(axis)
        moments = [diametral] * 3
        moments[k] = axial
        corner = np.where(np.arange(3) == k, 0.1, 1.0)
        return RigidBody(mass, _stack(moments), position, orientation, radius * corner[None], "wheel")

    @staticmethod
    def ball(mass, radius, *, position, orientation, factor=0.4) -> "RigidBody":
        """Return a ball of the given `radius` (m) with central moment of inertia `factor m r^2` (2/5 when
        solid, 2/3 when hollow).

        `mass` in kg; `position` (m, mass centre) and `orientation` as in `RigidBody`.
        """
        mass, radius = checked_real(mass, "mass of a ball", ()), checked_real(radius, "radius of a ball", ())
        advice = "give 2/5 for a solid ball, 2/3 for a shell"
        moments = [checked_real(factor, "factor of a ball", (), advice=advice) * mass * radius**2] * 3
        corner = radius * np.ones((1, 3))
        return RigidBody(mass, _stack(moments), position, orientation, corner, "ellipsoid")

    @staticmethod
    def rod(mass, length, *, axis: str, position, orientation) -> "RigidBody":
        """Return a thin uniform rod of the given `length` l (m) along the body axis `axis` ("x", "y" or "z").
        Its moments about the other axes are `m l^2/12`.

        `mass` in kg; `position` (m, mass centre) and `orientation` as in `RigidBody`. Raises ValueError for
        another axis.
        """
        k = _axis_index(axis)
        mass, length = checked_real(mass, "mass of a rod", ()), checked_real(length, "length of a rod", ())
        moments = [mass * length**2 / 12] * 3
        moments[k] = jnp.zeros_like(jnp.asarray(moments[k]))
        ends = np.zeros((2, 3))
        ends[0, k], ends[1, k] = -0.5, 0.5
        return RigidBody(mass, _stack(moments), position, orientation, length * ends)

    @staticmethod
    def box(mass, sides, *, position, orientation) -> "RigidBody":
        """Return a uniform cuboid with the three `sides` (m) along the body axes.

        `mass` in kg; `position` (m, mass centre) and `orientation` as in `RigidBody`.
        """
        mass = checked_real(mass, "mass of a box", ())
        sides = checked_real(sides, "sides of a box", (3,), advice="give three lengths, m")
        a, b, c = sides[0], sides[1], sides[2]
        moments = _stack([mass * (b**2 + c**2) / 12, mass * (a**2 + c**2) / 12, mass * (a**2 + b**2) / 12])
        return RigidBody(mass, moments, position, orientation, sides[None] / 2, "box")


Body = Particle | RigidBody


def _stack(values) -> Array:
    return jnp.stack([jnp.asarray(v, real_type()) for v in values])


def _axis_index(axis: str) -> int:
    if axis not in _AXES:
        raise ValueError(f"body axis `{axis}` is unknown; expected one of `x`, `y`, `z`")
    return _AXES[axis]
