"""What measurements tell about the unknowns: covariance where they do, and the combinations that they leave open.

    J_s = d r / d (theta / size) = U S V'          residuals r in units of sigma, unknowns in units of their own size
    rank: number of singular values above cutoff * (the largest)
    covariance = size V_1 S_1^-2 V_1' size          over the directions V_1 that show

An unknown with a part in the remaining directions V_0 has no standard error and no interval.
Source: G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989), sections 2.1 and 3.4.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


class Information(eqx.Module):
    """Singular values of the scaled Jacobian and what follows."""

    singular_values: Float[Array, "unknowns"]  # largest first
    directions: Float[Array, "unknowns unknowns"]  # rows: V', changes of theta / size
    rank: Int[Array, ""]
    identifiable: Bool[Array, "unknowns"]
    covariance: Float[Array, "unknowns unknowns"]  # units of the unknowns; NaN where not identifiable


def information(jacobian: Float[Array, "samples unknowns"], size: Float[Array, "unknowns"], cutoff: float) -> Information:
    """Information in residuals (units of sigma) with this Jacobian `d r / d theta`.

    `size`: magnitude of each unknown, in its unit; `cutoff`: singular values below this fraction of the largest count as zero.
    Unknowns whose part in the directions that do not show exceeds the square root of the cut-off are not identifiable.
    """
    scaled = jacobian * size
    usable = jnp.all(jnp.isfinite(scaled))
    _, S, Vt = jnp.linalg.svd(jnp.where(usable, scaled, 0.0), full_matrices=False)
    shows = cutoff * S[0] < S
    V = Vt.T * size[:, None]
    covariance = (V * jnp.where(shows, 1 / jnp.where(shows, S, 1.0) ** 2, 0.0)) @ V.T
    hidden = jnp.sqrt(jnp.sum(jnp.where(shows[:, None], 0.0, Vt) ** 2, axis=0))
    identifiable = hidden < jnp.sqrt(cutoff)
    both = identifiable[:, None] & identifiable[None, :]
    return Information(S, Vt, jnp.sum(shows), identifiable, jnp.where(both, covariance, jnp.nan))


def hidden_combinations(directions, size, values, labels: tuple[str, ...]) -> tuple[str, ...]:
    """Each direction that does not show, in words. `directions`: rows, changes of theta / size, orthonormal.

    A basis is chosen in which each direction has one unknown of its own (row-reduced form), in relative changes
    `d theta / theta` where the unknown is not zero.
    """
    relative = np.abs(values) > 1e-3 * np.abs(size)
    basis = _reduced(np.asarray(directions) * size / np.where(relative, values, 1.0))
    shared = np.count_nonzero(basis, axis=0) > 1
    return tuple(_in_words(row, relative, relative & ~shared, labels) for row in basis)


def _in_words(row: np.ndarray, relative: np.ndarray, power: np.ndarray, labels: tuple[str, ...]) -> str:
    """`power`: where a power of the unknown stays as it is along this direction and along all others."""
    involved = np.flatnonzero(row)
    if len(involved) == 1:
        return f"`{labels[involved[0]]}` does not show in any channel"
    names = " and ".join(f"`{labels[i]}`" for i in involved)
    changes = " : ".join(f"d {labels[i]}/{labels[i]}" if relative[i] else f"d {labels[i]}" for i in involved)
    text = f"{names} do not show separately: no channel changes along {changes} = {' : '.join(f'{row[i]:.3g}' for i in involved)}"
    if not power[involved].all():
        return text
    own, others = involved[0], involved[1:]
    products = ", ".join(f"{labels[i]} {labels[own]}^{-row[i] / row[own]:.3g}" for i in others)
    return f"{text}; what shows is {products}"


def _reduced(rows: np.ndarray) -> np.ndarray:
    """Reduced row-echelon form with the largest pivots; entries below 1e-3 of the largest of their row are noise, and go."""
    rows = rows / np.max(np.abs(rows), axis=1, keepdims=True)
    free = list(range(len(rows)))
    for _ in range(len(rows)):
        i, k = max(((i, k) for i in free for k in range(rows.shape[1])), key=lambda place: round(abs(rows[place]), 6))
        rows[i] /= rows[i, k]
        others = [j for j in range(len(rows)) if j != i]
        rows[others] -= np.outer(rows[others, k], rows[i])
        free.remove(i)
    return np.where(np.abs(rows) > 1e-3 * np.max(np.abs(rows), axis=1, keepdims=True), rows, 0.0)
