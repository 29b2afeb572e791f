"""Correlated noise: an Ornstein-Uhlenbeck process in each channel. At equal intervals this is an AR(1)
process.

    E e(t) e(t') = sigma^2 exp(-|t - t'| / tau)
    rho_k = exp(-(t_k - t_j) / tau)
    w_k = (r_k - rho_k r_j) / sqrt(1 - rho_k^2),     w = r at the first sample

e: noise; r = e / sigma; j: the last sample before k that is not missing. The whitened residuals w are
independent, of variance one. This is exact at uneven times and across missing samples. An unknown correlation
time tau minimises, at the estimates of all other unknowns,

    sum w^2 / 2 + sum log sqrt(1 - rho_k^2) + log det(J_w' J_w) / 2

This is the restricted likelihood. Its last term accounts for the unknowns; without it, tau would be too
short. tau and the unknowns are estimated alternately. Intervals include the spread of estimates and variances
over all tau, weighted by that likelihood, uniformly in arcsin rho (see `Problem.doubt`). Source: H. D.
Patterson and R. Thompson, Biometrika 58 (1971) 545; R. H. Jones, Longitudinal Data with Serial Correlation
(1993), chapter 3.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jourdain_jax.calculus.reals import Entries
from jourdain_jax.identification.data.experiment import Experiment
from jourdain_jax.identification.solve.arrow import Arrow, PerMember, eliminated

SHORTEST = 0.1  # numerics: shortest tau, in shortest intervals: below it the noise is white


def chain(
    weight: Float[Entries, "times *rest"], ts: Float[Entries, "times"], xp=np
) -> tuple[Array | np.ndarray, Array | np.ndarray]:
    """Return two arrays for a channel: the index of the previous available sample, and the time (s) since it.

    Without a predecessor, and for missing samples, the index is the sample's own, and the time is infinite.
    `weight` is zero for a missing sample. Results have its shape.
    """
    index = xp.reshape(xp.arange(ts.shape[0]), (-1,) + (1,) * (weight.ndim - 1))
    last = xp.maximum.accumulate(xp.where(weight > 0, index, -1), axis=0)
    before = xp.concatenate([xp.full_like(last[:1], -1), last[:-1]])
    linked = (before >= 0) & (weight > 0)
    before = xp.where(linked, before, index)
    return before, xp.where(linked, xp.reshape(ts, index.shape) - ts[before], xp.inf)


def memory(gap, tau, xp=np):
    """Return `rho = exp(-gap / tau)`, smooth in tau; zero for an infinite gap or a zero tau."""
    counts = xp.isfinite(gap) & (tau > 0)
    return xp.where(counts, xp.exp(-xp.where(counts, gap, 1.0) / xp.where(counts, tau, 1.0)), 0.0)


def whitened(r, previous, rho):
    """Return `(r - rho r_before) / sqrt(1 - rho^2)`; `previous`: r at the sample before."""
    return (r - rho * previous) / (1 - rho**2) ** 0.5


@dataclass(frozen=True)
class Chains:
    """The index of the previous sample for each sample among the residuals, separately for each member of a
    group of equally structured runs.
    """

    before: Int[np.ndarray, "runs members samples"]
    gap: Float[np.ndarray, "runs members samples"]  # s
    known: Float[np.ndarray, "runs samples"]  # tau, s; zero for white noise or an unknown tau
    unknown: list[slice]  # samples of channels with unknown tau

    @staticmethod
    def of(
        weights: Mapping[str, np.ndarray],
        ts: np.ndarray,
        taus: Mapping[str, np.ndarray],
        channels: Mapping[str, slice],
        unknown: list[slice],
    ) -> "Chains":
        """Return the chains of samples of some channels. Shapes: weights (runs, members, times, *channel),
        times (runs, times), correlation times (runs,).
        """
        parts, known, (runs, times) = [], [], ts.shape
        for name, where in channels.items():
            count = (where.stop - where.start) // times
            apart = weights[name].reshape(runs, -1, times, count)
            place, gap = (
                np.stack(x)
                for x in zip(
                    *(chain(np.moveaxis(one, 1, 0), t) for one, t in zip(apart, ts, strict=True)), strict=True
                )
            )
            both = where.start + place * count + np.arange(count), gap
            parts.append([np.moveaxis(x, 1, 2).reshape(runs, -1, times * count) for x in both])
            known.append(
                np.repeat(np.asarray(taus.get(name, np.zeros(runs)))[:, None], times * count, axis=1)
            )
        before, gap = (np.concatenate(x, axis=-1) for x in zip(*parts, strict=True))
        return Chains(before, gap, np.concatenate(known, axis=-1), unknown)

    def at(self, places: np.ndarray, members: np.ndarray, taus: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return, for pairs of a run (`places`) and a member, the index of each sample's predecessor, and
        their correlation rho. `taus`: estimated correlation times, s, (pairs, channels).
        """
        tau = self.known[places].copy()
        for where, value in zip(self.unknown, taus.T, strict=True):
            tau[:, where] = value[:, None]
        return self.before[places, members], memory(self.gap[places, members], tau)


def half_log_determinant(arrow: Arrow, size: Float[np.ndarray, "members unknowns"]) -> PerMember:
    """Return `log det(J'J) / 2` for unknowns divided by `size`; undetermined directions add constants."""
    scaled, tiny = arrow.scaled(size), 1e-7  # of the length of a column
    runs, m, p = arrow.counts
    members = len(size)
    upper, rest = eliminated(scaled.local, np.full((members, runs, m), tiny))
    whole = np.concatenate(
        [scaled.shared[..., :p], rest[..., :p], np.broadcast_to(tiny * np.eye(p), (members, p, p))], axis=1
    )
    diagonals = (
        np.einsum("bkii->bki", upper[..., :m]).reshape(members, -1),
        np.einsum("bii->bi", np.linalg.qr(whole, mode="r")),
    )
    return sum((np.sum(np.log(np.abs(d)), axis=1) for d in diagonals), np.zeros(members))


def lowest(f: Callable[[np.ndarray], np.ndarray], a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the minimiser of f between a and b, for each member, by golden section. The interval shrinks to
    7e-5 of its length.
    """
    golden = (np.sqrt(5) - 1) / 2
    inner = [b - golden * (b - a), a + golden * (b - a)]
    values = [f(x) for x in inner]
    for _ in range(20):
        left = values[0] < values[1]
        a, b = np.where(left, a, inner[0]), np.where(left, inner[1], b)
        kept = [np.where(left, *pair) for pair in (inner, values)]
        new = np.where(left, b - golden * (b - a), a + golden * (b - a))
        inner, values = (
            [np.where(left, n, k), np.where(left, k, n)] for n, k in zip((new, f(new)), kept, strict=True)
        )
    return np.asarray((a + b) / 2)


def correlation_limits(runs: Sequence[Experiment], channel: str) -> tuple[float, float]:
    """Return the shortest and longest correlation time (s) of the search. Raises ValueError if no run has two
    samples.
    """
    ts = [np.asarray(run.ts) for run in runs if channel in run.values and len(run.ts) > 1]
    if not ts:
        raise ValueError(
            "a correlation time is None, but each run has only one sample, which cannot "
            "determine it; give a number in s, or 0 for white noise"
        )
    # a correlation time beyond ten spans is hardly distinguishable from a bias
    return SHORTEST * min(float(np.min(np.diff(t))) for t in ts), 10.0 * max(float(t[-1] - t[0]) for t in ts)


def log_densities(r, weight, ts, tau) -> Float[Array, "times *channel"]:
    """Return the logarithm of the density of each sample of `r` in units of sigma, given those before it,
    without the term `log(sigma sqrt(2 pi))`: `- w^2 / 2 - log sqrt(1 - rho^2)`, for JAX arrays.

    r, weight: (times, *channel); a weight of zero marks a missing sample.
    """
    before, gap = chain(weight, ts, jnp)
    rho = memory(gap, tau, jnp)
    w = whitened(r, jnp.take_along_axis(r, before, axis=0), rho)
    return -0.5 * jnp.where(weight > 0, w**2 + jnp.log1p(-(rho**2)), 0.0)
