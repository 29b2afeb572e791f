"""Compute the matrices of small motions: A, B of the first-order form; M, C, K, F of the second-order form
(`linearize.py`).

A perturbation of a state on the constraint manifold satisfies

    dq = E ds,   dg = G ds = 0,   dphi = Phi_s ds + A du + Phi_f df = 0

For a plain coordinate, `ds` equals `dq`. A quaternion is perturbed by a small rotation in body axes, `dq = q
(0, ds)/2`, so that no component is special. The geometric constraints g determine the dependent `ds`; the
velocity constraints phi determine the dependent `du`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jourdain_jax.analysis.motion_derivatives import places_of, steadiness
from jourdain_jax.calculus.reals import (
    Entries,
    Indices,
    all_finite,
    array_module,
    largest,
    rank_cutoff,
    tiny_of,
)
from jourdain_jax.equations.reductions import scaled
from jourdain_jax.equations.rows import names_of_position_rows
from jourdain_jax.equations.virtual_power import equations_and_rows
from jourdain_jax.integrate.state import State
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.coordinates import Coordinates, Labels, check_names
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.rank import best_privileged, named_speeds, pivots_at
from jourdain_jax.structure.structure import WELL_CONDITIONED, structure_of, usual_rows


def perturbed_names(scene: Scene) -> Labels:
    """Return the names of the perturbations `ds`, in the order of the default speeds: the plain coordinates,
    and for each quaternion three rotations in body axes, such as `attitude_turn_x`, `..._y`, `..._z`.
    """
    speeds = scene.coordinates.default_speeds.entries
    names = ["_turn_".join(name.rsplit("_omega_", 1)) for name in speeds]
    for coordinate, speed in scene.coordinates.plain:
        names[speed] = scene.coordinate_names.entries[coordinate]
    return tuple(names)


@eval_numpy
def perturbations(
    coordinates: Coordinates,
) -> tuple[Float[Entries, "coordinates perturbed"], Float[Entries, "coordinates perturbed coordinates"]]:
    """Return S and B of `dq = E ds` with `E = S + B q`. Default speeds are rates of the perturbations, so E
    maps them to coordinate rates: for a quaternion, `E ds` is half its product with the small rotation ds.

    For a unit quaternion the inverse of `x -> q x` is its transpose: `ds = (S + 4 B q)' dq`.
    """
    E = jax.jacfwd(coordinates.default_rates, 1)
    at = jnp.zeros(len(coordinates.names)), jnp.zeros(len(coordinates.default_speeds))
    return E(*at), jax.jacfwd(E)(*at)


def inverse(x: Float[Entries, "rows columns"]) -> Float[Entries, "columns rows"]:
    """Return the inverse of a square matrix, or the pseudo-inverse of a rectangular one; NaN if there is
    none.
    """
    try:
        return (
            array_module(x).linalg.inv(x)
            if len(x) == x.shape[1]
            else array_module(x).linalg.pinv(x, rtol=rank_cutoff(x.dtype))
        )
    except np.linalg.LinAlgError:
        return np.full(x.T.shape, np.nan)


def others(some, count: int) -> Int[np.ndarray, "rest"]:
    """Return the indices below `count` that are not in `some`."""
    return np.setdiff1d(np.arange(count), np.asarray(some, int))


def eliminated(
    rows: Float[Entries, "rows all"], independent: Int[np.ndarray, "independent"]
) -> Float[Entries, "all independent"]:
    """Return the matrix that maps independent perturbations to all perturbations with `rows @ perturbation =
    0`.
    """
    dependent = others(independent, rows.shape[1])
    rows = _of_unit_length(rows, dependent)
    followed = -inverse(rows[:, dependent]) @ rows[:, independent]
    return array_module(rows).concatenate([np.eye(len(independent)), followed])[
        np.argsort(np.concatenate([independent, dependent]))
    ]


def smallest_pivot(
    rows: Float[Entries, "rows all"], dependent: Int[np.ndarray, "dependent"]
) -> Float[Entries, ""]:
    """Return the smallest singular value of the dependent columns, scaled to rows of unit length. It is
    treated as constant in differentiation.
    """
    xp, block = array_module(rows), _of_unit_length(rows, dependent)[:, dependent]
    if xp is np and not all_finite(block):
        return np.asarray(np.nan)
    sizes = xp.linalg.svd(jax.lax.stop_gradient(block) if xp is jnp else block, compute_uv=False)
    return xp.asarray(xp.min(sizes, initial=1.0) if len(block) >= len(dependent) else 0.0)


def _of_unit_length(
    rows: Float[Entries, "rows all"], dependent: Int[np.ndarray, "dependent"]
) -> Float[Entries, "rows all"]:
    """Return the rows, each divided by the length of its dependent part."""
    xp, block = array_module(rows), rows[:, dependent]
    length = xp.linalg.norm(jax.lax.stop_gradient(block) if xp is jnp else block, axis=1, keepdims=True)
    return rows / xp.where(length > 0, length, 1.0)


def privileged_speeds(scene: Scene, names: str | Labels | None = None) -> Indices:
    """Return the indices of the independent speeds: the named ones if given, otherwise those of the scene's
    structure.
    """
    known = structure_of(scene)
    return known.independent if names is None else named_speeds(scene, names, known.degrees_of_freedom)


def privileged_at(scene: Scene, state: State, f, usual: Indices) -> Indices:
    """Return the indices of independent speeds at a known state: the `usual` ones, or others if the usual
    ones do not determine the dependent speeds well.
    """
    A, count = _scaled_rows(scene, state.t, state.q, state.u, f)[None], len(scene.speed_names)
    rank = count - len(usual)
    pivot = pivots_at(A, others(usual, count).tolist(), rank)[0]
    return usual if pivot >= WELL_CONDITIONED else best_privileged(A, count, rank)


@eval_numpy
def _scaled_rows(scene: Scene, t, q, u, f):
    equations, rows = equations_and_rows(scene, t, q, u, f)
    return scaled(equations, rows.judged_by(usual_rows(scene))).A


def dependent_coordinates(
    scene: Scene,
    state: State,
    named: Labels,
    dependent: Labels | None,
    G: Float[np.ndarray, "rows coordinates"] | None = None,
) -> Int[np.ndarray, "dependent"]:
    """Return the indices of the dependent perturbations `ds`, which the geometric constraints determine:
    those in `dependent` if given, otherwise a well-conditioned choice.

    `G`: dg/dq at the state. If it is unknown, states of the scene's domain are used instead.
    """
    names = perturbed_names(scene)
    check_names(
        (*named, *(dependent or ())), names, f"`{type(scene).__name__}` has no coordinate `{{}}` to perturb"
    )
    if len(set(named)) != len(named):
        raise ValueError(f"`coordinates` contains a name twice ({', '.join(named)}); give each once")
    both = set(named) & set(dependent or ())
    if both:
        raise ValueError(
            f"coordinate `{both.pop()}` is both in `coordinates` and in `dependent`; omit it from one of them"
        )
    if dependent is not None:
        return np.array([names.index(name) for name in dependent], int)
    if not names_of_position_rows(scene):
        return np.zeros(0, int)
    known, count = structure_of(scene), len(names_of_position_rows(scene))
    G, q = (
        (known.closure_slopes[:, :count], known.coordinates)
        if G is None
        else (G[None], np.asarray(state.q)[None])
    )
    S, B = perturbations(scene.coordinates)
    G = G @ np.stack([S + B @ x for x in q[: len(G)]])
    G = G / np.maximum(np.linalg.norm(G, axis=2, keepdims=True), tiny_of(G))
    cutoff = rank_cutoff(G.dtype)
    rank = max(int(np.linalg.matrix_rank(block, tol=cutoff)) for block in G)
    free = others([names.index(name) for name in named], len(names))
    chosen = np.delete(free, best_privileged(G[:, :, free], len(free), rank)) if len(free) >= rank else free
    if len(chosen) < rank or np.any(pivots_at(G, chosen.tolist(), rank) <= cutoff):
        raise ValueError(
            f"the geometric constraints of `{type(scene).__name__}` make the given coordinates dependent; "
            "give fewer in `coordinates`, or name the `dependent` ones"
        )
    return chosen


def matrices_of(scene: Scene, q, v, D, mass, independent: Labels, y: Indices, coordinates: Labels) -> dict:
    """Return the matrices and scalars of a `Linearization`, by field name."""
    at, names, xp, chosen = places_of(scene), perturbed_names(scene), array_module((q, D)), np.array(y, int)
    kept, (count, m) = np.array([names.index(name) for name in independent], int), (len(names), len(at.u))
    (S, turned), constant = perturbations(scene.coordinates), at.udot[chosen]

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
    rates = steadiness(scene, v, D, constant)
    found |= {"A": A, "B": B, "acceleration": rates[0], "residual": xp.maximum(*rates)}
    found |= {"pivot": xp.minimum(*pivots), "followed": T}
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
    return perturbed_names(scene).index(name) if scene.speeds is None else None


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
