"""How far estimates are spread over repeats of an experiment: the parametric bootstrap.

    value* = prediction + sigma e       e: standard normal, or Student's t under that loss, with the memory that the noise was fitted with
    mean*  = theta + S M^-1 e           of priors: they were measured, too, and are drawn anew about the estimates; S, M: see `joint_prior`

Each repeat is fitted as the data were, from the estimates on; bias is the mean of what is found less the estimate.

    ends of the 95 % interval     theta + (q / 1.96) (quantile - theta)           quantiles: 2.5 and 97.5 % of what is found
    noise of residuals            e = (r - mean r) c,  of variance sum r^2 / (n - p)       of each channel: n samples, which determined p unknowns

q is that of Student's t where the size of the noise was estimated: all repeats have the size that was found, so that they spread too little. Its degrees of
freedom are 1 / sum share^2 / (n - p) over all channels, of whose share in the variance of an unknown `informed` tells. Where the noise is known, q is 1.96.
Source: B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap (1993), chapters 9, 10 and 13; T. C. Hesterberg, The American Statistician 69 (2015) 371
(quantiles of t in place of normal ones); F. E. Satterthwaite, Biometrics Bulletin 2 (1946) 110; at a bound: D. W. K. Andrews, Econometrica 68 (2000) 399.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.analysis.asked import TakenUp, taken_up
from jourdain_jax.analysis.correlated_noise import memory
from jourdain_jax.analysis.derived import derived
from jourdain_jax.analysis.estimated import Estimated
from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.held_out import Prediction, of_fitted
from jourdain_jax.analysis.information import students_t_95
from jourdain_jax.analysis.informed import informed, leverages
from jourdain_jax.analysis.levenberg_marquardt import Minimum
from jourdain_jax.analysis.losses import LEAST_SQUARES
from jourdain_jax.analysis.noise_levels import LEFT
from jourdain_jax.analysis.predictions import Lanes
from jourdain_jax.analysis.problem import Problem
from jourdain_jax.analysis.search import off_bounds, with_memory
from jourdain_jax.analysis.spread import NORMAL_95
from jourdain_jax.analysis.table import table
from jourdain_jax.scene.printing import Printed

_FEWEST = 40  # repeats: one beyond each end of an interval
_ROOM = 2**28  # bytes of residuals with derivatives that are kept at a time
_TAIL = 0.025
_BIASED = 0.25  # standard errors; Efron and Tibshirani, section 10.3


@dataclass(frozen=True, eq=False, repr=False)
class Bootstrap(Printed):
    """Estimates of repeats of an experiment; `print` shows intervals and bias, `bootstrap["offset"]` those of one unknown."""

    fit: Any  # whose repeats these are
    values: Float[np.ndarray, "repeats unknowns"]  # in the order of `fit.labels`
    converged: Bool[np.ndarray, "repeats"]  # the others count nowhere
    at_bound: Bool[np.ndarray, "repeats unknowns"]
    quantiles: Float[np.ndarray, "unknowns"]  # q
    bounds: tuple[Float[np.ndarray, "unknowns"], Float[np.ndarray, "unknowns"]]

    def __getitem__(self, name: str) -> Estimated:
        e, i = self.fit[name], self.fit.labels.index(name)
        return self._told(e.value, self.values[:, i], ~np.isnan(e.low + e.high), self.quantiles[i], e.unit, (self.bounds[0][i], self.bounds[1][i]))

    @property
    def estimates(self) -> dict[str, Estimated]:
        """All estimates of the fit by name, with standard errors and intervals of the bootstrap; none for what the measurements do not tell."""
        return {name: self[name] for name in self.fit.labels}

    @property
    def bias(self) -> dict[str, float]:
        """How much estimates of repeats are on average above what these were drawn from."""
        found = np.mean(self.values[self.converged], axis=0) - self.fit.values if self.converged.any() else np.full(len(self.fit.labels), np.nan)
        return dict(zip(self.fit.labels, found.tolist(), strict=True))

    def derived(self, function: Callable, unit: str = "") -> Estimated:
        """A number, or an array of them, that follows from the parameters, as `Fit.derived`, with standard error and interval of the bootstrap."""
        known, shared = self.fit.derived(function, unit), self.fit.layout.sizes[0]
        drawn, slopes = derived(self.fit.asked.scene, self.fit.layout, function, self.values[:, :shared])
        q = np.max(np.where(np.any(slopes != 0, axis=0), self.quantiles[:shared], 0.0), axis=-1, initial=0.0)
        return self._told(known.value, drawn, np.isfinite(known.standard_error), q, unit)

    @property
    def tied(self) -> dict[str, Estimated]:
        """The parameters that follow from unknowns, as in `Fit.tied`."""
        return {name: self.derived(lambda scene, name=name: getattr(scene, name), e.unit) for name, e in self.fit.tied.items()}

    def _told(self, value, drawn: np.ndarray, is_told, q, unit: str, bounds=(-np.inf, np.inf)) -> Estimated:
        drawn, spread = drawn[self.converged], np.full((3, *np.shape(value)), np.nan)
        if len(drawn) > 1:
            ends = np.clip(value + q / NORMAL_95 * (np.quantile(drawn, (_TAIL, 1 - _TAIL), axis=0) - value), *bounds)
            spread = np.where(is_told, [np.std(drawn, axis=0, ddof=1), *ends], np.nan)
        error, low, high = map(np.asarray, spread)
        return Estimated(value, error, low, high, unit)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why these intervals should not be relied on, one sentence each."""
        good, found = self.converged, []
        if (failed := np.count_nonzero(~good)) > _TAIL * good.size:
            found.append(f"{failed} of {good.size} fits did not converge and are left out, so that intervals may be too narrow")
        for name, share in zip(self.fit.labels, np.sum(self.at_bound[good], axis=0) / max(good.sum(), 1), strict=True):
            if share > _TAIL:
                found.append(f"`{name}` is at a bound in {share:.0%} of the fits, where a bootstrap gives no intervals that hold; those of `Fit.profiles` do")
        limit = _BIASED + 3 / math.sqrt(good.size)  # of the mean, and what chance adds
        for name, e in self.estimates.items():
            if not self.fit.at_bound[self.fit.labels.index(name)] and abs(bias := self.bias[name]) > limit * e.standard_error:
                found.append(f"`{name}` is biased by {bias / e.standard_error:.2g} standard errors: the fit is far from linear there, and intervals are rough")
        return tuple(found)

    def _text(self) -> str:
        lines = [f"Bootstrap of {type(self.fit.scene).__name__}: {len(self.values)} fits of repeats, {self.converged.sum()} converged"]
        lines += [f"WARNING: {sentence}" for sentence in self.warnings]
        rows = [("unknown", "unit", "estimate", "bias", "std. error", "95 % interval")]
        of_tied = {f"{name} (tied)": e for name, e in self.tied.items() if e.value.ndim == 0}
        for name, e in (self.estimates | of_tied).items():
            bias, error, interval = "-", "-", "none"
            if np.isfinite(e.standard_error):
                bias = f"{self.bias[name]:.2g}" if name in self.bias else bias
                error, interval = f"{e.standard_error:.2g}", f"[{e.low:.6g}, {e.high:.6g}]"
            rows.append((name, e.unit, f"{e.value:.6g}", bias, error, interval))
        return "\n".join([*lines, *table(rows)])


def bootstrap(fit, data: Experiment | Sequence[Experiment], repeats: int, seed: int, noise: str) -> Bootstrap:
    """The bootstrap of a `Fit` of one experiment; see `Fit.bootstrap`."""
    if isinstance(repeats, bool) or not isinstance(repeats, int | np.integer) or repeats < _FEWEST:
        raise ValueError(f"`repeats` is {repeats!r}, expected a whole number of {_FEWEST} or more; 1000 tell an end to a tenth of a standard error")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"`seed` is {seed!r}, expected a whole number of zero or more")
    if noise not in ("sigmas", "residuals"):
        raise ValueError(f'`noise` is {noise!r}, expected "sigmas" or "residuals": from what noise is drawn')
    if not fit.converged:
        raise ValueError("the fit has not converged, so that repeats of its experiment would be those of no estimate; fit again, with more `max_iterations`")
    if fit.errors == "runs":
        raise ValueError('errors="runs" holds whatever the noise within a run, but a bootstrap draws noise that is known; fit with errors="sigmas"')
    if fit.asked.loss.kind == "huber" and noise == "sigmas":
        raise ValueError('`huber` does not say what noise there is; draw it from the residuals, by noise="residuals", or fit with `student_t()`')
    again, generator = taken_up(fit, data), np.random.default_rng(seed)
    samples, width = sum(r.size for run in fit.residuals for r in run.values()), sum(fit.layout.sizes) + 2
    most = max(1, _ROOM // (8 * samples * width))
    pools: dict[str, np.ndarray] = {}
    places, limits, quantiles = again.problem.unknowns.estimated, again.limits, fit.statistics.quantiles
    if noise == "residuals":
        quantiles, pools = _of_residuals(fit, again)
    elif fit.asked.loss != LEAST_SQUARES:
        quantiles = np.full(quantiles.shape, NORMAL_95)
    parts = [_fitted(fit, again, generator, min(most, repeats - begun), pools) for begun in range(0, repeats, most)]
    theta = np.concatenate([part.theta for part in parts])
    bound = (theta <= limits.low) | (theta >= limits.high)
    converged = np.concatenate([part.converged for part in parts])
    return Bootstrap(fit, theta[:, places], converged, bound[:, places], quantiles, (limits.low[places], limits.high[places]))


def _of_residuals(fit, again: TakenUp) -> tuple[Float[np.ndarray, "unknowns"], dict[str, Float[np.ndarray, "samples"]]]:
    """q of each unknown, and by channel the noise that its residuals show, in units of sigma."""
    shares, of_runs, pools, doubt = informed(again, len(fit.labels)), leverages(again), {}, 0.0
    for name, share in shares.of_channels.items():
        r, leverage = (np.concatenate([np.ravel(of[name]) for of in parts if name in of]) for parts in (fit.whitened, of_runs))
        r, left = r[np.isfinite(r)], np.count_nonzero(np.isfinite(r)) - np.nansum(leverage)
        if left < LEFT or (r.any() and np.ptp(r) == 0):
            raise ValueError(f'residuals of `{name}` tell nothing of its noise, with samples: {r.size}; use `noise="sigmas"`')
        pools[name] = (r - np.mean(r)) * np.sqrt(np.sum(r**2) / left / max(np.var(r), np.finfo(float).tiny))
        doubt = doubt + share**2 / left
    quantiles = np.full(len(fit.labels), NORMAL_95)
    quantiles[[fit.labels.index(name) for name in shares.labels]] = students_t_95(1 / np.maximum(doubt, 1e-12))
    return quantiles, pools


def _fitted(fit, again: TakenUp, generator: np.random.Generator, count: int, pools: dict) -> Minimum:
    """So many repeats, fitted. `pools`: noise of channels to draw from; none: it is that of the sigmas."""
    problem, asked, limits = again.problem, fit.asked, again.limits
    runs = _drawn(fit, problem, generator, count, pools)
    lanes = Lanes(asked.scene, runs, problem.unknowns.layout, asked.simulation, count)
    of_repeats = Problem(asked.scene, runs, problem.unknowns, lanes, asked.loss)
    of_repeats.prior_mean = _drawn_priors(problem, again.theta[0], generator, count)
    of_repeats.tau = np.tile(problem.tau, (count, 1))
    found = of_repeats.minimum(np.tile(again.theta, (count, 1)), np.arange(count), limits, asked.control, "repeats")
    return off_bounds(of_repeats, with_memory(of_repeats, found, limits, asked.control), limits, asked.control, None)[0]


def _drawn(fit, problem: Problem, generator: np.random.Generator, count: int, pools: dict) -> tuple[Experiment, ...]:
    """The runs with so many repeats of their values; what is missing is so in each."""
    runs = []
    for run, of_run in zip(problem.runs, of_fitted(fit, problem.runs), strict=True):
        values = {}
        for name, predicted in of_run.items():
            shape = (count, *predicted.values.shape)
            if pools:
                e = generator.choice(pools[name], shape)
            else:
                e = generator.standard_normal(shape) if fit.asked.loss == LEAST_SQUARES else generator.standard_t(fit.asked.loss.parameter, shape)
            tau = fit.correlation_time[name] if name in fit.correlation_time else run.correlation_time.get(name, 0.0)
            values[name] = predicted.prediction + predicted.sigma * _with_memory(e, predicted, float(tau))
        runs.append(eqx.tree_at(lambda run: run.values, run, values))
    return tuple(runs)


def _with_memory(e: np.ndarray, predicted: Prediction, tau: float) -> np.ndarray:
    """`e_k = rho e_(k-1) + sqrt(1 - rho^2) w_k` from independent w (repeats, times, *channel)."""
    rho = memory(np.diff(predicted.ts), tau)
    for k, one in enumerate(rho.tolist() if tau > 0 else [], 1):
        e[:, k] = one * e[:, k - 1] + math.sqrt(1 - one**2) * e[:, k]
    return e


def _drawn_priors(problem: Problem, theta: Float[np.ndarray, "places"], generator: np.random.Generator, count: int) -> Float[np.ndarray, "count places"]:
    """Means of priors as they would have been measured."""
    unknowns, shared = problem.unknowns, problem.unknowns.layout.sizes[0]
    e = generator.standard_normal((count, theta.size))
    e[:, :shared] = np.linalg.solve(unknowns.whitening, e[:, :shared].T).T
    return theta + unknowns.prior_sigma * e  # NaN where there is none
