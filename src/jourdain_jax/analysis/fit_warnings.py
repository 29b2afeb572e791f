"""Why estimates of a fit, or their intervals, should not be relied on, in words."""

import numpy as np

from jourdain_jax.analysis.at_bounds import FAR_BEYOND
from jourdain_jax.analysis.losses import LEAST_SQUARES

_COINCIDING = 3  # different residuals that two channels may share by chance
_FROM_PRIOR = 4.0  # standard deviations: an estimate that lies further from its prior is no chance
_SURE = 5.0  # standard deviations of chi-square


def warnings_of(fit) -> tuple[str, ...]:
    """Of a fit of one experiment, the most serious reason first, one sentence each."""
    if not np.isfinite(fit.chi_square):
        return ("the motion fails at the first guess, so that there is nothing to fit; look at it with `simulate`",)
    found = []
    if fit.stuck:
        found.append("no step leads to a better fit, and yet this is no minimum: nearby the motion fails, or it is rougher than its tolerance; start elsewhere")
    elif fit.shooting is not None and fit.shooting.continuity > 1:
        found.append(
            f"pieces of runs do not join: states jump by up to {float(fit.shooting.continuity):.2g} tolerances of the simulation; take shorter pieces, or "
            "start nearer"
        )
    elif not fit.converged:
        found.append("no minimum was found; raise `max_iterations`, or start nearer to it")
    if np.any(fit.beyond > FAR_BEYOND):
        names = ", ".join(f"`{name}`" for name, far in zip(fit.labels, fit.beyond, strict=True) if far > FAR_BEYOND)
        found.append(f"{names} lies at a bound, which decides its value; all standard errors lose their meaning: widen the bounds")
    found += fit.impossible
    found += fit.statistics.too_narrow
    found += _counted_twice(fit)
    if fit.guesses > 1 and fit.converged and fit.agreeing == 1:
        found.append(f"only one of {fit.guesses} first guesses led to this minimum, so there may be a lower one; try more `guesses`, or narrower bounds")
    found += [
        f"`{name}` lies {abs(far):.2g} standard deviations from its prior: the prior, the data or the scene is not right"
        for name, far in zip(fit.labels, fit.statistics.from_prior, strict=True)
        if abs(far) > _FROM_PRIOR
    ]
    if _too_large(fit):
        found.append("the residuals are larger than the sigmas allow: a local minimum (start nearer), a scene that is not right, or sigmas that are too small")
    if fit.errors == "sigmas":
        coloured = [f"`{name}` ({rho:.2f})" for name, (rho, limit) in fit.autocorrelation.items() if abs(rho) > limit]
        if coloured:
            found.append(
                f"residuals of {', '.join(coloured)} are not white (in brackets: correlation of neighbouring ones), which makes intervals too narrow: the "
                "scene, a sensor or the noise is not right; `correlation_time=None` estimates a memory of the noise, and with five runs or more, "
                'errors="runs" gives intervals that allow for it'
            )
    return tuple(found)


def _too_large(fit) -> bool:
    """Whether residuals are too large for their sigmas; under a robust loss most of them, since some are far out."""
    degrees = max(int(fit.degrees_of_freedom), 1)
    if fit.asked.loss is LEAST_SQUARES:
        return bool(fit.reduced_chi_square > 1 + _SURE * np.sqrt(2 / degrees))  # chi-square has mean n and variance 2 n
    # the median of w^2 is 0.4549 for a normal w; relative to it, that of n has the standard deviation 2.33 / sqrt(n)
    squares = np.concatenate([np.ravel(r) for run in fit.whitened for r in run.values()]) ** 2
    return bool(np.nanmedian(squares) / 0.4549 > 1 + _SURE * 2.33 / np.sqrt(degrees))


def _counted_twice(fit) -> list[str]:
    """Channels whose residuals are those of another one, or of another run."""
    found: list[str] = []
    first: dict[bytes, str] = {}
    for run, of_run in enumerate(fit.residuals):
        for name, r in of_run.items():
            counted = np.round(r[np.isfinite(r)], 6)
            here = f"`{name}` of run {run}"
            there = first.setdefault(counted.tobytes(), here)
            if here != there and len(np.unique(counted)) > _COINCIDING:
                found.append(f"{there} and {here} hold the same numbers: counted as two measurements, they make intervals too narrow; leave one out")
    return found
