"""What a fit predicts for runs that had no part in it.

error = prediction - value,    rms^2 = mean error^2,    R^2 = 1 - sum error^2 / sum (value - mean)^2         over the samples of a channel that are not missing

All that runs share is held at its estimate. What is a run's own (unknown start values, numbers of its sensors) is fitted to the run itself.
"""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.asked import for_runs
from jourdain_jax.analysis.estimates import Estimates
from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.levenberg_marquardt import minimise
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.printing import Printed


class Prediction(Printed, eqx.Module):
    """A channel of a run as a fit predicts it, in the unit of the channel."""

    ts: Float[np.ndarray, "times"]  # s
    values: Float[np.ndarray, "times *channel"]  # measured; NaN where missing
    prediction: Float[np.ndarray, "times *channel"]  # NaN where missing
    sigma: Float[np.ndarray, "times *channel"]

    @property
    def error(self) -> Float[np.ndarray, "times *channel"]:
        """Prediction less value, in the unit of the channel."""
        return self.prediction - self.values

    @property
    def rms(self) -> float:
        """Root mean square of the error, in the unit of the channel."""
        return float(np.sqrt(np.nanmean(self.error**2)))

    @property
    def r_squared(self) -> float:
        """1 - sum error^2 / sum (value - mean)^2, each component of the channel about its own mean; NaN where the values do not vary."""
        values = np.where(np.isfinite(self.error), self.values, np.nan)
        spread = np.nansum((values - np.nanmean(values, axis=0)) ** 2)
        return float(1 - np.nansum(self.error**2) / spread) if spread > 0 else np.nan

    def _text(self) -> str:
        told = f"rms of {self.rms:.3g}; R^2 {self.r_squared:.6g}"
        return f"{np.isfinite(self.error).sum()} samples from {self.ts[0]:.6g} to {self.ts[-1]:.6g} s, predicted to an {told}"


def of_fitted(fit: Estimates, runs: Sequence[Experiment]) -> tuple[dict[str, Prediction], ...]:
    """Predictions of the runs that a `Fit` was fitted to."""
    return tuple(_by_channel(fit, run, residuals) for run, residuals in zip(runs, fit.residuals, strict=True))


def of_held_out(fit: Estimates, runs: Experiment | Sequence[Experiment]) -> tuple[dict[str, Prediction], ...]:
    """Predictions of other runs; ValueError where they do not fit the scene, or share unknowns that the fit did not estimate."""
    runs = (runs,) if isinstance(runs, Experiment) else tuple(runs)
    other = for_runs(fit, runs)
    unknowns, shared = other.problem.unknowns, other.problem.unknowns.layout.sizes[0]
    labels = unknowns.labels[:shared]
    for place, label in enumerate(labels):
        if label not in fit.labels:
            raise ValueError(f"the runs held out share `{label}`, which was not estimated; {nearest(label, fit.labels)}")
        other.theta[0, place] = fit[label].value
    other.limits.fixed[:shared] = True
    if not np.all(other.limits.fixed):
        other.theta = minimise(other.evaluate, other.theta, other.limits, fit.asked.control).theta
    if not np.isfinite(other.at.cost[0]):
        raise ValueError("a motion of the runs held out fails at the estimates; look at it with `simulate`")
    own = dict(zip(other.problem.estimated, other.at.sigma[0].tolist(), strict=True))
    found = []
    for run, data in enumerate(runs):
        # residuals are in units of sigmas, of which those that are not known were estimated from these very runs
        residuals = {name: r * own[name] / fit.sigma.get(name, own[name]) if name in own else r for name, r in other.residuals(run).items()}
        found.append(_by_channel(fit, data, residuals))
    return tuple(found)


def _by_channel(fit: Estimates, data: Experiment, residuals: dict[str, np.ndarray]) -> dict[str, Prediction]:
    found = {}
    for name, r in residuals.items():
        values, ts = np.asarray(data.values[name]), np.asarray(data.ts)
        sigma = np.broadcast_to(fit.sigma[name] if name in fit.sigma else np.asarray(data.sigma_of(name)), values.shape)
        found[name] = Prediction(ts, values, values + sigma * np.asarray(r), sigma)
    return found
