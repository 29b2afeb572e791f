"""Orthonormal bases of the null space of a wide matrix, with a derivative that is right for basis-independent results.

    A Z = 0,   dZ = -A+ dA Z

The rule leaves out the rotation of the basis within the null space (its gauge), which LAPACK chooses as it likes; results that do
not change under Z -> Z R never see it. It is wrong for Z itself: do not let a basis leave the function that uses it.

To keep shapes static where the rank is not known in advance, a basis has as many columns as `A`; the columns that are not in
the null space are zero, and `present` says which are.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.promotion import with_usual_promotion
from jourdain_jax.calculus.pseudo_inverse import numerical_rank, pseudo_inverse


def null_space_svd(A: Float[Array, "rows columns"]) -> Float[Array, "columns columns"]:
    """Null-space basis from the full singular value decomposition; columns of the row space are zero."""
    return _null_space(A, _svd_basis, None)


def null_space_qr(A: Float[Array, "rows columns"], cutoff: float | None = None) -> Float[Array, "columns columns"]:
    """Null-space basis from the column-pivoted QR decomposition of `A'`; columns of the row space are zero.

    Pivots below `cutoff` times the largest count as zero (default: `rank_cutoff`).
    """
    return _null_space(A, _qr_basis, cutoff)


def pivots_qr(A: Float[Array, "rows columns"]) -> Float[Array, "values"]:
    """Magnitudes of the pivots of the column-pivoted QR decomposition of `A'`, largest first, as a diagnostic: no derivative passes through them."""
    if 0 in A.shape:
        return jnp.ones((0,), A.dtype)
    _, R, _ = jax.lax.linalg.qr(jax.lax.stop_gradient(A).T, full_matrices=True, pivoting=True)
    return jnp.abs(jnp.diagonal(R))


def present(Z: Float[Array, "columns columns"]) -> Bool[Array, "columns"]:
    """Which columns of a basis belong to the null space."""
    return jnp.any(jax.lax.stop_gradient(Z) != 0, axis=0)


def _svd_basis(A, cutoff):
    _, sigma, right = jnp.linalg.svd(A, full_matrices=True)
    return right.T, numerical_rank(sigma, cutoff)


def _qr_basis(A, cutoff):
    Q, R, _ = jax.lax.linalg.qr(A.T, full_matrices=True, pivoting=True)
    return Q, numerical_rank(jnp.abs(jnp.diagonal(R)), cutoff)


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def _null_space(A, decomposed, cutoff):
    if A.shape[0] == 0:
        return jnp.eye(A.shape[1], dtype=A.dtype)
    basis, rank = decomposed(A, cutoff)
    return jnp.where(jnp.arange(A.shape[1]) >= rank, basis, 0)


@_null_space.defjvp
@with_usual_promotion
def _null_space_jvp(decomposed, cutoff, primals, tangents):
    (A,), (dA,) = primals, tangents
    Z = _null_space(A, decomposed, cutoff)
    return Z, -pseudo_inverse(A, cutoff) @ (dA @ Z)
