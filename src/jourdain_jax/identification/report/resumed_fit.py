"""Results of resumed fits: predictions for other runs, shares of information, and profiles.

Predictions for other runs:

    error = prediction - value,   rms^2 = mean error^2,   R^2 = 1 - sum error^2 / sum (value - mean)^2

Means and sums are over all available samples of a channel. Shared unknowns are held at their estimates.
Unknowns of a run (start values, sensor parameters) are fitted to that run.

The share of each sample in the information on an unknown:

    estimate_i = ... + sum_k a_ik r_k,     a_i = (C J')_i
    share_ik = a_ik^2 / C_ii = - d log C_ii / d log w_k

C = (J'J)^-1: covariance of all unknowns; J: derivatives of residuals r, whitened and weighted; w_k: weight of
sample k, one over the square of its sigma. Shares account for the estimation of all other unknowns. The
shares of all samples and priors add up to one. Source: R. D. Cook and S. Weisberg, Residuals and Influence in
Regression (1982), section 2.2.

Profile likelihood: the objective as a function of one unknown, minimised over all others.

    rise(x) = 2 min (F - F_min) / f       over all unknowns but one, held at x
    interval: where rise(x) <= 3.841, the 95 % quantile of chi-square with one degree of freedom

f: correction for the loss and for estimated sigmas (`standard_errors.py`). A profile is bounded if both ends
exist, one-sided if only one exists, and flat if none exists: then the data do not determine the unknown.
The fit at each point starts from the solution at its inner neighbour. Correlation times are held. Source: D.
J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87; A. Raue et al., Bioinformatics 25 (2009)
1923.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import largest
from jourdain_jax.identification.data.experiment import Data, Experiment
from jourdain_jax.identification.data.run_preparation import as_runs
from jourdain_jax.identification.inference.bound_limits import side
from jourdain_jax.identification.inference.information import information
from jourdain_jax.identification.inference.standard_errors import RISE_95
from jourdain_jax.identification.report.estimates import Estimates
from jourdain_jax.identification.solve.levenberg_marquardt import Minimum
from jourdain_jax.identification.solve.piecewise import Piecewise
from jourdain_jax.identification.solve.problem import Asked, Problem
from jourdain_jax.identification.solve.unknowns import unknowns_of
from jourdain_jax.scene.coordinates import Labels, UnknownNameError, check_name
from jourdain_jax.scene.printing import Printed


def taken_up(fit: Estimates, data: Data) -> tuple[Problem, Minimum]:
    """Return the problem and minimum of a `Fit` of one experiment, with residuals and derivatives computed
    again. Raises ValueError if `data` differ from the data of the fit.
    """
    problem = for_runs(fit, data, fit.asked, fit.shooting is not None)
    unknowns, theta = problem.unknowns, problem.unknowns.guess[None].copy()
    if unknowns.labels != fit.labels:
        raise ValueError(
            f"`data` have the unknowns {', '.join(unknowns.labels)}, expected the fit's: "
            f"{', '.join(fit.labels)}"
        )
    theta[0, unknowns.estimated] = fit.values
    if isinstance(problem, Piecewise) and fit.shooting is not None:
        problem.put_nodes(theta, fit.shooting)
    at = problem.linearised(theta, np.array([0]))
    # sigmas as in F; the sigmas of the fit are corrected for its unknowns
    sigma = dict(zip(problem.estimated, at.sigma[0].tolist(), strict=True))
    for run, residuals in enumerate(fit.residuals):
        again = problem.by_channel(run, at)
        for name, r in residuals.items():
            here = np.nan_to_num(again[name][0] if name in again else np.nan) * (
                sigma.get(name, 1.0) / fit.sigma.get(name, 1.0)
            )
            if here.shape != r.shape or largest(np.nan_to_num(r) - here) >= 0.01:
                raise ValueError(
                    "`data` are not the data of the fit, whose residuals differ; give the runs of the fit"
                )
    return problem, Minimum.begun(theta, at, "")


def for_runs(fit: Estimates, runs: Data, asked: Asked, apart: bool) -> Problem:
    """Return the problem of a `Fit` for these runs. Raises ValueError if they do not match the scene.
    `apart`: whether unknowns of runs are kept separate from shared ones.
    """
    checked = as_runs(asked.scene, runs)
    unknowns = unknowns_of(asked.scene, checked, asked.free, apart)
    problem = (
        Problem(asked, checked, unknowns) if asked.shooting is None else Piecewise(asked, checked, unknowns)
    )
    if problem.with_memory:
        problem.tau = np.array([[float(fit.correlation_time[name]) for name in problem.with_memory]])
    return problem


Samples = Float[np.ndarray, "times *channel"]


@dataclass(frozen=True, repr=False)
class Prediction(Printed):
    """Measured and predicted values of a channel of a run, in its unit."""

    ts: Float[np.ndarray, "times"]  # s
    values: Samples  # measured; NaN where missing
    prediction: Samples  # NaN where missing
    sigma: Samples

    @property
    def error(self) -> Samples:
        """Return prediction minus value, in the unit of the channel."""
        return self.prediction - self.values

    @property
    def rms(self) -> float:
        """Return the root mean square error, in the unit of the channel."""
        return float(np.sqrt(np.nanmean(self.error**2)))

    @property
    def r_squared(self) -> float:
        """Return `1 - sum error^2 / sum (value - mean)^2`, with the mean of each component of the channel;
        NaN for constant values.
        """
        values = np.where(np.isfinite(self.error), self.values, np.nan)
        spread = np.nansum((values - np.nanmean(values, axis=0)) ** 2)
        return float(1 - np.nansum(self.error**2) / spread) if spread > 0 else np.nan

    def _text(self) -> str:
        told = f"rms of {self.rms:.3g}; R^2 {self.r_squared:.6g}"
        return (
            f"{np.isfinite(self.error).sum()} samples from {self.ts[0]:.6g} to {self.ts[-1]:.6g} s, predicted"
            f" with an {told}"
        )


def of_fitted(fit: Estimates, runs: Sequence[Experiment]) -> tuple[dict[str, Prediction], ...]:
    """Return predictions for the runs of a `Fit`."""
    return tuple(_by_channel(fit, run, residuals) for run, residuals in zip(runs, fit.residuals, strict=True))


def of_held_out(fit: Estimates, runs: Data) -> tuple[dict[str, Prediction], ...]:
    """Return predictions for other runs. Raises ValueError if they do not match the scene, or share unknowns
    that the fit did not estimate.
    """
    runs = (runs,) if isinstance(runs, Experiment) else tuple(runs)
    problem = for_runs(fit, runs, replace(fit.asked, shooting=None), apart=True)
    unknowns = problem.unknowns
    theta = problem.unknowns.guess[None].copy()
    shared = problem.unknowns.layout.sizes[0]
    for place, label in enumerate(unknowns.labels[:shared]):
        check_name(label, fit.labels, f"the runs held out share `{label}`, which was not estimated")
        theta[0, place] = fit[label].value
    unknowns.fixed[:shared] = True
    if not np.all(unknowns.fixed):
        theta = problem.minimum(theta, np.array([0])).theta
    at = problem.linearised(theta, np.array([0]))
    if not np.isfinite(at.cost[0]):
        raise ValueError("a motion of the held-out runs fails at the estimates; examine it with `simulate`")
    own = dict(zip(problem.estimated, at.sigma[0].tolist(), strict=True))
    # residuals are in units of sigmas, and unknown sigmas were estimated from these runs
    ratio = {name: sigma / fit.sigma.get(name, sigma) for name, sigma in own.items()}
    residuals = [
        {name: r[0] * ratio.get(name, 1.0) for name, r in problem.by_channel(k, at).items()}
        for k in range(len(runs))
    ]
    return tuple(_by_channel(fit, run, r) for run, r in zip(runs, residuals, strict=True))


def _by_channel(fit: Estimates, data: Experiment, residuals: dict[str, np.ndarray]) -> dict[str, Prediction]:
    found = {}
    for name, r in residuals.items():
        values, ts = np.asarray(data.values[name]), np.asarray(data.ts)
        sigma = np.broadcast_to(
            fit.sigma[name] if name in fit.sigma else np.asarray(data.sigma_of(name)), values.shape
        )
        found[name] = Prediction(ts, values, values + sigma * np.asarray(r), sigma)
    return found


@dataclass(frozen=True)
class Informed:
    """The shares of all samples in the information on some unknowns."""

    labels: Labels
    # shares of the samples of each run, by channel, summed over components
    of_samples: tuple[dict[str, Float[np.ndarray, "unknowns times"]], ...]
    times: tuple[Float[np.ndarray, "times"], ...]  # s

    @property
    def of_runs(self) -> Float[np.ndarray, "unknowns runs"]:
        """Return the share of each run in the information on each unknown."""
        return np.stack([sum(share.sum(axis=1) for share in run.values()) for run in self.of_samples], axis=1)

    @property
    def of_channels(self) -> dict[str, Float[np.ndarray, "unknowns"]]:
        """Return the share of each channel, over all runs, in the information on each unknown."""
        names = dict.fromkeys(name for run in self.of_samples for name in run)
        return {name: sum(run[name].sum(axis=1) for run in self.of_samples if name in run) for name in names}

    @property
    def of_priors(self) -> Float[np.ndarray, "unknowns"]:
        """Return the share of the priors in the information on each unknown."""
        return 1 - self.of_runs.sum(axis=1)

    def half(self, unknown: int) -> tuple[int, float, float]:
        """Return the run with the most information on an unknown, and the shortest time span (first and last
        sample) that contains half of this information.
        """
        run = int(np.argmax(self.of_runs[unknown]))
        told, ts = sum(share[unknown] for share in self.of_samples[run].values()), self.times[run]
        total = np.append(0.0, np.cumsum(told))
        # end index of the span that begins at each sample
        last = np.searchsorted(total, total[:-1] + 0.5 * total[-1] * (1 - 1e-9))
        begins = np.flatnonzero(last < len(total))
        best = begins[np.argmin(ts[last[begins] - 1] - ts[begins])]
        return run, float(ts[best]), float(ts[last[best] - 1])


def informed(problem: Problem, found: Minimum, most: int) -> Informed:
    """Return the shares of information on the first `most` unknowns that have a standard error. They depend
    only on the sigmas, not on factors for the loss or for estimated sigmas.
    """
    unknowns, (p, m), theta, at = problem.unknowns, problem.unknowns.layout.sizes, found.theta, found.at
    known = information(
        at.arrow,
        unknowns.sizes(theta),
        unknowns.estimated,
        unknowns.reached(theta),
        ~found.going,
        problem.asked.control.cutoff,
    ).only()
    some = np.flatnonzero(known.identifiable)[:most]
    C = np.zeros((len(some), unknowns.fixed.size))
    C[:, unknowns.estimated] = known.whole_covariance[some]
    variance = C[range(len(some)), unknowns.estimated[some], None]
    shares: list[dict[str, np.ndarray]] = [{}] * len(problem.runs)
    for b, j, plain in problem.evaluated(theta, np.array([0])):
        group = problem.group_of[int(j[0])]
        white = group.whitened(j, b, plain, problem.taus(b))
        for run, r, J in zip(j.tolist(), white[..., -1], white[..., :-1], strict=True):
            rows, own = np.sqrt(problem.loss.weight(r))[:, None] * J, slice(p + run * m, p + (run + 1) * m)
            for k, name in enumerate(problem.estimated):
                if name in group.channels:
                    rows[group.channels[name]] /= at.sigma[0, k]
            # a = C J'
            share = (np.concatenate([C[:, own], C[:, :p]], axis=1) @ rows.T) ** 2 / variance
            shares[run] = {
                name: np.nansum(x, axis=tuple(range(2, x.ndim)))
                for name, x in group.by_channel(run, share).items()
            }
    return Informed(
        tuple(unknowns.labels[i] for i in some),
        tuple(shares),
        tuple(np.asarray(run.ts) for run in problem.runs),
    )


@dataclass(frozen=True, repr=False)
class Profile(Printed):
    """The rise of the objective along one unknown, and the resulting 95 % interval."""

    name: str
    unit: str
    estimate: float
    values: Float[np.ndarray, "points"]  # increasing, with the estimate among them
    rise: Float[np.ndarray, "points"]  # zero at the estimate
    low: float  # end of the interval; the bound or infinity if the data give no end
    high: float
    is_closed: tuple[bool, bool]  # whether the data determine each end
    kind: str  # "bounded", "one-sided" or "flat"
    notes: Labels  # other observations

    def _text(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        ends = "the data give no end" if self.kind == "flat" else f"[{self.low:.6g}, {self.high:.6g}]{unit}"
        return "; ".join(
            (f"`{self.name}` = {self.estimate:.6g}{unit}, profile {self.kind}: {ends}", *self.notes)
        )


def profiles(
    problem: Problem,
    fitted: Minimum,
    names: Iterable[str],
    errors: dict[str, float],
    divisors: dict[str, float],
) -> dict[str, Profile]:
    """Return profiles of the named unknowns. `errors`: standard errors by name, for the first step;
    `divisors`: f of the module's formula by name.
    """
    unknowns, found = problem.unknowns, {}
    for name in names:
        check_name(name, unknowns.labels, f"`{name}` was not estimated", UnknownNameError)
        k = unknowns.labels.index(name)
        place, error = int(unknowns.estimated[k]), errors[name]
        estimate = float(fitted.theta[0, place])
        if np.isfinite(error) and error > 0:
            first = 0.6 * error
        else:
            first = 0.1 * float(unknowns.sizes(fitted.theta)[0, place])
        low, high = (
            side(problem, fitted, 0, place, way, first, RISE_95 / 2 * divisors[name]) for way in (-1.0, 1.0)
        )
        values, rise = np.array(sorted({(estimate, 0.0), *low.points, *high.points})).T
        closed = low.is_closed, high.is_closed
        kind = ("flat", "one-sided", "bounded")[sum(closed)]
        notes = tuple(dict.fromkeys(one.note for one in (low, high) if one.note))
        unit, rise = unknowns.units[k], 2 * rise / divisors[name]
        found[name] = Profile(name, unit, estimate, values, rise, low.end, high.end, closed, kind, notes)
    return found
