"""How far from its bound an unknown may be that the measurements put there: a one-sided limit by profile likelihood.

p(delta) = min over all other unknowns of (F - F_min), theta = bound + delta;      the limit is where 2 p = 2.706, the square of the normal 95 % quantile
p is close to g delta + h delta^2 / 2, g: slope of F there, 1 / h: variance of the unknown if it were free
Source: D. J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.information import information
from jourdain_jax.analysis.levenberg_marquardt import Control, Limits, Minimum, minimise

ONE_SIDED = 2.7055434540954146 / 2  # of F
FAR_BEYOND = 3.0  # standard errors: an estimate that is held at its bound by more is no chance
CLOSE, MOST = 0.02, 8  # relative error of p; evaluations of it


def limits_at_bounds(evaluate: Callable, found: Minimum, limits: Limits, control: Control) -> tuple[np.ndarray, np.ndarray]:
    """For each unknown at a bound: the limit, and how many standard errors beyond the bound the data would put it; NaN elsewhere.

    The limit is infinite where the data give none; there is none of a fit that has not converged.
    """
    limit, beyond = np.full(found.theta.shape, np.nan), np.full(found.theta.shape, np.nan)
    bound = ((found.theta <= limits.low) | (found.theta >= limits.high)) & ~limits.fixed
    if not bound.any():
        return limit, beyond
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
        limit[b, place] = _limit(lambda d, b=b, place=place, inward=inward: _profile(evaluate, found, b, place, inward * d, limits, control), slope, error)
        limit[b, place] = np.clip(one[0, place] + inward * limit[b, place], limits.low[place], limits.high[place])
    return limit, beyond


def _limit(profile: Callable, slope: float, error: float) -> float:
    """Where the profile reaches `ONE_SIDED`."""
    if not np.isfinite(error):
        return np.inf
    curvature = 1 / error**2
    delta = _root(slope, curvature)
    for _ in range(MOST):
        rise = profile(delta)
        if not np.isfinite(rise):
            delta /= 2
            continue
        if rise <= 0:  # the minimum that was found is not the lowest
            delta *= 4
            continue
        if abs(rise / ONE_SIDED - 1) < CLOSE:
            break
        # the curvature that explains this rise; where even the slope is too much, a smaller slope
        curvature = 2 * (rise - slope * delta) / delta**2
        if curvature <= 0:
            slope, curvature = rise / delta, 0.0
        delta = _root(slope, curvature)
    return float(delta)


def _root(slope: float, curvature: float) -> float:
    """delta > 0 with slope delta + curvature delta^2 / 2 = ONE_SIDED."""
    return float(2 * ONE_SIDED / (slope + np.sqrt(slope**2 + 2 * curvature * ONE_SIDED)))


def _profile(evaluate: Callable, found: Minimum, b: int, place: int, step, limits: Limits, control: Control) -> float:
    theta: Float[np.ndarray, "1 unknowns"] = found.theta[b : b + 1].copy()
    theta[0, place] += step
    fixed = limits.fixed.copy()
    fixed[place] = True
    # to one per cent of a standard error is enough
    at = minimise(lambda x, _: evaluate(x, np.array([b])), theta, replace(limits, fixed=fixed), replace(control, tolerance=max(control.tolerance, 1e-2)))
    return float(at.at.cost[0] - found.at.cost[b])
