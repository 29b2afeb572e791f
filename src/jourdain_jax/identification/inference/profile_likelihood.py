"""The profile likelihood of one unknown: the minimum of F over all other unknowns, as a function of
this one.
"""

from typing import NamedTuple

import numpy as np

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
