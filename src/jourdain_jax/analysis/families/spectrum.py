"""Match eigenvalues of small motions along a family, so that each column follows one mode."""

import numpy as np
from jaxtyping import Complex, Float

from jourdain_jax.calculus.lazy_imports import module_on_first_use
from jourdain_jax.calculus.reals import largest
from jourdain_jax.scene.names import Labels
from jourdain_jax.scene.scene import Scene

optimize = module_on_first_use("scipy.optimize")
Modes = Complex[np.ndarray, "modes"]


def null_space(C: Float[np.ndarray, "rows states"]) -> Float[np.ndarray, "states free"]:
    """Return an orthonormal basis of the null space of C."""
    _, sigma, V = np.linalg.svd(C)
    return V[np.sum(sigma > 1e-9 * np.max(sigma, initial=1e-300)) :].T


def matched(before: Modes, now: Modes) -> Modes:
    """Return the eigenvalues in the order of their predecessors: the assignment with the smallest total
    change.
    """
    apart, place = np.abs(before[:, None] - now), np.arange(len(now))
    return now[optimize.linear_sum_assignment(apart - 1e-12 * (1 + largest(now)) * np.outer(place, place))[1]]


def surely_matched(before: Modes, now: Modes) -> bool:
    """Return whether each eigenvalue moved by at most half of its distance to the nearest other eigenvalue.
    Its complex conjugate does not count as another.
    """
    columns = range(len(now))
    beside = np.array([[k == j or are_partners(before, now, k, j) for j in columns] for k in columns])
    apart = np.where(beside, np.inf, np.abs(before[:, None] - before))
    return bool(np.all(np.abs(now - before) <= 0.5 * np.min(apart, axis=1, initial=np.inf)))


def are_partners(before, now, k: int, j: int) -> bool:
    """Return whether two columns are a complex conjugate pair before or now."""
    return any(v[k].imag != 0 and v[j] == np.conj(v[k]) for v in (before, now))


def mode_names(scene: Scene, names: Labels | None, values: Modes) -> Labels:
    """Return the names of the columns: `names` if given, otherwise the scene's, otherwise "mode 1", ..."""
    named = getattr(scene, "mode_names", None)
    names = (
        tuple(names)
        if names is not None
        else (named and named(values)) or tuple(f"mode {k + 1}" for k in range(len(values)))
    )
    if len(names) != len(values):
        raise ValueError(f"`names` has {len(names)} names, expected one for each of the {len(values)} modes")
    return names
