"""Numbers that were measured together: priors whose errors are correlated.

    r = M S^-1 (theta - mean),     M C M' = 1       S: standard deviations, C: correlations;     r: residuals more, so that |r|^2 = d' (S C S)^-1 d

C = V diag(e) V' gives M = diag(e)^-1/2 V'. Of numbers of which only some are free, S C S is the part of the covariance that belongs to these (the marginal).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import checked_known, described

_LEAST = 1e-8  # eigenvalue of correlations: a combination that is known exactly counts as known to a ten thousandth of the sigmas
_ROUND_OFF = 1e-9  # of correlations


@dataclass(frozen=True, eq=False)
class Correlated:
    """The prior of one of several numbers that were measured together (`joint_normal`): its mean, its standard deviation, and its place among them."""

    mean: float
    sigma: float
    place: int
    covariance: np.ndarray  # of all of them


def joint_normal(mean: Mapping[str, float], covariance) -> dict[str, Correlated]:
    """Priors of several parameters whose errors are correlated: `free=jj.joint_normal({"mass": 20.9, "inertia": 1.64}, covariance)`.

    **Arguments**
    - `mean`: name -> mean, in the unit of the parameter, of one number each.
    - `covariance`: (n, n), in the order of the names. It may be singular: a combination that it says is known exactly is taken as known to a ten thousandth of
      the standard deviations.

    **Returns** name -> prior, for `free` of `fit`, alone or together with others: `free=jj.joint_normal(...) | {"gain": None}`. Where only some of the names
    are free, the covariance is that of these. `jj.Estimate(range=..., prior=joint["mass"])` adds a range.

    **Raises** ValueError for numbers that are not finite, another shape, a matrix that is not symmetric or no covariance, and a variance that is zero.
    Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), chapter 14 (prior information as further data).
    """
    if not isinstance(mean, Mapping) or not mean:
        raise ValueError(f'`mean` of `joint_normal` is {described(mean)}, expected a dictionary of name -> mean, such as {{"mass": 20.9, "inertia": 1.64}}')
    means = [float(checked_known(x, f"the mean of `{name}`", (), advice="give one number")) for name, x in mean.items()]
    n, names = len(means), list(mean)
    C = checked_known(covariance, "`covariance` of `joint_normal`", (n, n), advice=f"one row and one column for each of {', '.join(names)}")
    if not (np.all(np.isfinite(C)) and np.all(np.isfinite(means))):
        raise ValueError("mean and covariance of `joint_normal` must be finite; leave out what is not known")
    variances = np.diag(C)
    if np.any(variances <= 0):
        first = names[int(np.argmax(variances <= 0))]
        raise ValueError(f"the variance of `{first}` is {variances[names.index(first)]:g}, expected one above zero; a number that is known needs no estimate")
    sigma = np.sqrt(variances)
    correlations = C / np.outer(sigma, sigma)
    if np.max(np.abs(correlations - correlations.T)) > _ROUND_OFF:
        raise ValueError("`covariance` of `joint_normal` is not symmetric; give cov(a, b) = cov(b, a)")
    if (least := np.linalg.eigvalsh(correlations)[0]) < -n * _ROUND_OFF:
        raise ValueError(f"`covariance` of `joint_normal` is no covariance: its correlations have the eigenvalue {least:.3g}, expected none below zero")
    return {name: Correlated(means[k], float(sigma[k]), k, C) for k, name in enumerate(names)}


def whitening(priors: Sequence) -> Float[np.ndarray, "numbers numbers"]:
    """M of numbers with these priors (None, or what has a mean and a sigma); the identity but for those that were measured together."""
    M = np.eye(len(priors))
    together: dict[int, list[int]] = {}
    for k, prior in enumerate(priors):
        if isinstance(prior, Correlated):
            together.setdefault(id(prior.covariance), []).append(k)
    for places in together.values():
        which, sigma = [priors[k].place for k in places], np.array([priors[k].sigma for k in places])
        C = priors[places[0]].covariance[np.ix_(which, which)] / np.outer(sigma, sigma)
        e, V = np.linalg.eigh(C)
        M[np.ix_(places, places)] = V.T / np.sqrt(np.maximum(e, _LEAST))[:, None]
    return M
