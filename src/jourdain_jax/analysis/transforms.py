"""Unknowns within bounds as vectors x of any real numbers, with the factor by which densities change.

    unbounded  theta = x
    positive   theta = exp x                                  log |d theta / dx| = x
    bounds     theta = low + (high - low) / (1 + exp(-x))     log |d theta / dx| = log(high - low) - log(1 + exp(-x)) - log(1 + exp(x))

Source: B. Carpenter et al., Journal of Statistical Software 76 (2017) 1, section 35 of the Stan reference manual of that year.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.ranges import Range


class Transforms(eqx.Module):
    """One transform for each unknown."""

    kinds: tuple[str, ...] = eqx.field(static=True)
    low: Float[np.ndarray, "unknowns"]  # zero and one where there are no bounds
    high: Float[np.ndarray, "unknowns"]

    def __init__(self, ranges: Sequence[Range]):
        self.kinds = tuple(one.kind for one in ranges)
        self.low = np.array([one.low if one.kind == "bounds" else 0.0 for one in ranges])
        self.high = np.array([one.high if one.kind == "bounds" else 1.0 for one in ranges])

    def _are(self, kind: str) -> np.ndarray:
        return np.array([one == kind for one in self.kinds], bool)

    def constrain(self, x: Float[Array, "*batch unknowns"]) -> Float[Array, "*batch unknowns"]:
        """The unknowns in their units."""
        positive, between = self._are("positive"), self._are("bounds")
        share = jax.nn.sigmoid(jnp.where(between, x, 0.0))
        return jnp.where(positive, jnp.exp(jnp.where(positive, x, 0.0)), jnp.where(between, self.low + (self.high - self.low) * share, x))

    def log_slopes(self, x: Float[Array, "*batch unknowns"]) -> Float[Array, "*batch unknowns"]:
        """`log |d theta / dx|` of each."""
        positive, between = self._are("positive"), self._are("bounds")
        inside = jnp.where(between, x, 0.0)
        logs = jnp.log(self.high - self.low) + jax.nn.log_sigmoid(inside) + jax.nn.log_sigmoid(-inside)
        return jnp.where(positive, x, jnp.where(between, logs, 0.0))

    def unconstrain(self, theta: Float[Array, "*batch unknowns"]) -> Float[Array, "*batch unknowns"]:
        """The inverse of `constrain`; infinite at a bound, NaN beyond it."""
        positive, between = self._are("positive"), self._are("bounds")
        share = jnp.where(between, (theta - self.low) / (self.high - self.low), 0.5)
        return jnp.where(positive, jnp.log(jnp.where(positive, theta, 1.0)), jnp.where(between, jnp.log(share) - jnp.log1p(-share), theta))
