"""The contact point of a convex body and a ground: two points with opposite normals, and the gap between
them.

    x + gap n(x) = P(n(x)),   f(x) = 0       x: point of the ground f = 0,  n: its normal
                                             P(n): lowest point of the body, with n upwards

On a plane n is known. The surface of a ball or a wheel has a constant distance from a core: the ball's
centre, or the circle within the tyre. Near a cylinder or sphere (ball) or near a sphere (wheel), the nearest
point of the core has a closed form. In all other cases Newton's method solves for x and the gap, four
unknowns, with derivatives by the implicit function theorem. If it does not converge, the result is NaN.
Source: P. Wriggers, Computational Contact Mechanics (2006), on closest points.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Matrix3, Scalar, Vector3, tiny_of
from jourdain_jax.calculus.roots import newton_root
from jourdain_jax.scene.contact.grounds import Cylinder, Ground, Plane, Sphere, normal_at


class Ball(eqx.Module):
    """A ball."""

    centre: Vector3  # m, inertial frame
    radius: Scalar  # m

    def lowest(self, n: Vector3) -> Vector3:
        """Return the lowest point if n points upwards: `c - a n` with the centre c and the radius a."""
        return self.centre - self.radius * n


class Wheel(eqx.Module):
    """A wheel with a tyre of circular section (a torus), or a thin disc if the tyre is None."""

    centre: Vector3  # m, inertial frame
    axle: Vector3  # unit vector
    radius: Scalar  # m, outer
    tyre: Scalar | None  # m, of the tyre's section

    @property
    def circle(self) -> Scalar:
        """Radius (m) of the circle of the centres of the tyre's sections."""
        return self.radius if self.tyre is None else self.radius - self.tyre

    def lowest(self, n: Vector3) -> Vector3:
        """Return the lowest point if n points upwards: `c - (R - r) (n - (n.k) k)/|n - (n.k) k| - r n`, with
        the centre c, the axle k, the radius R and the tyre r.
        """
        up = n - (n @ self.axle) * self.axle
        point = self.centre - self.circle * up / jnp.sqrt(up @ up)
        return point if self.tyre is None else point - self.tyre * n


class Ellipsoid(eqx.Module):
    """An ellipsoid."""

    centre: Vector3  # m, inertial frame
    orientation: Matrix3  # columns: its axes
    semi_axes: Vector3  # m

    def lowest(self, n: Vector3) -> Vector3:
        """Return the lowest point if n points upwards: `c - R S n'/sqrt(n'.S n')`, with the centre c, the
        orientation R, `n' = R' n` and the squared semi-axes S.
        """
        local = n @ self.orientation
        weighted = self.semi_axes**2 * local
        return self.centre - self.orientation @ (weighted / jnp.sqrt(local @ weighted))


Shape = Ball | Wheel | Ellipsoid


class Touch(eqx.Module):
    """The point of a body that is nearest to a ground."""

    point: Vector3  # m, inertial frame, of the body
    plane: Plane  # tangent to the ground
    gap: Scalar | None  # m; None: the point's height above the plane


def touch(shape: Shape, ground: Ground) -> Touch:
    """Return the point of the body nearest to the ground, the ground's tangent plane there, and the gap."""
    if isinstance(ground, Plane):
        return Touch(shape.lowest(ground.normal), ground, None)
    if isinstance(shape, Ball) and isinstance(ground, Cylinder | Sphere):
        return _of_core(shape.centre, shape.radius, ground)
    if isinstance(shape, Wheel) and isinstance(ground, Sphere):
        tyre = jnp.zeros_like(shape.radius) if shape.tyre is None else shape.tyre
        return _of_core(_of_circle(shape, ground), tyre, ground)
    return _by_newton(shape, ground)


def _of_circle(wheel: Wheel, sphere: Sphere) -> Vector3:
    """Return the point of the tyre's centre circle nearest to the sphere's surface: for a wheel outside the
    sphere the point nearest to the sphere's centre, for a wheel inside the farthest.
    """
    arm = wheel.centre - sphere.origin
    in_plane = arm - (arm @ wheel.axle) * wheel.axle
    towards = in_plane / jnp.sqrt(in_plane @ in_plane)
    return wheel.centre + wheel.circle * (towards if sphere.side == "inside" else -towards)


def _of_core(core: Vector3, distance: Scalar, ground: Cylinder | Sphere) -> Touch:
    """Return the contact of a body that consists of all points within `distance` (m) of a core point; NaN if
    the body does not fit into a hollow ground.
    """
    if ground.side == "inside":
        distance = jnp.where(distance < ground.radius, distance, jnp.nan)
    plane, arm = ground.plane_at(core), ground.arm_to(core)
    away = jnp.sqrt(arm @ arm)
    gap = ground.radius - distance - away if ground.side == "inside" else away - distance - ground.radius
    return Touch(core - distance * plane.normal, plane, gap)


def _by_newton(shape: Shape, ground: Ground) -> Touch:
    def residual(unknown):
        x, gap = unknown[:3], unknown[3]
        n = normal_at(ground, x)
        return jnp.append(x + gap * n - shape.lowest(n), ground.value(x))

    guess = _guess(jax.lax.stop_gradient(shape), ground)
    size = jnp.maximum(jnp.sqrt(jnp.sum((guess[:3] - shape.centre) ** 2)), tiny_of(guess))  # about the radius
    root = newton_root(residual, guess, jnp.full(4, jax.lax.stop_gradient(size)))
    x, gap = root.x[:3], root.x[3]
    found = root.converged
    plane = ground.plane_at(jnp.where(found, x, jnp.nan))
    return Touch(x + gap * plane.normal, plane, jnp.where(found, gap, jnp.nan))


def _guess(shape: Shape, ground: Ground) -> Float[Array, "4"]:
    """Return a first guess of the contact: the point of the body that faces the ground, the nearby point of
    the surface, and the gap.
    """
    x = point = shape.lowest(normal_at(ground, shape.centre))
    for _ in range(3):  # steps along the gradient
        value, slope = jax.value_and_grad(ground.value)(x)
        x = x - value * slope / (slope @ slope)
    return jax.lax.stop_gradient(jnp.append(x, normal_at(ground, x) @ (point - x)))
