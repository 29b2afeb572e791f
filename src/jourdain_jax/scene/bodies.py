"""Particles and rigid bodies: mass, inertia and pose as functions of the coordinates. Velocities follow by
automatic differentiation.

A body states its pose in the inertial frame; `outline` is a line in the body frame, for drawing only.

Shapes of bodies, such as `Box`, are in the body frame and for pictures only. A scene returns them from
`visuals(self, pose)`. Bodies without shapes are drawn from their `outline`, the
shapes of their contacts, or their inertia.
"""

import os
import re
from typing import Any, TypedDict, Unpack

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.calculus.reals import (
    Indices,
    Matrix3,
    Scalar,
    Vector,
    Vector3,
    all_finite,
    checked_known,
    checked_positive,
    checked_real,
    described,
    real_type,
    static,
)
from jourdain_jax.scene.contact.grounds import tangents_of

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
        mass: Any,
        radius: Any,
        *,
        axis: str,
        position: Any,
        orientation: Any,
        axial: Any = None,
        diametral: Any = None,
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
    def ball(mass: Any, radius: Any, *, position: Any, orientation: Any, factor: Any = 0.4) -> "RigidBody":
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
    def rod(mass: Any, length: Any, *, axis: str, position: Any, orientation: Any) -> "RigidBody":
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
    def box(mass: Any, sides: Any, *, position: Any, orientation: Any) -> "RigidBody":
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
    if str(axis) not in _AXES:
        raise ValueError(f"body axis `{axis}` is unknown; expected one of `x`, `y`, `z`")
    return _AXES[axis]


class Faces:
    """Corners (points, 3) and faces of a mesh, as concrete numbers; meshes are compared by identity."""

    def __init__(self, corners: np.ndarray, polygons: tuple[Indices, ...]):
        self.corners, self.polygons = corners, polygons


class Look(TypedDict, total=False):
    """Place and colour of a shape; see `Visual`."""

    at: Vector  # m
    turn: Matrix3
    colour: str | None
    opacity: float


class Visual(eqx.Module):
    """A shape in the frame of a body, for pictures only. Its constructors are `jj.Visual.ball(0.1)`, `wheel`,
    `box`, `cylinder`, `capsule` and others.

    All constructors take

    - `at`: (3,) in m, the middle of the shape in the body frame (default: the mass centre).
    - `turn`: (3, 3), rotation from the axes of the shape to the body axes (default: the identity).
    - `colour`: "#rrggbb" (default: the body's, from a palette). `opacity`: 0 to 1.

    Under the name `""` in `visuals`, shapes are fixed in the inertial frame. Positions, rotations and the
    points of lines may change with the pose; the sizes at the first saved time hold for the whole picture.

    **Examples**

        def visuals(self, pose):  # a method of a scene
            hub, mass = pose["wheel"].position, pose["rider"].position
            return {"rider": jj.Visual.capsule(0.1, 0.5), "": jj.Visual.line(hub, mass)}
    """

    kind: str = static()  # "ellipsoid", "wheel", "box", "cylinder", "capsule", "line" or "mesh"
    # m; semi-axes of an ellipsoid, sides of a box, points of a line, factors of a mesh; of a wheel, cylinder
    # or capsule the radius and the length along z, without the ends of the capsule
    size: Float[Array, "*size"]
    position: Vector3  # m, body frame
    orientation: Matrix3  # own components to body components
    radius: Scalar | None = None  # m, of a line; None: thin
    faces: Faces | None = static(default=None)
    colour: str | None = static(default=None)
    opacity: float = static(default=1.0)

    @staticmethod
    def ball(radius: Any, **look: Unpack[Look]) -> "Visual":
        """Return a ball of the given `radius` (m). Its octants alternate in colour, which shows rotation.
        `look`: see `Visual`.
        """
        return shape("ellipsoid", _lengths(radius, "radius of a ball", ()) * jnp.ones(3), **look)

    @staticmethod
    def ellipsoid(semi_axes: Any, **look: Unpack[Look]) -> "Visual":
        """Return an ellipsoid with three `semi_axes` (m) along its axes; `look`: see `Visual`."""
        return shape("ellipsoid", _lengths(semi_axes, "semi-axes of an ellipsoid", (3,)), **look)

    @staticmethod
    def wheel(radius: Any, width: Any = None, *, axis: str = "y", **look: Unpack[Look]) -> "Visual":
        """Return a wheel or disc of `radius` and `width` (m; default: a sixth of the radius) about `axis`
        ("x", "y" or "z"). Its quarters alternate in colour. `look`: see `Visual`.
        """
        radius = _lengths(radius, "radius of a wheel", ())
        width = radius / 6 if width is None else _lengths(width, "width of a wheel", ())
        return _about(axis, "wheel", [radius, width], **look)

    @staticmethod
    def box(sides: Any, **look: Unpack[Look]) -> "Visual":
        """Return a box with three `sides` (m) along its axes; `look`: see `Visual`."""
        return shape("box", _lengths(sides, "sides of a box", (3,)), **look)

    @staticmethod
    def cylinder(radius: Any, length: Any, *, axis: str = "z", **look: Unpack[Look]) -> "Visual":
        """Return a cylinder of `radius` and `length` (m) along `axis` ("x", "y" or "z"); `look`:
        see `Visual`.
        """
        radius = _lengths(radius, "radius of a cylinder", ())
        return _about(axis, "cylinder", [radius, _lengths(length, "length of a cylinder", ())], **look)

    @staticmethod
    def capsule(radius: Any, length: Any, *, axis: str = "z", **look: Unpack[Look]) -> "Visual":
        """Return a cylinder of `radius` and `length` (m) along `axis` with a half ball at each end; `look`:
        see `Visual`.
        """
        radius = _lengths(radius, "radius of a capsule", ())
        return _about(axis, "capsule", [radius, _lengths(length, "length of a capsule", ())], **look)

    @staticmethod
    def line(*points: Any, radius: Any = None, colour: Any = None, opacity: float = 1.0) -> "Visual":
        """Return a bar of round section from each of the `points` (m, body frame) to the next.

        `radius` in m (default: thin); `colour`, `opacity`: see `Visual`.
        """
        if len(points) < 2:
            raise ValueError(
                f"`jj.Visual.line` has {len(points)} points, expected at least two; write "
                "jj.Visual.line(a, b)"
            )
        what, advice = "point of a line to be drawn", "give three components, m"
        stacked = jnp.stack([checked_real(p, what, (3,), advice=advice).astype(float) for p in points])
        radius = None if radius is None else _lengths(radius, "radius of a line", ())
        return _checked(Visual("line", stacked, jnp.zeros(3), jnp.eye(3), radius, None, colour, opacity))

    @staticmethod
    def coil(
        a: Any, b: Any, radius: Any, *, turns: int = 8, colour: Any = None, opacity: float = 1.0
    ) -> "Visual":
        """Return a spring between two points `a`, `b` (m, body frame): a wire with a number of `turns` and a
        `radius` (m). `colour`, `opacity`: see `Visual`.
        """
        a, b = (
            checked_real(p, "end of a coil", (3,), advice="give three components, m").astype(float)
            for p in (a, b)
        )
        radius, length = _lengths(radius, "radius of a coil", ()), jnp.sqrt(jnp.sum((b - a) ** 2))
        direction = (b - a) / jnp.where(length > 0, length, 1.0)
        along = jnp.where(length > 0, direction, jnp.array([0.0, 0.0, 1.0]))
        share = np.linspace(0.0, 1.0, 12 * turns + 1)[:, None]
        wide = np.clip(np.minimum(share, 1 - share) * 12, 0.0, 1.0)  # straight at both ends
        across = tangents_of(along)
        angle = 2 * np.pi * turns * share
        points = a + share * (b - a) + radius * wide * (np.cos(angle) * across[0] + np.sin(angle) * across[1])
        return _checked(Visual("line", points, jnp.zeros(3), jnp.eye(3), radius / 6, None, colour, opacity))

    @staticmethod
    def mesh(vertices: Any, faces: Any, *, scale: Any = 1.0, **look: Unpack[Look]) -> "Visual":
        """Return a body with flat faces.

        `vertices`: (points, 3) in m; `faces`: for each face a list of vertex indices, anticlockwise seen from
        outside. Both must be concrete numbers. `scale`: one factor or three, which may depend on parameters;
        `look`: see `Visual`.
        """
        advice = "where they depend on parameters or coordinates, use `scale`, `at` and `turn`"
        corners = checked_known(vertices, "`vertices` of a mesh", advice=advice)
        if corners.ndim != 2 or corners.shape[1] != 3 or not all_finite(corners):
            raise ValueError(
                f"vertices of a mesh have shape {corners.shape}, expected (points, 3): finite numbers in m"
            )
        polygons = tuple(tuple(int(i) for i in face) for face in faces)
        right = lambda face: len(face) >= 3 and min(face) >= 0 and max(face) < len(corners)
        if not polygons or not all(map(right, polygons)):
            raise ValueError(
                "faces of a mesh need at least three vertex numbers each, from 0 to "
                f"{len(corners) - 1}, in order"
            )
        factors = jnp.broadcast_to(_lengths(scale, "scale of a mesh"), (3,))
        return shape("mesh", factors, faces=Faces(corners, polygons), **look)

    @staticmethod
    def from_file(path: str | os.PathLike[str], *, scale: Any = 1.0, **look: Unpack[Look]) -> "Visual":
        """Return the mesh in the file `path`, in a format of `trimesh`, such as .stl or .obj.

        `scale`: factor, 0.001 for millimetres; `look`: see `Visual`. Raises ImportError without
        `trimesh` (the extra `robots`), and ValueError for a missing file, an unknown format, or a mesh
        without faces.
        """
        if not os.path.isfile(path):
            raise ValueError(
                f"cannot read a mesh from `{os.fspath(path)}`: there is no such file; relative paths start "
                f"at `{os.getcwd()}`"
            )
        try:
            read = needed("trimesh", "reading a mesh from a file", "robots").load(
                os.fspath(path), force="mesh"
            )
        except (NotImplementedError, ValueError, IndexError, KeyError) as reason:
            raise ValueError(
                f"cannot read a mesh from `{os.fspath(path)}`: {reason}; give a file such as .stl or .obj"
            ) from None
        if not len(read.faces):
            raise ValueError(f"the file `{os.fspath(path)}` has no faces, expected a mesh")
        return Visual.mesh(read.vertices, read.faces, scale=scale, **look)


def _lengths(value, what: str, shape=None) -> Float[Array, "*shape"]:
    return checked_positive(value, what, shape).astype(real_type())


def _about(axis: str, kind: str, sizes, **look: Unpack[Look]) -> Visual:
    """Return a shape whose own z axis lies along `axis`."""
    k = _axis_index(axis)
    cyclic = np.eye(3)[:, [(k + 1) % 3, (k + 2) % 3, k]]
    placed = shape(kind, _stack(sizes), **look)
    return eqx.tree_at(lambda v: v.orientation, placed, placed.orientation @ cyclic)


def shape(
    kind: str, size, *, at=(0.0, 0.0, 0.0), turn=None, colour=None, opacity=1.0, faces: Faces | None = None
) -> Visual:
    """Return a shape of this `kind` and `size`; other arguments: see `Visual`."""
    advice = "give three components in the body frame, m"
    at = checked_real(at, f"place of a {kind}", (3,), advice=advice).astype(real_type())
    turn = jnp.eye(3) if turn is None else turn
    turn = checked_real(turn, f"turn of a {kind}", (3, 3), advice="give a rotation matrix")
    return _checked(Visual(kind, size, at, turn, None, faces, colour, opacity))


def _checked(visual: Visual) -> Visual:
    colour = visual.colour
    known = isinstance(colour, str) and re.fullmatch("#[0-9a-fA-F]{6}", colour)
    if colour is not None and not known:
        raise ValueError(
            f"colour of a {visual.kind} is {described(colour)}, expected six hexadecimal "
            'digits, such as "#1f77b4"'
        )
    if not isinstance(visual.opacity, int | float) or not 0 < visual.opacity <= 1:
        raise ValueError(
            f"opacity of a {visual.kind} is {visual.opacity!r}, expected a number above 0 and at most 1"
        )
    return visual
