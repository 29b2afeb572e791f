"""Unknown numbers as functions of a free coordinate z, so that an unconstrained method keeps them within their bounds.

positive: theta = guess exp(z)      bounded: theta = low + (high - low) / (1 + exp(-z))      unbounded: theta = guess + scale z
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import Number, checked_real


class Bijection(eqx.Module):
    """How an unknown follows from its free coordinate z; all functions work entry by entry."""

    @abc.abstractmethod
    def value(self, z, guess) -> Float[Array, "*shape"]:
        """The unknown, in its own unit."""

    @abc.abstractmethod
    def coordinate(self, guess) -> Float[Array, "*shape"]:
        """The z of the first guess."""

    @abc.abstractmethod
    def size(self, value, guess) -> Float[Array, "*shape"]:
        """What counts as a large change of the unknown: its own magnitude, except near zero."""

    @abc.abstractmethod
    def at_bound(self, value) -> Bool[Array, "*shape"]:
        """Whether the unknown lies so near to a bound that the bound decides its value."""

    @abc.abstractmethod
    def refusal(self, guess: np.ndarray) -> str:
        """Why a first guess cannot be represented; empty where it can."""


class Positive(Bijection):
    """Above zero, by the logarithm."""

    def value(self, z, guess):
        return guess * jnp.exp(z)

    def coordinate(self, guess):
        return jnp.zeros_like(guess)

    def size(self, value, guess):
        return value

    def at_bound(self, value):
        return jnp.zeros_like(value, bool)

    def refusal(self, guess):
        return "" if np.all(guess > 0) else "expected a first guess above zero; or leave it free to change sign with `unbounded()`"


class Bounded(Bijection):
    """Between two bounds, by the logistic function."""

    low: Float[Array, ""]
    high: Float[Array, ""]

    def value(self, z, guess):
        return self.low + (self.high - self.low) * jax.nn.sigmoid(z)

    def coordinate(self, guess):
        return jax.scipy.special.logit((guess - self.low) / (self.high - self.low))

    def size(self, value, guess):
        return jnp.maximum(jnp.abs(value), 0.01 * (self.high - self.low))

    def at_bound(self, value):
        return jnp.minimum(value - self.low, self.high - value) < 1e-3 * (self.high - self.low)

    def refusal(self, guess):
        if np.all((guess > self.low) & (guess < self.high)):
            return ""
        return f"expected a first guess between its bounds {self.low} and {self.high}; move the guess or widen the bounds"


class Unbounded(Bijection):
    """Any number; `scale` is a typical change (default: the magnitude of the first guess, or 1 where that is zero)."""

    scale: Float[Array, ""] | None

    def value(self, z, guess):
        return guess + self._scale(guess) * z

    def coordinate(self, guess):
        return jnp.zeros_like(guess)

    def size(self, value, guess):
        return jnp.maximum(jnp.abs(value), self._scale(guess))

    def at_bound(self, value):
        return jnp.zeros_like(value, bool)

    def refusal(self, guess):
        return ""

    def _scale(self, guess):
        return jnp.where(guess == 0, 1.0, jnp.abs(guess)) if self.scale is None else self.scale


def positive() -> Positive:
    """The unknown stays above zero: `free={"mass": jj.positive()}`. The default of parameters declared positive."""
    return Positive()


def bounds(low: Number, high: Number) -> Bounded:
    """The unknown stays between `low` and `high`, in its own unit: `free={"mass": jj.bounds(0.1, 10)}`.

    Raises ValueError unless both are finite and low < high.
    """
    for name, end in (("low end", low), ("high end", high)):
        checked_real(end, f"{name} of `bounds`", ())
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"bounds({low}, {high}): expected finite numbers low < high; for one bound at zero use `positive()`, for none `unbounded()`")
    return Bounded(jnp.asarray(low, jnp.result_type(float)), jnp.asarray(high, jnp.result_type(float)))


def unbounded(scale: Number | None = None) -> Unbounded:
    """The unknown may be any number; `scale`, in its unit, is a typical change: state it where the first guess is zero.

    Raises ValueError unless the scale is positive and finite.
    """
    if scale is not None:
        checked_real(scale, "`scale` of `unbounded`", ())
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise ValueError(f"unbounded({scale}): expected a positive scale, a typical change in the unit of the unknown")
    return Unbounded(None if scale is None else jnp.asarray(scale, jnp.result_type(float)))
