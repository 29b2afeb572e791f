"""The rank of constraints at probed states, and the redundant constraints.

A^ = d A c,  M^ = c M c        scaled rows, and inertias in scaled speeds (`reductions.py`)

The same probes show which quantities vanish or change, and which speeds have no inertia.
"""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import (
    Indices,
    all_finite,
    at_index,
    check_kind,
    eps_of,
    largest,
    rank_cutoff,
    tiny_of,
)
from jourdain_jax.program.graph import Unsupported
from jourdain_jax.scene.coordinates import Labels, Sentences, as_names
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import speed_scales
from jourdain_jax.structure.plausibility import without_inertia
from jourdain_jax.structure.probes import Probed, probed_on_graph
from jourdain_jax.structure.sampling import symmetric_configurations


class Scaled(eqx.Module):
    """The quantities that determine ranks and pivots, at every probed state."""

    A: Float[np.ndarray, "states rows speeds"]  # scaled rows in scaled speeds
    lengths: Float[np.ndarray, "states rows"]  # of the rows before scaling
    M: Float[np.ndarray, "states speeds speeds"]  # in scaled speeds
    c: Float[np.ndarray, "states speeds"]  # scales of the speeds


def scaled_states(found: Probed, typical: np.ndarray) -> Scaled:
    """Return `d A c` with the scales used for accelerations (`equations/reductions.py: row_scale`)."""
    c = speed_scales(found.M)
    A = found.A * c[:, None]
    length = np.maximum(np.sqrt(np.sum(A**2, axis=2, keepdims=True)), typical[:, None])
    M = c[:, :, None] * found.M * c[:, None]
    return Scaled(A / np.where(length > 0, length, 1), length[..., 0], M, c)


def ranks_of(A: Float[np.ndarray, "states rows speeds"], errors: Float[np.ndarray, "states"]) -> list[int]:
    """Return the ranks of scaled rows. The cut-off is `rank_cutoff` or, if larger, 100 times the error of the
    configuration.
    """
    if not A.size:
        return [0] * len(A)
    sigma = np.linalg.svd(A, compute_uv=False)
    # smaller singular values come from errors of the configuration
    cutoff = np.maximum(rank_cutoff(A.dtype), 100.0 * errors)[:, None]
    return np.sum(sigma > cutoff * sigma[:, :1], axis=1).tolist()


def contradictions(
    who: str,
    names: Labels,
    A: Float[np.ndarray, "states rows speeds"],
    at_rest: Float[np.ndarray, "states rows"],
    ranks: list[int],
) -> Labels:
    """Return an error message if some constraints have no common solution for the speeds at any of the
    random states.

        A u + phi_0 = 0 has a solution if (1 - U U') phi_0 = 0,   A = U S V'

    `A`, `at_rest`: scaled rows, and their values phi_0 at u = 0, of constraints affine in the speeds.
    """
    U = np.linalg.svd(A, full_matrices=False)[0]
    U = U * (np.arange(U.shape[2]) < np.array(ranks)[:, None])[:, None]
    left = at_rest - (U @ (U.transpose(0, 2, 1) @ at_rest[..., None]))[..., 0]
    # covers rounded constants; mistakes are larger
    unmet = np.abs(left) > 1e-4 * largest(at_rest, 1, keepdims=True)
    if not unmet.size or not unmet.any(axis=1).all():
        return ()
    wrong = [(name, s) for s, name in enumerate(names) if unmet[:, s].any()]
    idle = [name for name, s in wrong if not A[:, s].any()]
    several = ", ".join(f"`{name}`" for name, _ in wrong)
    said = (
        f"constraints {several} of `{who}` contradict each other: no speeds satisfy them at any of {len(A)} "
        "random states; omit or correct one"
    )
    if idle:
        said = (
            f"velocity constraint `{idle[0]}` of `{who}` depends on no speed and is not zero; state "
            "relations between coordinates in `geometric_constraints`"
        )
    return (said,)


def redundant_rows(
    found: Scaled,
    errors: np.ndarray,
    ranks: list[int],
    generic: np.ndarray,
    names: Labels,
    far: Callable[[], Scaled],
) -> Labels:
    """Return rows that may be omitted, later rows rather than earlier ones: the others keep the rank at every
    probed state and stay well conditioned.

    A row is omitted only if it is a combination of the others with bounded coefficients. An example of
    unbounded coefficients is the lateral row of one wheel of an axle: as a combination of its longitudinal
    row and the rows of the other wheel, it has tangents of the heading as coefficients. `generic`: which of
    the states `found` are random; `far`: function that returns rows at distant angles.
    """
    if not ranks:  # a scene without usable states has another fault
        return ()
    kept, everywhere = list(range(len(names))), None
    for s in reversed(range(len(names))):
        if len(kept) in ranks:
            break  # the remaining rows are independent somewhere
        rest = [i for i in kept if i != s]
        if ranks_of(found.A[:, rest], errors) != ranks:
            continue
        if everywhere is None:
            everywhere = jax.tree.map(lambda *x: np.concatenate(x), at_index(found, generic), far())
        if _are_bounded(_coefficients(everywhere, rest, s, max(ranks))):
            kept = rest
    return tuple(name for s, name in enumerate(names) if s not in kept)


def _coefficients(found: Scaled, rest: list[int], s: int, rank: int) -> np.ndarray:
    """Return the coefficients of row s as a combination of the rows `rest`, at states of the given `rank`.
    They refer to rows in units of their typical lengths, and are infinite where row s is not a combination.
    """
    tiny, made = tiny_of(found.A), []
    lengths = np.maximum(found.lengths, tiny)
    usual = np.median(lengths, axis=0)
    for A, length, its_rank in zip(found.A, lengths, ranks_of(found.A, np.zeros(len(found.A))), strict=True):
        if its_rank == rank:
            c = A[s] @ np.linalg.pinv(A[rest], rcond=rank_cutoff(A.dtype))
            given = np.linalg.norm(A[s] - c @ A[rest]) < np.sqrt(eps_of(A))
            relative = c * (length[s] / usual[s]) / (length[rest] / usual[rest])
            made.append(relative if given else np.full(len(rest), np.inf))
    return np.array(made).reshape(len(made), len(rest))


def _are_bounded(c: np.ndarray) -> bool:
    """Return whether coefficients are bounded over many states: none is large, and none far exceeds its
    median size with both signs, as a tangent does.
    """
    usual = 3.0 * np.median(np.abs(c), axis=0) + np.sqrt(eps_of(c))
    poles = (np.max(c, axis=0, initial=0.0) > usual) & (np.min(c, axis=0, initial=0.0) < -usual)
    return bool(np.all(np.abs(c) < 20.0) and not np.any(poles & (largest(c, 0) > 2)))


def named_speeds(scene: Scene, names: str | Iterable[str], freedoms: int) -> Indices:
    """Return the indices of the speeds that a scene names as `privileged`. Raises ValueError for unknown
    names, and for any other number of names than `freedoms`.
    """
    check_kind(names, str | Iterable, f"`privileged` of `{type(scene).__name__}`", "names of speeds")
    chosen = tuple(
        scene.speed_names.index(name, f"privileged speed of `{type(scene).__name__}`:")
        for name in as_names(names)
    )
    if len(set(chosen)) != len(chosen):
        raise ValueError(
            f"`privileged` of `{type(scene).__name__}` names a speed twice "
            f"({', '.join(as_names(names))}); name independent ones"
        )
    if len(chosen) != freedoms:
        raise ValueError(
            f"`privileged` of `{type(scene).__name__}` names {len(chosen)} speeds, but the scene has "
            f"{freedoms} degrees of freedom; name {freedoms} independent speeds"
        )
    return chosen


def pivots_at(scaled: np.ndarray, dependent: list[int], rank: int) -> np.ndarray:
    """Return the smallest singular value of A_z at every probe."""
    if rank == 0:
        return np.ones(len(scaled))
    return np.linalg.svd(scaled[:, :, dependent], compute_uv=False)[:, rank - 1]


def worst_pivot(scaled: np.ndarray, dependent: list[int], rank: int, pivots: np.ndarray) -> float:
    """Return the smallest pivot over the domain. It is zero if the determinant of A_z changes sign between
    probes.
    """
    if rank and scaled.shape[1] == rank:
        signs = np.linalg.slogdet(scaled[:, :, dependent])[0]
        if signs.min(initial=0.0) < 0 < signs.max(initial=0.0):
            return 0.0
    return float(pivots.min(initial=1.0))


def best_privileged(scaled: np.ndarray, count: int, rank: int) -> Indices:
    """Return the choice of independent speeds whose smallest pivot over all probes is largest. The median
    pivot breaks ties.
    """
    if rank == 0:
        return tuple(range(count))
    subsets = list(itertools.islice(itertools.combinations(range(count), rank), 3001))
    if len(subsets) > 3000:
        subsets = list({pivot_columns(A, rank) for A in scaled})

    def merit(dependent, probes):
        pivots = pivots_at(probes, list(dependent), rank)
        worst = worst_pivot(probes, list(dependent), rank, pivots)
        return round(worst, 6), round(float(np.median(pivots)), 6)

    some = scaled[:: max(1, len(scaled) // 40)]
    best = sorted(subsets, key=lambda dependent: merit(dependent, some), reverse=True)[:40]
    dependent = max(best, key=lambda dependent: merit(dependent, scaled))
    return tuple(i for i in range(count) if i not in dependent)


def pivot_columns(A: np.ndarray, rank: int) -> Indices:
    """Return the columns that pivoted QR chooses: at each step, the one with the largest remaining length."""
    remaining, chosen = A.copy(), []
    for _ in range(rank):
        lengths = np.linalg.norm(remaining, axis=0)
        k = int(np.argmax(lengths))
        chosen.append(k)
        e = remaining[:, k] / lengths[k]
        remaining = remaining - np.outer(e, e @ remaining)
    return tuple(sorted(chosen))


RANDOM_PROBES = 24  # numerics


def moves(rates: np.ndarray) -> bool:
    """Return whether any rate is a number other than zero."""
    return bool(np.any(np.isfinite(rates) & (rates != 0)))


def exceeds(difference: np.ndarray, tolerance: float, size: np.ndarray) -> bool:
    """Return whether any entry exceeds `tolerance` times the size of its row. Sizes are relative because
    constraints may have any unit.
    """
    size = np.maximum(size, np.nanmedian(size, axis=0, keepdims=True)) if size.size else size
    return bool(np.any(np.abs(difference) > tolerance * size))


def sizes(found: Probed) -> np.ndarray:
    """Return the largest entry of every row, at every state."""
    return largest(found.A, 2)


def _look(scene: Scene, t, q, u, u_other, generic) -> Probed:
    try:
        found = probed_on_graph(scene, t, q, u, u_other, generic)
        if not found.in_calls:
            return found
        # results of JAX calls may be nonzero only far from the probes, so a few distant states are probed too
        generator, count = np.random.default_rng(1), 16
        far = 100.0 * generator.uniform(size=count), q[:count] * 100.0 ** generator.uniform(size=(count, 1))
        for first, _ in scene.coordinates.quaternions:
            far[1][:, first : first + 4] = q[:count, first : first + 4]
        u, u_other = 100.0 * generator.uniform(-1, 1, (2, count, u.shape[1]))
        beyond = probed_on_graph(scene, *far, u, u_other, np.ones(count, bool), tries=0)
        unproved = (found.unproved - found.in_calls) | (found.in_calls & _seen(beyond, u))
        return replace(found, unproved=unproved)
    except Unsupported as reason:
        raise ValueError(
            f"the motion of `{type(scene).__name__}` needs {reason}; it is too large or has no forward mode; "
            "give that part a rule with `jax.custom_jvp`, or `friction=` to fewer contacts"
        ) from None


def _seen(found: Probed, u: np.ndarray) -> frozenset[str]:
    """Return the names of quantities that are nonzero at distant states. Values of constraints count as zero
    within round-off.
    """
    some = np.sqrt(eps_of(found.A))
    seen = {name for name, rates in found.vanishing.items() if moves(rates)} - {"rows at rest"}
    rows = (
        {"rows at rest"} if exceeds(found.vanishing["rows at rest"], some, speed_terms(found, u)) else set()
    )
    rows |= {"nonlinear"} if exceeds(found.A - found.A_other, some, sizes(found)[..., None]) else set()
    return frozenset(seen | rows)


def speed_terms(found: Probed, u: np.ndarray) -> np.ndarray:
    """Return the sizes of the terms of every constraint at the probed speeds."""
    return np.einsum("srk,sk->sr", np.abs(found.A), np.abs(u))


def at_probes(scene: Scene, t, q, u) -> tuple[np.ndarray, np.ndarray, np.ndarray, Probed]:
    """Probe a scene at random and symmetric states. Return times, speeds, flags of random states, and the
    probed quantities.
    """
    symmetric = symmetric_configurations(scene)
    t, q = np.concatenate([t, np.zeros(len(symmetric))]), np.concatenate([q, symmetric])
    u = np.concatenate([u, u[:1].repeat(len(symmetric), 0)])
    generic = np.arange(len(t)) < RANDOM_PROBES
    return t, u, generic, _look(scene, t, q, u, -u[::-1], generic)


def is_singular(M: np.ndarray) -> bool:
    """Return whether scaled mass matrices are singular at all states."""
    if not M.size:
        return False
    least = np.linalg.eigvalsh(np.nan_to_num(M, nan=1.0))[:, 0]
    return bool(np.all(least <= 16 * M.shape[1] * eps_of(M)))


def no_inertia(scene: Scene, found: Scaled) -> Sentences:
    """Return an error message with the names of the speeds if a free motion lacks inertia at every state."""
    if not (len(found.M) and without_inertia(found.M, found.A).all()):
        return ()
    directions = np.linalg.eigh(np.nan_to_num(found.M + found.A.mT @ found.A, nan=1.0))[1][..., 0]
    moved = np.abs(found.c * directions)
    share = np.median([x / x.max() for x in moved], axis=0)
    moving = [f"`{name}`" for name, part in zip(scene.speed_names.entries, share, strict=True) if part > 1e-3]
    names = ", ".join(moving) + (" together" if len(moving) > 1 else "")
    return (
        f"nothing in `{type(scene).__name__}` has inertia along {names}: no mass moves with it and no "
        "constraint determines it; give a body that moves with it a mass (or inertia), add a constraint, or "
        "omit the coordinate",
    )


def far_rows(scene: Scene, typical: np.ndarray, t, q, u) -> Scaled:
    """Return scaled rows at states on the geometric constraints, with coordinates up to half a turn from
    q.
    """
    generator = np.random.default_rng(4)
    t, q, u = (x[:RANDOM_PROBES].repeat(2, 0) for x in (t, q, u))
    turned = q + generator.uniform(-np.pi, np.pi, q.shape)
    for first, _ in scene.coordinates.quaternions:
        turned[:, first : first + 4] = q[:, first : first + 4]
    found = _look(scene, t, turned, u, -u, np.zeros(len(t), bool))
    good = np.isfinite(found.error) & all_finite(found.A, axis=(1, 2))
    return at_index(scaled_states(found, typical), good)
