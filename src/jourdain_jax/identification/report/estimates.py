"""Estimates of a fit by name, with covariance, undetermined combinations and a summary of the residuals."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import described, largest, static
from jourdain_jax.identification.inference.information import (
    derived,
    hidden_combinations,
    standard_errors,
    weak_combinations,
)
from jourdain_jax.identification.report.fit_statistics import Counts, PerRepeat, PerUnknown, Statistics
from jourdain_jax.identification.solve.piecewise import Shot
from jourdain_jax.identification.solve.problem import Asked
from jourdain_jax.identification.solve.unknowns import Unknowns
from jourdain_jax.scene.coordinates import Sentences, UnknownNameError, check_name, nearest, parameters_of
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.plausibility import impossible_bodies

Marks = Bool[np.ndarray, "*repeats"]


class Estimated(Printed, eqx.Module):
    """The estimate of one unknown, in its unit, with standard error and interval; NaN if the measurements do
    not determine it.
    """

    value: PerRepeat
    standard_error: PerRepeat
    low: PerRepeat  # ends of the 95 % interval
    high: PerRepeat
    unit: str = static()

    def _text(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.value.ndim:
            return (
                f"{described(self.value)}{unit}: its fields `value`, `standard_error`, `low`, `high` have"
                " that shape"
            )
        if np.isnan(self.low + self.high):
            return f"{self.value:.6g}{unit}, not determined by the measurements"
        if np.isfinite(self.standard_error):
            error = f"standard error {self.standard_error:.2g}"
        else:
            error = "at its bound"
        return f"{self.value:.6g}{unit}, {error}, 95 % interval [{self.low:.6g}, {self.high:.6g}]"


class ChannelResiduals(Printed, eqx.Module):
    """Residuals of one channel of one run, in units of sigma. Good fits have mean near 0 and rms near 1."""

    run: int
    channel: str
    samples: int
    mean: float
    rms: float
    largest: float  # in magnitude

    @staticmethod
    def of(run: int, name: str, r: np.ndarray) -> "ChannelResiduals":
        """Return the summary of a channel's residuals `r`, NaN for missing samples."""
        r = r[~np.isnan(r)]
        numbers = (r.mean(), np.sqrt((r**2).mean()), largest(r)) if r.size else (np.nan,) * 3
        return ChannelResiduals(run, name, r.size, *map(float, numbers))

    def _text(self) -> str:
        of = f"{self.samples} samples, mean {self.mean:.2g}, rms {self.rms:.3g}, largest {self.largest:.3g}"
        return f"residuals of `{self.channel}` of run {self.run}, in sigmas: {of}"


GONE = {"bootstrap": "`Fit.profiles` gives intervals of nonlinear scenes, `fit_batch` those of repeats"}


@dataclass(frozen=True, eq=False, repr=False)
class Estimates(Printed):
    """Estimates by name (`fit["offset"].value`), with covariance, residuals and the fitted scene.

    After `fit_batch`, every array has a leading axis `repeats`, also the arrays of `scene`. Results at the
    minimum are computed on first access: `scene`, `starts`, `standard_errors`, `low`, `high`, `at_bound`,
    `residuals`, `whitened`, `sigma`, `correlation_time`, `chi_square`, `samples`, `degrees_of_freedom` and
    the other fields of `Statistics`.
    """

    values: PerUnknown
    # distance of the free optimum beyond the bound, in standard errors; NaN for estimates off a bound
    beyond: PerUnknown
    converged: Marks
    stuck: Marks  # no step lowers the sum of squares, but the point is no minimum
    steps: Counts  # number of tried steps
    grown: Marks  # whether growing spans found the minimum, far from the result of the first guess
    agreeing: Counts  # number of first guesses that led to this minimum; zero for a batch
    shooting: Shot | None  # results of multiple shooting
    # name of the objective, and F initially and after each tried step; empty for a batch
    trace: tuple[tuple[str, tuple[float, ...]], ...]
    asked: Asked  # arguments of `fit`, among them `guesses` and `errors`
    unknowns: Unknowns  # with `labels`, `units` and `layout`
    work_out: Callable[[], Statistics]

    @cached_property
    def statistics(self) -> Statistics:
        """Return the statistics at the minimum."""
        return self.work_out()

    def __getstate__(self) -> dict:
        # compiled programs cannot leave their process
        return vars(self) | {"statistics": self.statistics, "work_out": None}

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of `statistics` (such as `standard_errors`), of the arguments of the fit, or of
        the unknowns.
        """
        parts = {
            "statistics": Statistics.__dataclass_fields__,
            "asked": ("guesses", "errors"),
            "unknowns": ("labels", "units", "layout"),
        }
        for part in (part for part, names in parts.items() if name in names):
            return getattr(getattr(self, part), name)
        raise AttributeError(
            f"`{name}` was removed: {GONE[name]}"
            if name in GONE
            else f"`Fit` has no `{name}`; {nearest(name, dir(self))}"
        )

    def __getitem__(self, name: str) -> Estimated:
        check_name(name, self.labels, f"`{name}` was not estimated", UnknownNameError)
        i = self.labels.index(name)
        value, error, low, high = (
            x[..., i] for x in (self.values, self.standard_errors, self.low, self.high)
        )
        return Estimated(value, error, low, high, self.units[i])

    @property
    def estimates(self) -> dict[str, Estimated]:
        """Return all estimates by name."""
        return {name: self[name] for name in self.labels}

    @property
    def covariance(self) -> Float[np.ndarray, "*repeats unknowns unknowns"]:
        """Return the covariance of the estimates in the order of `labels`, to first order; NaN for unknowns
        that are not identifiable.
        """
        return self.information.covariance

    @property
    def correlation(self) -> Float[np.ndarray, "*repeats unknowns unknowns"]:
        """Return the correlation of the estimates."""
        return self.covariance / (self.standard_errors[..., :, None] * self.standard_errors[..., None, :])

    @property
    def reduced_chi_square(self) -> PerRepeat:
        """Return the sum of squared residuals per degree of freedom: near 1 for a correct scene and correct
        sigmas, NaN without degrees of freedom.
        """
        return np.asarray(
            self.chi_square / np.where(self.degrees_of_freedom > 0, self.degrees_of_freedom, np.nan)
        )

    # For a single fit, not a batch.
    # ------------------------------------------------------------------------------------

    @property
    def agreement(self) -> str:
        """Return a sentence with the number of first guesses that led to the minimum."""
        return (
            f"{int(self.agreeing) or 'none'} of {self.guesses} first guesses led to"
            f" {'this' if self.agreeing else 'a'} minimum"
        )

    @property
    def not_identifiable(self) -> Sentences:
        """Return undetermined combinations of unknowns, one sentence each."""
        if not np.isfinite(self.chi_square):
            return ()
        return hidden_combinations(
            self.information.hidden[0], self.information.least_part, self.sizes, self.values, self.labels
        )

    @property
    def correlated(self) -> Sentences:
        """Return pairs of unknowns whose estimates correlate by 0.98 or more in magnitude, strongest first,
        one sentence each.
        """
        some = np.flatnonzero(np.isfinite(self.standard_errors))[:1000]  # unknowns
        found = np.triu(self.correlation[np.ix_(some, some)], 1)
        pairs = sorted(zip(*np.nonzero(np.abs(found) >= 0.98), strict=True), key=lambda ij: -abs(found[ij]))
        return tuple(
            f"`{self.labels[some[i]]}` and `{self.labels[some[j]]}` correlate at "
            f"{np.sign(found[i, j]) * min(abs(found[i, j]), 0.9999):.4g}: the data determine a combination "
            "of them far better than either"
            for i, j in pairs
        )

    @property
    def weak(self) -> Sentences:
        """Return poorly determined shared unknowns and combinations (relative standard error of at least
        0.1), weakest first, one sentence each.
        """
        return weak_combinations(self.covariance, self.values, self.sizes, self.labels)

    @property
    def impossible(self) -> Sentences:
        """Return one sentence for each body of the fitted scene whose inertia no distribution of mass can
        have.
        """
        q, _, _ = self.scene.named(**self.starts[0])
        return impossible_bodies(self.scene, q)

    @property
    def autocorrelation(self) -> dict[str, tuple[float, float]]:
        """Return, for each channel over all runs, the correlation of neighbouring whitened residuals, and the
        limit `3.5 / sqrt(pairs)`, which white noise rarely exceeds.
        """
        found = {}
        for name in dict.fromkeys(name for run in self.whitened for name in run):
            runs = [np.asarray(run[name]).reshape(len(run[name]), -1) for run in self.whitened if name in run]
            products = np.concatenate([np.ravel(r[1:] * r[:-1]) for r in runs])
            squares = np.concatenate([np.ravel(r) ** 2 for r in runs])
            pairs = np.isfinite(products).sum()
            size = np.nanmean(squares) if np.isfinite(squares).any() else 0.0
            if pairs and size > 0:
                found[name] = float(np.nanmean(products) / size), 3.5 / float(np.sqrt(pairs))
        return found

    def residual_summary(self) -> tuple[ChannelResiduals, ...]:
        """Return count, mean, rms and largest residual per run and channel."""
        return tuple(
            ChannelResiduals.of(run, name, np.asarray(r))
            for run, found in enumerate(self.residuals)
            for name, r in found.items()
        )

    def derived(self, function: Callable[[Scene], Array], unit: str = "") -> Estimated:
        """Return a number, or an array of them, that depends on the parameters, with its standard error and
        95 % interval.

            found.derived(lambda scene: scene.mass * scene.offset**2, "kg m^2")

        To first order (the delta method), the variance is `g' C g`, where g is the derivative of the quantity
        with respect to the unknowns and C is the covariance of the estimates. A combination of unknowns may
        have an interval even if the unknowns are not identifiable separately. The result is NaN if it depends
        on an undetermined direction, or on an unknown at its bound.

        - `function`: a function of a scene, in plain JAX, that returns an array of any shape. `unit`: unit of
          the result, for `print`.

        **Returns** value, standard error and ends of the interval in that shape; for a batch with a leading
        axis `repeats`. **Raises** ValueError if the function returns no numbers. Source: C. R. Rao, Linear
        Statistical Inference and Its Applications, 2nd ed. (1973), section 6a.2.
        """
        shared = self.layout.sizes[0]
        value, slopes = derived(self.asked.scene, self.layout, function, self.values[..., :shared])
        sizes, at_bound, quantiles = (
            x[..., :shared] for x in (self.sizes, self.at_bound, self.statistics.quantiles)
        )
        error = standard_errors(self.information, slopes, sizes, at_bound, self.asked.control.cutoff)
        of_numbers = quantiles.reshape(*quantiles.shape[:-1], *(1,) * (slopes.ndim - quantiles.ndim), shared)
        reach = error * np.max(np.where(slopes != 0, of_numbers, 0.0), axis=-1, initial=0.0)
        return Estimated(value, error, np.asarray(value - reach), np.asarray(value + reach), unit)

    @property
    def tied(self) -> dict[str, Estimated]:
        """Return estimates, as by `derived`, of the parameters that depend on unknowns through a function or
        a possible inertia in `free`.
        """
        units = {name: about["unit"] for name, _, about in parameters_of(self.asked.scene)}
        return {
            name: self.derived(lambda scene, name=name: getattr(scene, name), units[name])
            for name in self.layout.following
        }
