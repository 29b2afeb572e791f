"""Units out of the linear algebra: speeds scaled by their own inertia, rows to unit length, before any rank is decided.

    M^ = c M c,  f^ = c (Q - h),  A^ = d A c,  b^ = -d drift,   udot = c w,   c_i = M_ii^(-1/2),  d_s = 1/|A_s c|

The scales are constants to differentiation: the accelerations do not depend on them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.equations.rows import ConstraintRows
from jourdain_jax.equations.virtual_power import UnconstrainedEquations


class ScaledProblem(eqx.Module):
    """`M w + A' mu = f`, `A w = b` in scaled speeds and rows."""

    M: Float[Array, "speeds speeds"]
    f: Float[Array, "speeds"]
    A: Float[Array, "rows speeds"]
    b: Float[Array, "rows"]
    c: Float[Array, "speeds"]
    d: Float[Array, "rows"]


def speed_scale(M: Float[Array, "speeds speeds"]) -> Float[Array, "speeds"]:
    """`M_ii^(-1/2)`, and 1 for a speed without inertia of its own."""
    diagonal = jax.lax.stop_gradient(jnp.diagonal(M))
    heavy = diagonal > 0
    return jnp.where(heavy, 1 / jnp.sqrt(jnp.where(heavy, diagonal, 1)), 1)


def speed_scales(M: Float[np.ndarray, "states speeds speeds"]) -> Float[np.ndarray, "states speeds"]:
    """The same of numbers at many states, on NumPy."""
    diagonal = np.diagonal(M, axis1=1, axis2=2)
    return np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1)), 1)


def row_scale(A: Float[Array, "rows speeds"]) -> Float[Array, "rows"]:
    """One over the length of each row, and 1 for a row that vanishes."""
    length = jnp.sqrt(jnp.sum(jax.lax.stop_gradient(A) ** 2, axis=1))
    return jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1), 1)


def scaled(equations: UnconstrainedEquations, rows: ConstraintRows) -> ScaledProblem:
    """The scaled problem of one state."""
    c = speed_scale(equations.M)
    d = row_scale(rows.A * c)
    return ScaledProblem(c[:, None] * equations.M * c, c * (equations.Q - equations.h), d[:, None] * rows.A * c, -d * rows.drift, c, d)
