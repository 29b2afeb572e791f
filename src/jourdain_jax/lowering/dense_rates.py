"""Compute the rates of a scene by dense matrices in NumPy, with JAX's derivatives, as a reference for scalar
programs.

    beta, gamma, A          derivatives of v, omega, phi along each speed
    a_0, alpha_0, drift     derivatives along (1, qdot, 0)
    M = sum m beta' beta + gamma' I gamma
    f = sum beta' (F - m a_0) + gamma' (L - I alpha_0 - omega x I omega) + Q_direct
    M udot - A' lambda = f,   A udot = -drift                                        (68)-(70)

Source: Wang and Pao (2003).
"""

from collections.abc import Callable

import jax
import numpy as np
from jax.extend.core import jaxpr_as_fun

from jourdain_jax.calculus.jaxprs import needed_only
from jourdain_jax.calculus.reals import Indices, all_finite, at_index
from jourdain_jax.calculus.roots import shortest
from jourdain_jax.equations.virtual_power import mass_matrix
from jourdain_jax.program.eager import uncompiled_lanes
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import speed_scales, typical_lengths
from jourdain_jax.structure.structure import Structure
from jourdain_jax.structure.trace import VelocityQuantities, jaxpr_of_scene


def dense_rates(
    scene: Scene, structure: Structure, independent: Indices, parameters: Scene, t, q, u, inputs
) -> tuple[np.ndarray, ...]:
    """Return the rates of coordinates, the rates of the independent speeds, and the values of events, at many
    states. Rates are NaN if the accelerations are not unique.

    All arrays, including parameters, have a leading axis of states. `independent`: indices of the speeds in
    the state; the constraints determine the others.
    """
    closed, shape = jaxpr_of_scene(scene, structure.potentials_of_inputs)
    numbers: VelocityQuantities = jax.tree.unflatten(
        jax.tree.structure(shape), range(len(jax.tree.leaves(shape)))
    )[0]

    def of_state(*names: str) -> Callable:
        function = jaxpr_as_fun(needed_only(closed, [getattr(numbers, name) for name in names]))
        return lambda scene, t, q, u, inputs: function(*jax.tree.leaves(scene), t, q, u, inputs)

    names = "qdot", "omega", "force", "torque", "direct", "mass", "inertia", "events", "slip_turns"
    values, level = of_state(*names), of_state("v", "omega", "phi")

    def slopes(scene, t, q, u, inputs, *along):
        return jax.jvp(lambda *state: level(scene, *state, inputs), (t, q, u), along)

    functions, states = (uncompiled_lanes(values), uncompiled_lanes(slopes)), (parameters, t, q, u, inputs)
    # limits the product of states and directions that are computed at once
    size = -(-len(t) // (1 + u.size // 4096))
    found = [
        _rates(functions, structure, independent, *at_index(states, slice(i, i + size)))
        for i in range(0, len(t), size)
    ]
    return tuple(map(np.concatenate, zip(*found, strict=True)))


def _rates(
    functions: tuple[Callable, Callable],
    structure: Structure,
    independent: Indices,
    parameters,
    t,
    q,
    u,
    inputs,
) -> tuple[np.ndarray, ...]:
    values, slopes = functions
    kept, (states, speeds) = list(structure.kept_rows), u.shape
    dependent = np.setdiff1d(np.arange(speeds), independent)

    lanes = lambda *given: jax.tree.map(lambda x: np.repeat(x, speeds, axis=0), given)
    parted = lambda found: jax.tree.map(lambda x: x.reshape(states, speeds, *x.shape[1:]), found)

    u = np.where(np.isin(np.arange(speeds), dependent), 0.0, u)
    none, still = np.zeros(states * speeds), np.zeros((states * speeds, q.shape[1]))
    each = np.tile(np.eye(speeds), (states, 1))
    (_, _, phi), found = parted(slopes(*lanes(parameters, t, q, u, inputs), none, still, each))
    beta, gamma, A = (np.moveaxis(x, 1, -1) for x in found)
    A = A[:, kept]
    if dependent.size:  # A (u - y) = -phi(y)
        A_z = A[:, :, dependent]
        u[:, dependent] = -shortest(A_z, phi[:, 0, kept], typical_lengths(np.linalg.norm(A_z, axis=2)))
    qdot, omega, force, torque, direct, m, I, events, turns = values(parameters, t, q, u, inputs)
    # with the same batch size as above, so that JAX traces the function once
    along = np.ones(states), qdot, np.zeros_like(u)
    rates = parted(slopes(*lanes(parameters, t, q, u, inputs, *along)))[1]
    a, alpha, drift = (x[:, 0] for x in rates)
    turned = lambda x: np.einsum("sbij,sbj->sbi", I, x)
    force, torque = force - m[..., None] * a, torque - turned(alpha) - np.cross(omega, turned(omega))
    f = np.einsum("sbik,sbi->sk", beta, force) + np.einsum("sbik,sbi->sk", gamma, torque) + direct
    M, lengths = mass_matrix(m, I, beta, gamma), structure.row_lengths[kept]
    udot = accelerations(M, f, A, drift[:, kept], lengths, structure.rank)
    qdot = np.append(qdot[:, : q.shape[1] - turns.shape[1]], turns, axis=1)
    return qdot, udot[:, list(independent)], events


def accelerations(M, f, A, drift, row_lengths: np.ndarray, rank: int) -> np.ndarray:
    """Solve `M udot - A' lambda = f`, `A udot = -drift` for udot at many states; NaN if udot is not unique.

    `rank`: rank of the constraints. Further eigenvalues are ignored, because coordinates rounded to single
    precision make dependent constraints independent by about 1e-8.
    """
    c = speed_scales(M)
    A = A * c[:, None]
    length = np.maximum(np.linalg.norm(A, axis=2), row_lengths)
    d = 1 / np.where(length > 0, length, 1.0)
    A = d[..., None] * A
    system = np.block([[c[:, :, None] * M * c[:, None], A.mT], [A, np.zeros((*A.shape[:2], A.shape[1]))]])
    right = np.concatenate([c * f, -d * drift], axis=1)
    finite = all_finite(system, axis=(1, 2)) & all_finite(right, axis=1)
    size, V = np.linalg.eigh(np.where(finite[:, None, None], system, 0.0))
    largest = np.argsort(-np.abs(size), axis=1)[:, : f.shape[1] + rank]
    size, V = np.take_along_axis(size, largest, 1), np.take_along_axis(V, largest[:, None], 2)
    least = 16 * V.shape[1] * np.finfo(float).eps * np.abs(size[:, :1])
    determined = finite & np.all(np.abs(size) > least, axis=1)
    along = (V.mT @ np.where(finite[:, None], right, 0.0)[..., None])[..., 0]
    along = along / np.where(determined[:, None], size, 1.0)
    return np.where(determined[:, None], c * (V @ along[..., None])[:, : f.shape[1], 0], np.nan)
