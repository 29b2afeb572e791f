"""Rotation matrices, quaternions and the cross-product matrix.

A rotation matrix `R` maps body components to space components, `r_space = R r_body`. Its body angular
velocity is `omega_body = vee(R' Rdot)`, its space angular velocity `omega = vee(Rdot R') = R omega_body`.
Quaternions are `(w, x, y, z)`.

Column k of `R` is body axis k in the inertial frame. With x ahead, y to the left and z up, positive angles
act as follows: `rot_z` turns to the left, `rot_x` leans to the right, `rot_y` pitches the nose down and rolls
a wheel ahead.

`vec` makes vectors of three numbers.
"""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from jourdain_jax.calculus.reals import Entries, Matrix3, Number, Scalar, Vector, Vector3, checked_real, holds

Attitude = Float[Array, "4"]


def onto_axis(direction: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the shortest rotation from the z axis to a direction k, half a turn about x for k = -z.

    R = 1 + [v]x + (1 - c)/s^2 [v]x [v]x      v = z x k,  s = |v|,  c = z.k
    """
    k = direction / np.linalg.norm(direction)
    v = np.cross([0.0, 0.0, 1.0], k)
    if k[2] < 0 and np.linalg.norm(v) < 1e-10:
        return np.diag([1.0, -1.0, -1.0])
    factor, turned = 1 / (1 + k[2]) if k[2] > 0 else (1 - k[2]) / (v @ v), np.cross(np.eye(3), v)
    return np.eye(3) + turned + factor * turned @ turned


def _angle(angle: Number) -> Scalar:
    return checked_real(
        angle, "angle of a rotation", (), advice="pass one angle in rad; use `jax.vmap` for many"
    )


def _turned(angle: Number, rows: Callable) -> Matrix3:
    """Return the rotation matrix for an `angle` in rad. `rows`: function from (cosine, sine, zero, one) to
    the rows of the matrix.
    """
    angle = _angle(angle)
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack(row) for row in rows(c, s, jnp.zeros_like(c), jnp.ones_like(c))])


def rot_x(angle: Number) -> Matrix3:
    """Return the rotation matrix (3, 3), body to space, for a rotation by `angle` (rad) about the x axis.

    With x ahead and z up a positive angle leans to the right. Column k, `R[:, k]`, is body axis k in the
    inertial frame.
    """
    return _turned(angle, lambda c, s, o, i: [[i, o, o], [o, c, -s], [o, s, c]])


def rot_y(angle: Number) -> Matrix3:
    """Return the rotation matrix (3, 3), body to space, for a rotation by `angle` (rad) about the y axis.

    With x ahead and z up a positive angle pitches the nose down, and rolls a wheel ahead. Column k,
    `R[:, k]`, is body axis k in the inertial frame.
    """
    return _turned(angle, lambda c, s, o, i: [[c, o, s], [o, i, o], [-s, o, c]])


def rot_z(angle: Number) -> Matrix3:
    """Return the rotation matrix (3, 3), body to space, for a rotation by `angle` (rad) about the z axis.

    With z up a positive angle turns to the left. Column k, `R[:, k]`, is body axis k in the inertial frame.
    """
    return _turned(angle, lambda c, s, o, i: [[c, -s, o], [s, c, o], [o, o, i]])


def skew(v: Vector3) -> Matrix3:
    """Return the matrix of the cross product, `skew(v) w = v x w`."""
    x, y, z = v[0], v[1], v[2]
    o = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])


def vee(S: Matrix3) -> Vector3:
    """Return the vector of the antisymmetric part of `S`, the inverse of `skew`."""
    return 0.5 * jnp.stack([S[2, 1] - S[1, 2], S[0, 2] - S[2, 0], S[1, 0] - S[0, 1]])


def quaternion_to_matrix(quaternion: Real[Entries, "4"] | Sequence[Number]) -> Matrix3:
    """Return the rotation matrix (3, 3), body to space, of a nonzero `quaternion` (w, x, y, z). Its norm does
    not matter.

    Raises ValueError for a concrete zero quaternion; a traced one gives NaN.
    """
    quaternion = checked_real(quaternion, "quaternion", (4,), advice="pass (w, x, y, z)")
    if not holds(np.any, quaternion):
        raise ValueError(
            "quaternion is (0, 0, 0, 0), which is not an attitude; pass (w, x, y, z) of nonzero "
            "length, such as (1, 0, 0, 0) for no rotation"
        )
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    # R = 1 + 2 (w [v]x + [v]x^2) / (w^2 + v.v), independent of the norm, so a drifting norm never scales an
    # inertia.
    two = 2.0 / (w * w + x * x + y * y + z * z)
    return jnp.stack(
        [
            jnp.stack([1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)]),
            jnp.stack([two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)]),
            jnp.stack([two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)]),
        ]
    )


def matrices_to_quaternions(rotations: Float[np.ndarray, "matrices 3 3"]) -> Float[np.ndarray, "matrices 4"]:
    """Return unit quaternions (w, x, y, z), with either sign, of concrete rotation matrices, body to space.

    The diagonal gives the largest of `4 w^2, 4 x^2, 4 y^2, 4 z^2`. The other components are sums and
    differences of entries, divided by the root of that largest number (Shepperd 1978).
    """
    R = np.asarray(rotations, float)
    trace = np.trace(R, axis1=1, axis2=2)
    fours = np.stack([1 + trace, *(1 + 2 * R[:, k, k] - trace for k in range(3))], axis=1)
    found = np.empty((len(R), 4))
    for n, best in enumerate(fours.argmax(axis=1)):
        skew = [R[n, 2, 1] - R[n, 1, 2], R[n, 0, 2] - R[n, 2, 0], R[n, 1, 0] - R[n, 0, 1]]
        found[n] = [0.0, *skew] if best == 0 else [skew[best - 1], *(R[n, best - 1] + R[n, :, best - 1])]
        found[n, best] = fours[n, best]
        found[n] /= np.linalg.norm(found[n])
    return found


def quaternion_rate(quaternion: Attitude, omega_body: Vector3) -> Attitude:
    """Return `d quaternion / dt = 1/2 quaternion (0, omega_body)` for the body angular velocity (rad/s)."""
    return 0.5 * quaternion_product(quaternion, jnp.concatenate([jnp.zeros_like(omega_body[:1]), omega_body]))


def quaternion_product(p: Attitude, q: Attitude) -> Attitude:
    """Return Hamilton's product of two quaternions `(w, x, y, z)`."""
    pw, px, py, pz = p[0], p[1], p[2], p[3]
    qw, qx, qy, qz = q[0], q[1], q[2], q[3]
    return jnp.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ]
    )


def quaternion_from_axis_angle(axis: Vector, angle: Number) -> Attitude:
    """Return the quaternion (w, x, y, z) = `(cos(angle/2), sin(angle/2) axis)`, a rotation by `angle` (rad)
    about the unit vector `axis`.
    """
    half = _angle(angle) / 2
    axis = checked_real(axis, "axis of a quaternion", (3,), advice="pass a unit vector")
    return jnp.hstack([jnp.cos(half), jnp.sin(half) * axis])


def vec(x: Number, y: Number, z: Number) -> Float[Array, "*times 3"]:
    """Return the vector (x, y, z) of three numbers, even traced ones: `jj.vec(q.x, q.y, 0)`.

    Arrays of equal shape, such as values along a motion, give a vector for each entry.
    """
    dtype = jnp.result_type(float, x, y, z)
    return jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(part, dtype) for part in (x, y, z))), axis=-1)
