"""Results of fits: estimates, the reasons to doubt them, and further calls (profiles, predictions, plans)."""

import os
from collections.abc import Iterable, Mapping

import numpy as np

from jourdain_jax.analysis.estimates import Estimates
from jourdain_jax.analysis.experiment import Data, Experiment
from jourdain_jax.analysis.fit_page import fit_page, interval_widths
from jourdain_jax.analysis.fit_text import batch_text, text, warnings_of
from jourdain_jax.analysis.resumed import Prediction, Profile, informed, of_fitted, of_held_out, profiles, taken_up
from jourdain_jax.scene.names import as_names


class Fit(Estimates):
    """Estimates by name (`fit["offset"].value`), with covariance, residuals and the fitted scene; `print(fit)` shows a table.

    From `fit_batch`, every array has a leading axis `repeats`, those of `scene` too; what follows below is of one fit.
    """

    @property
    def warning(self) -> str:
        """Why the estimates should not be relied on, the first reason in one sentence; empty where nothing speaks against them."""
        return next(iter(self.warnings), "")

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why estimates or intervals should not be relied on, the most serious reason first, one sentence each."""
        return warnings_of(self)

    def profiles(self, data: Data, names: str | Iterable[str] = ()) -> dict[str, Profile]:
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

    def predict(self, runs: Data) -> tuple[dict[str, Prediction], ...]:
        """What the fit predicts for `runs` that had no part in it, by channel: `prediction`, `error`, `rms` (in the unit of the channel) and `r_squared`.

        What all runs share is held at its estimate; start values that are unknown, and numbers of sensors of each run, are fitted to the run itself.
        ValueError for a fit of a batch or one that failed, and for runs that do not fit its scene or whose motion fails.
        """
        self._check_one()
        return of_held_out(self, runs)

    def report(
        self,
        path: str | os.PathLike,
        data: Data = (),
        *,
        held_out: Data = (),
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
            shares=informed(taken_up(self, runs), 24) if runs else None,  # unknowns of which the report says what informs them
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
