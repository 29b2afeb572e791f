"""The result of a fit: estimates with their uncertainty, residuals, the fitted scene, and what the measurements cannot tell."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jourdain_jax.analysis.asked import Asked, taken_up
from jourdain_jax.analysis.derived import derived, standard_errors
from jourdain_jax.analysis.estimated import ChannelResiduals, Estimated, summary
from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.fit_page import fit_page
from jourdain_jax.analysis.fit_pictures import interval_widths
from jourdain_jax.analysis.fit_statistics import Statistics
from jourdain_jax.analysis.fit_text import batch_text, text
from jourdain_jax.analysis.fit_warnings import warnings_of
from jourdain_jax.analysis.held_out import Prediction, of_fitted, of_held_out
from jourdain_jax.analysis.information import hidden_combinations
from jourdain_jax.analysis.informed import informed
from jourdain_jax.analysis.layout import Layout
from jourdain_jax.analysis.likelihood_profiles import Profile, profiles
from jourdain_jax.analysis.piecewise import Shot
from jourdain_jax.analysis.weak_directions import CORRELATED, weak_combinations
from jourdain_jax.build.plausibility import impossible_bodies
from jourdain_jax.scene.names import UnknownNameError, as_names, nearest
from jourdain_jax.scene.parameters import parameters_of
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene

MOST_COMPARED = 1000  # unknowns
MOST_INFORMED = 24  # unknowns of which the report says what informs them


GONE = {
    "bootstrap": "`Fit.profiles` gives intervals where the scene is not linear; of repeats, draw them about `simulate` of `scene` and `starts`, and give them "
    "to `fit_batch`"
}


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Printed):
    """Estimates by name (`fit["offset"].value`), with covariance, residuals and the fitted scene; `print(fit)` shows a table.

    From `fit_batch`, every array has a leading axis `repeats`, those of `scene` too. What follows from the minimum is worked out when it is first asked
    for; each part of it can be asked for here: `scene`, `starts`, `standard_errors`, `low`, `high`, `at_bound`, `residuals`, `whitened`, `sigma`,
    `correlation_time`, `chi_square`, `samples`, `degrees_of_freedom` and all else of `Statistics`.
    """

    values: Float[np.ndarray, "*repeats unknowns"]
    beyond: Float[np.ndarray, "*repeats unknowns"]  # of estimates at a bound, by how many standard errors the data would put them beyond; NaN elsewhere
    converged: Bool[np.ndarray, "*repeats"]
    stuck: Bool[np.ndarray, "*repeats"]  # no step lowers the sum of squares, however short, and this is no minimum
    steps: Int[np.ndarray, "*repeats"]  # tried
    grown: Bool[np.ndarray, "*repeats"]  # whether the minimum was found over growing spans, far from where the first guess led to
    agreeing: Int[np.ndarray, "*repeats"]  # first guesses that led to this minimum, of those tried; of a batch, which has one for each repeat, zero
    guesses: int  # first guesses tried
    labels: tuple[str, ...]  # names of the unknowns
    units: tuple[str, ...]
    cutoff: float
    errors: str  # whence standard errors come: "sigmas" or "runs"
    shooting: Shot | None  # how it was found by multiple shooting
    trace: tuple[tuple[str, tuple[float, ...]], ...]  # what was minimised, and F at first and after each step tried; none of a batch
    asked: Asked  # the arguments of `fit`
    layout: Layout
    work_out: Callable[[], Statistics]

    @cached_property
    def statistics(self) -> Statistics:
        """What follows from the minimum."""
        return self.work_out()

    def __getstate__(self) -> dict:
        return vars(self) | {"statistics": self.statistics, "work_out": None}  # what was compiled stays in its process

    def __getattr__(self, name: str) -> Any:
        """A part of `statistics`, such as `standard_errors`."""
        if name in Statistics.__dataclass_fields__:
            return getattr(self.statistics, name)
        raise AttributeError(f"`{name}` has gone: {GONE[name]}" if name in GONE else f"`Fit` has no `{name}`; {nearest(name, dir(self))}")

    def __getitem__(self, name: str) -> Estimated:
        if name not in self.labels:
            raise UnknownNameError(f"`{name}` was not estimated; {nearest(name, self.labels)}")
        i = self.labels.index(name)
        return Estimated(self.values[..., i], self.standard_errors[..., i], self.low[..., i], self.high[..., i], self.units[i])

    @property
    def estimates(self) -> dict[str, Estimated]:
        """All estimates by name."""
        return {name: self[name] for name in self.labels}

    @property
    def covariance(self) -> Float[np.ndarray, "*repeats unknowns unknowns"]:
        """Covariance of the estimates in the order of `labels`, to first order; NaN where not identifiable."""
        return self.information.covariance

    @property
    def correlation(self) -> Float[np.ndarray, "*repeats unknowns unknowns"]:
        """Correlation of the estimates."""
        return self.covariance / (self.standard_errors[..., :, None] * self.standard_errors[..., None, :])

    @property
    def reduced_chi_square(self) -> Float[np.ndarray, "*repeats"]:
        """Sum of squared residuals per degree of freedom, near 1 where scene and sigmas are right; NaN where there are as many unknowns as samples."""
        return np.asarray(self.chi_square / np.where(self.degrees_of_freedom > 0, self.degrees_of_freedom, np.nan))

    # Of one fit, not of a batch. -----------------------------------------------------------------------------------

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """What the measurements cannot tell, one sentence per combination of unknowns."""
        if not np.isfinite(self.chi_square):
            return ()
        return hidden_combinations(self.information.hidden[0], self.information.least_part, self.sizes, self.values, self.labels)

    @property
    def correlated(self) -> tuple[str, ...]:
        """Pairs of unknowns whose estimates correlate by `CORRELATED` or more in magnitude, strongest first, one sentence each."""
        some = np.flatnonzero(np.isfinite(self.standard_errors))[:MOST_COMPARED]
        found = np.triu(self.correlation[np.ix_(some, some)], 1)
        pairs = sorted(zip(*np.nonzero(np.abs(found) >= CORRELATED), strict=True), key=lambda ij: -abs(found[ij]))
        return tuple(
            f"`{self.labels[some[i]]}` and `{self.labels[some[j]]}` correlate at {np.sign(found[i, j]) * min(abs(found[i, j]), 0.9999):.4g}: "
            "the data tell a combination of them far better than either"
            for i, j in pairs
        )

    @property
    def weak(self) -> tuple[str, ...]:
        """Shared unknowns, and combinations of them, that the data tell with a relative standard error of 0.1 or more, weakest first, one sentence each."""
        return weak_combinations(self.covariance, self.values, self.sizes, self.labels)

    @property
    def impossible(self) -> tuple[str, ...]:
        """Bodies of the fitted scene that no distribution of mass can make, one sentence each."""
        q, _, _ = self.scene.named(**self.starts[0])
        return impossible_bodies(self.scene, q)

    @property
    def warning(self) -> str:
        """Why the estimates should not be relied on, the first reason in one sentence; empty where nothing speaks against them."""
        return next(iter(self.warnings), "")

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why estimates or intervals should not be relied on, the most serious reason first, one sentence each."""
        return warnings_of(self)

    @property
    def autocorrelation(self) -> dict[str, tuple[float, float]]:
        """For each channel, the correlation of neighbouring whitened residuals over all runs, and what white ones hardly exceed (3.5 / sqrt(pairs))."""
        found = {}
        for name in dict.fromkeys(name for run in self.whitened for name in run):
            runs = [np.asarray(run[name]).reshape(len(run[name]), -1) for run in self.whitened if name in run]
            products = np.concatenate([np.ravel(r[1:] * r[:-1]) for r in runs])
            squares = np.concatenate([np.ravel(r) ** 2 for r in runs])
            pairs, size = np.isfinite(products).sum(), np.nanmean(squares) if np.isfinite(squares).any() else 0.0
            if pairs and size > 0:
                found[name] = float(np.nanmean(products) / size), 3.5 / float(np.sqrt(pairs))
        return found

    def residual_summary(self) -> tuple[ChannelResiduals, ...]:
        """Count, mean, rms and largest residual per run and channel."""
        return tuple(summary(run, name, np.asarray(r)) for run, found in enumerate(self.residuals) for name, r in found.items())

    def derived(self, function: Callable[[Scene], Array], unit: str = "") -> Estimated:
        """A number, or an array of them, that follows from the parameters, with its standard error and 95 % interval.

            found.derived(lambda scene: scene.mass * scene.offset**2, "kg m^2")

        y = f(scene), var(y) = g' C g with g = d y / d theta and C the covariance of the estimates: to first order (the delta method). So a combination is
        told whose parts the data do not tell apart. NaN where it depends on a direction that does not show, or on an unknown at its bound.

        - `function`: plain JAX, of a scene; it returns an array of any shape. `unit`: of the result, for print.

        **Returns** value, standard error and ends of the interval in that shape, of a batch with a leading axis `repeats`. **Raises** ValueError where the
        function returns no numbers. Source: C. R. Rao, Linear Statistical Inference and Its Applications, 2nd ed. (1973), section 6a.2.
        """
        shared = self.layout.sizes[0]
        value, slopes = derived(self.asked.scene, self.layout, function, self.values[..., :shared])
        sizes, at_bound, quantiles = (x[..., :shared] for x in (self.sizes, self.at_bound, self.statistics.quantiles))
        error = standard_errors(self.information, slopes, sizes, at_bound, self.cutoff)
        of_numbers = quantiles.reshape(*quantiles.shape[:-1], *(1,) * (slopes.ndim - quantiles.ndim), shared)
        reach = error * np.max(np.where(slopes != 0, of_numbers, 0.0), axis=-1, initial=0.0)
        return Estimated(value, error, np.asarray(value - reach), np.asarray(value + reach), unit)

    @property
    def tied(self) -> dict[str, Estimated]:
        """The parameters that follow from unknowns, by the functions and the possible inertias in `free`, as `derived` tells them."""
        units = {name: about["unit"] for name, _, about in parameters_of(self.asked.scene)}
        return {name: self.derived(lambda scene, name=name: getattr(scene, name), units[name]) for name in self.layout.following}

    def profiles(self, data: Experiment | Sequence[Experiment], names: str | Iterable[str] = ()) -> dict[str, Profile]:
        """The profile likelihood of the unknowns in `names` (default: all that are not of one run alone), by name: how far each may be moved, all others
        being fitted anew, before 2 (F - F_min) reaches 3.84, and whether that is "bounded", "one-sided" or "flat". `data`: the runs fitted.

        It takes ten to thirty fits for each name. Where sigmas are estimated, a robust loss was used, or errors="runs", the rise is divided by what variances
        and quantiles are the larger for it. ValueError for a fit of a batch or one that failed, and other data than the fit's; KeyError for names that were
        not estimated.
        """
        self._check_one()
        of_all = [name for name in self.labels if not name.startswith("run ")] or self.labels
        fitted = taken_up(self, data)
        errors, of_rise = (dict(zip(self.labels, x.tolist(), strict=True)) for x in (self.standard_errors, self.statistics.of_rise))
        return profiles(fitted, as_names(names) or of_all, errors, of_rise)

    def predict(self, runs: Experiment | Sequence[Experiment]) -> tuple[dict[str, Prediction], ...]:
        """What the fit predicts for `runs` that had no part in it, by channel: `prediction`, `error`, `rms` (in the unit of the channel) and `r_squared`.

        What all runs share is held at its estimate; start values that are unknown, and numbers of sensors of each run, are fitted to the run itself.
        ValueError for a fit of a batch or one that failed, and for runs that do not fit its scene or whose motion fails.
        """
        self._check_one()
        return of_held_out(self, runs)

    def report(
        self,
        path: str | os.PathLike,
        data: Experiment | Sequence[Experiment] = (),
        *,
        held_out: Experiment | Sequence[Experiment] = (),
        profiles: "bool | str | Iterable[str] | Mapping[str, Profile]" = False,
        units: Mapping[str, str] | None = None,
    ) -> None:
        """Write this fit as one HTML file that loads nothing from elsewhere: estimates, warnings, what the data do not tell, correlations, residuals, the way
        to the minimum.

        - `data`: the runs fitted; their samples are drawn beside the prediction, with R^2 = 1 - sum (prediction - value)^2 / sum (value - mean)^2, and it is
          told which run, channel and time span informs which unknown: shares a_k^2 / sum a^2, a = C J', of the variance of the estimate.
        - `held_out`: other runs, which are predicted as by `predict`.
        - `profiles`: True or names, to compute them now; or what `profiles` returned.
        - `units`: channel -> its unit, for labels, such as `{"x": "m"}`; a scene knows the units of its parameters only.

        ValueError for a path that is no .html file, a fit of a batch or one that failed, and other data than the fit's.
        """
        runs, others = ((x,) if isinstance(x, Experiment) else tuple(x) for x in (data, held_out))
        if not str(path).lower().endswith((".html", ".htm")):
            raise ValueError(f"cannot write `{os.fspath(path)}`: the report of a fit is a .html file")
        self._check_one()
        shapes = lambda runs: [{name: np.shape(x) for name, x in run.items()} for run in runs]  # noqa: E731
        if runs and shapes(run.values for run in runs) != shapes(self.residuals):
            raise ValueError(
                f"`data` has {len(runs)} runs with channels {shapes(run.values for run in runs)}, expected those of the fit: {shapes(self.residuals)}"
            )
        if not runs and profiles and not isinstance(profiles, Mapping):
            raise ValueError("profiles are computed from the runs that were fitted; give them as `data`")
        along = profiles if isinstance(profiles, Mapping) else self.profiles(runs, () if profiles is True else profiles) if profiles else {}
        page = fit_page(
            self,
            fitted=of_fitted(self, runs) if runs else (),
            shares=informed(taken_up(self, runs), MOST_INFORMED) if runs else None,
            held_out=self.predict(others) if others else (),
            profiles=along,
            units=units or {},
        )
        with open(path, "w", encoding="utf-8") as file:
            file.write(page)

    def _check_one(self) -> None:
        if self.values.ndim > 1 or not np.isfinite(self.chi_square):
            raise ValueError("this is told of one fit whose motion does not fail; of a batch, and of a failed fit, see `print`")

    def _repr_html_(self) -> str:
        one = self.values.ndim == 1 and np.isfinite(self.chi_square)
        return super()._repr_html_() + (interval_widths(self) if one else "")

    def _text(self) -> str:
        return batch_text(self) if self.values.ndim > 1 else text(self)
