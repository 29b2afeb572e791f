"""Uncertainty of estimates at a minimum: from given or estimated sigmas, unknown correlation times, or
differences between runs.

    interval     estimate -+ q e      e: standard error; q: 97.5 % quantile of the normal distribution, or of Student's t if noise is
                                      estimated, times the root of the contribution of estimated correlation times and channel weights
    by profile   2 (F - F_min) <= 3.84 f,   3.84 f = w^2 n log(1 + q^2 / n)      n: degrees of freedom; w: e over the value predicted
                                      by F alone, in which sigma is estimated from all samples, without allowing for the unknowns

With one channel of unknown sigma, no prior and a linear motion, both are the interval of Student's t of
regression. Source: F. E. Satterthwaite, Biometrics Bulletin 2 (1946) 110; D. M. Bates and D. G. Watts,
Nonlinear Regression Analysis (1988), section 6.1.

Unknowns at a bound: a one-sided limit by profile likelihood, and intervals that bounds make too narrow.

    p(delta) = min over all other unknowns of (F - F_min), theta = bound + delta; the limit is at 2 p = 3.84 f; f = 1 for known noise
    p is close to g delta + h delta^2 / 2, g: slope of F at the bound, 1 / h: variance of the unknown if it were free
    p < 0: F is lower away from the bound, a saddle. F is level at the bound if another unknown has the same effect: a delay at zero lag
    beyond = b / sqrt(w^2 - b^2 / n),  b = g e: standard errors from the bound to the free minimum beyond it; e: as predicted by F

If sigmas are estimated, residuals caused by a bound count as noise: with N samples, b stays below sqrt(N)
however far the bound is; `beyond` does not. The rise is the same as for other intervals. With the rise of a
one-sided limit, 2.71 f, data would choose between two kinds of interval. Together these cover a true value
1.6 standard errors from its bound in only 92.5 % of repeats.

Source: D. J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87; G. J. Feldman and R. D. Cousins,
Physical Review D 57 (1998) 3873, section IV.

Estimated sigmas, corrected for the unknowns that the same samples determine:

    sigma_c^2 = sum w^2 / (n_c - p_c),    p_c = tr(C A_c),   A_c = J_c' J_c / sigma_c^2       n_c samples of channel c; C: covariance of all unknowns
    degrees of freedom of the variance C_ii:   1 / sum_c v_ic^2 / (n_c - p_c),    v_ic = (C A_c C)_ii / C_ii: contribution of channel c
    variance of the estimate:   C_ii - sum_c 2 / (n_c - p_c) sigma_c^4 d^2 C_ii / d (sigma_c^2)^2,    since weights are estimated too

With one channel and no prior there are n - p degrees of freedom, and intervals are those of Student's t.
Under a robust loss the same holds for all samples together, with the inflation of the variance in place of
sigma^2. Priors and given sigmas count as known.

Source: H. D. Patterson and R. Thompson, Biometrika 58 (1971) 545; F. E. Satterthwaite, Biometrics Bulletin 2
(1946) 110; M. G. Kenward and J. H. Roger, Biometrics 53 (1997) 983.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.identification.inference.information import (
    Information,
    information,
    students_t_95,
    variances,
)
from jourdain_jax.identification.solve.arrow import Arrow, ByUnknown
from jourdain_jax.identification.solve.levenberg_marquardt import LEAST, Linearised, Minimum
from jourdain_jax.identification.solve.problem import LEAST_SQUARES, Problem

RISE_95 = 3.841458820694124  # of 2 F
FAR_BEYOND = 3.0  # standard errors: an estimate this far beyond its bound is significant
ADVICE = "`Fit.profiles` gives intervals that hold"


@dataclass(frozen=True)
class Rise:
    """The permitted rise of F within an interval."""

    errors: ByUnknown  # standard errors predicted by F alone
    of_rise: ByUnknown  # f
    wider: ByUnknown  # w
    degrees: ByUnknown  # n


@dataclass
class AtBounds:
    """Statistics of unknowns at a bound, for converged fits; NaN for all others."""

    limit: ByUnknown  # infinite if the data give none
    beyond: ByUnknown  # distance of the free minimum beyond the bound, in standard errors
    if_free: Rise
    # by member: F and all unknowns at a lower minimum with one unknown off its bound
    lower: dict[int, tuple[float, np.ndarray]] = field(default_factory=dict)
    # by member and unknown at a bound: all unknowns when that one is at its limit
    at_limit: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)


class Side(NamedTuple):
    """The profile of one unknown to one side of its estimate."""

    end: float  # value at the permitted rise of F; if F does not rise so far, the bound or infinity
    is_closed: bool  # whether F reaches the permitted rise
    at: Minimum | None  # the minimum at the end, or a minimum lower than the fit's
    points: list[tuple[float, float]]  # values of the unknown, and rises of F
    note: str  # other observations


def side(problem: Problem, found: Minimum, b: int, place: int, way: float, first: float, end: float) -> Side:
    """Follow the profile of member `b` along one unknown in one direction (`way` is 1 or -1), starting at the
    distance `first`, until F has risen by `end`.

    All other unknowns start from their values at the previous point. The end is found by the secant method
    for the square root of the rise, which is nearly linear.
    """
    close, origin, theta = (
        0.01,
        float(found.theta[b, place]),
        found.theta[b : b + 1],
    )  # close: of the rise at the end
    bound = float((problem.unknowns.low if way < 0 else problem.unknowns.high)[place])
    room = min(abs(bound - origin), 1e6 * first)
    inner, outer, note = (0.0, 0.0), (np.inf, np.inf), ""  # distance and rise on either side
    delta, points = min(first, room), []
    for _ in range(20 if room else 0):
        at = problem.beside(theta, b, place, origin + way * delta)
        rise, where = float(at.at.cost[0] - found.at.cost[b]), f"near {origin + way * delta:.6g}"
        if np.isfinite(rise):
            points.append((origin + way * delta, rise))
            note = (
                note
                if at.converged[0]
                else (f"no minimum over the others was found {where}, so the interval may be too narrow")
            )
        if rise < -2 * close * end:
            return Side(bound, False, at, points, f"a lower minimum lies {where}; fit again from there")
        if abs(rise / end - 1) < close:
            return Side(origin + way * delta, True, at, points, note)
        if rise < end:
            theta, inner = at.theta, (delta, max(rise, 0.0))
        else:
            outer = delta, rise
        if inner[0] >= room:
            return Side(bound, False, None, points, note)
        if np.isfinite(outer[1]):
            low, high = np.sqrt(inner[1] / end), np.sqrt(outer[1] / end)
            delta = inner[0] + (outer[0] - inner[0]) * float(np.clip((1 - low) / (high - low), 0.1, 0.9))
        elif np.isfinite(outer[0]):  # the motion fails there
            if outer[0] - inner[0] < 1e-3 * first:
                break
            delta = inner[0] + (outer[0] - inner[0]) / 4
        else:
            delta = min(delta * min(np.sqrt(end / inner[1]) * (1 + close) if inner[1] else 4.0, 4.0), room)
    if not np.isfinite(outer[1]):
        return Side(
            bound, False, None, points, f"the motion fails {where}" if np.isfinite(outer[0]) else note
        )
    return Side(
        origin + way * outer[0], True, at, points, f"the sum of squares jumps {where}: other unknowns change"
    )


def limits_at_bounds(problem: Problem, found: Minimum) -> AtBounds:
    """Return the statistics of unknowns at a bound: each is moved away from it, while all others are fitted
    again.
    """
    theta, bound = found.theta, problem.unknowns.reached(found.theta)
    told = AtBounds(
        np.full(theta.shape, np.nan), np.full(theta.shape, np.nan), if_free(problem, found, bound)
    )
    for b, place in np.argwhere(bound & found.converged[:, None]).tolist():
        _look_inward(problem, found, told, b, place)
    return told


def _look_inward(problem: Problem, found: Minimum, told: AtBounds, b: int, place: int) -> None:
    """Follow the objective as one unknown leaves its bound."""
    bound, limits = found.theta[b, place], problem.unknowns
    inward = 1.0 if bound <= limits.low[place] else -1.0
    error, f, w, n = (x[b, place] for x in vars(told.if_free).values())
    slope, end = abs(float(found.at.arrow.gradient[b, place])), RISE_95 / 2 * f
    if np.isfinite(error):
        left = w**2 - (slope * error) ** 2 / n
        told.beyond[b, place] = np.inf if left <= 0 else slope * error / np.sqrt(left)
    if told.beyond[b, place] > FAR_BEYOND:  # the bound is decisive: the slope alone gives the limit
        told.limit[b, place] = bound + inward * _root(slope, 1 / error**2, end)
        return
    first = (
        _root(slope, 1 / error**2, end) if np.isfinite(error) else float(limits.sizes(found.theta[b])[place])
    )
    inner = side(problem, found, b, place, inward, first, end)
    if inner.is_closed and inner.at is not None:
        told.at_limit[b, place] = inner.at.theta[0]
    elif inner.at is not None and (b not in told.lower or inner.at.at.cost[0] < told.lower[b][0]):
        told.lower[b] = inner.at.at.cost[0], inner.at.theta[0]
    told.limit[b, place] = inner.end


def moved_from_bounds(
    told: AtBounds, theta: np.ndarray, reach: np.ndarray, places: np.ndarray, labels: tuple[str, ...]
) -> list[str]:
    """Return a sentence on each unknown of the first member that leaves its interval (`reach`) when an
    unknown at a bound moves to its limit.
    """
    sentences = []
    for (_, place), there in told.at_limit.items():
        far = [
            f"`{name}`"
            for name, shift, most in zip(labels, np.abs(there - theta)[places], reach, strict=True)
            if shift > most
        ]
        if far:
            bounded = labels[int(np.searchsorted(places, place))]
            sentences.append(
                f"{_too_narrow(far)}: with `{bounded}` off its bound, within its interval, the best fit lies "
                f"outside; {ADVICE}"
            )
    return sentences


def too_narrow_near_bounds(
    problem: Problem, found: Minimum, told: AtBounds, errors: Float[np.ndarray, "unknowns"]
) -> list[str]:
    """Return sentences on intervals of the first member that are too narrow: the squares rise less than
    predicted by `errors`, the standard errors of all free unknowns.

    The ends of intervals of shared unknowns are tested if an interval reaches a bound, or if an unknown may
    leave its bound.
    """
    limits, theta = problem.unknowns, found.theta[0]
    places, labels = limits.estimated, limits.labels

    def rise(place: int, step: float) -> float:
        return float(problem.beside(found.theta, 0, place, theta[place] + step).at.cost[0] - found.at.cost[0])

    def named(some: Iterable[int], steps: Callable[[int], list[float]]) -> list[str]:
        return [
            f"`{labels[k]}`"
            for k in some
            if any(2 * rise(int(places[k]), step) < 0.5 * (step / errors[k]) ** 2 for step in steps(k))
        ]

    def to_bounds(k: int) -> list[float]:
        steps = [float((end - theta)[places[k]]) for end in (limits.low, limits.high)]
        return [step for step in steps if 1 < (step / errors[k]) ** 2 < 2 * RISE_95]

    def to_ends(k: int) -> list[float]:
        at, reach = theta[places[k]], float(np.sqrt(RISE_95) * errors[k])
        return [
            step for step in (-reach, reach) if limits.low[places[k]] < at + step < limits.high[places[k]]
        ]

    sentences = []
    if names := named(range(len(labels)), to_bounds):
        why = "and others may be: up to a nearby bound, the squares rise less than standard errors predict"
        sentences.append(f"{_too_narrow(names)}, {why}; {ADVICE}")
    bounded = ", ".join(f"`{labels[k]}`" for k in np.flatnonzero(told.beyond[0, places] <= FAR_BEYOND))
    shared = [
        k
        for k, name in enumerate(labels)
        if bounded and np.isfinite(errors[k]) and not name.startswith("run ")
    ]
    if names := named(shared[:8], to_ends):
        sentences.append(
            f"{_too_narrow(names)}: where {bounded} may leave a bound, the squares rise less to "
            f"the ends than standard errors predict; {ADVICE}"
        )
    return sentences


def _too_narrow(names: list[str]) -> str:
    return (
        f"the {'intervals' if len(names) > 1 else 'interval'} of {', '.join(names)}"
        f" {'are' if len(names) > 1 else 'is'} too narrow"
    )


def _root(slope: float, curvature: float, end: float) -> float:
    """Solve slope delta + curvature delta^2 / 2 = end for delta > 0."""
    return float(2 * end / (slope + np.sqrt(slope**2 + 2 * curvature * end)))


@dataclass(frozen=True)
class NoiseLevels:
    """A linearised problem with these sigmas, and their statistics."""

    at: Linearised
    known: Information
    doubt: ByUnknown  # variance of log C_ii: 2 over its degrees of freedom
    more: ByUnknown  # contribution of estimated weights to C_ii, relative to it
    # channels that do not determine their sigma, and are not used
    untold: Bool[np.ndarray, "members channels"]


def noise_levels(
    problem: Problem,
    theta: np.ndarray,
    at: Linearised,
    told_by: Callable,
    of_loss: Callable[[np.ndarray, float], float],
) -> NoiseLevels:
    """Return sigmas and their statistics at theta. `told_by` returns the information of an arrow matrix.
    `of_loss` returns the inflation of variances by a loss; its arguments are the residuals of one member and
    the number of unknowns that they determined.
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
        widths[:, 0] = (
            [
                np.sqrt(of_loss(r, p)) if r.size else 1.0
                for r, p in zip(residuals, determined[:, 0].tolist(), strict=True)
            ]
            if unsure
            else 1.0
        )
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
    more, change = 0 * doubt, 0.03  # of sigma^2: increment for the second derivative of C
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
    m, S, G, own = (
        known.follow.shape[-2],
        known.shared[:, None, None],
        known.follow[:, :, None],
        known.own[:, :, None],
    )
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


@dataclass(frozen=True)
class Spread:
    """Uncertainties of the estimates, of all members."""

    levels: NoiseLevels  # sigmas, and the information with them
    known: Information  # the same, or by differences between runs
    quantiles: ByUnknown  # q
    rise: Rise


def spread(problem: Problem, found: Minimum, bound: Bool[np.ndarray, "members places"]) -> Spread:
    """Return the uncertainties of estimates; unknowns at a `bound` are held there."""
    unknowns, theta, scores, cutoff = (
        problem.unknowns,
        found.theta,
        found.at.arrow.scores,
        problem.asked.control.cutoff,
    )
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
        of_runs = (
            levels
            if problem.estimated
            else noise_levels(problem, theta, found.at, told_by, lambda r, _: problem.loss.bend(r))
        )
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
    """Return the statistics of each unknown at a `bound` as if it were free; NaN for others."""
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
