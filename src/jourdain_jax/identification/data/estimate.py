"""Unknowns of a fit: first guess, range and prior.

With a prior of mean m and standard deviation s, (theta - m) / s is an additional residual: the estimate is
the most probable value (maximum a posteriori). Source: G. A. F. Seber and C. J. Wild, Nonlinear Regression
(1989), section 2.7.

Ranges low <= theta <= high: steps are taken in theta itself and end at a bound, so that an unknown can lie
exactly at its bound.

Priors with correlated errors, of numbers that were measured together:

    r = M S^-1 d,   d = theta - mean,   M C M' = 1,   |r|^2 = d' (S C S)^-1 d

r: additional residuals; S: standard deviations; C: correlations. C = V diag(e) V' gives M = diag(e)^-1/2 V'.
If only some of the numbers are free, S C S is their block of the covariance (the marginal).

Transforms from any real number x to an unknown theta within its range, with the logarithm of the derivative
by which densities change:

    unbounded  theta = x
    positive   theta = exp x
                   log |d theta / dx| = x
    bounds     theta = low + (high - low) / (1 + exp(-x))
                   log |d theta / dx| = log(high - low) - log(1 + exp(-x)) - log(1 + exp(x))
    memory     for a correlation time: as `bounds`, applied to arcsin rho, rho = exp(-h / theta), with the
               shortest interval h

Source: B. Carpenter et al., Journal of Statistical Software 76 (2017) 1, section 35 of the Stan reference
manual of that year.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Number, all_finite, check_kind, checked_known, described, largest

Numbers = Float[Array, "*batch"]


@dataclass(frozen=True)
class Range:
    """Bounds of an unknown (infinite if there are none), and its typical change."""

    kind: Literal["bounds", "positive", "unbounded", "memory"]
    low: float = -np.inf
    high: float = np.inf
    scale: float | None = None
    interval: float = 0.0  # h in s, for a correlation time

    def least_size(self, guess: float) -> float:
        """Return the scale for changes of an unknown near zero: its typical change if given, else a hundredth
        of the first guess or of the width of the range.
        """
        if self.kind == "unbounded":
            return self.scale or abs(guess) or 1.0
        return self.scale or 0.01 * (self.high - self.low if self.kind == "bounds" else abs(guess)) or 1.0

    def spread(self, guess, share) -> Float[np.ndarray, "*shape"]:
        """Return another first guess for each `share` from 0 to 1. The guesses cover the range between the
        bounds. Without bounds they cover a factor of five, or one typical change, to either side.
        """
        if self.kind == "bounds":
            return np.asarray(self.low + share * (self.high - self.low))
        if self.kind == "positive":
            return guess * 5.0 ** (2 * share - 1)  # a first guess may be wrong by a factor of five
        return guess + (2 * share - 1) * max(abs(guess), self.least_size(guess))

    def not_below(self, low: float) -> "Range":
        """Return the range restricted to values of at least `low`."""
        return replace(
            self, kind="positive" if self.kind == "unbounded" else self.kind, low=max(self.low, low)
        )

    def constrain(self, x: Numbers) -> Numbers:
        """Return the unknown, in its unit, for a real number."""
        if self.kind in ("positive", "unbounded"):
            return jnp.exp(x) if self.kind == "positive" else x
        inside = self.low + (self.high - self.low) * jax.nn.sigmoid(x)
        return -self.interval / jnp.log(jnp.sin(inside)) if self.kind == "memory" else inside

    def log_slope(self, x: Numbers) -> Numbers:
        """Return `log |d theta / dx|`; for a correlation time `log |d arcsin rho / dx|`."""
        if self.kind in ("bounds", "memory"):
            return np.log(self.high - self.low) + jax.nn.log_sigmoid(x) + jax.nn.log_sigmoid(-x)
        return x if self.kind == "positive" else jnp.zeros_like(x)

    def unconstrain(self, theta: Numbers) -> Numbers:
        """Return the inverse of `constrain`; infinite at a bound, NaN beyond it."""
        if self.kind not in ("bounds", "memory"):
            return jnp.log(theta) if self.kind == "positive" else theta
        inside = jnp.arcsin(jnp.exp(-self.interval / theta)) if self.kind == "memory" else theta
        share = (inside - self.low) / (self.high - self.low)
        return jnp.log(share) - jnp.log1p(-share)

    def refusal(self, guess: np.ndarray) -> str:
        """Return the reason why a first guess is invalid; empty if it is valid."""
        if np.all((self.low < guess) & (guess < self.high)):
            return ""
        if self.kind == "positive":
            return "expected a first guess above zero; for an unknown of any sign use `unbounded()`"
        return (
            f"expected a first guess between its bounds {self.low} and {self.high}; move the guess or widen"
            " the bounds"
        )


def positive() -> Range:
    """Return the range of an unknown that stays at zero or above: `free={"mass": jj.positive()}`. This is the
    default for parameters declared positive or non-negative.
    """
    return Range("positive", low=0.0)


def bounds(low: Number, high: Number) -> Range:
    """Return the range of an unknown between `low` and `high`, in its unit: `free={"mass": jj.bounds(0.1,
    10)}`.

    Raises ValueError unless both are finite and low < high.
    """
    for name, end in (("low end", low), ("high end", high)):
        checked_known(end, f"{name} of `bounds`", ())
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(
            f"bounds({low}, {high}): expected finite numbers low < high; for one bound at zero "
            "use `positive()`, for none `unbounded()`"
        )
    return Range("bounds", float(low), float(high))


def unbounded(scale: Number | None = None) -> Range:
    """Return the range of an unknown that can be any number; a parameter keeps its declared sign. `scale`: a
    typical change, in the unit of the unknown, required if the first guess is zero.

    Raises ValueError unless the scale is positive and finite.
    """
    if scale is None:
        return Range("unbounded")
    number = float(checked_known(scale, "`scale` of `unbounded`", ()))
    if not (np.isfinite(number) and number > 0):
        raise ValueError(
            f"unbounded({scale}): expected a positive scale, the typical change of the unknown in its unit"
        )
    return Range("unbounded", scale=number)


@dataclass(frozen=True, eq=False)
class Correlated:
    """The prior of one of several numbers that were measured together (`joint_normal`): its mean, its
    standard deviation, and its index.
    """

    mean: float
    sigma: float
    place: int
    covariance: np.ndarray  # of all these numbers


def joint_normal(mean: Mapping[str, float], covariance: Any) -> dict[str, Correlated]:
    """Return priors of several parameters with correlated errors:
    `free=jj.identification.joint_normal({"mass": 20.9, "inertia": 1.64}, covariance)`.

    **Arguments**
    - `mean`: name -> mean, one number in the unit of the parameter.
    - `covariance`: (n, n), in the order of the names. It may be singular: a combination of zero variance gets
      a ten thousandth of the standard deviation of the others.

    **Returns** `joint`, name -> prior, for `free` of `fit`, alone or with others:
    `free=joint | {"gain": None}`. If only some of the names are free, their block of the covariance is used.
    `jj.Estimate(range=..., prior=joint["mass"])` adds a range.

    **Raises** ValueError for numbers that are not finite, another shape, a matrix that is not symmetric or
    not a covariance, and a variance of zero. Source: A. Gelman et al., Bayesian Data Analysis, 3rd ed.
    (2013), chapter 14 (prior information as further data).
    """
    if not isinstance(mean, Mapping) or not mean:
        raise ValueError(
            f"`mean` of `joint_normal` is {described(mean)}, expected a dictionary of name -> "
            'mean, such as {"mass": 20.9, "inertia": 1.64}'
        )
    means = [
        float(checked_known(x, f"the mean of `{name}`", (), advice="give one number"))
        for name, x in mean.items()
    ]
    n, names = len(means), list(mean)
    advice = f"give one row and one column for each of {', '.join(names)}"
    C = checked_known(covariance, "`covariance` of `joint_normal`", (n, n), advice=advice)
    if not (all_finite(C) and all_finite(means)):
        raise ValueError("mean and covariance of `joint_normal` must be finite; omit unknown quantities")
    for name, variance in zip(names, variances := np.diag(C), strict=True):
        if variance <= 0:
            raise ValueError(
                f"the variance of `{name}` is {variance:g}, expected a number above zero; omit "
                "known quantities"
            )
    sigma, round_off = np.sqrt(variances), 1e-9  # of correlations
    correlations = C / np.outer(sigma, sigma)
    if largest(correlations - correlations.T) > round_off:
        raise ValueError("`covariance` of `joint_normal` is not symmetric; give cov(a, b) = cov(b, a)")
    if (least := np.linalg.eigvalsh(correlations)[0]) < -n * round_off:
        raise ValueError(
            "`covariance` of `joint_normal` is not a covariance matrix: its correlation matrix has "
            f"the negative eigenvalue {least:.3g}"
        )
    return {name: Correlated(means[k], float(sigma[k]), k, C) for k, name in enumerate(names)}


def whitening(priors: Sequence) -> Float[np.ndarray, "numbers numbers"]:
    """Return the matrix M of the module docstring for numbers with these priors (None, or a mean and a
    sigma). Numbers that were not measured together have rows of the identity.
    """
    M = np.eye(len(priors))
    together: dict[int, list[int]] = {}
    for k, prior in enumerate(priors):
        if isinstance(prior, Correlated):
            together.setdefault(id(prior.covariance), []).append(k)
    for places in together.values():
        which, sigma = [priors[k].place for k in places], np.array([priors[k].sigma for k in places])
        C = priors[places[0]].covariance[np.ix_(which, which)] / np.outer(sigma, sigma)
        e, V = np.linalg.eigh(C)
        # least eigenvalue of correlations: a combination of zero variance counts as known to a ten
        # thousandth of the sigmas
        M[np.ix_(places, places)] = V.T / np.sqrt(np.maximum(e, 1e-8))[:, None]
    return M


@dataclass(frozen=True)
class Estimate:
    """An unknown number, estimated by a fit.

        jj.identification.Sensor("lean_rate", gain=jj.Estimate(1.0), bias=jj.Estimate(0.0, per_run=True))
        jj.fit(scene, data, free={"mass": jj.Estimate(prior=jj.studies.Normal(20.9, 0.5))})        # kg

    - `guess`: the initial value of the fit, in the unit of the number; not needed for parameters and start
      values.
    - `range`: `bounds(low, high)`, `positive()`, `unbounded()`; the default depends on the kind of number.
    - `per_run`: whether each run has its own value; otherwise all runs share it. Start values always belong
      to their run, parameters to all runs.
    - `prior`: earlier knowledge, as `Normal(mean, sigma)`; it counts as one measured value.

    Raises ValueError for numbers that are not finite, a prior that is not a `Normal`, and a sigma of zero.
    """

    guess: Any = None  # a number, or several
    range: Any = None  # Range
    per_run: Any = False  # bool
    prior: Any = None  # Normal

    def __post_init__(self):
        if self.guess is not None:
            guess = checked_known(self.guess, "`guess` of `Estimate`", advice="give a number")
            if not all_finite(guess):
                raise ValueError(f"`guess` of `Estimate` is {self.guess}, expected a finite number")
            one = guess.ndim != 1
            found = float(checked_known(guess, "`guess` of `Estimate`", ())) if one else tuple(guess.tolist())
            object.__setattr__(self, "guess", found)
        ranges = "`bounds(low, high)`, `positive()` or `unbounded()`"
        check_kind(self.range, Range | None, "`range` of `Estimate`", ranges)
        check_kind(self.per_run, bool, "`per_run` of `Estimate`", "True or False")
        if self.prior is not None:
            _check_prior(self.prior)


def _check_prior(prior) -> None:
    try:
        mean, sigma = float(prior.mean), float(prior.sigma)
    except (AttributeError, TypeError):
        raise ValueError(
            f"`prior` of `Estimate` is {described(prior)}, expected `jj.studies.Normal(mean, sigma)`"
        ) from None
    if not (np.isfinite(mean) and np.isfinite(sigma) and sigma > 0):
        raise ValueError(
            f"`prior` of `Estimate` is {prior}, expected a standard deviation above zero; give "
            "known numbers without `Estimate`"
        )
