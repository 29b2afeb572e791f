"""Unknowns at a bound: how far from it each may be, a one-sided limit by profile likelihood; and intervals that bounds make too narrow.

p(delta) = min over all other unknowns of (F - F_min), theta = bound + delta;      the limit is where 2 p = 2.706, the square of the normal 95 % quantile
p is close to g delta + h delta^2 / 2, g: slope of F there, 1 / h: variance of the unknown if it were free
p < 0: F is lower away from the bound. So it is where another unknown does the same at the bound, as a delay does at a lag of zero: F is level there, a saddle
Source: D. J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.information import information
from jourdain_jax.analysis.levenberg_marquardt import Control, Limits, Minimum, minimise

ONE_SIDED = 2.7055434540954146 / 2  # of F
RISE_95 = 3.841458820694124  # of 2 F
FAR_BEYOND = 3.0  # standard errors: an estimate that is held at its bound by more is no chance
CLOSE = 0.02  # of `ONE_SIDED`: error of p at the limit, and by how much F is to be lower elsewhere to count as lower
MOST = 16  # evaluations of p
FURTHER = 4.0  # factor of delta where p does not rise
NARROW = 0.5  # of the rise that a standard error foretells at a bound nearby: with less, the interval is too narrow
ADVICE = "`Fit.profiles` gives intervals that hold"


@dataclass
class AtBounds:
    """What is known of unknowns at a bound, of fits that have converged; NaN for all others."""

    limit: Float[np.ndarray, "members unknowns"]  # infinite where the data give none
    beyond: Float[np.ndarray, "members unknowns"]  # by how many standard errors the data would put it beyond its bound
    lower: dict[int, np.ndarray] = field(default_factory=dict)  # by member: all unknowns where F is lower, with one away from its bound
    at_limit: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)  # by member and unknown at a bound: all unknowns with that one at its limit


def limits_at_bounds(evaluate: Callable, found: Minimum, limits: Limits, control: Control) -> AtBounds:
    """Each unknown at a bound is moved away from it, all others following."""
    limit, beyond = np.full(found.theta.shape, np.nan), np.full(found.theta.shape, np.nan)
    told, costs = AtBounds(limit, beyond), found.at.cost.copy()
    bound = ((found.theta <= limits.low) | (found.theta >= limits.high)) & ~limits.fixed
    if not bound.any():
        return told
    for b, place in np.argwhere(bound & found.converged[:, None]).tolist():
        one = found.theta[b : b + 1]
        others = bound[b : b + 1].copy()
        others[0, place] = False
        size, estimated = limits.size(one), np.flatnonzero(~limits.fixed)
        known = information(found.at.arrow.at([b]), size, estimated, others, np.zeros(1, bool), control.cutoff, True)
        error = float(known.standard_errors[np.searchsorted(estimated, place)])
        slope = abs(float(found.at.arrow.at([b]).gradient[0, place]))
        beyond[b, place] = slope * error
        inward = 1.0 if one[0, place] <= limits.low[place] else -1.0
        if beyond[b, place] > FAR_BEYOND:  # the bound decides: the slope alone gives the limit
            limit[b, place] = _root(slope, 1 / error**2) * inward + one[0, place]
            continue
        room = float(limits.high[place] - limits.low[place])
        first = min(_root(slope, 1 / error**2) if np.isfinite(error) else float(size[0, place]), room)
        delta, at = _limit(partial(_rise, evaluate, found, limits, control, b, place), inward, first, room)
        if at is not None and np.isfinite(delta):
            told.at_limit[b, place] = at.theta[0]
        elif at is not None and at.at.cost[0] < costs[b]:
            told.lower[b], costs[b] = at.theta[0], at.at.cost[0]
        limit[b, place] = np.clip(one[0, place] + inward * delta, limits.low[place], limits.high[place])
    return told


def moved_from_bounds(told: AtBounds, theta: np.ndarray, reach: np.ndarray, places: np.ndarray, labels: tuple[str, ...]) -> list[str]:
    """Of the first member: which unknowns move further than the `reach` of their interval while one at its bound moves to its limit, one sentence each."""
    sentences = []
    for (_, place), there in told.at_limit.items():
        far = [f"`{name}`" for name, shift, most in zip(labels, np.abs(there - theta)[places], reach, strict=True) if shift > most]
        if far:
            bounded = labels[int(np.searchsorted(places, place))]
            sentences.append(f"{_too_narrow(far)}: with `{bounded}` away from its bound, though within its interval, the best fit lies outside; {ADVICE}")
    return sentences


def too_narrow_near_bounds(evaluate: Callable, found: Minimum, limits: Limits, control: Control, errors: np.ndarray, factor: float, labels) -> list[str]:
    """Of the first member: which unknowns have a bound so near that their interval reaches it, where the squares rise less than `errors` foretell.

    `errors`: standard errors of those that are not fixed; `factor`: by what their squares were multiplied.
    """
    narrow = []
    for name, place, error in zip(labels, np.flatnonzero(~limits.fixed).tolist(), errors, strict=True):
        for step in (limits.low[place] - found.theta[0, place], limits.high[place] - found.theta[0, place]):
            square = (step / error) ** 2
            if 1 < square < 2 * RISE_95 and 2 * _rise(evaluate, found, limits, control, 0, place, step)[0] < NARROW * factor * square:
                narrow.append(f"`{name}`")
    if not narrow:
        return []
    return [f"{_too_narrow(narrow)}, and so may be those of others: up to a bound nearby, the squares rise less than standard errors foretell; {ADVICE}"]


def _too_narrow(names: list[str]) -> str:
    return f"the {'intervals' if len(names) > 1 else 'interval'} of {', '.join(names)} {'are' if len(names) > 1 else 'is'} too narrow"


def _limit(profile: Callable[[float], tuple[float, Minimum]], inward: float, delta: float, room: float) -> tuple[float, Minimum | None]:
    """How far `inward` (1 or -1) the profile reaches `ONE_SIDED`, looked for from `delta` on, and the minimum there; infinite and None where it does not.

    Infinite with a minimum: that one is lower than at the bound.
    """
    inner, outer = (0.0, 0.0), (np.inf, np.inf)  # delta and rise on either side
    for _ in range(MOST):
        rise, at = profile(inward * delta)
        if rise < -CLOSE * ONE_SIDED:
            return np.inf, at
        if abs(rise / ONE_SIDED - 1) < CLOSE:
            return delta, at
        if rise < ONE_SIDED:
            inner = delta, max(rise, 0.0)
        else:
            outer = delta, rise
        if inner[0] >= room:
            return np.inf, None
        if np.isfinite(outer[1]):  # the root of p is nearly straight
            low, high = np.sqrt(inner[1]), np.sqrt(outer[1])
            delta = inner[0] + (outer[0] - inner[0]) * (np.sqrt(ONE_SIDED) - low) / (high - low)
        elif np.isfinite(outer[0]):  # the motion fails there
            delta = (inner[0] + outer[0]) / 2
        else:
            delta = min(delta * min(np.sqrt(ONE_SIDED / inner[1]) * (1 + CLOSE) if inner[1] else FURTHER, FURTHER), room)
    return (delta, at) if np.isfinite(outer[0]) else (np.inf, None)


def _root(slope: float, curvature: float) -> float:
    """delta > 0 with slope delta + curvature delta^2 / 2 = ONE_SIDED."""
    return float(2 * ONE_SIDED / (slope + np.sqrt(slope**2 + 2 * curvature * ONE_SIDED)))


def _rise(evaluate: Callable, found: Minimum, limits: Limits, control: Control, b: int, place: int, step: float) -> tuple[float, Minimum]:
    """By how much F of member `b` rises when one unknown is moved by a step and held there (infinite where the motion fails), and the minimum there."""
    theta: Float[np.ndarray, "1 unknowns"] = found.theta[b : b + 1].copy()
    theta[0, place] += step
    fixed = limits.fixed.copy()
    fixed[place] = True
    # to one per cent of a standard error is enough
    at = minimise(lambda x, _: evaluate(x, np.array([b])), theta, replace(limits, fixed=fixed), replace(control, tolerance=max(control.tolerance, 1e-2)))
    return float(at.at.cost[0] - found.at.cost[b]), at
