"""Rolling contacts without slip, of balls, ellipsoids, discs and wheels, on planes, cylinders, spheres,
surfaces and height maps.

A contact has two velocity constraints (no slip along the two tangents of the ground). With `height="row"` it
also has one geometric constraint (zero gap), whose multiplier is the normal force. With
`height="coordinates"` the coordinates keep the contact point on the ground, and the normal force follows from
Newton's equations (`dynamics/accelerations.py`). Spin about the normal is free.
"""

from collections.abc import Callable, Iterable
from typing import Any, TypedDict, Unpack, get_args

import equinox as eqx
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Parameter,
    Scalar,
    Vector,
    Vector3,
    check_kind,
    checked_positive,
    checked_real,
    described,
)
from jourdain_jax.scene.bodies import RigidBody, _axis_index
from jourdain_jax.scene.contact.contact_points import Ball, Ellipsoid, Shape, Wheel, touch
from jourdain_jax.scene.contact.grounds import Ground, Plane
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.motion_state import BodyPose, Motion

_HEIGHTS = ("coordinates", "row")
IMPACTS = ("moreau", "newton", "poisson", "energetic")


class Coulomb(eqx.Module):
    """Coulomb's law of friction: the coefficient `sliding` while a contact slips, and `static` >= `sliding`
    while it sticks (default: equal).
    """

    sliding: Scalar
    static: Scalar

    def __init__(self, sliding: Any, static: Any = None):
        self.sliding = checked_real(sliding, "coefficient of friction", ())
        static = self.sliding if static is None else static
        self.static = checked_real(static, "coefficient of static friction", ())


class Slipping(TypedDict, total=False):
    """Options of contacts that slip, fly and strike."""

    friction: Parameter | Coulomb | None
    restitution: Parameter
    impact: str


class Contact(eqx.Module):
    """A point contact of a body that rolls on the ground without slip. Pass its `point`, or let
    `ball_contact` and similar functions compute it.

    - `body`: `pose["name"]`, or its name. `point` (m, inertial frame): the body's point of contact.
    - `plane`: a `jj.Plane`, tangent to the ground at the point (default: `ground.plane_at(point)`, or the
      resting plane z = 0 without a ground).
    - `ground`: a `jj.Plane`, `Cylinder`, `Sphere`, `Surface` or `HeightMap`, shown in pictures.
    - `height`: "coordinates" if the coordinates keep the point on the ground, "row" for a
      geometric constraint.
    - `carried`: names of the bodies that this contact supports, alone or with other contacts (default: all
      bodies of the scene). With `height="coordinates"` they determine the normal force.
    - `distance` (m): the gap (default: the point's height above the plane).
    - `shape`: for pictures, set by `ball_contact` and similar functions; the scene's `visuals` override it.
    - `friction`, `restitution`, `impact`: as in `ball_contact`.

    Raises ValueError for an unknown height, or an argument of another kind or shape.
    """

    body: str = eqx.field(static=True)
    point: Vector3  # m, inertial frame
    plane: Plane
    height: str = eqx.field(static=True)  # "coordinates" or "row"
    carried: Labels | None = eqx.field(static=True)  # supported bodies; None: all of them
    distance: Scalar | None  # m; None: the point's height above the plane
    shape: Shape | None  # of the rolling body, for pictures
    ground: Ground | None  # for pictures; None: the plane
    friction: Coulomb | None  # None: it never slips
    restitution: Scalar | None
    impact: str = eqx.field(static=True)

    def __init__(
        self,
        body,
        point,
        plane=None,
        height="coordinates",
        carried=None,
        distance=None,
        *,
        shape=None,
        ground=None,
        **slips: Unpack[Slipping],
    ):
        """Make a contact of the `body` at its `point` with the tangent `plane` of a ground."""
        check_kind(body, BodyPose | str, "the body of a contact", 'the pose of a body; write pose["name"]')
        self.body = body if isinstance(body, str) else body.name
        if plane is not None and not isinstance(plane, Plane):
            advice = "; write ground=..." if isinstance(plane, get_args(Ground)) else ""
            raise ValueError(
                f"`plane` of the contact of `{self.body}` is {described(plane)}, expected a "
                f"`jj.Plane(...)`, or None for the resting plane z = 0{advice}"
            )
        if ground is not None:
            _checked_ground(ground, self.body)
        if shape is not None and not isinstance(shape, get_args(Shape)):
            advice = "omit it, and state the body's look in `visuals`"
            raise ValueError(
                f"`shape` of the contact of `{self.body}` is {described(shape)}, expected a shape set by "
                f"`ball_contact` or a similar function; {advice}"
            )
        advice = "give three components in the inertial frame, m"
        self.point = checked_real(point, f"point of the contact of `{self.body}`", (3,), advice=advice)
        if plane is None:
            plane = Plane() if ground is None else ground.plane_at(self.point)
        self.plane = plane
        self.height = _checked_height(height)
        self.carried = _checked_carried(carried, self.body)
        if distance is not None:
            distance = checked_real(distance, f"distance of the contact of `{self.body}`", ())
        self.distance = distance
        self.shape, self.ground = shape, ground
        self.friction, self.restitution, self.impact = _slipping(self.body, height, **slips)

    def gap(self) -> Scalar:
        """Return the signed distance of the contact point from the ground, m."""
        return self.plane.height_of(self.point) if self.distance is None else self.distance

    def slip(self, motion: Motion) -> Float[Array, "2"]:
        """Return the velocity (m/s) of the body relative to the ground at the contact point, in a `motion`,
        along both tangents of the ground.
        """
        v, ground = motion[self.body].velocity_at(self.point), self.plane.velocity_at(self.point)
        return self.plane.tangents @ (v - ground)

    def lean(self) -> Scalar | None:
        """Return `1 - (n.k)^2` of a disc or wheel with axle k, zero if it lies flat; None for
        other shapes.
        """
        return 1 - (self.plane.normal @ self.shape.axle) ** 2 if isinstance(self.shape, Wheel) else None


class Rolling(Slipping, total=False):
    """Options of all rolling contacts."""

    centre: Vector | None  # m, body frame, of the rolling shape
    ground: Ground | None
    height: str
    carried: Labels | None


def ball_contact(body: BodyPose, radius: Any, **options: Unpack[Rolling]) -> Contact:
    """Return the rolling contact of a ball with a ground, without slip. The contact point is `c - a n`, with
    the ground's normal n.

    - `body`: `pose["name"]`; `radius` a in m.

    The `options` of all rolling contacts:

    - `centre`: c (3,), the centre of the rolling shape in m, body frame (default: the mass centre).
    - `ground`: `jj.Plane`, `Cylinder`, `Sphere`, `Surface` or `HeightMap` (default: z = 0 at rest).
    - `height`: "coordinates" if the coordinates keep the body on the ground, "row" for a
      geometric constraint.
    - `carried`: names of the bodies that this contact supports, alone or with other contacts (default: all
      bodies of the scene). With `height="coordinates"` they determine the normal force.
    - `friction`: Coulomb's coefficient, or a `jj.Coulomb(sliding, static)`. The contact then flies, rolls or
      slips (`motion.phase`), and needs `height="row"`. None (default): it never slips.
    - `restitution`: the coefficient e of impacts, from 0 (default) to 1.
    - `impact`: the law of impacts, for normal velocities w_n before and w_n+ after. "moreau" (default): w_n+
      = -e w_n, and Coulomb's law for the slip afterwards. The other laws integrate over the normal impulse,
      with friction against the instantaneous slip. They differ in the end of the integral. "newton": w_n+ =
      -e w_n. "poisson": the impulse of restitution is e times the impulse of compression. "energetic": its
      work is `-e^2` times the work of compression. These laws need a ball, or slip of constant direction, as
      in plane motion; otherwise a result code reports the failure.

    The contact has two velocity constraints (m/s), along the ground's tangents. Raises ValueError for an
    unknown height, for a length that is not positive, and, when the scene is built, for a ball that is too
    large for its cylinder or sphere.
    """
    return rolling(body, lambda centre: Ball(centre, _radius(body, radius)), **options)


def ellipsoid_contact(body: BodyPose, semi_axes: Any, **options: Unpack[Rolling]) -> Contact:
    """Return the rolling contact of an ellipsoid with a ground, without slip.

    The contact point is `centre - R S n'/sqrt(n'.S n')` with the orientation R of the body, the ground's
    normal n, `n' = R' n` and `S = diag(a^2, b^2, c^2)`. Except on planes, Newton's method finds it.

    - `body`: `pose["name"]`; `semi_axes` (a, b, c) in m, along the axes of its body frame. `options`: as in
      `ball_contact`.

    The contact has two velocity constraints (m/s), along the ground's tangents. Raises ValueError for an
    unknown height.
    """

    def ellipsoid(centre) -> Ellipsoid:
        lengths = checked_positive(
            semi_axes, f"semi-axes of the contact of `{body.name}`", (3,), advice="give three lengths, m"
        )
        return Ellipsoid(centre, body.orientation, lengths)

    return rolling(body, ellipsoid, **options)


def disc_contact(body: BodyPose, radius: Any, *, axis: str = "y", **options: Unpack[Rolling]) -> Contact:
    """Return the rolling contact of the edge of a thin disc with a ground, without slip.

    The contact is the lowest point of the circle, `c - a (n - (n.k) k)/|n - (n.k) k|`, with the centre c, the
    ground's normal n and the disc's axis k. A disc that lies flat has no such point. On a plane or a sphere
    the point has a closed form.

    - `body`: `pose["name"]`; `radius` a in m; `axis`: the body axis k, "x", "y" or "z". `options`: as in
      `ball_contact`.

    The contact has two velocity constraints (m/s), along the ground's tangents. Raises ValueError for an
    unknown axis or height.
    """
    return rolling(
        body,
        lambda centre: Wheel(centre, body.orientation[:, _axis_index(axis)], _radius(body, radius), None),
        **options,
    )


def wheel_contact(
    body: BodyPose, radius: Any, tyre: Any, *, axis: str = "y", **options: Unpack[Rolling]
) -> Contact:
    """Return the rolling contact of a wheel with a ground, without slip. The wheel's tyre has a circular
    section, so its surface is a torus.

    The contact is the wheel's outermost point along `-n`: `c - (R - r) (n - (n.k) k)/|n - (n.k) k| - r n`,
    with the centre c, the ground's normal n and the axle k. R is the wheel's outer radius, R - r the radius
    of the centre circle of the tyre; r = 0 makes a `disc_contact`. A wheel that lies flat has no such point.
    On a plane or a sphere the point has a closed form.

    - `body`: `pose["name"]`; `radius` R and `tyre` r in m, `0 <= r < R`; `axis`: the body axis k, "x", "y" or
      "z". `options`: as in `ball_contact`.

    The contact has two velocity constraints (m/s), along the ground's tangents. Raises ValueError for an
    unknown axis or height.
    """
    tyre = checked_real(tyre, "tyre of a wheel's contact", ())
    return rolling(
        body,
        lambda centre: Wheel(centre, body.orientation[:, _axis_index(axis)], _radius(body, radius), tyre),
        **options,
    )


def _radius(body: BodyPose, radius) -> Scalar:
    return checked_positive(radius, f"radius of the contact of `{body.name}`")


def rolling(
    body: BodyPose,
    shape: Callable[[Array], Shape],
    *,
    centre=None,
    ground: Ground | None = None,
    height="coordinates",
    carried=None,
    **slips: Unpack[Slipping],
) -> Contact:
    """Return the contact of a rolling body. `shape`: function from the centre (m, inertial frame) to the
    shape. Other arguments: as in `ball_contact`.
    """
    _checked_height(height)
    check_kind(body, BodyPose, "the body of a contact", 'the pose of a body; write pose["name"]')
    if not isinstance(body.body, RigidBody):
        raise ValueError(
            f"body `{body.name}` of a contact is a particle, which cannot roll; make it a `jj.RigidBody`"
        )
    ground, at = Plane() if ground is None else _checked_ground(ground, body.name), body.position
    if centre is not None:
        advice = "give three components in its body frame, m"
        at = body.place(checked_real(centre, f"centre of the contact of `{body.name}`", (3,), advice=advice))
    rolls = shape(at)
    found = touch(rolls, ground)
    return Contact(
        body, found.point, found.plane, height, carried, found.gap, shape=rolls, ground=ground, **slips
    )


def _checked_ground(given, body: str) -> Ground:
    if not isinstance(given, get_args(Ground)):
        known = "`jj.Plane(...)`, `jj.Cylinder`, `jj.Sphere`, `jj.Surface` or `jj.HeightMap`"
        raise ValueError(
            f"`ground` of the contact of `{body}` is {described(given)}, expected a {known}, or "
            "None for the resting plane z = 0"
        )
    return given


def _slipping(
    body: str, height: str, friction=None, restitution=0.0, impact="moreau"
) -> tuple[Coulomb | None, Scalar | None, str]:
    if impact not in IMPACTS:
        raise ValueError(
            f"`impact` of the contact of `{body}` is {described(impact)}, expected one of "
            f"{', '.join(IMPACTS)}"
        )
    if friction is None:
        return None, None, impact
    if height != "row":
        raise ValueError(
            f'a contact with friction may lift off, but with height="coordinates" `{body}` cannot leave the '
            'ground; give the body a coordinate for its height, and write height="row"'
        )
    known = isinstance(friction, Coulomb)
    law = friction if known else Coulomb(checked_real(friction, f"friction of the contact of `{body}`", ()))
    return law, checked_real(restitution, f"restitution of the contact of `{body}`", ()), impact


def _checked_height(height: str) -> str:
    if height not in _HEIGHTS:
        raise ValueError(
            f"contact height `{height}` is unknown; expected `coordinates` (they keep the contact point on "
            "the ground) or `row` (a geometric constraint keeps it there)"
        )
    return height


def _checked_carried(carried, body: str) -> Labels | None:
    if carried is None:
        return None
    names = () if isinstance(carried, str) or not isinstance(carried, Iterable) else tuple(carried)
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(
            f"`carried` of the contact of `{body}` is {described(carried)}, expected names of "
            f'bodies; write ("{body}",)'
        )
    return names
