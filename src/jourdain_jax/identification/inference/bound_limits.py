"""One-sided limits of unknowns at a bound by profile likelihood, and detection of intervals that bounds make
too narrow.

    p(delta) = min over all other unknowns of (F - F_min),   theta = bound + delta
    limit    2 p = 3.84 f;   f = 1 for known noise (see `standard_errors`)
    p is close to g delta + h delta^2 / 2
    beyond   b / sqrt(w^2 - b^2 / n),   b = g e

g: slope of F at the bound; 1 / h: variance of the unknown if it were free; e: its standard error, as
predicted by F; b: standard errors from the bound to the free minimum beyond it. If p < 0, F is lower away
from the bound. F has zero slope at the bound if another unknown has the same effect, as a delay has at zero
lag.

If sigmas are estimated, residuals caused by a bound count as noise. With N samples, b then stays below
sqrt(N) however far away the bound is; `beyond` corrects this. The permitted rise of F is that of two-sided
intervals. A one-sided rise of 2.71 f would let the data choose between two kinds of interval, which together
would cover a true value 1.6 standard errors from its bound in only 92.5 % of repeats.

Source: D. J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87; G. J. Feldman and R. D. Cousins,
Physical Review D 57 (1998) 3873, section IV.

`side` follows the profile likelihood of one unknown: the minimum of F over all other unknowns as a function
of this one.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jourdain_jax.identification.inference.standard_errors import RISE_95, Rise, if_free
from jourdain_jax.identification.solve.arrow import ByUnknown
from jourdain_jax.identification.solve.levenberg_marquardt import Minimum
from jourdain_jax.identification.solve.problem import Problem


class Side(NamedTuple):
    """The profile of one unknown on one side of its estimate."""

    end: float  # value at the permitted rise of F; the bound or infinity if F does not rise so far
    is_closed: bool  # whether F reaches the permitted rise
    at: Minimum | None  # the minimum at the end, or a minimum lower than the fit's
    points: list[tuple[float, float]]  # values of the unknown, and rises of F
    note: str  # other observations


def side(problem: Problem, found: Minimum, b: int, place: int, way: float, first: float, end: float) -> Side:
    """Follow the profile of member `b` along one unknown in the direction `way` (1 or -1), starting at the
    distance `first` from the estimate, until F has risen by `end`.

    Each fit of the other unknowns starts from the previous point. The end is found by the secant method for
    the square root of the rise, which is nearly linear.
    """
    close, origin, theta = (
        0.01,
        float(found.theta[b, place]),
        found.theta[b : b + 1],
    )  # close: relative to `end`
    bound = float((problem.unknowns.low if way < 0 else problem.unknowns.high)[place])
    room = min(abs(bound - origin), 1e6 * first)
    inner, outer, note = (0.0, 0.0), (np.inf, np.inf), ""  # distance and rise on either side
    delta, points = min(first, room), []
    for _ in range(20 if room else 0):
        at = problem.beside(theta, b, place, origin + way * delta)
        rise, where = float(at.at.cost[0] - found.at.cost[b]), f"near {origin + way * delta:.6g}"
        if np.isfinite(rise):
            points.append((origin + way * delta, rise))
            if not at.converged[0]:
                note = f"no minimum over the others was found {where}, so the interval may be too narrow"
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


FAR_BEYOND = 3.0  # numerics: in standard errors; an estimate this far beyond its bound is significant
ADVICE = "`Fit.profiles` gives intervals that hold"


@dataclass
class AtBounds:
    """Statistics of unknowns at a bound, for converged fits; NaN for all others."""

    limit: ByUnknown  # infinite if the data give none
    beyond: ByUnknown  # distance of the free minimum beyond the bound, in standard errors
    if_free: Rise
    # by member: F and all unknowns at a lower minimum, where one unknown is off its bound
    lower: dict[int, tuple[float, np.ndarray]] = field(default_factory=dict)
    # by member and unknown at a bound: all unknowns when that one is at its limit
    at_limit: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)


def limits_at_bounds(problem: Problem, found: Minimum) -> AtBounds:
    """Return the statistics of unknowns at a bound. Each is moved away from its bound while all others are
    fitted again.
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
    """Return one sentence for each unknown of the first member that is at a bound and whose move to its limit
    takes other unknowns out of their intervals (`reach`).
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
                f"{_too_narrow(far)}: if `{bounded}` leaves its bound within its interval, the best fit lies "
                f"outside of them; {ADVICE}"
            )
    return sentences


def too_narrow_near_bounds(
    problem: Problem, found: Minimum, told: AtBounds, errors: Float[np.ndarray, "unknowns"]
) -> list[str]:
    """Return sentences on intervals of the first member that are too narrow, because the sum of squares rises
    less than `errors`, the standard errors of all free unknowns, predict.

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
        why = "and others may be: up to a nearby bound, squares rise less than the standard errors predict"
        sentences.append(f"{_too_narrow(names)}, {why}; {ADVICE}")
    bounded = ", ".join(f"`{labels[k]}`" for k in np.flatnonzero(told.beyond[0, places] <= FAR_BEYOND))
    shared = [
        k
        for k, name in enumerate(labels)
        if bounded and np.isfinite(errors[k]) and not name.startswith("run ")
    ]
    if names := named(shared[:8], to_ends):
        sentences.append(
            f"{_too_narrow(names)}: if {bounded} may leave the bound, squares rise less towards the ends "
            f"than the standard errors predict; {ADVICE}"
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
