"""The result of a fit, `Fit`: estimates, warnings, profiles, predictions and the report."""

import os
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Array

from jourdain_jax.calculus.files import FilePath
from jourdain_jax.identification.data.experiment import Data, Experiment
from jourdain_jax.identification.inference.log_density import log_density
from jourdain_jax.identification.report.estimates import Estimates
from jourdain_jax.identification.report.fit_page import fit_page, interval_widths
from jourdain_jax.identification.report.fit_text import batch_text, text, warnings_of
from jourdain_jax.identification.report.resumed_fit import (
    Prediction,
    Profile,
    informed,
    of_fitted,
    of_held_out,
    profiles,
    taken_up,
)
from jourdain_jax.identification.solve.levenberg_marquardt import LEAST_SQUARES
from jourdain_jax.scene.coordinates import Sentences, as_names


class Fit(Estimates):
    """Estimates by name (`fit["offset"].value`), with covariance, residuals and the fitted scene;
    `print(fit)` shows a table.

    After `fit_batch`, every array, including those of `scene`, has a leading axis `repeats`; the following
    describes one fit.
    """

    @property
    def warning(self) -> str:
        """Return the most serious reason to doubt the estimates, in one sentence; empty if there is none."""
        return next(iter(self.warnings), "")

    @property
    def warnings(self) -> Sentences:
        """Return all reasons to doubt estimates or intervals, one sentence each, the most serious first."""
        return warnings_of(self)

    def profiles(self, data: Data, names: str | Iterable[str] = ()) -> dict[str, Profile]:
        """Return the profile likelihoods of the unknowns in `names` (default: all shared ones), by name. A
        profile has the range within which 2 (F - F_min) stays below 3.84 when all other unknowns are fitted
        again, and its kind: "bounded", "one-sided" or "flat". `data`: the runs of the fit.

        This takes some ten fits per name. For estimated sigmas, a robust loss or errors="runs", 2 (F - F_min)
        is first divided by a factor, so that the range widens as the interval does. Raises ValueError for a
        batch, a failed fit, and other data than the fit's; KeyError for names that were not estimated.
        """
        self._check_one()
        of_all = [name for name in self.labels if not name.startswith("run ")] or self.labels
        fitted = taken_up(self, data)
        errors, of_rise = (
            dict(zip(self.labels, x.tolist(), strict=True))
            for x in (self.standard_errors, self.statistics.of_rise)
        )
        return profiles(*fitted, as_names(names) or of_all, errors, of_rise)

    def predict(self, runs: Data) -> tuple[dict[str, Prediction], ...]:
        """Return predictions for `runs` that were not fitted: for each run a dictionary by channel with
        `prediction`, `error`, `rms` (in the unit of the channel) and `r_squared`.

        Shared unknowns keep their estimates. Unknown start values and unknown sensor parameters of each run
        are fitted to that run. Raises ValueError for a batch or a failed fit, and for runs that do not fit
        the scene or whose motion fails.
        """
        self._check_one()
        return of_held_out(self, runs)

    def report(
        self,
        path: FilePath,
        data: Data = (),
        *,
        held_out: Data = (),
        profiles: "bool | str | Iterable[str] | Mapping[str, Profile]" = False,
        units: Mapping[str, str] | None = None,
    ) -> None:
        """Write this fit as one self-contained HTML file: estimates, warnings, undetermined combinations,
        correlations, residuals, the path to the minimum.

        - `data`: the fitted runs; their samples are drawn with the prediction and its
          `R^2 = 1 - sum (prediction - value)^2 / sum (value - mean)^2`. The report shows the share of each
          run, channel and time span in the information on each unknown. The share of sample k is
          `a_k^2 / sum a^2`, with `a = C J'`, the covariance C and the derivatives J.
        - `held_out`: other runs, predicted as by `predict`.
        - `profiles`: True or names of unknowns, to compute their profiles now; or the result of
          `Fit.profiles`.
        - `units`: channel -> unit, for labels, such as `{"x": "m"}`; a scene has units only for parameters.

        Raises ValueError for a path that does not end in .html, a batch or a failed fit, and other data than
        the fit's.
        """
        runs, others = ((x,) if isinstance(x, Experiment) else tuple(x) for x in (data, held_out))
        if not str(path).lower().endswith((".html", ".htm")):
            raise ValueError(f"cannot write `{os.fspath(path)}`: the report of a fit is a .html file")
        self._check_one()
        shapes = lambda runs: [{name: np.shape(x) for name, x in run.items()} for run in runs]
        if runs and shapes(run.values for run in runs) != shapes(self.residuals):
            raise ValueError(
                f"`data` has {len(runs)} runs with channels {shapes(run.values for run in runs)}, expected "
                f"the fit's: {shapes(self.residuals)}"
            )
        if not runs and profiles and not isinstance(profiles, Mapping):
            raise ValueError("profiles are computed from the fitted runs; give these as `data`")
        if isinstance(profiles, Mapping):
            along = profiles
        else:
            along = self.profiles(runs, () if profiles is True else profiles) if profiles else {}
        shares = informed(*taken_up(self, runs), 24) if runs else None  # at most this many unknowns
        fitted, held_out = of_fitted(self, runs) if runs else (), self.predict(others) if others else ()
        page = fit_page(self, fitted, shares, held_out, along, units or {})
        with open(path, "w", encoding="utf-8") as file:
            file.write(page)

    def to_arviz(self, data: Data, z: Array | np.ndarray | None = None):
        """Return draws of the posterior as `arviz.InferenceData`, with chains, measured values and pointwise
        log likelihoods (`LogDensity.to_arviz`).

        - `data`: the fitted runs.
        - `z`: draws of a sampler, shape (chains, draws, unknowns), for `log_density(...).whitened(fit)`;
          default: four chains of 1000 standard normal draws, that is, draws from the normal approximation
          of the posterior at this fit.

        Raises ImportError without ArviZ; ValueError for a batch, a failed fit, a robust loss, and unknowns
        without a standard error.
        """
        self._check_one()
        asked = self.asked
        if asked.loss != LEAST_SQUARES:
            raise ValueError("a robust loss has no probability density; fit by least squares")
        density = log_density(asked.scene, data, asked.free, options=asked.options).whitened(self)
        if z is None:
            z = np.random.default_rng(0).normal(size=(4, 1000, len(density.labels)))
        return density.to_arviz(z)

    def _check_one(self) -> None:
        if self.values.ndim > 1 or not np.isfinite(self.chi_square):
            raise ValueError(
                "this needs a single fit whose motion does not fail; for a batch or a failed fit, use `print`"
            )

    def _repr_html_(self) -> str:
        one = self.values.ndim == 1 and np.isfinite(self.chi_square)
        return super()._repr_html_() + (interval_widths(self) if one else "")

    def _text(self) -> str:
        return batch_text(self) if self.values.ndim > 1 else text(self)
