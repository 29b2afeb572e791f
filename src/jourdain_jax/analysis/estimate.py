"""Numbers that a fit is to find: where it begins to look, between which ends, and what is known of them beforehand.

With a prior of mean m and standard deviation s, (theta - m) / s is one residual more: the estimate is the most probable value (maximum a posteriori).
Source: G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989), section 2.7.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jourdain_jax.analysis.ranges import Range
from jourdain_jax.calculus.reals import checked_known, described


@dataclass(frozen=True)
class Estimate:
    """A number that a fit estimates, in place of one that is known.

        jj.Sensor("lean_rate", gain=jj.Estimate(1.0), bias=jj.Estimate(0.0, per_run=True))
        jj.fit(scene, data, free={"mass": jj.Estimate(prior=jj.Normal(20.9, 0.5))})        # kg

    - `guess`: where the fit begins, in the unit of the number. It may be left out where the number has a value already: a parameter, a start value.
    - `range`: `bounds(low, high)`, `positive()`, `unbounded()`; by default what suits the number.
    - `per_run`: whether each run has one of its own; otherwise all runs share it. Start values are each run's own, parameters are shared.
    - `prior`: what is known beforehand, as `Normal(mean, sigma)`; it counts as one measured value.

    Raises ValueError for numbers that are not finite, and for a prior that is none or has no spread.
    """

    guess: Any = None  # a number, or several
    range: Any = None  # Range
    per_run: Any = False  # bool
    prior: Any = None  # Normal

    def __post_init__(self):
        if self.guess is not None:
            guess = checked_known(self.guess, "`guess` of `Estimate`", advice="give a number")
            if not np.all(np.isfinite(guess)):
                raise ValueError(f"`guess` of `Estimate` is {self.guess}, expected a finite number")
            object.__setattr__(self, "guess", tuple(guess.tolist()) if guess.ndim == 1 else float(checked_known(guess, "`guess` of `Estimate`", ())))
        if self.range is not None and not isinstance(self.range, Range):
            raise ValueError(f"`range` of `Estimate` is {described(self.range)}, expected `bounds(low, high)`, `positive()` or `unbounded()`")
        if not isinstance(self.per_run, bool):
            raise ValueError(f"`per_run` of `Estimate` is {described(self.per_run)}, expected True or False")
        if self.prior is not None:
            _check_prior(self.prior)

    @property
    def known_before(self) -> tuple[float, float] | None:
        """Mean and standard deviation of the prior."""
        return None if self.prior is None else (float(self.prior.mean), float(self.prior.sigma))


def _check_prior(prior) -> None:
    try:
        mean, sigma = float(prior.mean), float(prior.sigma)
    except (AttributeError, TypeError):
        raise ValueError(f"`prior` of `Estimate` is {described(prior)}, expected `jj.Normal(mean, sigma)`") from None
    if not (np.isfinite(mean) and np.isfinite(sigma) and sigma > 0):
        raise ValueError(f"`prior` of `Estimate` is {prior}, expected a standard deviation above zero; a number that is known needs no estimate")
