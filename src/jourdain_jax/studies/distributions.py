"""Variation of a parameter or a start value over the samples of a study: distributions, and levels of a grid.

A distribution maps uniform numbers u in (0, 1) to values by its inverse distribution function. A sampler that
spreads u evenly (Latin hypercube, Sobol) therefore spreads the values well.
"""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from jourdain_jax.calculus.reals import all_finite, checked_known
from jourdain_jax.studies.rounded_functions import exponential, normal_quantile, product


class Distribution:
    """Base of the distributions: `values(u)` is the inverse distribution function."""

    _positive: ClassVar[str] = ""  # name of the number that must be positive

    def __post_init__(self):
        """Convert the numbers to floats. Raises ValueError if one is not finite, or out of range."""
        kind, known = type(self).__name__, dict(vars(self))
        for name, value in known.items():
            known[name] = float(checked_known(value, f"`{name}` of {kind}", (), advice="give one number"))
            object.__setattr__(self, name, known[name])
            if not np.isfinite(known[name]):
                raise ValueError(f"`{name}` of {kind} is {value}, expected a finite number")
        if known.get("sigma", 0.0) < 0:
            raise ValueError(f"`sigma` of {kind} is {known['sigma']:g}, expected a standard deviation >= 0")
        if not known.get("low", 0.0) < known.get("high", 1.0):
            raise ValueError(
                f"{kind} has low = {known['low']:g} and high = {known['high']:g}, expected low < high"
            )
        if self._positive and known[self._positive] <= 0:
            raise ValueError(
                f"`{self._positive}` of {kind} is {known[self._positive]:g}, expected a positive number"
            )

    def values(self, u):
        """Return the values at the probabilities `u`, between 0 and 1."""
        return self._inverse(u, *vars(self).values())

    def derivatives(self, u: np.ndarray) -> dict[str, np.ndarray]:
        """Return derivatives of `values(u)` with respect to the numbers of the distribution, by name. They
        are computed by complex steps, exact to round-off.
        """
        known, tiny = vars(self), 1e-30
        return {
            name: np.imag(self._inverse(u, *(known | {name: known[name] + 1j * tiny}).values())) / tiny
            for name in known
        }

    @staticmethod
    @abstractmethod
    def _inverse(u: np.ndarray, first, second) -> np.ndarray:
        """Return the values at the probabilities `u`. The result is an analytic function of the numbers
        `first` and `second`.
        """


@dataclass(frozen=True)
class Normal(Distribution):
    """A normal distribution with the given `mean` and standard deviation `sigma`, in the unit of the
    quantity; constant for sigma = 0.
    """

    mean: Any
    sigma: Any

    @staticmethod
    def _inverse(u, mean, sigma):
        return mean + product(sigma, normal_quantile(u), u)


@dataclass(frozen=True)
class Uniform(Distribution):
    """A uniform distribution between `low` and `high`, in the unit of the quantity."""

    low: Any
    high: Any

    @staticmethod
    def _inverse(u, low, high):
        return low + product(high - low, u, u)


@dataclass(frozen=True)
class LogNormal(Distribution):
    """A positive quantity whose logarithm is normal: `median` in the unit of the quantity, `sigma` the
    standard deviation of its natural logarithm.
    """

    median: Any
    sigma: Any
    _positive = "median"

    @staticmethod
    def _inverse(u, median, sigma):
        return median * exponential(product(sigma, normal_quantile(u), u), u)


@dataclass(frozen=True)
class LogUniform(Distribution):
    """A positive quantity whose logarithm is uniformly distributed between the logarithms of `low` and
    `high`, in the unit of the quantity.
    """

    low: Any
    high: Any
    _positive = "low"

    @staticmethod
    def _inverse(u, low, high):
        return low * exponential(product(np.log(high / low), u, u), u)


@dataclass(frozen=True)
class Levels:
    """The `levels` of a quantity in a grid, in its unit. A grid has all combinations of levels; the last
    quantity varies fastest.
    """

    levels: tuple[float, ...]

    def __init__(self, levels: Sequence[float]):
        found = np.asarray(checked_known(levels, "`levels`", advice="give a list of numbers"), float)
        if found.ndim != 1 or not found.size or not all_finite(found):
            raise ValueError(
                f"`levels` has the shape {found.shape}, expected a list of finite numbers, at least one"
            )
        object.__setattr__(self, "levels", tuple(found.tolist()))
