"""Rates of a scene by dense matrices on NumPy, which a scalar program is compared with: derivatives are JAX's, of what JAX traced.

    beta, gamma, A          derivatives of v, omega, phi along each speed
    a_0, alpha_0, drift     along (1, qdot, 0)

    M = sum m beta' beta + gamma' I gamma
    f = sum beta' (F - m a_0) + gamma' (L - I alpha_0 - omega x I omega) + Q_direct
    udot = C yddot + c,   A C = 0,   A c = -drift,   C' (M udot - f) = 0            (25)-(31), (41)

C and c are those of the privileged speeds, or where all speeds stay in the state those of the null space. Source: Wang and Pao (2003).
"""

from dataclasses import dataclass

import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun

from jourdain_jax.build.structure import Structure
from jourdain_jax.build.trace import VelocityQuantities, jaxpr_of_scene
from jourdain_jax.calculus.jaxprs import needed_only
from jourdain_jax.calculus.pseudo_inverse import rank_cutoff
from jourdain_jax.eager.lanes import uncompiled_lanes
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
    kept = [s for s, name in enumerate(structure.row_names) if name not in structure.redundant_rows]
    parts = range(0, len(t), max(1, LANES // max(1, u.shape[1])))
    found = [_rates(traced, structure, kept, independent, *jax.tree.map(lambda x, i=i: x[i : i + parts.step], (parameters, t, q, u, inputs))) for i in parts]
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


def _rates(traced: _Traced, structure: Structure, kept: list[int], independent: tuple[int, ...], parameters: Scene, t, q, u, inputs) -> DenseRates:
    states, count = u.shape
    dependent = [i for i in range(count) if i not in independent]
    if dependent:
        u = np.where(np.isin(np.arange(count), independent), u, 0.0)
    (_, _, phi), (beta, gamma, A) = traced.by_speeds(parameters, t, q, u, inputs)
    if dependent:  # A (u - y) = -phi(y)
        u[:, dependent] = -_from_rows(A[:, kept][:, :, dependent], phi[:, kept, None])[..., 0]
    at = traced.values(parameters, t, q, u, inputs)
    still = np.zeros_like(u)
    _, (a, alpha, drift) = traced.along((np.ones(states), at["qdot"], still), parameters, t, q, u, inputs)
    # M and f = Q - h
    m, I, omega = at["mass"][..., None], at["inertia"], at["omega"]
    turned = lambda x: np.einsum("sbij,sbj...->sbi...", I, x)  # noqa: E731
    flat = lambda x: x.reshape(states, -1, x.shape[-1])  # noqa: E731
    M = np.swapaxes(flat(beta), 1, 2) @ flat(m[..., None] * beta) + np.swapaxes(flat(gamma), 1, 2) @ flat(turned(gamma))
    force, torque = at["force"] - m * a, at["torque"] - turned(alpha) - np.cross(omega, turned(omega))
    f = np.einsum("sbik,sbi->sk", beta, force) + np.einsum("sbik,sbi->sk", gamma, torque) + at["direct"]
    udot = _accelerations(M, f, A, drift, structure, kept, list(independent), dependent)
    return DenseRates(at["qdot"], udot[:, list(independent)], at["events"])


def _accelerations(M, f, A, drift, structure: Structure, kept: list[int], independent: list[int], dependent: list[int]) -> np.ndarray:
    """`udot = C yddot + c`, in speeds scaled by their inertia and rows by their length."""
    states, count = f.shape
    diagonal = np.diagonal(M, axis1=1, axis2=2)
    scale = np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 1.0)
    M, f, A = scale[:, :, None] * M * scale[:, None], scale * f, A * scale[:, None]
    if dependent:
        A, drift = A[:, kept], drift[:, kept]
        C, c = np.zeros((states, count, len(independent))), np.zeros((states, count))
        C[:, independent] = np.eye(len(independent))
        C[:, dependent] = -_from_rows(A[:, :, dependent], A[:, :, independent])
        c[:, dependent] = -_from_rows(A[:, :, dependent], drift[..., None])[..., 0]
    elif A.shape[1]:
        length = np.maximum(np.linalg.norm(A, axis=2), structure.row_lengths)
        d = np.where(length > 0, 1 / np.where(length > 0, length, 1.0), 1.0)
        C, c = _null_space(d[..., None] * A, -d * drift)
    else:
        C, c = np.tile(np.eye(count), (states, 1, 1)), np.zeros((states, count))
    S = np.swapaxes(C, 1, 2) @ M @ C
    lone = np.all(C == 0, axis=1)  # columns that stand for nothing
    S[:, np.arange(S.shape[1]), np.arange(S.shape[1])] += lone
    right = np.swapaxes(C, 1, 2) @ (f[..., None] - M @ c[..., None])
    return scale * ((C @ _solved_definite(S, right))[..., 0] + c)


def _null_space(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An orthonormal basis of the null space, in as many columns as there are speeds (the others are zero), and the shortest c with `A c = b`."""
    finite = np.all(np.isfinite(A), axis=(1, 2)) & np.all(np.isfinite(b), axis=1)
    U, sigma, V = np.linalg.svd(np.where(finite[:, None, None], A, 0.0), full_matrices=True)
    counts = sigma > rank_cutoff(A.dtype) * sigma[:, :1]
    inverse = np.where(counts, 1 / np.where(counts, sigma, 1.0), 0.0)
    most = sigma.shape[1]
    c = (np.swapaxes(V[:, :most], 1, 2) @ (inverse[..., None] * (np.swapaxes(U[:, :, :most], 1, 2) @ b[..., None])))[..., 0]
    free = np.arange(A.shape[2]) >= np.count_nonzero(counts, axis=1)[:, None]
    return np.swapaxes(V, 1, 2) * free[:, None], np.where(finite[:, None], c, np.nan)


def _from_rows(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`A^-1 b` of every state; by least squares where there are more rows than speeds, since rows depend on each other."""
    if A.shape[1] == A.shape[2]:
        return _solved(A, b)
    length = np.linalg.norm(A, axis=2, keepdims=True)
    d = np.where(length > 0, 1 / np.where(length > 0, length, 1.0), 1.0)
    finite = np.all(np.isfinite(A), axis=(1, 2), keepdims=True)
    return np.where(finite, np.linalg.pinv(np.where(finite, d * A, 0.0), rcond=rank_cutoff(A.dtype)) @ (d * b), np.nan)


def _solved(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`A^-1 b` of every state; NaN where there is none."""
    try:
        return np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        return np.concatenate([_solved(A[k : k + 1], b[k : k + 1]) for k in range(len(A))]) if len(A) > 1 else np.full(b.shape, np.nan)


def _solved_definite(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """`A^-1 b` of every state; NaN where A is not positive definite beyond round-off: there the accelerations are not determined."""
    smallest = np.min(np.linalg.eigvalsh(np.nan_to_num(A)), axis=1, initial=1.0)
    determined = smallest > 16 * A.shape[1] * np.finfo(A.dtype).eps
    return np.where(determined[:, None, None], _solved(np.where(determined[:, None, None], A, np.eye(A.shape[1])), b), np.nan)
