"""Numbers that follow from what a fit found: their estimates, standard errors and intervals, to first order.

    y = f(scene),     var(y) = g' C g,     g = d y / d theta,     interval y -+ q sqrt(var(y))      C: covariance of the estimates

A number can be told although its parts cannot: it has a standard error where g has no part in the directions that do not show.
Source: C. R. Rao, Linear Statistical Inference and Its Applications, 2nd ed. (1973), section 6a.2 (the delta method).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.analysis.information import Information, least_move
from jourdain_jax.analysis.layout import Layout
from jourdain_jax.calculus.reals import described
from jourdain_jax.scene.scene import Scene


def derived(scene: Scene, layout: Layout, function: Callable[[Scene], Array], shared: Float[np.ndarray, "*repeats shared"]):
    """y and d y / d (shared unknowns), of one fit or of each of a batch. ValueError where the function does not return numbers."""

    def of(shared):
        value = function(layout.scene(scene, shared))
        try:
            return jnp.asarray(value, jnp.result_type(float))
        except (TypeError, ValueError):
            raise ValueError(f"the function returns {described(value)}, expected a number or an array of numbers") from None

    def with_slopes(shared):
        return of(shared), jax.jacfwd(of)(shared)

    for _ in shared.shape[:-1]:
        with_slopes = jax.vmap(with_slopes)
    value, slopes = with_slopes(jnp.asarray(shared))
    return np.asarray(value), np.asarray(slopes)


def standard_errors(
    known: Information,
    slopes: Float[np.ndarray, "*numbers shared"],
    sizes: Float[np.ndarray, "*repeats shared"],
    at_bound: Bool[np.ndarray, "*repeats shared"],
    cutoff: float,
) -> Float[np.ndarray, "*numbers"]:
    """Standard errors of numbers with these slopes, which have an axis of repeats in front where the information has.

    NaN for those that depend on a direction that does not show, or on an unknown at a bound.
    """
    shared = slopes.shape[-1]
    covariance, largest = known.whole_covariance[..., :shared, :shared], np.max(known.singular_values, axis=-1, initial=0.0)

    def of_one(C, hidden, rank, largest, slopes, sizes, at_bound):
        error = np.sqrt(np.einsum("...i,ij,...j->...", slopes, C, slopes))
        scaled = slopes * sizes  # with respect to theta / size
        part = np.linalg.norm(scaled @ hidden[:, :shared].T, axis=-1)
        told = (part <= np.minimum(np.sqrt(cutoff) * np.linalg.norm(scaled, axis=-1), error * least_move(cutoff, largest))) & ~np.any(
            (slopes != 0) & (at_bound | (rank == 0)), axis=-1
        )
        return np.where(told, error, np.nan)

    if sizes.ndim == 1:
        return of_one(covariance, known.hidden[0], known.rank, largest, slopes, sizes, at_bound)
    return np.stack([of_one(*one) for one in zip(covariance, known.hidden, known.rank, largest, slopes, sizes, at_bound, strict=True)])
