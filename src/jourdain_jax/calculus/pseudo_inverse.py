"""The truncated pseudo-inverse, with a derivative that is right wherever the rank is constant.

    dA+ = -A+ dA A+  +  A+ A+' dA' (1 - A A+)  +  (1 - A+ A) dA' A+' A+

Source: G. H. Golub and V. Pereyra, SIAM J. Numer. Anal. 10 (1973), eq. (4.12). Differentiating the factorisation itself
divides by differences of singular values, which are equal for the orthonormal rows of rolling and skating.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.promotion import with_usual_promotion


def rank_cutoff(dtype: jnp.dtype) -> float:
    """Singular values below this fraction of the largest one count as zero: 4096 units of round-off of `dtype`."""
    return 4096 * float(jnp.finfo(dtype).eps)


def passing_cutoff(dtype: jnp.dtype) -> float:
    """The cut-off for motions *through* a loss of rank of rows that are well conditioned elsewhere: the root of the round-off of `dtype`.

    Round-off e of a row of size sigma is a velocity e/sigma and an acceleration e/sigma^2; the step size resolves them down to about sqrt(e).
    """
    return max(rank_cutoff(dtype), float(jnp.finfo(dtype).eps) ** 0.5)


def undecided(dtype: jnp.dtype) -> float:
    """Beside its usual size, the size of a row below which round-off decides on which branch a motion goes on: 8 roots of the round-off of `dtype`.

    Where two branches of g = 0 cross, g = e is a hyperbola that turns from one into the other, as near as the root of e to their crossing.
    """
    return 8 * float(jnp.finfo(dtype).eps) ** 0.5


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def pseudo_inverse(A: Float[Array, "rows columns"], cutoff: float | None = None) -> Float[Array, "columns rows"]:
    """Moore-Penrose inverse of `A`; singular values below `cutoff` times the largest are dropped.

    Differentiable to any order in forward and reverse mode where the rank does not change.
    """
    if 0 in A.shape:
        return jnp.zeros(A.shape[::-1], A.dtype)
    cutoff = rank_cutoff(A.dtype) if cutoff is None else cutoff
    left, sigma, right = jnp.linalg.svd(A, full_matrices=False)
    keep = ~(sigma <= cutoff * sigma[0])  # written so that NaN is kept and shows
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
    """Singular values of `A`, largest first, as a diagnostic: no derivative passes through them."""
    if 0 in A.shape:
        return jnp.ones((0,), A.dtype)
    return jnp.linalg.svd(jax.lax.stop_gradient(A), compute_uv=False)


def numerical_rank(sigma: Float[Array, "values"], cutoff: float | None = None) -> Int[Array, ""]:
    """How many singular values exceed `cutoff` times the largest (default: the cut-off of their dtype)."""
    if sigma.shape[0] == 0:
        return jnp.zeros((), jnp.int32)
    cutoff = rank_cutoff(sigma.dtype) if cutoff is None else cutoff
    return jnp.sum(sigma > cutoff * sigma[0]).astype(jnp.int32)
