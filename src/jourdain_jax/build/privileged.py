"""Which speeds are privileged: those that a user names, or those whose complement has the best pivots over all probes.

A_z, the columns of the dependent speeds in the scaled rows, must be regular wherever a motion goes; its pivot is its smallest singular value.
"""

import itertools
from collections.abc import Iterable

import numpy as np

from jourdain_jax.calculus.reals import described
from jourdain_jax.scene.names import as_names
from jourdain_jax.scene.scene import Scene


def privileged_by_user(scene: Scene, freedoms: int) -> tuple[int, ...] | None:
    """Numbers of the speeds that the scene names; None where it names none. ValueError for unknown names, and for others than `freedoms` speeds."""
    if scene.privileged is None:
        return None
    if not isinstance(scene.privileged, str | Iterable):
        raise ValueError(f"`privileged` of `{type(scene).__name__}` is {described(scene.privileged)}, expected names of speeds")
    chosen = tuple(scene.speed_names.index(name, f"privileged speed of `{type(scene).__name__}`:") for name in as_names(scene.privileged))
    if len(set(chosen)) != len(chosen):
        raise ValueError(f"`privileged` of `{type(scene).__name__}` names a speed twice ({', '.join(as_names(scene.privileged))}); name independent ones")
    if len(chosen) != freedoms:
        raise ValueError(
            f"`privileged` of `{type(scene).__name__}` names {len(chosen)} speeds, but the scene has {freedoms} degrees of freedom; "
            f"name {freedoms} independent speeds"
        )
    return chosen


def pivots_at(scaled: np.ndarray, dependent: list[int], rank: int) -> np.ndarray:
    """Smallest singular value of A_z at every probe."""
    if rank == 0:
        return np.ones(len(scaled))
    return np.linalg.svd(scaled[:, :, dependent], compute_uv=False)[:, rank - 1]


def worst_pivot(scaled: np.ndarray, dependent: list[int], rank: int, pivots: np.ndarray) -> float:
    """The smallest of the pivots over the domain: zero where the determinant of A_z changes sign between probes, for it vanishes in between."""
    if rank and scaled.shape[1] == rank:
        signs = np.linalg.slogdet(scaled[:, :, dependent])[0]
        if signs.min(initial=0.0) < 0 < signs.max(initial=0.0):
            return 0.0
    return float(pivots.min(initial=1.0))


def best_privileged(scaled: np.ndarray, count: int, rank: int) -> tuple[int, ...]:
    """The independent speeds whose complement has the largest worst pivot over all probes (the largest typical one among equals)."""
    if rank == 0:
        return tuple(range(count))
    subsets = list(itertools.islice(itertools.combinations(range(count), rank), 3001))
    if len(subsets) > 3000:
        subsets = list({_greedy(A, rank) for A in scaled})

    def merit(dependent, probes):
        pivots = pivots_at(probes, list(dependent), rank)
        return round(worst_pivot(probes, list(dependent), rank, pivots), 6), round(float(np.median(pivots)), 6)

    some = scaled[:: max(1, len(scaled) // 40)]
    best = sorted(subsets, key=lambda dependent: merit(dependent, some), reverse=True)[:40]
    dependent = max(best, key=lambda dependent: merit(dependent, scaled))
    return tuple(i for i in range(count) if i not in dependent)


def _greedy(A: np.ndarray, rank: int) -> tuple[int, ...]:
    """Columns chosen one after another by largest remaining length (pivoted QR)."""
    remaining, chosen = A.copy(), []
    for _ in range(rank):
        lengths = np.linalg.norm(remaining, axis=0)
        k = int(np.argmax(lengths))
        chosen.append(k)
        e = remaining[:, k] / lengths[k]
        remaining = remaining - np.outer(e, e @ remaining)
    return tuple(sorted(chosen))
