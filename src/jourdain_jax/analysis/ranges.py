"""The numbers that an unknown may take: low <= theta <= high, and what counts as a large change of it.

Steps are taken in theta itself and end at a bound, so that an unknown can lie at its bound exactly.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Number, checked_known

_FAR = 5.0  # a factor by which a first guess may be off


@dataclass(frozen=True)
class Range:
    """Bounds of an unknown (infinite where there is none), and a typical change of it."""

    kind: Literal["bounds", "positive", "unbounded"]
    low: float = -np.inf
    high: float = np.inf
    scale: float | None = None

    def least_size(self, guess: float) -> float:
        """What counts as a large change of an unknown that is near zero: the typical change, or a hundredth of the first guess or of the width."""
        if self.kind == "unbounded":
            return self.scale or abs(guess) or 1.0
        return self.scale or 0.01 * (self.high - self.low if self.kind == "bounds" else abs(guess)) or 1.0

    def spread(self, guess, share) -> Float[np.ndarray, "*shape"]:
        """Other first guesses: for `share` from 0 to 1 all numbers between the bounds; without bounds a factor of five to either side, or a typical change."""
        if self.kind == "bounds":
            return np.asarray(self.low + share * (self.high - self.low))
        if self.kind == "positive":
            return guess * _FAR ** (2 * share - 1)
        return guess + (2 * share - 1) * max(abs(guess), self.least_size(guess))

    def not_below(self, low: float) -> "Range":
        """The part of the range that is not below this number, zero or a little more."""
        return replace(self, kind="positive" if self.kind == "unbounded" else self.kind, low=max(self.low, low))

    def refusal(self, guess: np.ndarray) -> str:
        """Why a first guess cannot be taken; empty where it can."""
        if self.low < float(guess) < self.high if guess.ndim == 0 else ((guess > self.low) & (guess < self.high)).all():
            return ""
        if self.kind == "positive":
            return "expected a first guess above zero; or leave it free to change sign with `unbounded()`"
        return f"expected a first guess between its bounds {self.low} and {self.high}; move the guess or widen the bounds"


def positive() -> Range:
    """The unknown is not below zero: `free={"mass": jj.positive()}`. The default of parameters declared positive or non-negative."""
    return Range("positive", low=0.0)


def bounds(low: Number, high: Number) -> Range:
    """The unknown stays between `low` and `high`, in its own unit: `free={"mass": jj.bounds(0.1, 10)}`.

    Raises ValueError unless both are finite and low < high.
    """
    for name, end in (("low end", low), ("high end", high)):
        checked_known(end, f"{name} of `bounds`", ())
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"bounds({low}, {high}): expected finite numbers low < high; for one bound at zero use `positive()`, for none `unbounded()`")
    return Range("bounds", float(low), float(high))


def unbounded(scale: Number | None = None) -> Range:
    """The unknown may be any number, but for a parameter that is declared positive or non-negative, which stays so. `scale`, in its unit, is a typical change:
    state it where the first guess is zero.

    Raises ValueError unless the scale is positive and finite.
    """
    if scale is not None:
        checked_known(scale, "`scale` of `unbounded`", ())
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"unbounded({scale}): expected a positive scale, a typical change in the unit of the unknown")
    return Range("unbounded", scale=None if scale is None else float(scale))
