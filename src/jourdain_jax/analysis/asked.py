"""A fit that is resumed: at its minimum, along a profile, and for other runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.estimates import Asked, Estimates
from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.information import Information, information
from jourdain_jax.analysis.levenberg_marquardt import Limits, Linearised
from jourdain_jax.analysis.likelihood import as_runs
from jourdain_jax.analysis.piecewise import Piecewise, problem_of
from jourdain_jax.analysis.problem import Problem
from jourdain_jax.analysis.unknowns import unknowns_of

_SAME = 0.01  # sigmas: between residuals of one fit, computed twice


@dataclass
class TakenUp:
    """A fit taken up again, for the runs it was fitted to or for others."""

    asked: Asked
    problem: Problem
    theta: Float[np.ndarray, "1 places"]
    limits: Limits
    pieces: Piecewise | None

    @cached_property
    def at(self) -> Linearised:
        """What is minimised, at theta."""
        return self.evaluate(self.theta, np.array([0]))

    def evaluate(self, theta: np.ndarray, members: np.ndarray) -> Linearised:
        """What is minimised, at any numbers."""
        return self.problem.linearised(theta, members)

    def residuals(self, run: int) -> dict[str, np.ndarray]:
        """Residuals of a run by channel, in units of sigma, at theta; NaN where a sample is missing."""
        return self.problem.by_channel(run, self.at, lambda x: x[0])

    def information(self) -> Information:
        """What the data tell at theta, from the sigmas alone: no factor for the loss, for sigmas that are estimated, or from how runs differ."""
        unknowns, theta = self.problem.unknowns, self.theta
        bound = ((theta <= self.limits.low) | (theta >= self.limits.high)) & ~self.limits.fixed
        size, fails = unknowns.sizes(theta), ~np.isfinite(self.at.cost)
        return information(self.at.arrow, size, unknowns.estimated, bound, fails, self.asked.control.cutoff).only()


def taken_up(fit: Estimates, data: Experiment | Sequence[Experiment]) -> TakenUp:
    """A `Fit` of one experiment where it ended, with residuals and derivatives computed anew. ValueError where `data` are not what it was fitted to."""
    again = for_runs(fit, data, fitted=True)
    unknowns = again.problem.unknowns
    if unknowns.labels != fit.labels:
        raise ValueError(f"`data` have the unknowns {', '.join(unknowns.labels)}, expected those of the fit: {', '.join(fit.labels)}")
    again.theta[0, unknowns.estimated] = fit.values
    if again.pieces is not None and fit.shooting is not None:
        again.pieces.put_nodes(again.theta, fit.shooting)
    sigma = dict(zip(again.problem.estimated, again.at.sigma[0].tolist(), strict=True))  # as F has it; that of a fit allows for its unknowns

    def here(run: int, name: str) -> np.ndarray:
        return np.nan_to_num(again.residuals(run).get(name, np.nan)) * (sigma.get(name, 1.0) / fit.sigma.get(name, 1.0))

    pairs = [(np.nan_to_num(r), here(run, name)) for run, of in enumerate(fit.residuals) for name, r in of.items()]
    if not all(a.shape == b.shape and np.max(np.abs(a - b), initial=0.0) < _SAME for a, b in pairs):
        raise ValueError("`data` are not those of the fit: its residuals are others there; give the runs that it was fitted to")
    return again


def for_runs(fit: Estimates, runs: Experiment | Sequence[Experiment], fitted: bool = False) -> TakenUp:
    """The problem of a `Fit` for these runs, at the first guesses; ValueError where they do not fit the scene.

    `fitted`: they are those of the fit, in pieces where it was found so.
    """
    asked = fit.asked
    checked = as_runs(asked.scene, runs)
    unknowns = unknowns_of(asked.scene, checked, asked.free)
    problem, pieces = problem_of(asked.scene, checked, unknowns, asked.options, None, asked.loss, asked.shooting if fitted else None)
    if problem.with_memory:
        problem.tau = np.array([[float(fit.correlation_time[name]) for name in problem.with_memory]])
    return TakenUp(asked, problem, unknowns.guess[None].copy(), Limits(*unknowns.ends, unknowns.fixed.copy(), unknowns.sizes), pieces)
