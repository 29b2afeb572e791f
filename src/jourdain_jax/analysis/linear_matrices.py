"""Compute the matrices of small motions: A, B of the first-order form; M, C, K, F of the second-order form
(`linearize.py`).
"""

import jax.numpy as jnp
import numpy as np

from jourdain_jax.analysis.motion_derivatives import places_of
from jourdain_jax.analysis.tangent import (
    eliminated,
    inverse,
    others,
    perturbations,
    perturbed_names,
    smallest_pivot,
)
from jourdain_jax.calculus.reals import Indices, array_module, largest
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.scene import Scene


def matrices_of(scene: Scene, q, v, D, mass, independent: Labels, y: Indices, coordinates: Labels) -> dict:
    """Return the matrices and scalars of a `Linearization`, by field name."""
    at, names, xp, chosen = places_of(scene), perturbed_names(scene), array_module((q, D)), np.array(y, int)
    kept, (count, m) = np.array([names.index(name) for name in independent], int), (len(names), len(at.u))
    (S, turned), constant = perturbations(scene), at.udot[chosen]
    change = D[constant] @ xp.concatenate([np.ones(1), v[at.qdot], v[at.udot], np.zeros(len(at.f))])

    # derivatives along all perturbations (ds, du, df); T: all perturbations from the independent ones
    along = xp.concatenate([D[:, at.q] @ (S + turned @ q), D[:, at.u], D[:, at.f]], axis=1)
    T = eliminated(
        along[np.concatenate([at.geometric, at.phi])],
        np.concatenate([kept, count + chosen, count + m + np.arange(len(at.f))]),
    )
    pivots = (
        smallest_pivot(along[at.geometric], others(kept, count)),
        smallest_pivot(along[at.phi], count + others(chosen, m)),
    )

    # rows of A and B: rates of the independent ds, in axes that rotate with the unperturbed motion, and of
    # the independent speeds. A rotation ds after q has the rate d(q0' q)/dt = q0' (qdot - q0dot q0' q), with
    # q0dot q0' dq = (B q0dot) ds
    rates = (S + 4 * turned @ q).T[kept] @ (along[at.qdot] @ T - turned @ v[at.qdot] @ T[:count])
    rates = xp.concatenate([rates, along[constant] @ T])
    n = len(kept) + len(y)
    A, B, Z = rates[:, :n], rates[:, n:], T[count : count + m, len(kept) : n]
    second = _second_order(scene, A, B, Z.T @ mass @ Z, independent, y, coordinates)
    found = dict(zip(("M", "C", "K", "F", "coupling"), second, strict=True))
    found |= {"A": A, "B": B, "acceleration": largest(v[constant]), "pivot": xp.minimum(*pivots)}
    found["residual"] = xp.maximum(found["acceleration"], largest(change))
    found["followed"] = T
    return {name: jnp.asarray(x, q.dtype) for name, x in found.items()}


def _second_order(scene: Scene, A, B, mass, independent: Labels, y, coordinates: Labels):
    """Return M, C, K, F of the named coordinates, and their coupling to other coordinates. `mass`: mass
    matrix of the independent speeds.
    """
    count, k, xp = len(independent), len(coordinates), array_module(A)
    p = np.array([independent.index(name) for name in coordinates], int)
    # (ds, pdot, other independent speeds) = change x
    kept = count + _speeds_beside(scene, y, coordinates)
    change = xp.concatenate([xp.eye(count, A.shape[0]), A[p], xp.eye(A.shape[0])[kept]])
    back = inverse(change)
    rates, forced = (change @ A @ back)[count:], (change @ B)[count:]
    M = back[count:, count:].T @ mass @ back[count:, count:]
    K, C, F = -M @ rates[:, :count], -M @ rates[:, count:], M @ forced
    beside = others(p, count)
    neglected = [
        _relative(M[:k, k:], M[:k, :k]),
        _relative(C[:k, k:], C[:k, :k]),
        _relative(K[:k, beside], K[:k, p]),
    ]
    return M[:k, :k], C[:k, :k], K[:k, p], F[:k], xp.max(xp.stack(neglected))


def _relative(neglected, kept):
    """Return the ratio of the largest neglected entry to the largest kept entry. If all kept entries are
    zero, return the largest neglected entry.
    """
    xp = array_module(kept)
    size = largest(kept)
    return largest(neglected) / xp.where(size > 0, size, 1.0)


def own_rate(scene: Scene, name: str) -> int | None:
    """Return the index of the speed that is the rate of the perturbation `name`; None if the scene defines
    its own speeds.
    """
    if scene.speeds is not None:
        return None
    speed = f"{name}_rate" if name in scene.coordinate_names.entries else name.replace("_turn_", "_omega_")
    return scene.speed_names.entries.index(speed)


def _speeds_beside(scene: Scene, y, coordinates: Labels) -> np.ndarray:
    """Return the positions in y of the independent speeds other than the rates of the named coordinates."""
    if len(coordinates) == len(y):
        return np.zeros(0, int)  # one per degree of freedom: their rates replace all of y
    own = [own_rate(scene, name) for name in coordinates]
    beside = [j for j, speed in enumerate(y) if speed not in own]
    if len(beside) + len(coordinates) == len(y):
        return np.array(beside, int)
    raise ValueError(
        f"not all rates of the coordinates {', '.join(f'`{name}`' for name in coordinates)} are privileged "
        f"speeds of `{type(scene).__name__}` "
        f"({', '.join(f'`{scene.speed_names.entries[i]}`' for i in y)}); name {len(y)} coordinates with "
        "privileged rates, or name the rates of these coordinates in `privileged`"
    )
