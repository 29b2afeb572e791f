"""Projection onto the constraints: positions by Gauss-Newton, speeds M-orthogonally.

    q <- q - G+ g(q),  G = dg/dq               u <- u - M^-1 A' (A M^-1 A')+ phi(u)

Each is iterated until nothing changes any more, in a way that can be differentiated in any mode; the iteration converges quadratically, and its
derivative with it. Rows affine in the speeds are met by one step. Unit norms of quaternions count as position rows here.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.fixed_point import fixed_point
from jourdain_jax.calculus.pseudo_inverse import pseudo_inverse
from jourdain_jax.equations.listed import names_of_position_rows
from jourdain_jax.equations.reductions import cholesky
from jourdain_jax.equations.rows import position_residual, velocity_residual
from jourdain_jax.equations.scaling import row_scale, speed_scale
from jourdain_jax.equations.virtual_power import mass_matrix_at
from jourdain_jax.scene.scene import Scene

MOST_MOVES_OF_POSITIONS, MOST_MOVES_OF_SPEEDS = 25, 8


class RowFunctions(NamedTuple):
    """How rows, their slopes and the mass matrix of a scene are evaluated."""

    closures: Callable  # (scene, t, q) -> g, G
    rows: Callable  # (scene, t, q, u, inputs) -> phi, A
    masses: Callable  # (scene, t, q) -> M


def closure_residual(scene: Scene, t, q) -> Float[Array, "closures"]:
    """Geometric rows, and `(|quaternion|^2 - 1)/2` of every quaternion."""
    norms = [(q[i : i + 4] @ q[i : i + 4] - 1)[None] / 2 for i, _ in scene.coordinates.quaternions]
    return jnp.concatenate([position_residual(scene, t, q), *norms])


def _closures(scene: Scene, t, q):
    return closure_residual(scene, t, q), jax.jacfwd(lambda q: closure_residual(scene, t, q))(q)


def _rows(scene: Scene, t, q, u, inputs):
    return velocity_residual(scene, t, q, u, inputs), jax.jacfwd(lambda u: velocity_residual(scene, t, q, u, inputs))(u)


BY_AUTODIFF = RowFunctions(_closures, _rows, mass_matrix_at)


def project_positions(
    scene: Scene,
    t,
    q: Float[Array, "coordinates"],
    *,
    free: Bool[Array, "coordinates"] | None = None,
    iterations: int = MOST_MOVES_OF_POSITIONS,
    typical=None,
    by: RowFunctions = BY_AUTODIFF,
) -> Float[Array, "coordinates"]:
    """Coordinates on the geometric rows, near q; only coordinates that are `free` move. At most so many `iterations`.

    `typical`: lengths of the rows by which one counts as vanishing, from `closure_lengths` (default: none does, unless it is zero).
    `by`: how rows are evaluated.
    """
    if jax.eval_shape(lambda s, q: closure_residual(s, 0.0, q), scene, q).shape[0] == 0:
        return q
    if free is None and not names_of_position_rows(scene):
        return _normalised(scene, q)
    free = jnp.ones(q.shape, bool) if free is None else free

    def step(q):
        residual, G = by.closures(scene, t, q)
        G = jnp.where(free, G, 0.0)
        d = row_scale(G, typical)
        return q - jnp.where(free, pseudo_inverse(d[:, None] * G) @ (d * residual), 0.0)  # what is held does not move by round-off either

    return fixed_point(step, q, iterations)


def _normalised(scene: Scene, q: Float[Array, "coordinates"]) -> Float[Array, "coordinates"]:
    """Where there are unit norms only, what the iteration converges to: `q / |q|` of every quaternion."""
    for first, _ in scene.coordinates.quaternions:
        wxyz = q[first : first + 4]
        squared = wxyz @ wxyz
        q = q.at[first : first + 4].set(wxyz / jnp.sqrt(jnp.where(squared == 0, 1.0, squared)))  # zero has no direction and stays
    return q


def project_speeds(
    scene: Scene,
    t,
    q,
    u: Float[Array, "speeds"],
    inputs=None,
    *,
    free: Bool[Array | np.ndarray, "speeds"] | None = None,
    iterations: int = MOST_MOVES_OF_SPEEDS,
    cutoff: float | None = None,
    typical=None,
    affine: bool = False,
    determined: bool = False,
    by: RowFunctions = BY_AUTODIFF,
) -> Float[Array, "speeds"]:
    """Speeds on the velocity rows, nearest to u in the metric of the mass matrix; only speeds that are `free` move.

    Rows count as dependent below `cutoff` (default: `rank_cutoff`). `typical`: lengths of the rows in scaled speeds by which one counts as vanishing,
    from `usual_rows` (default: none does, unless it is zero). `affine`: rows are, in the speeds, so that one step is exact; `iterations` do not count then.
    `determined`: rows are affine and determine all speeds that are `free`, so that no metric is needed; `typical` is then in plain speeds.
    `by`: how rows and the mass matrix are evaluated.
    """
    if jax.eval_shape(lambda s, q, u: velocity_residual(s, 0.0, q, u), scene, q, u).shape[0] == 0:
        return u
    if determined:
        return _determined_speeds((scene, t, q, u, inputs), free=free, typical=typical, by=by)
    free = jnp.ones(u.shape, bool) if free is None else free
    M = by.masses(scene, t, q)
    c = speed_scale(M)
    M = jnp.where(free[:, None] & free, c[:, None] * M * c, jnp.eye(u.shape[0], dtype=u.dtype))
    L, _ = cholesky(M)  # the identity where M is singular: then nearest in the scaled speeds

    def towards_rows(u):
        """The residual of rows at u, and the linear function that takes a residual to the change of speeds which removes it."""
        phi, A = by.rows(scene, t, q, u, inputs)
        weighted = jax.scipy.linalg.solve_triangular(L, jnp.where(free, A * c, 0.0).T, lower=True).T  # A L'^-1
        d = row_scale(weighted, typical)
        P = pseudo_inverse(d[:, None] * weighted, cutoff)
        return phi, lambda phi: -jnp.where(free, c * jax.scipy.linalg.solve_triangular(L.T, P @ (d * phi), lower=False), 0.0)

    def step(u):
        phi, change = towards_rows(u)
        return u + change(phi)

    if not affine:
        return fixed_point(step, u, iterations)
    phi, change = towards_rows(u)
    u = u + change(phi)
    return u + jax.lax.stop_gradient(change(by.rows(scene, t, q, u, inputs)[0]))  # round-off, of which no derivative is wanted


@eqx.filter_custom_jvp
def _determined_speeds(state: tuple, *, free, typical, by: RowFunctions) -> Float[Array, "speeds"]:
    """Speeds on affine rows that determine those which are free; `state`: scene, time, coordinates, speeds, inputs."""
    return _on_rows(state, free, typical, by)[0]


@_determined_speeds.def_jvp
def _determined_speeds_jvp(primals, tangents, *, free, typical, by):
    """Of `phi = 0`, as of any root: `du = -A+ dphi`, with the derivative of the rows at speeds that are held."""
    ((scene, t, q, u, inputs),), ((*along, du, dinputs),) = primals, tangents
    u, P = _on_rows((scene, t, q, u, inputs), free, typical, by)
    du = jnp.zeros_like(u) if du is None else jnp.where(free, 0.0, du)
    tangents = (*along, du, dinputs)
    moving, fixed = eqx.partition((scene, t, q, u, inputs), jax.tree.map(lambda d: d is not None, tangents, is_leaf=lambda d: d is None))
    dphi = jax.jvp(lambda moving: by.rows(*eqx.combine(moving, fixed))[0], (moving,), (tangents,))[1]
    return u, du - P @ dphi


def _on_rows(state: tuple, free, typical, by: RowFunctions) -> tuple[Float[Array, "speeds"], Float[Array, "speeds rows"]]:
    """Those speeds, and what takes a residual of rows to the change of speeds that makes it."""
    scene, t, q, u, inputs = state
    A = jnp.where(free, by.rows(scene, t, q, u, inputs)[1], 0.0)
    d = row_scale(A, typical)
    P = jnp.where(free[:, None], pseudo_inverse(d[:, None] * A) * d, 0.0)  # what is held does not move by round-off either
    for _ in range(2):  # once more for round-off
        u = u - P @ by.rows(scene, t, q, u, inputs)[0]
    return u, P
