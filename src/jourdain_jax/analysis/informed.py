"""Which samples inform which unknown: of each, the share of what the data tell of it.

    estimate_i = ... + sum_k a_ik r_k,     a_i = (C J')_i       C = (J'J)^-1: covariance of all unknowns; J: derivatives of residuals r, whitened and weighted
    share_ik = a_ik^2 / C_ii = - d log C_ii / d log w_k          w_k: weight of sample k, one over the square of its sigma

It allows for all other unknowns being estimated, too. The shares of all samples add up to one; a prior takes what is missing.
Source: R. D. Cook and S. Weisberg, Residuals and Influence in Regression (1982), section 2.2.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.asked import TakenUp
from jourdain_jax.analysis.information import variances


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
    for b, j, plain in problem.evaluate(*unknowns.split(fitted.theta), np.array([0])):
        group = problem.lanes.group_of(int(j[0]))
        white = group.whitened(j, b, plain, {name: np.broadcast_to(tau, len(j)) for name, tau in taus.items()})
        for run, r, J in zip(j.tolist(), white[..., -1], white[..., :-1], strict=True):
            rows = np.sqrt(problem.loss.weight(r))[:, None] * J
            for k, name in enumerate(problem.estimated):
                if name in problem.runs[run].values:
                    rows[group.channels[name]] /= fitted.at.sigma[0, k]
            # those of a single run count as shared, and come last
            own, shared = (rows[:, :0], np.roll(rows, -m, axis=1)) if len(problem.runs) == 1 else (rows[:, :m], rows[:, m:])
            a_shared = known.shared @ (shared - own @ known.follow[run]).T  # own unknowns of a run follow the shared ones, x = - G s
            a_own = -np.einsum("kij,js->kis", known.follow, a_shared)
            a_own[run] += known.own[run] @ own.T
            share = np.concatenate([a_shared, a_own.reshape(-1, len(own))])[places] ** 2 / variance[:, None]
            found[run] = {name: np.nansum(x, axis=tuple(range(2, x.ndim))) for name, x in group.by_channel(run, share).items()}
    return Informed(labels, tuple(found), tuple(np.asarray(run.ts) for run in problem.runs))
