"""A fit that is resumed: at its minimum, along a profile, and for other runs.

What a fit predicts for runs that had no part in it.

error = prediction - value,    rms^2 = mean error^2,    R^2 = 1 - sum error^2 / sum (value - mean)^2         over the samples of a channel that are not missing

All that runs share is held at its estimate. What is a run's own (unknown start values, numbers of its sensors) is fitted to the run itself.

Which samples inform which unknown: of each, the share of what the data tell of it.

    estimate_i = ... + sum_k a_ik r_k,     a_i = (C J')_i       C = (J'J)^-1: covariance of all unknowns; J: derivatives of residuals r, whitened and weighted
    share_ik = a_ik^2 / C_ii = - d log C_ii / d log w_k          w_k: weight of sample k, one over the square of its sigma

It allows for all other unknowns being estimated, too. The shares of all samples add up to one; a prior takes what is missing.
Source: R. D. Cook and S. Weisberg, Residuals and Influence in Regression (1982), section 2.2.

How far an unknown may be moved before the data object, all others being fitted anew: profile likelihood.

    rise(x) = 2 min (F - F_min) / inflation       over all unknowns but one, which is held at x; inflation: as of the covariance, for the loss and for sigmas
    interval: where rise(x) <= 3.841, the 95 % quantile of chi-square with one degree of freedom              that are estimated

bounded: both ends are found; one-sided: one of them; flat: none, the data do not tell the unknown. From the estimate outwards, each point begins where the
one before it ended. Correlation times are held. Source: D. J. Venzon and S. H. Moolgavkar, Applied Statistics 37 (1988) 87; A. Raue et al., Bioinformatics 25
(2009) 1923.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.estimates import Estimates
from jourdain_jax.analysis.experiment import Data, Experiment
from jourdain_jax.analysis.information import Information, information, variances
from jourdain_jax.analysis.likelihood import as_runs
from jourdain_jax.analysis.piecewise import Piecewise
from jourdain_jax.analysis.problem import Asked, Problem
from jourdain_jax.analysis.spread import RISE_95
from jourdain_jax.analysis.unknowns import unknowns_of
from jourdain_jax.scene.names import UnknownNameError, nearest
from jourdain_jax.scene.printing import Printed


class TakenUp:
    """A fit taken up again at theta, (1, places), for the runs it was fitted to or for others."""

    def __init__(self, problem: Problem, theta: np.ndarray):
        self.problem, self.theta = problem, theta
        self.at = problem.linearised(theta, np.array([0]))

    def residuals(self, run: int) -> dict[str, np.ndarray]:
        """Residuals of a run by channel, in units of sigma, at theta; NaN where a sample is missing."""
        return self.problem.by_channel(run, self.at, lambda x: x[0])

    def information(self) -> Information:
        """What the data tell at theta, from the sigmas alone: no factor for the loss, for sigmas that are estimated, or from how runs differ."""
        unknowns, theta = self.problem.unknowns, self.theta
        size, fails = unknowns.sizes(theta), ~np.isfinite(self.at.cost)
        return information(self.at.arrow, size, unknowns.estimated, unknowns.reached(theta), fails, self.problem.asked.control.cutoff).only()


def taken_up(fit: Estimates, data: Data) -> TakenUp:
    """A `Fit` of one experiment where it ended, with residuals and derivatives computed anew. ValueError where `data` are not what it was fitted to."""
    problem = for_runs(fit, data, fit.asked, fit.shooting is not None)
    unknowns, theta = problem.unknowns, problem.unknowns.guess[None].copy()
    if unknowns.labels != fit.labels:
        raise ValueError(f"`data` have the unknowns {', '.join(unknowns.labels)}, expected those of the fit: {', '.join(fit.labels)}")
    theta[0, unknowns.estimated] = fit.values
    if isinstance(problem, Piecewise) and fit.shooting is not None:
        problem.put_nodes(theta, fit.shooting)
    again = TakenUp(problem, theta)
    sigma = dict(zip(problem.estimated, again.at.sigma[0].tolist(), strict=True))  # as F has it; that of a fit allows for its unknowns

    def here(run: int, name: str) -> np.ndarray:
        return np.nan_to_num(again.residuals(run).get(name, np.nan)) * (sigma.get(name, 1.0) / fit.sigma.get(name, 1.0))

    pairs = [(np.nan_to_num(r), here(run, name)) for run, of in enumerate(fit.residuals) for name, r in of.items()]
    if not all(a.shape == b.shape and np.max(np.abs(a - b), initial=0.0) < 0.01 for a, b in pairs):
        raise ValueError("`data` are not those of the fit: its residuals are others there; give the runs that it was fitted to")
    return again


def for_runs(fit: Estimates, runs: Data, asked: Asked, apart: bool) -> Problem:
    """The problem of a `Fit` for these runs; ValueError where they do not fit the scene. `apart`: what is a run's own is told from what runs share."""
    checked = as_runs(asked.scene, runs)
    unknowns = unknowns_of(asked.scene, checked, asked.free, apart)
    problem = Problem(asked, checked, unknowns) if asked.shooting is None else Piecewise(asked, checked, unknowns)
    if problem.with_memory:
        problem.tau = np.array([[float(fit.correlation_time[name]) for name in problem.with_memory]])
    return problem


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


def of_held_out(fit: Estimates, runs: Data) -> tuple[dict[str, Prediction], ...]:
    """Predictions of other runs; ValueError where they do not fit the scene, or share unknowns that the fit did not estimate."""
    runs = (runs,) if isinstance(runs, Experiment) else tuple(runs)
    problem = for_runs(fit, runs, replace(fit.asked, shooting=None), apart=True)
    unknowns, theta, shared = problem.unknowns, problem.unknowns.guess[None].copy(), problem.unknowns.layout.sizes[0]
    labels = unknowns.labels[:shared]
    for place, label in enumerate(labels):
        if label not in fit.labels:
            raise ValueError(f"the runs held out share `{label}`, which was not estimated; {nearest(label, fit.labels)}")
        theta[0, place] = fit[label].value
    unknowns.fixed[:shared] = True
    if not np.all(unknowns.fixed):
        theta = problem.minimum(theta, np.array([0])).theta
    other = TakenUp(problem, theta)
    if not np.isfinite(other.at.cost[0]):
        raise ValueError("a motion of the runs held out fails at the estimates; look at it with `simulate`")
    own = dict(zip(problem.estimated, other.at.sigma[0].tolist(), strict=True))
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


@dataclass(frozen=True)
class Informed:
    """Shares of the samples for some unknowns."""

    labels: tuple[str, ...]
    of_samples: tuple[dict[str, Float[np.ndarray, "unknowns times"]], ...]  # of each run, by channel: all components of the channel together
    times: tuple[Float[np.ndarray, "times"], ...]  # s

    @property
    def of_runs(self) -> Float[np.ndarray, "unknowns runs"]:
        """Share of each run."""
        return np.stack([sum(share.sum(axis=1) for share in run.values()) for run in self.of_samples], axis=1)

    @property
    def of_channels(self) -> dict[str, Float[np.ndarray, "unknowns"]]:
        """Share of each channel in all runs."""
        names = dict.fromkeys(name for run in self.of_samples for name in run)
        return {name: sum(run[name].sum(axis=1) for run in self.of_samples if name in run) for name in names}

    @property
    def of_priors(self) -> Float[np.ndarray, "unknowns"]:
        """What priors tell, not the data."""
        return 1 - self.of_runs.sum(axis=1)

    def half(self, unknown: int) -> tuple[int, float, float]:
        """The run that tells most of an unknown, and the shortest time span, first and last sample, that holds half of what this run tells."""
        run = int(np.argmax(self.of_runs[unknown]))
        told, ts = sum(share[unknown] for share in self.of_samples[run].values()), self.times[run]
        total = np.concatenate([[0.0], np.cumsum(told)])
        last = np.searchsorted(total, total[:-1] + 0.5 * total[-1] * (1 - 1e-9))  # span from each sample on, up to and with sample last - 1
        begins = np.flatnonzero(last < len(total))
        best = begins[np.argmin(ts[last[begins] - 1] - ts[begins])]
        return run, float(ts[best]), float(ts[last[best] - 1])


def informed(fitted: TakenUp, most: int) -> Informed:
    """Shares for the first `most` unknowns of a fit that have a standard error."""
    problem, known = fitted.problem, fitted.information()
    unknowns = problem.unknowns
    some = np.flatnonzero(known.identifiable)[:most]
    places, labels = unknowns.estimated[some], tuple(unknowns.labels[i] for i in some)
    variance = variances(known.shared, known.own, known.follow)[places]
    found: list[dict[str, np.ndarray]] = [{}] * len(problem.runs)
    m, taus = unknowns.layout.sizes[1], problem.taus(np.array([0]))
    for b, j, plain in problem.evaluated(fitted.theta, np.array([0])):
        group = problem.group_of[int(j[0])]
        white = group.whitened(j, b, plain, {name: tau[b] for name, tau in taus.items()})
        for run, r, J in zip(j.tolist(), white[..., -1], white[..., :-1], strict=True):
            rows = np.sqrt(problem.loss.weight(r))[:, None] * J
            for k, name in enumerate(problem.estimated):
                if name in problem.runs[run].values:
                    rows[group.channels[name]] /= fitted.at.sigma[0, k]
            own, shared = rows[:, :m], rows[:, m:]
            a_shared = known.shared @ (shared - own @ known.follow[run]).T  # own unknowns of a run follow the shared ones, x = - G s
            a_own = -np.einsum("kij,js->kis", known.follow, a_shared)
            a_own[run] += known.own[run] @ own.T
            share = np.concatenate([a_shared, a_own.reshape(-1, len(own))])[places] ** 2 / variance[:, None]
            found[run] = {name: np.nansum(x, axis=tuple(range(2, x.ndim))) for name, x in group.by_channel(run, share).items()}
    return Informed(labels, tuple(found), tuple(np.asarray(run.ts) for run in problem.runs))


class Profile(Printed, eqx.Module):
    """The rise of the sum of squares along one unknown, and the 95 % interval that follows from it."""

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    estimate: float
    values: Float[np.ndarray, "points"]  # increasing, the estimate among them
    rise: Float[np.ndarray, "points"]  # zero at the estimate
    low: float  # ends of the interval; where the data set none, the bound, or infinite
    high: float
    is_closed: tuple[bool, bool] = eqx.field(static=True)  # whether the data set them
    kind: str = eqx.field(static=True)  # "bounded", "one-sided" or "flat"
    notes: tuple[str, ...] = eqx.field(static=True)  # what else was seen

    def _text(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        ends = "no data set an end to it" if self.kind == "flat" else f"[{self.low:.6g}, {self.high:.6g}]{unit}"
        return "; ".join((f"`{self.name}` = {self.estimate:.6g}{unit}, profile {self.kind}: {ends}", *self.notes))


def profiles(fitted: TakenUp, names: Iterable[str], errors: dict[str, float], inflation: dict[str, float]) -> dict[str, Profile]:
    """Profiles of the unknowns named. `errors`: standard errors by name, for the first step; `inflation`: by what the rise is divided."""
    unknowns, found = fitted.problem.unknowns, {}
    for name in names:
        if name not in unknowns.labels:
            raise UnknownNameError(f"`{name}` was not estimated; {nearest(name, unknowns.labels)}")
        place = int(unknowns.estimated[unknowns.labels.index(name)])
        low, high = (_side(fitted, place, errors[name], inflation[name], way) for way in (-1.0, 1.0))
        points = sorted({(float(fitted.theta[0, place]), 0.0), *low.points, *high.points})
        closed = low.is_closed, high.is_closed
        kind = ("flat", "one-sided", "bounded")[sum(closed)]
        notes = tuple(dict.fromkeys(note for note in (low.note, high.note) if note))
        values, rise = np.array(points).T
        estimate = float(fitted.theta[0, place])
        found[name] = Profile(name, unknowns.units[unknowns.labels.index(name)], estimate, values, rise, low.end, high.end, closed, kind, notes)
    return found


class _Side(NamedTuple):
    """The profile from the estimate to one side."""

    end: float  # of the interval; infinite, or the bound, where there is none
    points: list[tuple[float, float]]
    is_closed: bool
    note: str


def _side(fitted: TakenUp, place: int, error: float, inflation: float, way: float) -> _Side:
    """The profile to one side: `way` is 1 or -1."""
    theta, origin, note = fitted.theta, float(fitted.theta[0, place]), ""
    unknowns = fitted.problem.unknowns
    size, bound = float(unknowns.sizes(theta)[0, place]), float((unknowns.low if way < 0 else unknowns.high)[place])
    stride = 0.6  # of sqrt(rise), from point to point
    first = step = stride * error if np.isfinite(error) and error > 0 else 0.1 * size
    points: list[tuple[float, float]] = []

    def solved(theta: np.ndarray, at: float) -> tuple[float, np.ndarray]:
        """The rise so far from the estimate, and all others there; infinite where the motion fails."""
        nonlocal note
        found = fitted.problem.beside(theta, 0, place, origin + way * at)
        if np.isfinite(found.at.cost[0]) and not found.converged[0]:
            note = f"no minimum over the others was found near {origin + way * at:.4g}, so that the interval may be too narrow"
        rise = 2 * float(found.at.cost[0] - fitted.at.cost[0]) / inflation
        if np.isfinite(rise):
            points.append((origin + way * at, rise))
        return rise, found.theta

    def crossing(theta: np.ndarray, inner: tuple[float, float], outer: tuple[float, float]) -> float:
        """Where the rise is that of the interval's end, between two points: by halves where it jumps, else by secants of its root, which is nearly straight.

        `theta`: all unknowns at the inner point, from which the others follow; beyond the outer one they may have gone elsewhere.
        """
        nonlocal note
        for _ in range(8):
            low, end, high = np.sqrt(np.maximum([inner[1], RISE_95, outer[1]], 0.0))
            middle = inner[0] + (outer[0] - inner[0]) * (0.5 if outer[1] > 3 * RISE_95 else float((end - low) / (high - low)))
            found, there = solved(theta, middle)
            if abs(found / RISE_95 - 1) < 0.01:
                return middle
            if found < RISE_95:
                inner, theta = (middle, found), there
            else:
                outer = middle, found
        note = f"the sum of squares jumps near {origin + way * outer[0]:.4g}: beyond it, other unknowns are elsewhere"
        return outer[0]

    far, rise, slope = 0.0, 0.0, np.zeros(1)
    room = min(abs(bound - origin), 1e3 * max(size, first))
    for _ in range(16):
        if far >= room:
            break
        at = min(far + step, room)
        # others go on as they went from the point before to this one
        found, there = solved(theta + slope * (at - far), at)
        if not np.isfinite(found):
            step = (at - far) / 4
            if step < 1e-3 * first:
                break
            note = f"the motion fails near {origin + way * at:.4g}"
            continue
        if found < -0.02 * RISE_95:
            note = f"a lower minimum than that of the fit lies near {origin + way * at:.6g}: fit again from there"
        if found >= RISE_95:
            note = "" if "fails" in note else note
            return _Side(origin + way * crossing(theta, (far, rise), (at, found)), points, True, note)
        speed = (np.sqrt(max(found, 0.0)) - np.sqrt(max(rise, 0.0))) / (at - far)
        step = (at - far) * float(np.clip(stride / max(speed * (at - far), 1e-9), 0.5, 4.0))
        slope, theta, far, rise = (there - theta) / (at - far), there, at, found
    return _Side(bound if np.isfinite(bound) else way * np.inf, points, False, note)
