"""Limits of quantities that depend on the parameters, by a Monte Carlo with the measured standard deviations.

Parameters are drawn from a normal distribution with the measured values and their covariance, or
independently if the covariance is unknown, as from parameter files. If only some samples have a quantity,
such as a capsize speed, their fraction is reported, and the limits refer to them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Key, UInt32

from jourdain_jax.bicycle.parameter_files import MeasuredBicycle
from jourdain_jax.bicycle.parameters import PARAMETER_NAMES, violations
from jourdain_jax.calculus.reals import Scalar


class ParameterSamples(eqx.Module):
    """Sampled parameters of one bicycle, in SI units."""

    values: Float[Array, "samples parameters"]  # columns in the order of `PARAMETER_NAMES`
    physical: Bool[Array, " samples"]  # False for an impossible sample, such as one with a negative radius
    refused: dict[str, Array]  # violated condition, as a sentence -> number of samples

    def by_name(self) -> dict[str, Float[Array, " samples"]]:
        """Return one array of samples per parameter, for `jax.vmap` of a function of parameters by name."""
        return dict(zip(PARAMETER_NAMES, self.values.T, strict=True))


class Interval(eqx.Module):
    """A quantity with limits that contain 95 % of the samples with this quantity."""

    value: Scalar  # NaN if the bicycle lacks the quantity
    low: Scalar  # 2.5 % quantile, NaN if no sample has the quantity
    high: Scalar  # 97.5 % quantile
    fraction: Scalar  # share of the counted samples that have the quantity


def sample_parameters(
    bicycle: MeasuredBicycle, key: Key[Array, ""] | UInt32[Array, "2"], count: int
) -> ParameterSamples:
    """Return `count` bicycles drawn from a normal distribution with the measured values and their covariance.
    If this is unknown, parameters are independent, with their sigmas.

        samples = sample_parameters(bicycle, jax.random.key(0), 2000)
        weave = jax.vmap(lambda parameters: ...)(samples.by_name())

    **Arguments:** `bicycle`; `key`, a JAX random key; `count`, number of samples. **Returns:** all samples.
    Impossible bicycles are marked (`physical`) and counted by violation (`refused`). **Raises** ValueError
    unless `count` is positive.
    """
    if count < 1:
        raise ValueError(
            f"`count` is {count}, expected at least 1 sample; 2000 samples give limits to about 0.1 sigma."
        )
    value = jnp.array([bicycle.values[name] for name in PARAMETER_NAMES])
    standard = jax.random.normal(key, (count, len(PARAMETER_NAMES)), value.dtype)
    values = value + standard @ jnp.asarray(_root(bicycle), value.dtype).T
    broken = violations(dict(zip(PARAMETER_NAMES, values.T, strict=True)))
    return ParameterSamples(
        values=values,
        physical=~jnp.any(jnp.stack(list(broken.values())), axis=0),
        refused={sentence: jnp.sum(where) for sentence, where in broken.items() if jnp.any(where)},
    )


def _root(bicycle: MeasuredBicycle) -> np.ndarray:
    """Return R with R R' the covariance, which may be singular."""
    sigma = np.array([bicycle.sigmas[name] for name in PARAMETER_NAMES])
    if bicycle.covariance is None:
        return np.diag(sigma)
    scale = np.where(sigma > 0, sigma, 1.0)  # correlations do not depend on units
    squares, directions = np.linalg.eigh(bicycle.covariance / np.outer(scale, scale))
    return scale[:, None] * directions * np.sqrt(np.maximum(squares, 0.0))


def interval(
    values: Float[Array, " samples"],
    *,
    nominal: ArrayLike | None = None,
    counted: Bool[Array, " samples"] | None = None,
) -> Interval:
    """Return limits of a sampled quantity over the samples in which it is finite.

    **Arguments:** `values`, one per sample, NaN if a sample lacks the quantity; `nominal`, the quantity of
    the bicycle as measured (default: the median of the samples); `counted`, False for samples to exclude,
    such as impossible ones. **Returns:** `value`, 2.5 % and 97.5 % quantiles, and the fraction of the counted
    samples that have the quantity.
    """
    counted = jnp.ones(values.shape, bool) if counted is None else counted
    has = counted & jnp.isfinite(values)
    present = jnp.where(has, values, jnp.nan)
    low, median, high = jnp.nanquantile(present, jnp.array([0.025, 0.5, 0.975], values.dtype))
    return Interval(
        value=median if nominal is None else jnp.asarray(nominal, values.dtype),
        low=low,
        high=high,
        fraction=jnp.sum(has) / jnp.maximum(jnp.sum(counted), 1),
    )
