"""Velocities and constraints of a scene at one instant, with their derivatives with respect to the speeds and
along the motion.

    v, omega, phi              at (t, q, u)
    beta, gamma, A             their derivatives in u; for rows affine in u they do not depend on u
    a_0, alpha_0, drift        their rates at udot = 0

Poses are the costly part of a scene, so all these quantities share one evaluation of the poses.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Number, Numbers, Scalar, as_real
from jourdain_jax.equations.kinematics import (
    Inertias,
    Velocities,
    coordinate_rates,
    inertias_of,
    motion_at,
    velocities_of,
)
from jourdain_jax.equations.rows import ConstraintRows, flatten_rows, names_of_rows, velocity_rows
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.arguments import InputLike, as_coordinates, as_speeds, as_time
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene


class VelocityLevel(eqx.Module):
    """Velocities of the bodies and residuals of the constraints, or a derivative of both."""

    bodies: Velocities
    rows: Float[Array, "rows *directions"]


class Instant(eqx.Module):
    """Kinematic quantities of a scene at (t, q, u) for the equations of motion."""

    motion: Motion
    weights: Inertias
    value: VelocityLevel  # v, omega, phi
    by_speeds: VelocityLevel  # beta, gamma, A
    rate: VelocityLevel  # a_0, alpha_0, drift


def instant_at(scene: Scene, t, q, u, inputs=None) -> Instant:
    """Return the kinematic quantities of a scene at (t, q, u) for the equations of motion."""
    q, u = as_coordinates(scene, q), as_speeds(scene, u)
    by_speeds, _, _ = derivatives_in_speeds(scene, t, q, u, inputs)
    value, rate, motion = rates_along_motion(scene, t, q, u, inputs)
    return Instant(motion, inertias_of(motion), value, by_speeds, rate)


def rows_of(scene: Scene, instant: Instant) -> ConstraintRows:
    """Return the constraint rows of an instant."""
    return ConstraintRows(instant.value.rows, instant.by_speeds.rows, instant.rate.rows, names_of_rows(scene))


@eager_if_concrete
def constraint_rows(
    scene: Scene, t: Number, q: Numbers, u: Numbers, inputs: InputLike = None
) -> ConstraintRows:
    """Return phi, `A = d phi/du`, the drift and the names of all constraint rows: `A udot = -drift`, where
    the drift is `d phi/dt` at `udot = 0`; eqs. (5)-(9), (25).

    `inputs`: values of the scene's inputs (default: zero). Geometric constraints enter by their rate and come
    first.
    """
    return rows_of(scene, instant_at(scene, t, q, u, inputs))


def derivatives_in_speeds(scene: Scene, t, q, u, inputs=None) -> tuple[VelocityLevel, VelocityLevel, Motion]:
    """Return the derivatives with respect to the speeds (`beta`, `gamma` and `A`), the velocities and
    residuals, and the motion.
    """
    t, q, u = as_time(t), as_real(q), as_real(u)

    def level(u):
        value, motion = _velocity_level(scene, t, q, u, inputs)
        return value, (value, motion)

    by_speeds, (value, motion) = jax.jacfwd(level, has_aux=True)(u)
    return by_speeds, value, motion


def rates_along_motion(scene: Scene, t, q, u, inputs=None) -> tuple[VelocityLevel, VelocityLevel, Motion]:
    """Return velocities and residuals, their derivatives along `(1, qdot, 0)` (`a_0`, `alpha_0` and the
    drift), and the motion.
    """
    t, q, u = as_time(t), as_real(q), as_real(u)
    qdot = coordinate_rates(scene, t, q, u)
    return jax.jvp(
        lambda t, q: _velocity_level(scene, t, q, u, inputs), (t, q), (jnp.ones_like(t), qdot), has_aux=True
    )


@eqx.filter_jit  # traced once for all derivatives
def _velocity_level(scene: Scene, t: Scalar, q, u, inputs) -> tuple[VelocityLevel, Motion]:
    motion = motion_at(scene, t, q, u, inputs)
    return VelocityLevel(velocities_of(motion), flatten_rows(velocity_rows(scene, motion), q.dtype)), motion
