"""How far estimates are spread about a minimum: from sigmas, given or estimated, from correlation times that are not known, or from how much runs differ.

interval     estimate -+ q e      e: standard error; q: 97.5 % quantile of the normal distribution, or of Student's t where noise is estimated, times the root
                                  of what correlation times and weights of channels that are estimated add to the variance
by profile   2 (F - F_min) <= 3.84 f,   3.84 f = w^2 n log(1 + q^2 / n)      n: degrees of freedom; w: e over what F alone foretells, as sigma is estimated in F
                                                                             from all samples, without allowing for the unknowns
With one channel of unknown sigma, no prior and a linear motion both are the interval of Student's t of regression.
Source: F. E. Satterthwaite, Biometrics Bulletin 2 (1946) 110; D. M. Bates and D. G. Watts, Nonlinear Regression Analysis (1988), section 6.1.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.analysis.arrow import Arrow
from jourdain_jax.analysis.at_bounds import RISE_95, IfFree
from jourdain_jax.analysis.information import Information, information, students_t_95
from jourdain_jax.analysis.levenberg_marquardt import LEAST, Control, Limits, Minimum
from jourdain_jax.analysis.losses import LEAST_SQUARES
from jourdain_jax.analysis.noise_levels import NoiseLevels, noise_levels
from jourdain_jax.analysis.problem import Problem

NORMAL_95 = 1.959963984540054  # 97.5 % quantile of the standard normal distribution
_FEWEST_DEGREES = 4  # of freedom, that an estimated correlation time leaves


@dataclass(frozen=True)
class Spread:
    """What is told of how far estimates are spread, of all members."""

    levels: NoiseLevels  # sigmas, and what is known with them
    known: Information  # the same, or from how much runs differ
    plain: Float[np.ndarray, "members unknowns"]  # standard errors that F alone foretells
    quantiles: Float[np.ndarray, "members unknowns"]  # q
    wider: Float[np.ndarray, "members unknowns"]  # w
    degrees: Float[np.ndarray, "members unknowns"]  # n
    of_rise: Float[np.ndarray, "members unknowns"]  # f


def spread(problem: Problem, found: Minimum, bound: Bool[np.ndarray, "members places"], limits: Limits, control: Control, errors: str) -> Spread:
    """The spread of estimates; those at a `bound` are held there. `errors`: as of `fit`."""
    unknowns, theta, scores = problem.unknowns, found.theta, found.at.arrow.scores
    places, size, fails = unknowns.estimated, unknowns.sizes(theta), ~np.isfinite(found.at.cost)
    told_by = partial(information, size=size, estimated=places, bound=bound, fails=fails, cutoff=control.cutoff)

    def elsewhere(arrow: Arrow) -> tuple[np.ndarray, np.ndarray]:
        norms = np.where(arrow.column_norms > 0, arrow.column_norms, 1.0)
        moved = arrow.step(np.full(len(theta), LEAST), norms, limits.fixed | bound, np.zeros_like(theta), control.cutoff)
        return told_by(arrow).standard_errors, moved[:, places]

    levels = noise_levels(problem, theta, found.at, told_by, problem.loss.inflation)
    known, plain, of_sigmas = levels.known, told_by(found.at.arrow).standard_errors, levels.doubt
    more, of_memory = problem.doubt(theta, elsewhere)
    quantiles = _normal_or_t(of_memory, of_sigmas) * np.sqrt(1 + more + levels.more)
    if errors == "runs":
        of_runs = levels if problem.estimated else noise_levels(problem, theta, found.at, told_by, lambda r, _: problem.loss.bend(r))
        known = replace(of_runs.known, own=known.own).between_runs(levels.at.arrow.scores if problem.estimated else scores)
        quantiles, of_sigmas = students_t_95(len(problem.runs) - 1), np.zeros(1)
    quantiles, degrees = (np.broadcast_to(x, plain.shape) for x in (quantiles, 2 / np.maximum(of_sigmas, 1e-12)))
    wider = known.standard_errors / plain
    return Spread(levels, known, plain, quantiles, wider, degrees, _of_rise(wider, quantiles, degrees))


def if_free(problem: Problem, found: Minimum, bound: Bool[np.ndarray, "members places"], limits: Limits, control: Control, errors: str) -> IfFree:
    """f, w and n of each unknown at a `bound`, as if it were free."""
    told = IfFree(np.ones(bound.shape), np.ones(bound.shape), np.full(bound.shape, np.inf))
    if problem.estimated or problem.with_memory or problem.loss != LEAST_SQUARES or errors == "runs":
        for place in np.flatnonzero(bound.any(axis=0)).tolist():
            others = np.where(np.arange(bound.shape[1]) == place, False, bound)
            here, k = spread(problem, found, others, limits, control, errors), np.searchsorted(problem.unknowns.estimated, place)
            told.of_rise[:, place], told.wider[:, place], told.degrees[:, place] = here.of_rise[:, k], here.wider[:, k], here.degrees[:, k]
    return told


def _normal_or_t(of_memory: np.ndarray, of_sigmas: np.ndarray) -> np.ndarray:
    """97.5 % quantile by which a standard error is multiplied: normal where the noise is known, else Student's t.

    Its degrees of freedom are 2 / var(log C). The variances are those that estimated correlation times and sigmas leave. C is a mean over correlation times, so
    that t is to have that variance, without its n / (n - 2).
    """
    of_memory = np.minimum(of_memory, 2 / _FEWEST_DEGREES)
    doubt = of_memory + of_sigmas
    return np.where(doubt > 0, students_t_95(2 / np.maximum(doubt, 1e-12)) * np.sqrt(1 - of_memory), NORMAL_95)


def _of_rise(wider: np.ndarray, quantiles: np.ndarray, n: np.ndarray) -> Float[np.ndarray, "members unknowns"]:
    """f; where an unknown has no standard error, the largest of others is taken."""
    f = wider**2 * n * np.log1p(quantiles**2 / n) / RISE_95
    return np.where(np.isfinite(f), f, np.max(f, axis=-1, keepdims=True, where=np.isfinite(f), initial=1.0))
