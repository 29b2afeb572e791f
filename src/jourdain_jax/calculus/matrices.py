"""Truncated pseudo-inverse, and orthonormal null-space bases of wide matrices, with exact derivatives at
constant rank.

    dA+ = -A+ dA A+  +  A+ A+' dA' (1 - A A+)  +  (1 - A+ A) dA' A+' A+
    A Z = 0,   dZ = -A+ dA Z

The formula of A+ is from G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10 (1973), eq. (4.12).
Differentiating the factorisation would divide by differences of singular values, which are zero for the
orthonormal rows of rolling and skating.

The formula of the basis Z omits its rotation within the null space, which LAPACK chooses arbitrarily. The
derivative of Z itself is therefore wrong, but derivatives of results that are invariant under rotations Z ->
Z R are right. Return only such results from a function that uses a basis.

For static shapes, a basis has as many columns as `A`. Columns outside the null space are zero, and `present`
identifies the others.
"""

from functools import partial

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.compilation import with_usual_promotion
from jourdain_jax.calculus.reals import Count, rank_cutoff


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def pseudo_inverse(
    A: Float[Array, "rows columns"], cutoff: float | None = None
) -> Float[Array, "columns rows"]:
    """Return the Moore-Penrose inverse of `A`, differentiable to any order in both modes where the rank is
    constant. Singular values below `cutoff` times the largest count as zero.
    """
    if 0 in A.shape:
        return jnp.zeros(A.shape[::-1], A.dtype)
    cutoff = rank_cutoff(A.dtype) if cutoff is None else cutoff
    wide = A.shape[0] < A.shape[1]
    Q, R = jnp.linalg.qr(A.T if wide else A)
    P = jax.scipy.linalg.solve_triangular(R, Q.T)
    P = P.T if wide else P
    # the product of the norms is at least the ratio of the largest singular value to the smallest
    regular = jnp.linalg.norm(A) * jnp.linalg.norm(P) * cutoff < 1  # false for NaN
    truncated = jax.lax.cond(eqxi.unvmap_any(~regular), lambda: _truncated(A, cutoff), lambda: P)
    return jnp.where(regular, P, truncated)


def _truncated(A, cutoff: float):
    left, sigma, right = jnp.linalg.svd(A, full_matrices=False)
    keep = ~(sigma <= cutoff * sigma[0])  # written so that NaN is kept
    inverse = jnp.where(keep, 1 / jnp.where(keep, sigma, 1), 0)
    return (right.T * inverse) @ left.T


@pseudo_inverse.defjvp
@with_usual_promotion
def _pseudo_inverse_jvp(cutoff, primals, tangents):
    (A,), (dA,) = primals, tangents
    P = pseudo_inverse(A, cutoff)
    rows = dA.T - dA.T @ A @ P  # dA' (1 - A A+)
    columns = dA.T - P @ (A @ dA.T)  # (1 - A+ A) dA'
    return P, -P @ dA @ P + P @ (P.T @ rows) + (columns @ P.T) @ P


def singular_values(A: Float[Array, "rows columns"]) -> Float[Array, "values"]:
    """Return the singular values of `A`, largest first, as a diagnostic without derivative."""
    if 0 in A.shape:
        return jnp.ones((0,), A.dtype)
    return jnp.linalg.svd(jax.lax.stop_gradient(A), compute_uv=False)


def numerical_rank(sigma: Float[Array, "values"], cutoff: float | None = None) -> Count:
    """Return the number of singular values above `cutoff` times the largest (default: `rank_cutoff`)."""
    if sigma.shape[0] == 0:
        return jnp.zeros((), jnp.int32)
    cutoff = rank_cutoff(sigma.dtype) if cutoff is None else cutoff
    return jnp.sum(sigma > cutoff * sigma[0]).astype(jnp.int32)


def null_space_svd(A: Float[Array, "rows columns"]) -> Float[Array, "columns columns"]:
    """Return a null-space basis from the full singular value decomposition; columns outside the null
    space are zero.
    """
    return _null_space(A, _svd_basis, None)


def null_space_qr(
    A: Float[Array, "rows columns"], cutoff: float | None = None
) -> Float[Array, "columns columns"]:
    """Return a null-space basis from the column-pivoted QR decomposition of `A'`; columns outside the null
    space are zero.

    Pivots below `cutoff` times the largest count as zero (default: `rank_cutoff`).
    """
    return _null_space(A, _qr_basis, cutoff)


def pivots_qr(A: Float[Array, "rows columns"]) -> Float[Array, "values"]:
    """Return the magnitudes of the pivots of the column-pivoted QR decomposition of `A'`, largest first, as a
    diagnostic without derivative.
    """
    if 0 in A.shape:
        return jnp.ones((0,), A.dtype)
    _, R, _ = jax.lax.linalg.qr(jax.lax.stop_gradient(A).T, full_matrices=True, pivoting=True)
    return jnp.abs(jnp.diagonal(R))


def present(Z: Float[Array, "columns columns"]) -> Bool[Array, "columns"]:
    """Return which columns of a basis belong to the null space."""
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
