"""The Gibbs function and the Gibbs-Appell equations.

    G = sum m a.a / 2 + alpha.I alpha / 2 + alpha.(omega x I omega),     dG/d(yddot_k) = Q_k     (12)-(17)

G follows from the bodies' accelerations; automatic differentiation gives its Hessian M in udot, and its
gradient h at `udot = 0`. This derivation of the equations of motion is independent of the others. Source:
Wang and Pao (2003), section II.

Appell's equations in the minimal state (q, y), y the independent speeds, for constraints linear or affine
in the speeds.

    u    = C y + c                     from the constraints, which hold exactly                      (25)-(31)
    udot = C ydot + c'                 from their rates
    C' (M (C ydot + c') + h - Q) = 0   Jourdain's principle for the virtual velocities C dy               (41)

A, C and the partial velocities do not depend on u. They are computed once, at `u = (y, 0)`, for speeds and
accelerations. A has only the requested rows. Without redundant rows A_z is square, and its determinant
changes sign where it is singular. Source: Wang and Pao (2003), sections III and IV.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import Number, Numbers, PerRow, Scalar, Speeds
from jourdain_jax.equations.instant import Instant, VelocityLevel, derivatives_in_speeds, rates_along_motion
from jourdain_jax.equations.kinematics import Inertias, bias_accelerations, inertias, inertias_of, velocities
from jourdain_jax.equations.reductions import (
    APPLICABLE_PIVOT,
    Partition,
    Reduced,
    appell,
    reduced,
    row_scale,
    scaled,
    solve_definite,
    speed_scale,
)
from jourdain_jax.equations.rows import ConstraintRows
from jourdain_jax.equations.virtual_power import (
    UnconstrainedEquations,
    equations_of,
    generalized_forces,
    mass_matrix,
)
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.arguments import InputLike, as_coordinates, as_speeds
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene


def gibbs_function(scene: Scene, t: Number, q: Numbers, u: Numbers, udot: Numbers) -> Scalar:
    """Return the Gibbs function `G = sum m a.a/2 + alpha.I alpha/2 + alpha.(omega x I omega)` in kg m^2/s^4,
    up to terms without accelerations; (12)-(14).

    `udot`: accelerations of all speeds; they need not satisfy the constraints.
    """
    q, u, udot = as_coordinates(scene, q), as_speeds(scene, u), as_speeds(scene, udot, "udot")
    velocity, bias = bias_accelerations(scene, t, q, u)
    _, partial = jax.jvp(lambda u: velocities(scene, t, q, u), (u,), (udot,))  # beta udot, gamma udot
    a, alpha, omega = bias.linear + partial.linear, bias.angular + partial.angular, velocity.angular
    weights = inertias(scene, t, q)
    gyroscopic = jnp.cross(omega, jnp.einsum("bij,bj->bi", weights.inertia, omega))
    return (
        0.5 * jnp.sum(weights.mass * jnp.sum(a * a, 1))
        + 0.5 * jnp.einsum("bi,bij,bj->", alpha, weights.inertia, alpha)
        + jnp.sum(alpha * gyroscopic)
    )


@eager_if_concrete
def gibbs_equations(
    scene: Scene, t: Number, q: Numbers, u: Numbers, inputs: InputLike = None
) -> UnconstrainedEquations:
    """Return M, h and Q of `M udot + h = Q` from the Gibbs function: its Hessian, and its gradient at
    `udot = 0`; (12)-(17).

    `inputs`: values of the scene's inputs (default: zero).
    """
    q, u = as_coordinates(scene, q), as_speeds(scene, u)
    h, M = _gradient_and_hessian(lambda a: gibbs_function(scene, t, q, u, a), jnp.zeros_like(u))
    return UnconstrainedEquations(M, h, generalized_forces(scene, t, q, u, inputs))


def _gradient_and_hessian(f, x):
    return jax.grad(f)(x), jax.hessian(f)(x)


class GibbsAppell(eqx.Module):
    """The reduction by the Gibbs-Appell equations `dG/d(yddot_k) = Q_k` (17) in the independent
    accelerations.

    `independent`: indices of the independent speeds. The reduction applies where the constraints determine
    all other speeds from these.
    """

    independent: tuple[int, ...] = eqx.field(static=True)
    name = "Gibbs-Appell"

    def accelerations(
        self, scene: Scene, t, q, u, equations: UnconstrainedEquations, rows: ConstraintRows
    ) -> Reduced:
        """Return accelerations that satisfy the constraint `rows`. Only Q of `equations` is used."""
        problem = scaled(equations, rows)
        split = Partition(problem.A, self.independent)
        C, c, pivot = split.C, split.particular(problem.b), split.pivot()
        gradient, hessian = _gradient_and_hessian(
            lambda yddot: gibbs_function(scene, t, q, u, problem.c * (C @ yddot + c)),
            jnp.zeros(C.shape[1], u.dtype),
        )
        yddot, definite = solve_definite(hessian, C.T @ (problem.c * equations.Q) - gradient)
        return reduced(problem.c * (C @ yddot + c), pivot, definite & (pivot > APPLICABLE_PIVOT), equations)


class MinimalKinematics(eqx.Module):
    """All speeds, from the independent ones, and the intermediate results."""

    u: Speeds
    partial: VelocityLevel  # beta, gamma, A
    weights: Inertias
    split: Partition  # of the scaled rows d A c
    c: Speeds
    d: PerRow
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
