"""Projection onto the constraints: positions by Gauss-Newton, speeds M-orthogonally.

    q <- q - G+ g(q),  G = dg/dq               u <- u - M^-1 A' (A M^-1 A')+ phi(u)

Both iterations, and their derivatives in any mode, converge quadratically. One step suffices for constraints
affine in the speeds. Unit norms of quaternions count as geometric constraints here.

The smallest change that removes the residual of constraints, and its derivative in closed form.

    min |D (A x - r)|, then min x' M x:      x = K r,   K = C L'^-1 (D A C L'^-1)+ D,   C M C = L L'
    dx = K (dr - dA x) + K D^-2 K' dA' D^2 (r - A x) + (1 - K A) M^-1 (dA' mu - dM x),   M x = A' mu

x, A, M: change of the free unknowns, Jacobian of the constraints, metric; r: residual; C, D: diagonal scales
of the unknowns and of the rows, constant under differentiation. The second term of dx is zero unless
constraints contradict each other. Source: as in `calculus/matrices.py`, in the metric M.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.compilation import with_usual_promotion
from jourdain_jax.calculus.matrices import pseudo_inverse
from jourdain_jax.calculus.reals import Flag, PerCoordinate, PerRow, Speeds
from jourdain_jax.calculus.roots import fixed_point
from jourdain_jax.equations.reductions import cholesky, row_scale, speed_scale
from jourdain_jax.equations.rows import names_of_position_rows, position_residual, velocity_residual
from jourdain_jax.equations.virtual_power import mass_matrix_at
from jourdain_jax.scene.scene import Scene


class Change(NamedTuple):
    """A change, and the matrix (without derivative) that computes it from the residual."""

    x: Float[Array, "moving"]
    K: Float[Array, "moving rows"]


def least_change(
    A: Float[Array, "rows moving"],
    r: PerRow,
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
    mu: PerRow
    d: PerRow
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
    both = jnp.column_stack([y, P * d])
    if L is not None:
        both = jax.scipy.linalg.solve_triangular(L.T, both)
    both *= c[:, None]
    return _Solved(Change(both[:, 0], both[:, 1:]), d * (P.T @ y), d, c, L, definite)


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


MOST_MOVES_OF_POSITIONS, MOST_MOVES_OF_SPEEDS = 25, 8  # numerics


class RowFunctions(NamedTuple):
    """Functions that evaluate a scene's constraints, their derivatives and the mass matrix."""

    closures: Callable  # (given, t, q) -> g, G
    rows: Callable  # (given, t, q, u, inputs) -> phi, A
    masses: Callable  # (given, t, q) -> M
    given: Callable = lambda scene, *_: scene  # from a scene and `plain` of `project_speeds`


def closure_residual(scene: Scene, t, q) -> Float[Array, "closures"]:
    """Return the geometric residuals, and `(|quaternion|^2 - 1)/2` of every quaternion."""
    norms = [(q[i : i + 4] @ q[i : i + 4] - 1)[None] / 2 for i, _ in scene.coordinates.quaternions]
    return jnp.concatenate([position_residual(scene, t, q), *norms])


def _closures(scene: Scene, t, q):
    return closure_residual(scene, t, q), jax.jacfwd(lambda q: closure_residual(scene, t, q))(q)


def linearised_rows(scene: Scene, t, q, u, inputs) -> tuple[PerRow, Float[Array, "rows speeds"]]:
    """Return `phi` and `A = d phi/du`."""
    phi = lambda u: velocity_residual(scene, t, q, u, inputs)
    return phi(u), jax.jacfwd(phi)(u)


BY_AUTODIFF = RowFunctions(_closures, linearised_rows, mass_matrix_at)


def project_positions(
    scene: Scene,
    t,
    q: PerCoordinate,
    *,
    free: Bool[Array, "coordinates"] | None = None,
    iterations: int = MOST_MOVES_OF_POSITIONS,
    typical=None,
    by: RowFunctions = BY_AUTODIFF,
    plain: tuple[Scene, ...] = (),
) -> PerCoordinate:
    """Return coordinates near q on the geometric constraints, after at most `iterations` corrections; only
    `free` coordinates move.

    `typical`: typical lengths of the rows of G, from `closure_lengths`; a row that is mere round-off relative
    to its typical length counts as zero (default: no row does). `by`: the evaluation of the constraints;
    `plain`: as in `project_speeds`.
    """
    if not (names_of_position_rows(scene) or scene.coordinates.quaternions):
        return q
    if free is None and not names_of_position_rows(scene):
        return _normalised(scene, q)
    free = jnp.ones(q.shape, bool) if free is None else free

    def step(given, q):
        at, (free, typical) = given
        g, G = by.closures(*at[:2], q)
        return q - least_change(G, g, None, free, typical).x

    prepare = lambda a: ((by.given(a[0][0], *a[0][2:]), a[0][1]), a[1])
    given = (scene, jnp.asarray(t), *plain), (free, typical)
    return fixed_point(step, given, q, iterations, None if by.given is BY_AUTODIFF.given else prepare)


def _normalised(scene: Scene, q: PerCoordinate) -> PerCoordinate:
    """Normalise every quaternion to `q / |q|`. Without other constraints this is the projection, and no
    iteration is needed.
    """
    for first, _ in scene.coordinates.quaternions:
        wxyz = q[first : first + 4]
        squared = wxyz @ wxyz
        # zero has no direction and stays zero
        q = q.at[first : first + 4].set(wxyz / jnp.sqrt(jnp.where(squared == 0, 1.0, squared)))
    return q


def project_speeds(
    scene: Scene,
    t,
    q,
    u: Speeds,
    inputs=None,
    *,
    free: Bool[Array | np.ndarray, "speeds"] | None = None,
    iterations: int = MOST_MOVES_OF_SPEEDS,
    cutoff: float | None = None,
    typical=None,
    affine: bool = False,
    determined: bool = False,
    by: RowFunctions = BY_AUTODIFF,
    plain: tuple[Scene, ...] = (),
) -> Speeds:
    """Return the speeds that satisfy the velocity constraints, nearest to u in the metric of the mass matrix;
    only `free` speeds change.

    - `cutoff`: relative size of singular values below which rows count as dependent (default: `rank_cutoff`).
    - `typical`: typical lengths of the rows in scaled speeds, from `usual_rows`; a row that is mere round-off
      relative to its typical length counts as zero (default: no row does).
    - `affine`: whether the constraints are affine in the speeds. One step is then exact, and `iterations`
      has no effect.
    - `determined`: whether affine constraints determine all `free` speeds. No metric is then used, and
      `typical` is in plain speeds.
    - `by`: the evaluation of constraints and mass matrix.
    - `plain`: if samples may share the numbers of the scene, the same scene without derivatives.
    """
    free = jnp.ones(u.shape, bool) if free is None else jnp.asarray(free)
    parameters = by.given(scene, *plain)
    M = None if determined else by.masses(parameters, t, q)

    def change(given, u):
        (parameters, t, q, inputs, M), (free, typical) = given
        phi, A = by.rows(parameters, t, q, u, inputs)
        return least_change(A, phi, M, free, typical, cutoff, determined=determined)

    given = (parameters, jnp.asarray(t), q, inputs, M), (free, typical)
    if not (affine or determined):
        return fixed_point(lambda given, u: u - change(given, u).x, given, u, iterations)
    found = change(given, u)
    u = u - found.x
    # removes round-off, which has no derivative
    return u - found.K @ by.rows(*jax.lax.stop_gradient((parameters, t, q, u, inputs)))[0]
