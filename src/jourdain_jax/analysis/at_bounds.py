"""Unknowns at a bound: how far from it each may be, a one-sided limit by profile likelihood; and intervals that bounds make too narrow.

p(delta) = min over all other unknowns of (F - F_min), theta = bound + delta;      the limit is where 2 p = 3.84 f      f: see `spread`; 1 where noise is known
p is close to g delta + h delta^2 / 2, g: slope of F there, 1 / h: variance of the unknown if it were free
p < 0: F is lower away from the bound. So it is where another unknown does the same at the bound, as a delay does at a lag of zero: F is level there, a saddle
beyond      d = b / sqrt(w^2 - b^2 / n),  b = g e:   standard errors that the data would put it beyond its bound      e: as F foretells; w, n: see `spread`

What a bound adds to the residuals counts as noise where sigmas are estimated: with N samples, b stays below sqrt(N) however far the bound is; d does not.
The rise is that at the ends of other intervals. With that of a one-sided limit, 2.71 f, data would choose between two kinds of interval, which together hold a
truth that is 1.6 standard errors from its bound in 92.5 % of repeats.
Source: D. J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87; G. J. Feldman and R. D. Cousins, Physical Review D 57 (1998) 3873, section IV.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.analysis.information import information
from jourdain_jax.analysis.levenberg_marquardt import Control, Limits, Minimum, minimum_beside

RISE_95 = 3.841458820694124  # of 2 F
FAR_BEYOND = 3.0  # standard errors: an estimate that is held at its bound by more is no chance
CLOSE = 0.02  # of p at the limit: its error there, and by how much F is to be lower elsewhere to count as lower
MOST = 16  # evaluations of p
FURTHER = 4.0  # factor of delta where p does not rise
NARROW = 0.5  # of the rise that a standard error foretells: with less, the interval is too narrow
MOST_LOOKED_AT = 8  # unknowns whose intervals are compared with the rise at their ends
ADVICE = "`Fit.profiles` gives intervals that hold"


@dataclass(frozen=True)
class IfFree:
    """What is known of unknowns at a bound, as if they were free."""

    of_rise: Float[np.ndarray, "members unknowns"]  # f
    wider: Float[np.ndarray, "members unknowns"]  # w
    degrees: Float[np.ndarray, "members unknowns"]  # n


@dataclass
class AtBounds:
    """What is known of unknowns at a bound, of fits that have converged; NaN for all others."""

    limit: Float[np.ndarray, "members unknowns"]  # infinite where the data give none
    beyond: Float[np.ndarray, "members unknowns"]  # by how many standard errors the data would put it beyond its bound
    if_free: IfFree
    lower: dict[int, tuple[float, np.ndarray]] = field(default_factory=dict)  # by member: F and all unknowns where it is lower, one being off its bound
    at_limit: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)  # by member and unknown at a bound: all unknowns with that one at its limit


@dataclass(frozen=True)
class Around:
    """A minimum, and how much worse the best fit is where one unknown is elsewhere."""

    evaluate: Callable  # as `minimise` asks for
    found: Minimum
    limits: Limits
    control: Control

    @property
    def at_bound(self) -> Bool[np.ndarray, "members unknowns"]:
        """Which unknowns lie at a bound."""
        theta, limits = self.found.theta, self.limits
        return ((theta <= limits.low) | (theta >= limits.high)) & ~limits.fixed

    def rise(self, b: int, place: int, step: float) -> tuple[float, Minimum]:
        """How much F of member `b` rises when one unknown is moved by a step and held there (infinite where the motion fails), and the minimum there."""
        theta = self.found.theta[b : b + 1]
        at = minimum_beside(lambda x, _: self.evaluate(x, np.array([b])), theta, place, theta[0, place] + step, self.limits, self.control)
        return float(at.at.cost[0] - self.found.at.cost[b]), at

    def if_free(self, b: int, place: int) -> tuple[float, float]:
        """The standard error that an unknown at its bound had if it were free, infinite where it does not show, and the size of the slope of F."""
        others, estimated, arrow = self.at_bound[b : b + 1], np.flatnonzero(~self.limits.fixed), self.found.at.arrow.at([b])
        others[0, place] = False
        known = information(arrow, self.limits.size(self.found.theta[b : b + 1]), estimated, others, np.zeros(1, bool), self.control.cutoff)
        error = float(known.standard_errors[0, np.searchsorted(estimated, place)])
        return error if np.isfinite(error) else np.inf, abs(float(arrow.gradient[0, place]))


def limits_at_bounds(around: Around, if_free: IfFree) -> AtBounds:
    """Each unknown at a bound is moved away from it, all others following."""
    theta = around.found.theta
    told = AtBounds(np.full(theta.shape, np.nan), np.full(theta.shape, np.nan), if_free)
    for b, place in np.argwhere(around.at_bound & around.found.converged[:, None]).tolist():
        _look_inward(around, told, b, place)
    return told


def _look_inward(around: Around, told: AtBounds, b: int, place: int) -> None:
    """Tells what one unknown at its bound shows when it is moved away from it."""
    bound, limits = around.found.theta[b, place], around.limits
    inward = 1.0 if bound <= limits.low[place] else -1.0
    (error, slope), end = around.if_free(b, place), RISE_95 / 2 * told.if_free.of_rise[b, place]
    if np.isfinite(error):
        left = told.if_free.wider[b, place] ** 2 - (slope * error) ** 2 / told.if_free.degrees[b, place]
        told.beyond[b, place] = np.inf if left <= 0 else slope * error / np.sqrt(left)
    if told.beyond[b, place] > FAR_BEYOND:  # the bound decides: the slope alone gives the limit
        told.limit[b, place] = bound + inward * _root(slope, 1 / error**2, end)
        return
    room = float(limits.high[place] - limits.low[place])
    first = min(_root(slope, 1 / error**2, end) if np.isfinite(error) else float(limits.size(around.found.theta[b : b + 1])[0, place]), room)
    delta, at = _limit(partial(around.rise, b, place), inward, first, room, end)
    if at is not None and np.isfinite(delta):
        told.at_limit[b, place] = at.theta[0]
    elif at is not None and (b not in told.lower or at.at.cost[0] < told.lower[b][0]):
        told.lower[b] = at.at.cost[0], at.theta[0]
    told.limit[b, place] = np.clip(bound + inward * delta, limits.low[place], limits.high[place])


def moved_from_bounds(told: AtBounds, theta: np.ndarray, reach: np.ndarray, places: np.ndarray, labels: tuple[str, ...]) -> list[str]:
    """Says which unknowns of the first member move further than the `reach` of their interval while one at its bound moves to its limit, one sentence each."""
    sentences = []
    for (_, place), there in told.at_limit.items():
        far = [f"`{name}`" for name, shift, most in zip(labels, np.abs(there - theta)[places], reach, strict=True) if shift > most]
        if far:
            bounded = labels[int(np.searchsorted(places, place))]
            sentences.append(f"{_too_narrow(far)}: with `{bounded}` away from its bound, though within its interval, the best fit lies outside; {ADVICE}")
    return sentences


def too_narrow_near_bounds(around: Around, told: AtBounds, errors: Float[np.ndarray, "unknowns"], labels: tuple[str, ...]) -> list[str]:
    """Says which intervals of the first member are too narrow, since the squares rise less than `errors` foretell, those of all unknowns that are not fixed.

    Looked at are bounds that an interval reaches, and where an unknown at its bound may leave it, the ends of the intervals of what runs share.
    """
    limits, theta, places = around.limits, around.found.theta[0], np.flatnonzero(~around.limits.fixed)

    def named(some: Iterable[int], steps: Callable[[int], list[float]]) -> list[str]:
        return [f"`{labels[k]}`" for k in some if any(2 * around.rise(0, int(places[k]), step)[0] < NARROW * (step / errors[k]) ** 2 for step in steps(k))]

    def to_bounds(k: int) -> list[float]:
        steps = [float((end - theta)[places[k]]) for end in (limits.low, limits.high)]
        return [step for step in steps if 1 < (step / errors[k]) ** 2 < 2 * RISE_95]

    def to_ends(k: int) -> list[float]:
        at, reach = theta[places[k]], float(np.sqrt(RISE_95) * errors[k])
        return [step for step in (-reach, reach) if limits.low[places[k]] < at + step < limits.high[places[k]]]

    sentences = []
    if names := named(range(len(labels)), to_bounds):
        why = "and so may be those of others: up to a bound nearby, the squares rise less than standard errors foretell"
        sentences.append(f"{_too_narrow(names)}, {why}; {ADVICE}")
    bounded = ", ".join(f"`{labels[k]}`" for k in np.flatnonzero(told.beyond[0, places] <= FAR_BEYOND))
    shared = [k for k, name in enumerate(labels) if bounded and np.isfinite(errors[k]) and not name.startswith("run ")]
    if names := named(shared[:MOST_LOOKED_AT], to_ends):
        sentences.append(f"{_too_narrow(names)}: where {bounded} may leave a bound, the squares rise less to the ends than standard errors foretell; {ADVICE}")
    return sentences


def _too_narrow(names: list[str]) -> str:
    return f"the {'intervals' if len(names) > 1 else 'interval'} of {', '.join(names)} {'are' if len(names) > 1 else 'is'} too narrow"


def _limit(profile: Callable[[float], tuple[float, Minimum]], inward: float, delta: float, room: float, end: float) -> tuple[float, Minimum | None]:
    """How far `inward` (1 or -1) the profile reaches `end`, looked for from `delta` on, and the minimum there; infinite and None where it does not.

    Infinite with a minimum: that one is lower than at the bound.
    """
    inner, outer = (0.0, 0.0), (np.inf, np.inf)  # delta and rise on either side
    for _ in range(MOST):
        rise, at = profile(inward * delta)
        if rise < -CLOSE * end:
            return np.inf, at
        if abs(rise / end - 1) < CLOSE:
            return delta, at
        if rise < end:
            inner = delta, max(rise, 0.0)
        else:
            outer = delta, rise
        if inner[0] >= room:
            return np.inf, None
        if np.isfinite(outer[1]):  # the root of p is nearly straight
            low, high = np.sqrt(inner[1]), np.sqrt(outer[1])
            delta = inner[0] + (outer[0] - inner[0]) * (np.sqrt(end) - low) / (high - low)
        elif np.isfinite(outer[0]):  # the motion fails there
            delta = (inner[0] + outer[0]) / 2
        else:
            delta = min(delta * min(np.sqrt(end / inner[1]) * (1 + CLOSE) if inner[1] else FURTHER, FURTHER), room)
    return (delta, at) if np.isfinite(outer[0]) else (np.inf, None)


def _root(slope: float, curvature: float, end: float) -> float:
    """delta > 0 with slope delta + curvature delta^2 / 2 = end."""
    return float(2 * end / (slope + np.sqrt(slope**2 + 2 * curvature * end)))
