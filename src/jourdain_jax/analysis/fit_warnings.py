"""Why estimates of a fit, or their intervals, should not be relied on, in words."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jourdain_jax.analysis.at_bounds import FAR_BEYOND
from jourdain_jax.analysis.losses import LEAST_SQUARES

_BEYOND_ALL = 1e150  # sigmas: the square is no number any more
_COINCIDING = 3  # different residuals that two channels may share by chance
_FROM_PRIOR = 4.0  # standard deviations: an estimate that lies further from its prior is no chance
_SURE = 5.0  # standard deviations: a mean square that is further from 1 is no chance


def warnings_of(fit) -> tuple[str, ...]:
    """Warnings of a fit of one experiment, the most serious reason first, one sentence each."""
    if not np.isfinite(fit.chi_square):
        if any(np.any(np.abs(r) > _BEYOND_ALL) for run in fit.residuals for r in run.values()):
            return ("residuals at the first guess are beyond all measure: a value that stands for a missing one (give NaN), or a sigma that is far too small",)
        return ("the motion fails at the first guess, so that there is nothing to fit; look at it with `simulate`", *fit.statistics.events_met)
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
        names = [f"`{name}`" for name, far in zip(fit.labels, fit.beyond, strict=True) if far > FAR_BEYOND]
        verb = "lies at a bound, which decides its value" if len(names) == 1 else "lie at bounds, which decide their values"
        found.append(f"{', '.join(names)} {verb}; all standard errors lose their meaning: widen the bounds")
    for name in fit.statistics.untold:
        found.append(
            f"the samples of `{name}` determine as many unknowns as they are, so that they do not tell its sigma, which is None: estimates are drawn to meet "
            "them exactly, and intervals take nothing from them; give a number"
        )
    found += fit.impossible
    found += fit.statistics.events_met
    found += fit.statistics.oddities
    found += fit.statistics.too_narrow
    found += _counted_twice(fit)
    if fit.guesses > 1 and fit.converged and fit.agreeing == 1:
        found.append(f"only one of {fit.guesses} first guesses led to this minimum, so there may be a lower one; try more `guesses`, or narrower bounds")
    found += [
        f"`{name}` lies {abs(far):.2g} standard deviations from its prior: the prior, the data or the scene is not right"
        for name, far in zip(fit.labels, fit.statistics.from_prior, strict=True)
        if abs(far) > _FROM_PRIOR
    ]
    coloured, sizes = {name: rho for name, (rho, limit) in fit.autocorrelation.items() if abs(rho) > limit}, _sizes_of_residuals(fit)
    if large := [size for size in sizes if size.least > _by_chance(size.narrow, _SURE)]:
        found.append(
            f"the residuals{large[0].named} are larger than the sigmas allow: a local minimum (start nearer), a scene that is not right, or sigmas that are "
            "too small"
        )
    if small := [size for size in sizes if size.is_small(coloured)]:
        times = f" by a factor of about {1 / np.sqrt(small[0].most):.2g}" if small[0].most > 0 else ""
        found.append(
            f"the residuals{small[0].named} are smaller than the sigmas foretell{times}: sigmas are too large, so that intervals are too wide, or samples were "
            "smoothed or have no noise; a sigma of `None` is estimated"
        )
    wide = {name for size in small for name in size.channels}
    named = ", ".join(f"`{name}` ({rho:.2f})" for name, rho in coloured.items() if name not in wide)
    if named and fit.errors == "runs" and (own := [name for name in fit.labels if name.startswith("run ")]):
        found.append(
            f"residuals of {named} are not white (in brackets: correlation of neighbouring ones), which makes intervals of what is a run's own too narrow "
            f"(`{own[0]}`): how runs differ says nothing of it"
        )
    if named and fit.errors == "sigmas":
        found.append(
            f"residuals of {named} are not white (in brackets: correlation of neighbouring ones), which makes intervals too narrow: the scene, a sensor or the "
            'noise is not right; `correlation_time=None` estimates a memory of the noise, and with five runs or more, errors="runs" gives intervals that '
            "allow for it"
        )
    return tuple(found)


class _Size(NamedTuple):
    """The mean square of the residuals of some channels, in sigmas."""

    channels: list[str]
    named: str  # as a sentence goes on; empty where these are all channels
    least: float  # where they determined no unknown that others may have determined
    narrow: float  # standard deviation of that, of normal residuals
    most: float  # where they determined all of them
    wide: float

    def is_small(self, coloured: Mapping[str, float]) -> bool:
        """Whether it is too small to be chance; `coloured`: correlations rho of neighbours, with which residuals tell (1 + rho)/(1 - rho) times less."""
        larger = max((1 + rho) / max(1 - rho, 1e-9) for rho in (0.0, *(coloured.get(name, 0.0) for name in self.channels)))
        return self.most * larger < _by_chance(self.wide, -_SURE)


def _by_chance(spread: float, deviations: float) -> float:
    """A mean square so many standard deviations from 1: its cube root is nearly normal, also far out (Wilson and Hilferty). `spread`: one of it, near 1."""
    return max(1 - spread**2 / 9 + deviations * spread / 3, 0.0) ** 3


def _sizes_of_residuals(fit) -> list[_Size]:
    """Sizes of the residuals of all channels whose sigmas are known, then of one by one; under a robust loss those of most, since some are far out."""
    robust, determined = fit.asked.loss != LEAST_SQUARES, float(fit.samples - fit.degrees_of_freedom)
    names = [name for name in dict.fromkeys(name for run in fit.whitened for name in run) if name not in fit.sigma]
    found = []
    for channels in (names, *([name] for name in names)):
        squares = np.concatenate([np.zeros(0), *(np.ravel(run[name]) for run in fit.whitened for name in channels if name in run)]) ** 2
        squares = squares[np.isfinite(squares)]
        if squares.size:
            some = len(channels) < len(names)
            named = f" of {', '.join(f'`{name}`' for name in channels)}" if some else ""
            found.append(_Size(channels, named, *_mean_square(squares, 0.0 if some else determined, robust), *_mean_square(squares, determined, robust)))
    return found


def _mean_square(squares: np.ndarray, determined: float, robust: bool) -> tuple[float, float]:
    """The mean square of residuals that determined so many unknowns, and its standard deviation where they are normal; `robust`: from their median."""
    degrees = max(squares.size - determined, 1)
    if robust:  # the median of w^2 is 0.4549 for a normal w; relative to it, that of n has the standard deviation 2.33 / sqrt(n)
        return float(np.median(squares)) / 0.4549, 2.33 / degrees**0.5
    return float(np.sum(squares)) / degrees, (2 / degrees) ** 0.5  # chi-square has mean n and variance 2 n


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
