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

Estimated sigmas are corrected for the unknowns that the same samples determine:

    sigma_c^2 = sum w^2 / (n_c - p_c),   p_c = tr(C A_c),   A_c = J_c' J_c / sigma_c^2
    degrees of freedom of C_ii   1 / sum_c v_ic^2 / (n_c - p_c),   v_ic = (C A_c C)_ii / C_ii
    variance of the estimate     C_ii - sum_c 2 / (n_c - p_c) sigma_c^4 d^2 C_ii / d (sigma_c^2)^2

C: covariance of all unknowns; w, J_c: the n_c residuals of channel c and their derivatives; v_ic:
contribution of channel c to the variance C_ii. The last line accounts for the weights, which are estimated,
too.

With one channel and no prior there are n - p degrees of freedom, and intervals are those of Student's t.
Under a robust loss the same holds for all samples together, with the inflation of the variance in place of
sigma^2. Priors and given sigmas count as known.

Source: H. D. Patterson and R. Thompson, Biometrika 58 (1971) 545; F. E. Satterthwaite, Biometrics Bulletin 2
(1946) 110; M. G. Kenward and J. H. Roger, Biometrics 53 (1997) 983.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.identification.inference.information import (
    Information,
    information,
    students_t_95,
    variances,
)
from jourdain_jax.identification.solve.arrow import Arrow, ByUnknown
from jourdain_jax.identification.solve.levenberg_marquardt import LEAST, LEAST_SQUARES, Linearised, Minimum
from jourdain_jax.identification.solve.problem import Problem


@dataclass(frozen=True)
class NoiseLevels:
    """A linearised problem with estimated sigmas, and the statistics of these."""

    at: Linearised
    known: Information
    doubt: ByUnknown  # variance of log C_ii: 2 over its degrees of freedom
    more: ByUnknown  # contribution of estimated weights to C_ii, relative to it
    # channels that do not determine their sigma; their samples are not used
    untold: Bool[np.ndarray, "members channels"]


def noise_levels(
    problem: Problem,
    theta: np.ndarray,
    at: Linearised,
    told_by: Callable,
    of_loss: Callable[[np.ndarray, float], float],
) -> NoiseLevels:
    """Return sigmas and their statistics at theta. `told_by(arrow)` returns the information of an arrow
    matrix. `of_loss(residuals, unknowns)` returns the inflation of variances by a loss, for the residuals of
    one member and the number of unknowns that they determined.
    """
    members, places, count = np.arange(len(theta)), problem.unknowns.estimated, 1 + len(problem.estimated)
    known = told_by(at.arrow)
    doubt, untold = np.zeros((len(theta), len(places))), np.zeros((len(theta), count), bool)
    if count == 1 and problem.loss == LEAST_SQUARES:
        return NoiseLevels(at, known, doubt, 0 * doubt, untold[:, 1:])
    by_run = [problem.by_channel(run, at) for run in range(len(problem.runs))]
    residuals = [
        r[np.isfinite(r)]
        for r in np.concatenate([r.reshape(len(theta), -1) for of in by_run for r in of.values()], axis=1)
    ]
    samples = np.concatenate(
        [[[r.size] for r in residuals], problem.counted(problem.estimated, members)], axis=1
    )
    (determined, widths), unsure = np.zeros((2, len(theta), count)), problem.loss != LEAST_SQUARES
    fewest = 0.5  # degrees of freedom that a channel needs to determine its sigma
    for _ in range(50):
        left, before = samples - determined, widths.copy()
        untold[:, 1:] |= left[:, 1:] < fewest
        widths[:, 1:] = np.maximum(
            np.sqrt(at.squares[:, 1:] / np.maximum(left[:, 1:], fewest)), problem.least_sigma
        )
        widths[:, 0] = 1.0
        if unsure:
            pairs = zip(residuals, determined[:, 0].tolist(), strict=True)
            widths[:, 0] = [np.sqrt(of_loss(r, p)) if r.size else 1.0 for r, p in pairs]
        widths[untold] = np.inf
        if np.allclose(widths, before, rtol=1e-8, atol=0):
            break
        arrow = problem.joined(theta, at.triangles, widths)[0]
        known = told_by(arrow)
        determined, added = _told_by_kind(known, at.triangles / widths[:, None, :, None, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = added[..., places] / variances(known.shared, known.own, known.follow)[:, None, places]
    counts = np.s_[:, 0 if unsure else 1 :]
    doubt = 2 * np.sum(
        np.nan_to_num(shares[counts]) ** 2 / np.maximum(left[counts], fewest)[..., None], axis=1
    )
    at = replace(at, arrow=arrow, sigma=np.where(untold[:, 1:], at.sigma, widths[:, 1:]))
    more, change = 0 * doubt, 0.03  # relative increment of sigma^2, for the second derivative of C
    for k in range(1, count):
        other = [widths * np.sqrt(1 + step * (np.arange(count) == k)) for step in (-change, change)]
        ends = [
            (told_by(problem.joined(theta, at.triangles, some)[0]).standard_errors / known.standard_errors)
            ** 2
            for some in other
        ]
        more -= 2 / np.maximum(left[:, k : k + 1], 1.0) * (sum(ends) - 2) / change**2
    return NoiseLevels(at, known, doubt, np.maximum(np.nan_to_num(more), 0.0), untold[:, 1:])


def _told_by_kind(
    known: Information, T: Float[np.ndarray, "members runs kinds width width"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return p_c (members, kinds) and (C A_c C)_ii (members, kinds, places), from triangles in units of
    sigma.
    """
    m = known.follow.shape[-2]
    S = known.shared[:, None, None]
    G = known.follow[:, :, None]
    own = known.own[:, :, None]
    T_o, T_s = T[..., :m], T[..., m:-1]
    X = T_s - T_o @ G  # unknowns of a run follow the shared ones, x = - G s
    p = np.einsum("brkij,brkij->bk", X @ S, X) + np.einsum("brkij,brkij->bk", T_o @ own, T_o)
    Q = np.sum(S @ np.swapaxes(X, -1, -2) @ X @ S, axis=1)  # of all runs
    direct, through = T_o @ own, X @ S @ np.swapaxes(G, -1, -2)
    of_own = np.einsum("brij,bkjl,bril->bkri", known.follow, Q, known.follow) + np.swapaxes(
        np.sum(direct**2 - 2 * direct * through, axis=-2), 1, 2
    )
    return p, np.concatenate(
        [np.diagonal(Q, axis1=-2, axis2=-1), of_own.reshape(*of_own.shape[:2], -1)], axis=-1
    )


RISE_95 = 3.841458820694124  # numerics: of 2 F: 95 % quantile of chi-square


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
