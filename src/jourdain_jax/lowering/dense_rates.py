"""Rates of a scene by dense matrices on NumPy, which a scalar program is compared with: derivatives are JAX's, of what JAX traced.

    beta, gamma, A          derivatives of v, omega, phi along each speed
    a_0, alpha_0, drift     along (1, qdot, 0)

    M = sum m beta' beta + gamma' I gamma
    f = sum beta' (F - m a_0) + gamma' (L - I alpha_0 - omega x I omega) + Q_direct
    udot = Z zeta + c,   A Z = 0,   A c = -drift,   Z' (M udot - f) = 0            (71)-(73)

Source: Wang and Pao (2003).
"""

from dataclasses import dataclass

import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun

from jourdain_jax.build.assembling import speed_scales, typical_lengths
from jourdain_jax.build.structure import Structure
from jourdain_jax.build.trace import VelocityQuantities, jaxpr_of_scene
from jourdain_jax.calculus.gauss_newton import shortest
from jourdain_jax.calculus.jaxprs import needed_only
from jourdain_jax.calculus.pseudo_inverse import rank_cutoff
from jourdain_jax.eager.lanes import uncompiled_lanes
from jourdain_jax.equations.virtual_power import mass_matrix
from jourdain_jax.scene.scene import Scene

LANES = 2048  # states times directions that are worked out at once
_DIFFERENTIATED = ("v", "omega", "phi")
_VALUES = ("qdot", "omega", "force", "torque", "direct", "mass", "inertia", "events")


@dataclass
class DenseRates:
    """Rates of coordinates, of the independent speeds, and values of the stop events at some states; NaN where accelerations are not determined."""

    qdot: np.ndarray  # (states, coordinates)
    ydot: np.ndarray  # (states, independent)
    events: np.ndarray  # (states, events)


def dense_rates(scene: Scene, structure: Structure, independent: tuple[int, ...], parameters: Scene, t, q, u, inputs) -> DenseRates:
    """Rates at many states, each with parameters of its own (all arrays with an axis of states first).

    `independent`: speeds in the state; where these are not all, the others follow from the rows.
    """
    traced = _Traced(scene, structure.potentials_of_inputs)
    kept = list(structure.kept_rows)
    parts = range(0, len(t), max(1, LANES // max(1, u.shape[1])))
    found = [_rates(traced, structure, kept, independent, jax.tree.map(lambda x, i=i: x[i : i + parts.step], (parameters, t, q, u, inputs))) for i in parts]
    return DenseRates(*(np.concatenate([getattr(x, name) for x in found]) for name in ("qdot", "ydot", "events")))


class _Traced:
    """The quantities of a scene at the level of velocities and their derivatives along directions in (t, q, u), at many states."""

    def __init__(self, scene: Scene, of_inputs: tuple[int, ...]):
        closed, shape = jaxpr_of_scene(scene, of_inputs)
        numbers: VelocityQuantities = jax.tree.unflatten(jax.tree.structure(shape), range(len(jax.tree.leaves(shape))))[0]
        quantities = lambda names: jaxpr_as_fun(needed_only(closed, [getattr(numbers, name) for name in names]))  # noqa: E731
        values, differentiated = quantities(_VALUES), quantities(_DIFFERENTIATED)
        self._values = uncompiled_lanes(lambda leaves, t, q, u, inputs: values(*leaves, t, q, u, inputs))

        def along(leaves, t, q, u, inputs, direction):
            return jax.jvp(lambda t, q, u: differentiated(*leaves, t, q, u, inputs), (t, q, u), direction)

        self._along = uncompiled_lanes(along)

    def values(self, parameters: Scene, t, q, u, inputs) -> dict[str, np.ndarray]:
        return dict(zip(_VALUES, self._values(jax.tree.leaves(parameters), t, q, u, inputs), strict=True))

    def along(self, direction, parameters: Scene, t, q, u, inputs) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """v, omega, phi and their derivatives, at every state along its own direction (dt, dq, du)."""
        return self._along(jax.tree.leaves(parameters), t, q, u, inputs, direction)

    def by_speeds(self, parameters: Scene, t, q, u, inputs) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """v, omega, phi, and beta, gamma, A; these with the axis of speeds last."""
        states, count = u.shape
        repeated = jax.tree.map(lambda x: np.repeat(x, count, axis=0), (parameters, t, q, u, inputs))
        direction = (np.zeros(states * count), np.zeros((states * count, q.shape[1])), np.tile(np.eye(count), (states, 1)))
        found = self.along(direction, *repeated)
        values, slopes = ([x.reshape(states, count, *x.shape[1:]) for x in part] for part in found)
        return [x[:, 0] for x in values], [np.moveaxis(x, 1, -1) for x in slopes]


def _rates(traced: _Traced, structure: Structure, kept: list[int], independent: tuple[int, ...], states: tuple) -> DenseRates:
    parameters, t, q, u, inputs = states
    every = np.arange(u.shape[1])
    dependent = np.setdiff1d(every, independent)
    u = np.where(np.isin(every, dependent), 0.0, u)
    (_, _, phi), (beta, gamma, A) = traced.by_speeds(parameters, t, q, u, inputs)
    if dependent.size:  # A (u - y) = -phi(y)
        A_z = A[:, kept][:, :, dependent]
        u[:, dependent] = -shortest(A_z, phi[:, kept], typical_lengths(np.linalg.norm(A_z, axis=2)))
    at = traced.values(parameters, t, q, u, inputs)
    _, (a, alpha, drift) = traced.along((np.ones(len(u)), at["qdot"], np.zeros_like(u)), parameters, t, q, u, inputs)
    # M and f = Q - h
    m, I, omega = at["mass"], at["inertia"], at["omega"]
    turned = lambda x: np.einsum("sbij,sbj->sbi", I, x)  # noqa: E731
    M = mass_matrix(m, I, beta, gamma)
    force, torque = at["force"] - m[..., None] * a, at["torque"] - turned(alpha) - np.cross(omega, turned(omega))
    f = np.einsum("sbik,sbi->sk", beta, force) + np.einsum("sbik,sbi->sk", gamma, torque) + at["direct"]
    udot = _accelerations(M, f, A[:, kept], drift[:, kept], structure.row_lengths[kept], structure.rank)
    return DenseRates(at["qdot"], udot[:, list(independent)], at["events"])


def _accelerations(M, f, A, drift, row_lengths: np.ndarray, rank: int) -> np.ndarray:
    """`udot = Z zeta + c`, in speeds scaled by their inertia and rows by their length; NaN where it is not determined."""
    scale = speed_scales(M)
    M, f, A = scale[:, :, None] * M * scale[:, None], scale * f, A * scale[:, None]
    Z, c = np.broadcast_to(np.eye(f.shape[1]), M.shape), np.zeros_like(f)
    if A.shape[1]:
        length = np.maximum(np.linalg.norm(A, axis=2), row_lengths)
        d = 1 / np.where(length > 0, length, 1.0)
        Z, c = _null_space(d[..., None] * A, -d * drift, rank)
    S = Z.mT @ M @ Z + np.all(Z == 0, axis=1)[:, None] * np.eye(Z.shape[2])  # columns that stand for nothing
    determined = np.min(np.linalg.eigvalsh(np.nan_to_num(S)), axis=1, initial=1.0) > 16 * S.shape[1] * np.finfo(S.dtype).eps
    zeta = np.linalg.solve(np.where(determined[:, None, None], S, np.eye(S.shape[1])), Z.mT @ (f[..., None] - M @ c[..., None]))
    return np.where(determined[:, None], scale * ((Z @ zeta)[..., 0] + c), np.nan)


def _null_space(A: np.ndarray, b: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """An orthonormal basis of the null space, in as many columns as there are speeds (the others are zero), and the shortest c with `A c = b`.

    At most `rank` rows count: at coordinates that were rounded to single precision, rows that depend on each other are independent by some 1e-8.
    """
    finite = np.all(np.isfinite(A), axis=(1, 2)) & np.all(np.isfinite(b), axis=1)
    U, sigma, V = np.linalg.svd(np.where(finite[:, None, None], A, 0.0), full_matrices=True)
    counts = (sigma > rank_cutoff(A.dtype) * sigma[:, :1]) & (np.arange(sigma.shape[1]) < rank)
    inverse = np.where(counts, 1 / np.where(counts, sigma, 1.0), 0.0)
    most = sigma.shape[1]
    c = (V[:, :most].mT @ (inverse[..., None] * (U[:, :, :most].mT @ b[..., None])))[..., 0]
    free = np.arange(A.shape[2]) >= np.count_nonzero(counts, axis=1)[:, None]
    return V.mT * free[:, None], np.where(finite[:, None], c, np.nan)
