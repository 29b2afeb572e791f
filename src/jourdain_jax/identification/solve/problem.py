"""The objective of a fit: whitened and weighted residuals of all runs, with derivatives.

    F = sum rho(w) + sum n log sigma + |M (theta - mean) / s|^2 / 2

w: whitened residuals (see `correlated_noise`); sigma^2: mean w^2 of the n samples of each channel of unknown
sigma; mean, s: of priors; M: see `joint_normal`; rho: see `Loss`.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.identification.data.experiment import Experiment
from jourdain_jax.identification.inference.correlated_noise import (
    SHORTEST,
    correlation_limits,
    half_log_determinant,
    lowest,
)
from jourdain_jax.identification.solve.arrow import Arrow, ByMember, PerMember, arrow, triangle, with_prior
from jourdain_jax.identification.solve.levenberg_marquardt import Control, Linearised, Loss, Minimum, minimise
from jourdain_jax.identification.solve.run_groups import Group, Some, grouped
from jourdain_jax.identification.solve.shooting import MultipleShooting
from jourdain_jax.identification.solve.unknowns import Places, Unknowns
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Asked:
    """The arguments of a fit without its data, stored in the result so that the fit can be resumed."""

    scene: Scene  # with the first guesses
    free: Mapping | tuple[str, ...]
    options: AllOptions
    loss: Loss
    control: Control
    errors: str  # source of standard errors: "sigmas" or "runs"
    guesses: int  # number of first guesses to try
    shooting: MultipleShooting | None


@dataclass(frozen=True)
class Span(ByMember):
    """The first part of all runs, for a fit in which the first guess is a weak prior with its own size as
    standard deviation.
    """

    shares: PerMember  # of the duration of each run, from its start; later samples do not count
    begun: Places  # first guesses


class Problem:
    """The objective of a fit over its runs: residuals with derivatives, for any members and values of the
    unknowns. `repeats`: the number of repeats of the experiment, or None.
    """

    def __init__(
        self, asked: Asked, runs: tuple[Experiment, ...], unknowns: Unknowns, repeats: int | None = None
    ):
        self.asked = asked
        self.runs = runs
        self.unknowns = unknowns
        self.single = repeats is None
        self.count = repeats or 1
        self.scene, self.loss = asked.scene, asked.loss
        self.groups = [
            Group(asked.scene, runs, indices, unknowns.layout, asked.options, repeats)
            for indices in grouped(runs)
        ]
        # run -> its group of runs of equal structure
        self.group_of = {run: group for group in self.groups for run in group.runs.tolist()}
        # channels with estimated sigma
        self.estimated = tuple(sorted({name for run in runs for name in run.unknown_sigma}))
        largest = [
            max(float(np.nanmax(np.abs(run.values[name]))) for run in runs if name in run.values)
            for name in self.estimated
        ]
        # lower limit of the estimated sigmas, reached by an exact fit
        self.least_sigma = 1e-10 * np.array([x or 1.0 for x in largest])
        self.with_memory = tuple(
            sorted({name for run in runs for name in run.unknown_correlation})
        )  # channels whose correlation time is estimated
        # s, correlation times of these channels; initially as for white noise
        self.tau = np.zeros((self.count, len(self.with_memory)))
        self.failed = False  # whether any motion has failed

    def one(self, x: np.ndarray) -> np.ndarray:
        """Return `x` without its axis of members if the experiment has no repeats."""
        return np.asarray(x[0]) if self.single else x

    def taus(self, members: np.ndarray) -> np.ndarray:
        """Return the correlation times of some members, (members, channels with memory), s."""
        return self.tau[members % self.count]

    def counted(self, names: Sequence[str], members: np.ndarray) -> Float[np.ndarray, "members names"]:
        """Return the number of samples that are not missing in each of these channels, over all runs."""
        found = np.zeros((self.count, len(names)))
        for k, name in enumerate(names):
            for weights in (group.weights[name] for group in self.groups if name in group.weights):
                found[:, k] += np.count_nonzero(weights, axis=(0, *range(2, weights.ndim)))
        return found[members % self.count]

    def evaluated(self, theta: np.ndarray, members: np.ndarray) -> Iterator[Some]:
        """Yield Jacobian and residuals [J r] of all runs of some members, batch by batch."""
        for group in self.groups:
            yield from group.evaluate(*self.unknowns.split(theta), members)

    def linearised(self, theta: np.ndarray, members: np.ndarray, span: Span | None = None) -> Linearised:
        """Return the objective and its arrow matrix for some members, over all runs or a span of them."""
        return self.assembled(theta, members, self.evaluated(theta, members), self.taus(members), span)

    def minimum(
        self,
        theta: np.ndarray,
        members: np.ndarray,
        what: str = "",
        control: Control | None = None,
        span: Span | None = None,
    ) -> Minimum:
        """Return the minimum for some members, starting from theta. `control` replaces the fit's own."""
        evaluate = lambda x, here: self.linearised(x, members[here], span and span.of(here))
        return minimise(evaluate, theta, self.unknowns, control or self.asked.control, what)

    def beside(self, theta: Float[np.ndarray, "1 places"], member: int, place: int, value: float) -> Minimum:
        """Return the minimum over all unknowns but one, which is held at `value`. It is accurate to one per
        cent of a standard error.
        """
        unknowns, control, fixed = self.unknowns, self.asked.control, self.unknowns.fixed.copy()
        begin = np.clip(theta, unknowns.low, unknowns.high)
        begin[0, place], fixed[place] = value, True
        # tolerance in standard errors: only the value of F matters here, not the location of the minimum
        roughly = replace(control, tolerance=max(control.tolerance, 1e-2))
        evaluate = lambda x, _: self.linearised(x, np.array([member]))
        return minimise(evaluate, begin, replace(unknowns, fixed=fixed), roughly)

    def assembled(
        self,
        theta: np.ndarray,
        members: np.ndarray,
        evaluated: Iterable[Some],
        taus: np.ndarray,
        span: Span | None = None,
    ) -> Linearised:
        """Return the objective for evaluated residuals and these correlation times."""
        (p, m), runs = self.unknowns.layout.sizes, self.unknowns.runs
        count, kinds = len(theta), 1 + len(self.estimated)
        triangles = np.zeros((count, runs, kinds, m + p + 1, m + p + 1))
        costs, squares = np.zeros((count, runs)), np.zeros((count, kinds))
        kept, sigma = np.empty((count, runs), object), np.zeros((count, 0))
        with np.errstate(over="ignore", invalid="ignore"):
            for b, j, plain in evaluated:
                group = self.group_of[int(j[0])]
                whole = group.whitened(j, members[b], plain, taus[b])
                if span is not None:
                    whole = np.where(group.within(j, span.shares[b])[..., None], whole, 0.0)
                for k, rows in enumerate(self.kinds(int(j[0]), whole)):
                    r = rows[..., -1]
                    triangles[b, j, k] = triangle(closed(self.loss.weighted(rows, r), m + p))
                    if k:
                        np.add.at(squares[:, k], b, np.sum(r**2, axis=1))
                    else:
                        costs[b, j] = self.loss.value(r)
                for place, one in zip(zip(b.tolist(), j.tolist(), strict=True), plain, strict=True):
                    kept[place] = one[:, -1]
                # one failed run makes the objective infinite
                if count == 1 and runs > 1 and not math.isfinite(triangles[b, j].sum()):
                    triangles.fill(np.nan)
                    break
            cost = costs.sum(axis=1)
            if not math.isfinite(triangles.sum() + cost.sum()):
                failed = ~np.isfinite(triangles.sum(axis=(1, 2, 3, 4)) + cost)
                triangles[failed], cost[failed], self.failed = 0.0, np.inf, True
        if kinds > 1:
            samples = self.counted(self.estimated, members)
            sigma = np.sqrt(np.maximum(squares[:, 1:] / np.maximum(samples, 1), self.least_sigma**2))
            cost = cost + np.sum(samples * np.log(sigma), axis=1)
        whole, of_priors = self.joined(
            theta, triangles, np.concatenate([np.ones((count, 1)), sigma], axis=1), span
        )
        cost = cost + of_priors
        return Linearised(cost, whole, kept, sigma, triangles, squares)

    def joined(
        self, theta: np.ndarray, triangles: np.ndarray, sigma: np.ndarray, span: Span | None = None
    ) -> tuple[Arrow, np.ndarray | float]:
        """Return the arrow matrix of all runs and priors, and the contribution of the priors to F.
        `triangles` (members, runs, kinds, width, width) are divided by `sigma` (members, kinds).
        """
        (p, m), (count, runs, kinds, *_) = self.unknowns.layout.sizes, triangles.shape
        together = triangles[:, :, 0]
        if kinds > 1 or np.any(sigma != 1):
            together = np.linalg.qr(
                (triangles / sigma[:, None, :, None, None]).reshape(count, runs, -1, m + p + 1), mode="r"
            )
        whole = arrow(together, m)
        unknowns, mean, weight = self.unknowns, self.unknowns.prior_mean, self.unknowns.prior_weight
        if span is not None:
            none = (weight == 0) & ~unknowns.fixed
            mean = np.where(none, span.begun, mean)
            weight = np.where(none, 1 / unknowns.sizes(span.begun), weight)
        elif not weight.any():
            return whole, 0.0
        r, M = (theta - mean) * weight, unknowns.whitening
        return with_prior(whole, r, weight, M), 0.5 * (
            np.sum((r[:, :p] @ M.T) ** 2, axis=1) + np.sum(r[:, p:] ** 2, axis=1)
        )

    def is_followed(
        self, at: Linearised, shares: Float[np.ndarray, "shares"], most: float
    ) -> Bool[np.ndarray, "members shares"]:
        """Return whether the mean squared residual of the runs, up to each of these fractions of their spans,
        is at most `most` times that of noise.
        """
        good = np.isfinite(at.cost)
        squares, counted = np.zeros((2, good.sum(), len(shares)))
        for run in range(len(self.runs) if good.any() else 0):
            within = self.group_of[run].within(np.full(len(shares), run), shares)
            r, early = (self.kinds(run, x)[0] for x in (np.stack(list(at.residuals[good, run])), within))
            r = np.where(early, r[:, None], 0.0)
            squares, counted = squares + np.sum(r**2, axis=-1), counted + np.count_nonzero(r, axis=-1)
        found = np.zeros((good.size, len(shares)), bool)
        found[good] = squares <= most * counted
        return found

    def restrict(self, theta: np.ndarray, members: np.ndarray) -> np.ndarray:
        """Maximise the restricted likelihood over unknown correlation times. Return the largest change of
        rho, the correlation over one shortest interval.
        """
        evaluated = list(self.evaluated(theta, members))
        ends = np.array([correlation_limits(self.runs, name) for name in self.with_memory])
        taus, changed = np.maximum(self.taus(members), ends[:, 0]), np.zeros(len(members))
        for k, (low, high) in enumerate(ends):
            edges = (np.full(len(members), np.log(x)) for x in (low, high))
            of = lambda x, k=k: self._restricted(theta, members, evaluated, _with(taus, k, np.exp(x)))[0]
            found = np.exp(lowest(of, *edges))
            interval = low / SHORTEST
            changed = np.maximum(changed, np.abs(np.exp(-interval / found) - np.exp(-interval / taus[:, k])))
            taus[:, k] = found
        self.tau[members % self.count] = taus
        return changed

    def _restricted(
        self, theta, members: np.ndarray, evaluated: list, taus: np.ndarray
    ) -> tuple[np.ndarray, Linearised]:
        """Return the terms of the negative restricted log likelihood."""
        at, logs = self.assembled(theta, members, evaluated, taus), np.zeros(len(members))
        for b, j, _ in evaluated:
            np.add.at(logs, b, self.group_of[int(j[0])].log_widths(j, members[b], taus[b]))
        return at.cost + logs + half_log_determinant(at.arrow, self.unknowns.sizes(theta)), at

    def doubt(
        self, theta: np.ndarray, of: Callable[[Arrow], tuple[np.ndarray, np.ndarray]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the contribution of estimated correlation times to each squared standard error C (members,
        unknowns), relative to C; and the variance of log C. Both are zero if no correlation time is
        estimated.

        Moments are taken over the restricted likelihood of each correlation time, with a uniform prior of
        arcsin rho (Jeffreys' prior of AR(1) noise). The total variance is the mean of C plus the variance of
        the estimates. `of(arrow)` returns standard errors and changes of the estimates for an arrow matrix.
        """
        members, more, spread = np.arange(len(theta)), np.zeros((1, 1)), np.zeros((1, 1))
        if not self.with_memory:
            return more, spread
        evaluated, taus = list(self.evaluated(theta, members)), self.taus(members)
        for k, name in enumerate(self.with_memory):
            low, high = correlation_limits(self.runs, name)
            interval, counted = low / SHORTEST, self.counted([name], members)[:, 0]
            angle = lambda tau, h=interval: np.arcsin(np.exp(-h / tau))
            # nodes in standard deviations of arcsin rho: 1 / sqrt(samples) if there were no unknowns
            nodes = angle(taus[:, k])[:, None] + np.linspace(-3.2, 3.2, 9) / np.sqrt(counted)[:, None]
            inside = (nodes >= angle(low)) & (nodes <= angle(high))
            found = []
            for node in np.clip(nodes, angle(low), angle(high)).T:
                value, at = self._restricted(
                    theta, members, evaluated, _with(taus, k, -interval / np.log(np.sin(node)))
                )
                found.append((value, *of(at.arrow)))
            values, errors, moved = (np.stack(x, axis=1) for x in zip(*found, strict=True))
            weight = np.where(inside, np.exp(np.min(values, axis=1, keepdims=True) - values), 0.0)
            weight = (weight / weight.sum(axis=1, keepdims=True))[..., None]
            mean = lambda x, weight=weight: np.sum(weight * x, axis=1)
            middle = errors[:, 4] ** 2
            with np.errstate(divide="ignore", invalid="ignore"):
                logs = 2 * np.log(errors)
                more = more + mean(errors**2) / middle - 1 + (mean(moved**2) - mean(moved) ** 2) / middle
                spread = spread + mean(logs**2) - mean(logs) ** 2
        return np.nan_to_num(more), np.nan_to_num(spread)

    @property
    def samples(self) -> int:
        """Return the number of samples of channels with known sigma, in one repeat."""
        channels = [
            (run, name)
            for i, run in enumerate(self.runs)
            for name in run.values
            if name not in self.estimated
        ]
        return sum(math.prod(np.shape(run.values[name])[int(not self.single) :]) for run, name in channels)

    def by_channel(self, run: int, at: Linearised, white: bool = False) -> dict[str, np.ndarray]:
        """Return the residuals of a run by channel in units of sigma, (members, *samples). They are NaN for
        missing samples, and for members of which another run failed. `white`: whether to whiten them.
        """
        group = self.group_of[run]
        flat = [np.zeros(0) if r is None else r for r in at.residuals[:, run]]
        longest = max(map(len, flat))
        whole = np.stack([np.full(longest, np.nan) if len(r) < longest else r for r in flat])
        members = np.arange(len(whole))
        if white and longest:
            whole = group.whitened(np.full(len(whole), run), members, whole[..., None], self.taus(members))[
                ..., 0
            ]
        parts = group.by_channel(run, whole)
        for k, name in enumerate(self.estimated):
            if name in parts:
                parts[name] = parts[name] / at.sigma[:, k].reshape(-1, *[1] * (parts[name].ndim - 1))
        return parts

    def kinds(self, run: int, whole: np.ndarray) -> list[np.ndarray]:
        """Split Jacobian and residuals [J r] of a batch of one run: first for all channels with known sigma,
        then for each other channel.
        """
        if not self.estimated:
            return [whole]
        channels = self.group_of[run].channels
        known = [whole[:, where] for name, where in channels.items() if name not in self.estimated]
        return [
            np.concatenate([whole[:, :0], *known], axis=1),
            *(whole[:, channels.get(name, slice(0))] for name in self.estimated),
        ]


def closed(rows: np.ndarray, unknowns: int) -> np.ndarray:
    """Return [J r + g] from [J g r] of a run cut into pieces; g is the first-order change of r when gaps are
    closed.
    """
    if rows.shape[-1] == unknowns + 1:
        return rows
    return np.concatenate([rows[..., :unknowns], rows[..., unknowns:-1] + rows[..., -1:]], axis=-1)


def _with(taus: np.ndarray, k: int, values: np.ndarray) -> np.ndarray:
    """Return the correlation times with new values for channel `k`."""
    return np.where(np.arange(taus.shape[1]) == k, values[:, None], taus)
