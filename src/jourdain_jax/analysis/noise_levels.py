"""How large noise is that nobody stated: what sigmas are estimated to be, once it is allowed for that their samples determined unknowns as well.

    sigma_c^2 = sum w^2 / (n_c - p_c),    p_c = tr(C A_c),   A_c = J_c' J_c / sigma_c^2       n_c samples of channel c; C: covariance of all unknowns
    degrees of freedom of the variance C_ii:   1 / sum_c v_ic^2 / (n_c - p_c),    v_ic = (C A_c C)_ii / C_ii: what channel c adds to it
    variance of the estimate:   C_ii - sum_c 2 / (n_c - p_c) sigma_c^4 d^2 C_ii / d (sigma_c^2)^2,    as the weights of channels and priors are estimated, too

With one channel and no prior n - p is left, and intervals are those of Student's t. Under a robust loss the same holds of all samples together, and the factor
by which their variance is to be multiplied takes the place of sigma^2. Priors and channels whose sigma is given are taken as they are.
Source: H. D. Patterson and R. Thompson, Biometrika 58 (1971) 545; F. E. Satterthwaite, Biometrics Bulletin 2 (1946) 110; M. G. Kenward and J. H. Roger,
Biometrics 53 (1997) 983.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.analysis.information import Information, variances
from jourdain_jax.analysis.levenberg_marquardt import Linearised
from jourdain_jax.analysis.losses import LEAST_SQUARES
from jourdain_jax.analysis.problem import Problem

LEFT = 0.5  # degrees of freedom: with fewer, a channel does not tell its sigma
_STEP = 0.03  # of sigma^2, for the second derivative of C
_TURNS, _SETTLED = 50, 1e-8  # of sigmas and covariance; relative change of sigmas that ends them


@dataclass(frozen=True)
class NoiseLevels:
    """A linearised problem with these sigmas, and what is known of them."""

    at: Linearised
    known: Information
    doubt: Float[np.ndarray, "members unknowns"]  # variance of log C_ii, 2 over its degrees of freedom
    more: Float[np.ndarray, "members unknowns"]  # what weights that are estimated add to C_ii, relative to it
    untold: Bool[np.ndarray, "members channels"]  # which channels do not tell their sigma: nothing is taken from them


def noise_levels(problem: Problem, theta: np.ndarray, at: Linearised, told_by: Callable, of_loss: Callable[[np.ndarray, float], float]) -> NoiseLevels:
    """What is known at theta. `told_by`: the information of an arrow; `of_loss`: the factor by which a loss multiplies variances, of the residuals of one
    member and the number of unknowns that they determined.
    """
    members, places, count = np.arange(len(theta)), problem.unknowns.estimated, 1 + len(problem.estimated)
    known = told_by(at.arrow)
    doubt, untold = np.zeros((len(theta), len(places))), np.zeros((len(theta), count), bool)
    if count == 1 and problem.loss == LEAST_SQUARES:
        return NoiseLevels(at, known, doubt, 0 * doubt, untold[:, 1:])
    by_run = [problem.by_channel(run, at, lambda x: x) for run in range(len(problem.runs))]
    residuals = [r[np.isfinite(r)] for r in np.concatenate([r.reshape(len(theta), -1) for of in by_run for r in of.values()], axis=1)]
    samples = np.concatenate([[[r.size] for r in residuals], problem.lanes.counted(problem.estimated, members)], axis=1)
    (determined, widths), unsure = np.zeros((2, len(theta), count)), problem.loss != LEAST_SQUARES
    for _ in range(_TURNS):
        left, before = samples - determined, widths.copy()
        untold[:, 1:] |= left[:, 1:] < LEFT
        widths[:, 1:] = np.maximum(np.sqrt(at.squares[:, 1:] / np.maximum(left[:, 1:], LEFT)), problem.least_sigma)
        widths[:, 0] = [np.sqrt(of_loss(r, p)) if r.size else 1.0 for r, p in zip(residuals, determined[:, 0].tolist(), strict=True)] if unsure else 1.0
        widths[untold] = np.inf
        if np.allclose(widths, before, rtol=_SETTLED, atol=0):
            break
        arrow = problem.joined(theta, at.triangles, widths)[0]
        known = told_by(arrow)
        determined, added = _told_by_kind(known, at.triangles / widths[:, None, :, None, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = added[..., places] / variances(known.shared, known.own, known.follow)[:, None, places]
    counts = np.s_[:, 0 if unsure else 1 :]
    doubt = 2 * np.sum(np.nan_to_num(shares[counts]) ** 2 / np.maximum(left[counts], LEFT)[..., None], axis=1)
    at = replace(at, arrow=arrow, sigma=np.where(untold[:, 1:], at.sigma, widths[:, 1:]))
    more = 0 * doubt
    for k in range(1, count):
        other = [widths * np.sqrt(1 + step * (np.arange(count) == k)) for step in (-_STEP, _STEP)]
        ends = [(told_by(problem.joined(theta, at.triangles, some)[0]).standard_errors / known.standard_errors) ** 2 for some in other]
        more -= 2 / np.maximum(left[:, k : k + 1], 1.0) * (sum(ends) - 2) / _STEP**2
    return NoiseLevels(at, known, doubt, np.maximum(np.nan_to_num(more), 0.0), untold[:, 1:])


def _told_by_kind(known: Information, T: Float[np.ndarray, "members runs kinds width width"]) -> tuple[np.ndarray, np.ndarray]:
    """p_c (members, kinds), and (C A_c C)_ii (members, kinds, places), from triangles in units of sigma."""
    m, S, G, own = known.follow.shape[-2], known.shared[:, None, None], known.follow[:, :, None], known.own[:, :, None]
    T_o, T_s = T[..., :m], T[..., m:-1]
    X = T_s - T_o @ G  # own unknowns of a run follow the shared ones, x = - G s
    p = np.einsum("brkij,brkij->bk", X @ S, X) + np.einsum("brkij,brkij->bk", T_o @ own, T_o)
    Q = np.sum(S @ np.swapaxes(X, -1, -2) @ X @ S, axis=1)  # of all runs
    direct, through = T_o @ own, X @ S @ np.swapaxes(G, -1, -2)
    of_own = np.einsum("brij,bkjl,bril->bkri", known.follow, Q, known.follow) + np.swapaxes(np.sum(direct**2 - 2 * direct * through, axis=-2), 1, 2)
    return p, np.concatenate([np.diagonal(Q, axis1=-2, axis2=-1), of_own.reshape(*of_own.shape[:2], -1)], axis=-1)
