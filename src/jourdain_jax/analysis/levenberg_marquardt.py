"""Levenberg-Marquardt within bounds, for residuals that are expensive: one simulation with all its derivatives per step tried.

minimise F(theta), low <= theta <= high;      near theta   F + g' d + |J d|^2 / 2
step       (J'J + lambda D^2) d = - g          D: lengths of the columns of J;  unknowns that would pass a bound end there, and the others are solved for again
converged  the undamped step is at most `tolerance` standard errors long, |J d|, and moves no unknown by more than that fraction of its size

Several problems of one shape (`members`) go side by side; those that have ended cost nothing.
Source: D. W. Marquardt, SIAM J. Appl. Math. 11 (1963) 431; J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from jourdain_jax.analysis.arrow import Arrow

FIRST, LEAST, MOST = 1e-3, 1e-9, 1e9  # damping lambda: at first, at least, and where no step is found
FASTEST = 10.0  # factor by which damping falls after a good step
RELEASES = 8  # times that unknowns which would pass a bound are put there and the others solved for again


@dataclass
class Linearised:
    """Value and slopes at some theta, of each member."""

    cost: Float[np.ndarray, "members"]  # F; not finite where the motion fails
    arrow: Arrow  # J and residuals with J'r = dF/dtheta
    residual: np.ndarray  # (members, runs) of vectors
    sigma: Float[np.ndarray, "members channels"]  # of channels whose noise is estimated

    def at(self, members) -> "Linearised":
        """That of some members."""
        return Linearised(self.cost[members], self.arrow.at(members), self.residual[members], self.sigma[members])

    def replaced(self, members: Int[np.ndarray, "some"], new: "Linearised", chosen: Bool[np.ndarray, "some"]) -> "Linearised":
        """With what is `new` of these members where it is `chosen`."""
        if len(members) == len(self.cost) and chosen.all():
            return new
        found = self.at(np.arange(len(self.cost)))  # a copy
        for kept, one in zip(found._arrays, new._arrays, strict=True):
            kept[members[chosen]] = one[chosen]
        return found

    @property
    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.cost, self.residual, self.sigma, *self.arrow.arrays


@dataclass(frozen=True)
class Limits:
    """What steps may do; all of shape (unknowns,)."""

    low: Float[np.ndarray, "unknowns"]
    high: Float[np.ndarray, "unknowns"]
    fixed: Bool[np.ndarray, "unknowns"]
    size: Callable  # theta -> magnitude of each unknown


@dataclass(frozen=True)
class Control:
    """When to stop."""

    tolerance: float
    most_steps: int
    cutoff: float


@dataclass
class Minimum:
    """Where the minimisation of each member ended."""

    theta: Float[np.ndarray, "members unknowns"]
    at: Linearised
    converged: Bool[np.ndarray, "members"]
    stuck: Bool[np.ndarray, "members"]  # no step lowers F, however short, and this is no minimum
    steps: Int[np.ndarray, "members"]  # tried
    grown: Bool[np.ndarray, "members"]  # whether it was found over growing spans
    trace: np.ndarray  # (members,) of tuples of (what was minimised, F at first and after each step tried)

    def lowest(self) -> "Minimum":
        """That of the member with the lowest value."""
        best = [int(np.argmin(self.at.cost))]
        return Minimum(self.theta[best], self.at.at(best), self.converged[best], self.stuck[best], self.steps[best], self.grown[best], self.trace[best])

    def agreeing(self, apart: float) -> int:
        """How many members converged to a value at most so far `apart` from the lowest one."""
        return int(np.sum(self.converged & (self.at.cost <= np.min(self.at.cost) + apart)))

    def lowered(self, members: Int[np.ndarray, "some"], other: "Minimum") -> "Minimum":
        """With the minima of these members that were found in another way, where they are lower; and the steps of that one."""
        lower = other.at.cost < self.at.cost[members]
        here = members[lower]
        self.at = self.at.replaced(members, other.at, lower)
        names = ("theta", "converged", "stuck", "grown", "trace")
        for kept, new in ((getattr(self, name), getattr(other, name)) for name in names):
            kept[here] = new[lower]
        self.steps[members] = other.steps
        return self

    def replaced(self, members: Int[np.ndarray, "some"], new: "Minimum") -> "Minimum":
        """With what was found for these members once more; steps add up."""
        self.at = self.at.replaced(members, new.at, np.ones(len(members), bool))
        for kept, one in ((self.theta, new.theta), (self.converged, new.converged), (self.stuck, new.stuck)):
            kept[members] = one
        self.steps[members] += new.steps
        self.trace[members] += new.trace
        return self


def minimise(
    evaluate: Callable[[np.ndarray, np.ndarray], Linearised], theta: Float[np.ndarray, "members unknowns"], limits: Limits, control: Control, what: str = ""
) -> Minimum:
    """Minimise from `theta`. `evaluate(theta, members)`: value and slopes of the members with these numbers; `what`: says in the trace what is minimised."""
    theta, members = theta.copy(), np.arange(len(theta))
    at = evaluate(theta, members)
    damping, growth, fall = (np.full(len(theta), x) for x in (FIRST, 4.0, FASTEST))
    converged, stuck, steps = np.zeros(len(theta), bool), np.zeros(len(theta), bool), np.zeros(len(theta), int)
    going, costs = np.isfinite(at.cost), [[cost] for cost in at.cost.tolist()]
    for _ in range(control.most_steps):
        here = members[going]
        if not here.size:
            break
        arrow, x = at.arrow if len(here) == len(theta) else at.arrow.at(here), theta[here]
        size = limits.size(x)
        d = _step(arrow, x, size, damping[here], limits, control.cutoff)
        done = _is_small(arrow, size, d, control)
        if (done & (damping[here] > LEAST)).any():
            done &= _is_small(arrow, size, _step(arrow, x, size, np.full(len(here), LEAST), limits, control.cutoff), control)
        if done.any():
            converged[here[done]], going[here[done]] = True, False
            here, d, x, arrow = here[~done], d[~done], x[~done], arrow.at(~done)
            if not here.size:
                break
        steps[here] += 1
        promised = -np.sum(arrow.gradient * d, axis=1) - 0.5 * arrow.change(d)
        trial = evaluate(x + d, here)
        with np.errstate(invalid="ignore", over="ignore"):
            found = at.cost[here] - trial.cost
            # near the minimum the simulation's own error decides whether F falls
            level = (promised < 100 * control.tolerance**2) & (np.abs(found) < control.tolerance)
            better = np.isfinite(trial.cost) & ((found > 1e-4 * promised) | level)
            ratio = np.where(np.isfinite(found), found / np.maximum(promised, np.finfo(float).tiny), -1.0)
        theta[here[better]] = (x + d)[better]
        at = at.replaced(here, trial, better)
        for b in here.tolist():
            costs[b].append(float(at.cost[b]))
        # after a step that failed, damping falls slowly: in a curved valley every other step would fail. It rises where steps overshoot: where residuals
        # stay large, undamped ones go to and fro along what shows least
        change = np.where(ratio > 0.9, 1 / fall[here], np.where(ratio < 0.6, 3.0, 1.0))
        damping[here] *= np.where(better, change, growth[here])
        damping[here] = np.where(better & level, LEAST, np.maximum(damping[here], LEAST))
        growth[here] = np.where(better, 4.0, growth[here] * 2)
        fall[here] = np.where(better, np.minimum(1.5 * fall[here], FASTEST), 2.0)
        lost = damping[here] > MOST
        stuck[here[lost]], going[here[lost]] = True, False
    trace = np.empty(len(theta), object)
    trace[:] = [((what, tuple(of_one)),) for of_one in costs]
    return Minimum(theta, at, converged, stuck, steps, np.zeros(len(theta), bool), trace)


def _step(arrow: Arrow, theta, size, damping, limits: Limits, cutoff: float) -> np.ndarray:
    """The damped step within the bounds."""
    norms, g = arrow.column_norms, arrow.gradient
    D = np.maximum(norms, 1e-8 * (norms * size).max(axis=1, keepdims=True) / size)
    D = np.where(D > 0, D, 1.0)
    held = limits.fixed | ((theta <= limits.low) & (g >= 0)) | ((theta >= limits.high) & (g <= 0))
    moved = np.zeros_like(theta)
    for _ in range(RELEASES):
        d = arrow.step(damping, D, held, moved, cutoff)
        low, high = theta + d < limits.low, theta + d > limits.high
        if not (low.any() or high.any()):
            return d
        within = np.clip(theta + d, limits.low, limits.high) - theta
        over = ~held & (within != d) & (low | high)
        if not over.any():
            return d
        held, moved = held | over, np.where(over, within, moved)
    return np.clip(theta + d, limits.low, limits.high) - theta


def _is_small(arrow: Arrow, size, d, control: Control) -> Bool[np.ndarray, "members"]:
    return (arrow.change(d) <= control.tolerance**2) & (np.abs(d) <= control.tolerance * size).all(axis=1)
