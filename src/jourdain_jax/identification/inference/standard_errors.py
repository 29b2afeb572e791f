"""Uncertainty of estimates at a minimum, from given or estimated sigmas, estimated correlation times, or
differences between runs.

    interval     estimate -+ q e
    by profile   2 (F - F_min) <= 3.84 f,   3.84 f = w^2 n log(1 + q^2 / n)

e: standard error; n: degrees of freedom. q: 97.5 % quantile of the normal distribution, or of Student's t if
noise is estimated, times the root of the contribution of estimated correlation times and channel weights.
w: e over the standard error that F alone predicts. F estimates sigma from all samples, without allowing for
the unknowns.

With one channel of unknown sigma, no prior and a linear motion, both equal the Student's t interval of linear
regression. Source: F. E. Satterthwaite, Biometrics Bulletin 2 (1946) 110; D. M. Bates and D. G. Watts,
Nonlinear Regression Analysis (1988), section 6.1.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool

from jourdain_jax.identification.inference.information import Information, information, students_t_95
from jourdain_jax.identification.inference.noise_levels import NoiseLevels, noise_levels
from jourdain_jax.identification.solve.arrow import Arrow, ByUnknown
from jourdain_jax.identification.solve.levenberg_marquardt import LEAST, Minimum
from jourdain_jax.identification.solve.problem import Problem

RISE_95 = 3.841458820694124  # of 2 F: 95 % quantile of chi-square


@dataclass(frozen=True)
class Rise:
    """The permitted rise of F within an interval."""

    errors: ByUnknown  # standard errors predicted by F alone
    of_rise: ByUnknown  # f
    wider: ByUnknown  # w
    degrees: ByUnknown  # n


@dataclass(frozen=True)
class Spread:
    """Uncertainties of the estimates, of all members."""

    levels: NoiseLevels  # sigmas, and the information that follows from them
    known: Information  # the same information, or that from differences between runs
    quantiles: ByUnknown  # q
    rise: Rise


def spread(problem: Problem, found: Minimum, bound: Bool[np.ndarray, "members places"]) -> Spread:
    """Return the uncertainties of estimates. Unknowns at a `bound` are held there."""
    unknowns = problem.unknowns
    theta = found.theta
    scores = found.at.arrow.scores
    cutoff = problem.asked.control.cutoff
    places, size, fails = unknowns.estimated, unknowns.sizes(theta), ~np.isfinite(found.at.cost)
    told_by = partial(information, size=size, estimated=places, bound=bound, fails=fails, cutoff=cutoff)

    def elsewhere(arrow: Arrow) -> tuple[np.ndarray, np.ndarray]:
        norms = np.where(arrow.column_norms > 0, arrow.column_norms, 1.0)
        moved = arrow.step(
            np.full(len(theta), LEAST), norms, unknowns.fixed | bound, np.zeros_like(theta), cutoff
        )
        return told_by(arrow).standard_errors, moved[:, places]

    levels = noise_levels(problem, theta, found.at, told_by, problem.loss.inflation)
    known, plain, of_sigmas = levels.known, told_by(found.at.arrow).standard_errors, levels.doubt
    more, of_memory = problem.doubt(theta, elsewhere)
    quantiles = _normal_or_t(of_memory, of_sigmas) * np.sqrt(1 + more + levels.more)
    if problem.asked.errors == "runs":
        if problem.estimated:
            of_runs = levels
        else:
            of_runs = noise_levels(problem, theta, found.at, told_by, lambda r, _: problem.loss.bend(r))
        known = replace(of_runs.known, own=known.own).between_runs(
            levels.at.arrow.scores if problem.estimated else scores
        )
        quantiles, of_sigmas = students_t_95(len(problem.runs) - 1), np.zeros(1)
    quantiles, degrees = (
        np.broadcast_to(x, plain.shape) for x in (quantiles, 2 / np.maximum(of_sigmas, 1e-12))
    )
    wider = known.standard_errors / plain
    return Spread(levels, known, quantiles, Rise(plain, _of_rise(wider, quantiles, degrees), wider, degrees))


def if_free(problem: Problem, found: Minimum, bound: Bool[np.ndarray, "members places"]) -> Rise:
    """Return the statistics that each unknown at a `bound` would have if it were free; NaN for other
    unknowns.
    """
    told = np.full((4, *bound.shape), np.nan)
    for place in np.flatnonzero(bound.any(axis=0)).tolist():
        others = np.where(np.arange(bound.shape[1]) == place, False, bound)
        here, k = spread(problem, found, others), np.searchsorted(problem.unknowns.estimated, place)
        told[..., place] = [x[:, k] for x in vars(here.rise).values()]
    return Rise(*told)


def _normal_or_t(of_memory: np.ndarray, of_sigmas: np.ndarray) -> np.ndarray:
    """Return the 97.5 % quantile in units of standard errors: normal for known noise, else Student's t.

    Its degrees of freedom are 2 / var(log C), for the variance C of an estimate as a function of the
    estimated correlation times and sigmas. C is a mean over correlation times, so the factor n / (n - 2) of
    Student's variance is omitted.
    """
    # an estimated correlation time leaves at least four degrees of freedom
    of_memory = np.minimum(of_memory, 0.5)
    doubt = of_memory + of_sigmas
    return np.where(
        doubt > 0, students_t_95(2 / np.maximum(doubt, 1e-12)) * np.sqrt(1 - of_memory), 1.959963984540054
    )


def _of_rise(wider: np.ndarray, quantiles: np.ndarray, n: np.ndarray) -> ByUnknown:
    """Return f; for an unknown without standard error, the largest f of the others."""
    f = wider**2 * n * np.log1p(quantiles**2 / n) / RISE_95
    return np.where(np.isfinite(f), f, np.max(f, axis=-1, keepdims=True, where=np.isfinite(f), initial=1.0))
