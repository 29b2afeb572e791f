"""Estimated sigmas, corrected for the unknowns that the same samples determine.

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

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.identification.inference.information import Information, variances
from jourdain_jax.identification.solve.arrow import ByUnknown
from jourdain_jax.identification.solve.levenberg_marquardt import Linearised
from jourdain_jax.identification.solve.loss import LEAST_SQUARES
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
