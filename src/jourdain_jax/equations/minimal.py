"""Appell's equations in the minimal state (q, y), y the independent speeds, for constraints linear or affine
in the speeds.

    u    = C y + c                     from the constraints, which hold exactly                      (25)-(31)
    udot = C ydot + c'                 from their rates
    C' (M (C ydot + c') + h - Q) = 0   Jourdain's principle for the virtual velocities C dy               (41)

A, C and the partial velocities do not depend on u. They are computed once, at `u = (y, 0)`, for speeds and
accelerations. A has only the requested rows. Without redundant rows A_z is square, and its determinant
changes sign where it is singular. Source: Wang and Pao (2003), sections III and IV.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Speeds
from jourdain_jax.equations.instant import Instant, VelocityLevel, derivatives_in_speeds, rates_along_motion
from jourdain_jax.equations.kinematics import Inertias, inertias_of
from jourdain_jax.equations.reductions import Partition, Reduced, appell, reduced, row_scale, speed_scale
from jourdain_jax.equations.virtual_power import equations_of, mass_matrix
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene


class MinimalKinematics(eqx.Module):
    """All speeds, from the independent ones, and the intermediate results."""

    u: Speeds
    partial: VelocityLevel  # beta, gamma, A
    weights: Inertias
    split: Partition  # of the scaled rows d A c
    c: Speeds
    d: Float[Array, "rows"]
    rows: tuple[int, ...] = eqx.field(static=True)  # indices among the scene's rows


def minimal_kinematics(
    scene: Scene, independent: tuple[int, ...], rows: tuple[int, ...], t, q, y, inputs=None
) -> MinimalKinematics:
    """Return `u = C y + c`, from the constraint rows with the indices `rows`."""
    at_rest = jnp.zeros(len(scene.speed_names), q.dtype).at[jnp.array(independent, jnp.int32)].set(y)
    partial, value, motion = derivatives_in_speeds(scene, t, q, at_rest, inputs)
    weights = inertias_of(motion)
    c = speed_scale(mass_matrix(weights.mass, weights.inertia, partial.bodies.linear, partial.bodies.angular))
    A, phi = partial.rows[np.array(rows, int)], value.rows[np.array(rows, int)]
    d = row_scale(A * c)
    split = Partition(d[:, None] * A * c, independent)
    # A (u - at_rest) = -phi(at_rest), with a difference in the dependent speeds only
    return MinimalKinematics(at_rest + c * split.particular(-d * phi), partial, weights, split, c, d, rows)


def accelerations_of(scene: Scene, known: MinimalKinematics, t, q, inputs=None) -> tuple[Motion, Reduced]:
    """Return the motion and the accelerations at the given speeds."""
    value, rate, motion = rates_along_motion(scene, t, q, known.u, inputs)
    equations = equations_of(scene, Instant(motion, known.weights, value, known.partial, rate))
    c = known.c
    # in scaled speeds, where definiteness is independent of units
    M, f = c[:, None] * equations.M * c, c * (equations.Q - equations.h)
    w, pivot, applicable = appell(
        M,
        f,
        known.split.C,
        known.split.particular(-known.d * rate.rows[np.array(known.rows, int)]),
        known.split.pivot(),
    )
    return motion, reduced(c * w, pivot, applicable, equations)
