"""The smallest change that removes the residual of constraints, and its derivative in closed form.

    min |D (A x - r)|, then min x' M x:      x = K r,   K = C L'^-1 (D A C L'^-1)+ D,   C M C = L L'
    dx = K (dr - dA x) + K D^-2 K' dA' D^2 (r - A x) + (1 - K A) M^-1 (dA' mu - dM x),   M x = A' mu

x, A, M: change of the free unknowns, Jacobian of the constraints, metric; r: residual; C, D: diagonal scales
of the unknowns and of the rows, constant under differentiation. The second term of dx is zero unless
constraints contradict each other. Source: as in `calculus/matrices.py`, in the metric M.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.compilation import with_usual_promotion
from jourdain_jax.calculus.matrices import pseudo_inverse
from jourdain_jax.calculus.reals import Flag
from jourdain_jax.equations.reductions import cholesky, row_scale, speed_scale


class Change(NamedTuple):
    """A change, and the matrix (without derivative) that computes it from the residual."""

    x: Float[Array, "moving"]
    K: Float[Array, "moving rows"]


def least_change(
    A: Float[Array, "rows moving"],
    r: Float[Array, "rows"],
    M: Float[Array, "moving moving"] | None,
    free: Bool[Array, "moving"],
    typical=None,
    cutoff: float | None = None,
    *,
    determined: bool = False,
) -> Change:
    """Return the least change of the `free` entries, in the metric `M`, that removes the residual r. The
    result is differentiable in any mode at constant rank.

    - `M`: None for the Euclidean metric of the coordinates. The identity replaces a singular `M`.
    - `typical`: typical lengths of the rows, in scaled speeds with a metric; a row that is mere round-off
      relative to its typical length counts as zero (default: no row does).
    - `cutoff`: relative size of singular values below which rows count as dependent (default: `rank_cutoff`).
    - `determined`: whether the constraints can be satisfied and determine all free entries. Only the first
      term of the derivative then remains.
    """
    x, K = _least_change(
        (A, r, M), free=free, typical=jax.lax.stop_gradient(typical), cutoff=cutoff, determined=determined
    )
    return Change(x, jax.lax.stop_gradient(K))


class _Solved(NamedTuple):
    change: Change
    mu: Float[Array, "rows"]
    d: Float[Array, "rows"]
    c: Float[Array, "moving"]  # zero for fixed entries
    L: Float[Array, "moving moving"] | None
    definite: Flag | None


def _solved(A, r, M, free, typical, cutoff) -> _Solved:
    A = jnp.where(free, A, 0.0)
    if M is None:
        c, L, definite = free.astype(A.dtype), None, None
        W = A * c
    else:
        c = speed_scale(M)
        both, one = free[:, None] & free, jnp.eye(len(c), dtype=c.dtype)
        L, definite = cholesky(jnp.where(both, c[:, None] * M * c, one))
        c = jnp.where(free, c, 0.0)
        W = jax.scipy.linalg.solve_triangular(L, (A * c).T, lower=True).T
    d = row_scale(W, typical)
    P = pseudo_inverse(d[:, None] * W, cutoff)
    y = P @ (d * r)
    x, K = (
        (c * y, c[:, None] * P * d) if L is None else (c * _backward(L, y), c[:, None] * _backward(L, P * d))
    )
    return _Solved(Change(x, K), d * (P.T @ y), d, c, L, definite)


def _backward(L, y):
    return jax.scipy.linalg.solve_triangular(L.T, y, lower=False)


@eqx.filter_custom_jvp
def _least_change(of: tuple, *, free, typical, cutoff, determined) -> Change:
    A, r, M = of
    return _solved(A, r, M, free, typical, cutoff).change


@_least_change.def_jvp
@with_usual_promotion
def _least_change_jvp(primals, tangents, *, free, typical, cutoff, determined):
    ((A, r, M),), ((dA, dr, dM),) = primals, tangents
    (x, K), mu, d, c, L, definite = _solved(A, r, M, free, typical, cutoff)
    dx = jnp.zeros_like(x)
    if dr is not None:
        dx += K @ dr
    if dA is not None:
        dx -= K @ (dA @ x)
    if dA is not None and not determined:
        dx += K @ (K.T @ (dA.T @ (d**2 * (r - A @ x))) / d**2)
    if (dA is not None or dM is not None) and not determined:
        pull = jnp.zeros_like(x)
        pull = pull if dA is None else pull + dA.T @ mu
        pull = c * (pull if dM is None else pull - jnp.where(definite, dM @ x, 0.0))
        # M^-1 (dA' mu - dM x)
        moved = c * (pull if L is None else jax.scipy.linalg.cho_solve((L, True), pull))
        dx += moved - K @ (A @ moved)
    return Change(x, K), Change(dx, jnp.zeros_like(K))
