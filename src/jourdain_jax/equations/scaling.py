"""Scaling before rank decisions: speeds by their inertia, constraint rows by their length.

    M^ = c M c,  f^ = c (Q - h),  A^ = d A c,  b^ = -d drift,   udot = c w
    c_i = M_ii^(-1/2),   d_s = 1/max(|A_s c|, l_s)        l_s: typical length of row s (`structure_of`)

A row that vanishes at a configuration has only round-off left; l_s keeps it from being scaled up. The scales
are constant under differentiation, because the accelerations do not depend on them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Speeds
from jourdain_jax.equations.rows import ConstraintRows, UsualRows
from jourdain_jax.equations.virtual_power import UnconstrainedEquations


class ScaledProblem(eqx.Module):
    """`M w + A' mu = f`, `A w = b` in scaled speeds and rows."""

    M: Float[Array, "speeds speeds"]
    f: Speeds
    A: Float[Array, "rows speeds"]
    b: Float[Array, "rows"]
    c: Speeds
    d: Float[Array, "rows"]
    usual: UsualRows | None


def speed_scale(M: Float[Array, "speeds speeds"]) -> Speeds:
    """Return `M_ii^(-1/2)`, and 1 for a speed without inertia."""
    diagonal = jax.lax.stop_gradient(jnp.diagonal(M))
    heavy = diagonal > 0
    return jnp.where(heavy, 1 / jnp.sqrt(jnp.where(heavy, diagonal, 1)), 1)


def row_scale(
    A: Float[Array, "rows speeds"], typical: Float[Array | np.ndarray, "rows"] | None = None
) -> Float[Array, "rows"]:
    """Return the reciprocal length of each row, or of its `typical` length if that is longer; 1 for a zero
    row without a typical length.

    So a row that becomes shorter than its typical length has a length below 1 after scaling. It counts as
    zero once it is mere round-off relative to its typical length.
    """
    length = jnp.sqrt(jnp.sum(jax.lax.stop_gradient(A) ** 2, axis=1))
    if typical is not None:
        length = jnp.maximum(length, jnp.asarray(typical, length.dtype))
    return jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1), 1)


def scaled(equations: UnconstrainedEquations, rows: ConstraintRows) -> ScaledProblem:
    """Return the scaled problem of one state."""
    c = speed_scale(equations.M)
    d = row_scale(rows.A * c, None if rows.usual is None else rows.usual.lengths)
    return ScaledProblem(
        c[:, None] * equations.M * c,
        c * (equations.Q - equations.h),
        d[:, None] * rows.A * c,
        -d * rows.drift,
        c,
        d,
        rows.usual,
    )
