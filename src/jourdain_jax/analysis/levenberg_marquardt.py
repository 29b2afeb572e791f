"""Levenberg-Marquardt within bounds, for residuals that are expensive: one simulation with all its derivatives per step tried.

minimise F(theta), low <= theta <= high;      near theta   F + g' d + |J d|^2 / 2
step       (J'J + lambda D^2) d = - g          D: lengths of the columns of J;  unknowns that would pass a bound end there, and the others are solved for again
patience   where F is large, and has not become far smaller within so many steps, no more are tried: the member has neither converged nor is it stuck
converged  the undamped step is at most `tolerance` standard errors long, |J d|, and moves no unknown by more than that fraction of its size

Bounds end steps, since a bijection onto their inside never reaches them: of ten fits whose damping is zero, seven by its logarithm had not converged in 256
steps, and all ten do in 4 here. The method of optimistix is not used for three reasons. Its Jacobian is dense: each of many runs would be differentiated with
respect to the starts of all others. It has no bounds. It evaluates residuals and derivatives one after the other.

Several problems of one shape (`members`) go side by side; those that have ended cost nothing.
Source: D. W. Marquardt, SIAM J. Appl. Math. 11 (1963) 431; J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105; near the minimum slopes in place of
values: W. W. Hager and H. Zhang, SIAM J. Optim. 16 (2005) 170.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jourdain_jax.analysis.arrow import Arrow

FIRST, LEAST, MOST = 1e-3, 1e-9, 1e9  # damping lambda: at first, at least, and where no step is found
GROWTH = 4.0  # factor by which damping grows after a step that failed, at first; twice as much after each further one
FASTEST = 10.0  # factor by which it falls after a good step
ENOUGH, WELL, OVER = 1e-4, 0.9, 0.6  # of what was promised: F falls by that much in a step that is taken, in a good one, and in one that overshoots
ERROR = 1e-6  # relative, of F: smaller changes may be errors of the simulation
SLOW = 0.25  # of F: what it is to fall to within the steps of `patience`
LEAST_COLUMN = 1e-8  # of the longest column of J, both times the sizes of their unknowns: what counts as zero
SHRINKS = 0.1  # by what factor an unknown whose bound is above zero may shrink in one step: with far smaller masses and lengths, motions take long
ROUGHLY = 1e-2  # standard errors: tolerance where the value of F matters, not the place
RELEASES = 8  # times that unknowns which would pass a bound are put there and the others solved for again


@dataclass
class Linearised:
    """Value and slopes at some theta, of each member."""

    cost: Float[np.ndarray, "members"]  # F; not finite where the motion fails
    arrow: Arrow  # J and residuals with J'r = dF/dtheta
    residuals: np.ndarray  # (members, runs) of those of all samples, not whitened; None where another run had failed
    sigma: Float[np.ndarray, "members channels"]  # of channels whose noise is estimated
    triangles: Float[np.ndarray, "members runs kinds width width"]  # of [J r]: of channels whose sigma is known, then of each other
    squares: Float[np.ndarray, "members kinds"]  # sums of squared residuals of these

    def at(self, members) -> "Linearised":
        """That of some members."""
        return Linearised(self.cost[members], self.arrow.at(members), *(x[members] for x in self._arrays[1:5]))

    def replaced(self, members: Int[np.ndarray, "some"], new: "Linearised", chosen: Bool[np.ndarray, "some"]) -> "Linearised":
        """All members, with what is `new` of these where it is `chosen`."""
        if len(members) == len(self.cost) and chosen.all():
            return new
        found = self.at(np.arange(len(self.cost)))  # a copy
        for kept, one in zip(found._arrays, new._arrays, strict=True):
            kept[members[chosen]] = one[chosen]
        return found

    @property
    def _arrays(self) -> tuple[np.ndarray, ...]:
        return self.cost, self.residuals, self.sigma, self.triangles, self.squares, *self.arrow.arrays


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
    patience: int | None = None  # steps within which F is to fall to `SLOW` of what it was; None: any number
    near: float = 0.0  # F below which it may fall as slowly as it does


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
        if len(self.theta) == 1:
            return self
        best = [int(np.argmin(self.at.cost))]
        return Minimum(self.theta[best], self.at.at(best), self.converged[best], self.stuck[best], self.steps[best], self.grown[best], self.trace[best])

    def agreeing(self, apart: float) -> int:
        """How many members converged to a value at most so far `apart` from the lowest one."""
        return int(np.sum(self.converged & (self.at.cost <= np.min(self.at.cost) + apart)))

    def lowered(self, members: Int[np.ndarray, "some"], other: "Minimum") -> "Minimum":
        """All members, with those minima of these that were found in another way, where they are lower; and the steps of that one."""
        lower = other.at.cost < self.at.cost[members]
        here = members[lower]
        self.at = self.at.replaced(members, other.at, lower)
        names = ("theta", "converged", "stuck", "grown", "trace")
        for kept, new in ((getattr(self, name), getattr(other, name)) for name in names):
            kept[here] = new[lower]
        self.steps[members] = other.steps
        return self

    def replaced(self, members: Int[np.ndarray, "some"], new: "Minimum") -> "Minimum":
        """All members, with what was found for these once more; steps add up."""
        self.at = self.at.replaced(members, new.at, np.ones(len(members), bool))
        for kept, one in ((self.theta, new.theta), (self.converged, new.converged), (self.stuck, new.stuck)):
            kept[members] = one
        self.steps[members] += new.steps
        self.trace[members] += new.trace
        return self


def minimise(
    evaluate: Callable[[np.ndarray, np.ndarray], Linearised],
    theta: Float[np.ndarray, "members unknowns"],
    limits: Limits,
    control: Control,
    what: str = "",
) -> Minimum:
    """Minimise from `theta`. `evaluate(theta, members)`: value and slopes of the members with these numbers; `what`: says in the trace what is minimised."""
    state = State.at_begin(theta, evaluate(theta, np.arange(len(theta))))
    for _ in range(control.most_steps):
        if not state.going.any():
            break
        here, step = state.next_step(limits, control)
        if here.size:
            state.take(here, step, evaluate(step.end, here), control)
    trace = np.empty(len(theta), object)
    trace[:] = [((what, tuple(costs)),) for costs in state.costs]
    return Minimum(state.theta, state.at, state.converged, state.damping > MOST, state.steps, np.zeros(len(theta), bool), trace)


def minimum_beside(evaluate: Callable, theta: Float[np.ndarray, "1 unknowns"], place: int, value: float, limits: Limits, control: Control) -> Minimum:
    """The minimum over all unknowns but one, which is held at this value; to one per cent of a standard error."""
    begin, fixed = np.clip(theta, limits.low, limits.high), limits.fixed.copy()
    begin[0, place], fixed[place] = value, True
    return minimise(evaluate, begin, replace(limits, fixed=fixed), replace(control, tolerance=max(control.tolerance, ROUGHLY)))


@dataclass
class Step:
    """The next step of some members."""

    end: Float[np.ndarray, "some unknowns"]
    d: Float[np.ndarray, "some unknowns"]
    change: Float[np.ndarray, "some"]  # |J d|^2
    fall: Float[np.ndarray, "some"]  # of F along the step, by its slope at the begin


@dataclass
class State:
    """Where members are on their way to a minimum, with their damping."""

    theta: Float[np.ndarray, "members unknowns"]
    at: Linearised
    damping: Float[np.ndarray, "members"]
    growth: Float[np.ndarray, "members"]  # by what damping grows if the next step fails, and by what it falls if that is good
    fall: Float[np.ndarray, "members"]
    going: Bool[np.ndarray, "members"]
    converged: Bool[np.ndarray, "members"]
    steps: Int[np.ndarray, "members"]
    costs: list[list[float]]  # F at first and after each step tried

    @staticmethod
    def at_begin(theta: Float[np.ndarray, "members unknowns"], at: Linearised) -> "State":
        """Return the state before the first step; members whose motion fails do not go."""
        full, none = np.ones(len(theta)), np.zeros(len(theta), bool)
        costs = [[cost] for cost in at.cost.tolist()]
        return State(theta.copy(), at, FIRST * full, GROWTH * full, FASTEST * full, np.isfinite(at.cost), none, none.astype(int), costs)

    def next_step(self, limits: Limits, control: Control) -> tuple[Int[np.ndarray, "some"], Step]:
        """Return members and their steps; those have converged whose step is small, also without damping."""
        here = np.flatnonzero(self.going)
        whole = here.size == self.going.size
        arrow, x, damping = (self.at.arrow, self.theta, self.damping) if whole else (self.at.arrow.at(here), self.theta[here], self.damping[here])
        size = limits.size(x)
        scaling = column_scaling(arrow, size)
        d = damped_step(arrow, x, scaling, damping, limits, control.cutoff)
        change = arrow.change(d)
        done = is_small(change, size, d, control)
        if (done & (damping > LEAST)).any():
            undamped = damped_step(arrow, x, scaling, np.full(here.size, LEAST), limits, control.cutoff)
            done &= is_small(arrow.change(undamped), size, undamped, control)
        fall = -np.einsum("bi,bi->b", arrow.gradient, d)
        if done.any():
            self.converged[here[done]], self.going[here[done]] = True, False
            here, x, d, change, fall = here[~done], x[~done], d[~done], change[~done], fall[~done]
        self.steps[here] += 1
        return here, Step(x + d, d, change, fall)

    def take(self, here: Int[np.ndarray, "some"], step: Step, trial: Linearised, control: Control) -> None:
        """Go to the end of the step if F falls there (infinite: the motion failed), and change damping; end where no step is found, or patience.

        Near the minimum the simulation's own error decides whether F falls: it jumps where a motion takes one step more. There the slopes of F at both
        ends of the step tell it to more digits.
        """
        before, promised = self.at.cost[here], step.fall - 0.5 * step.change
        found = before - trial.cost
        by_slopes = 0.5 * (step.fall - np.einsum("bi,bi->b", trial.arrow.gradient, step.d))
        unsure = (np.abs(found) < ERROR * np.abs(before)) | ((promised < 100 * control.tolerance**2) & (np.abs(found) < control.tolerance))
        found = np.where(unsure, by_slopes, found)
        better = np.isfinite(found) & (found > ENOUGH * promised)
        # damping rises where steps overshoot: where residuals stay large, undamped ones go to and fro along what shows least
        change = np.where(found > WELL * promised, 1 / self.fall[here], np.where(found < OVER * promised, 3.0, 1.0))
        self.damping[here] = np.maximum(self.damping[here] * np.where(better, change, self.growth[here]), LEAST)
        # after a step that failed it falls slowly: in a curved valley every other step would fail
        self.fall[here] = np.where(better, np.minimum(1.5 * self.fall[here], FASTEST), 2.0)
        self.growth[here] = np.where(better, GROWTH, 2 * self.growth[here])
        self.theta[here[better]] = step.end[better]
        self.at = self.at.replaced(here, trial, better)
        self.going &= self.damping <= MOST
        for b in here.tolist():
            costs = self.costs[b]
            costs.append(float(self.at.cost[b]))
            if control.patience is not None and len(costs) > control.patience and costs[-1] > max(control.near, SLOW * costs[-1 - control.patience]):
                self.going[b] = False


def column_scaling(arrow: Arrow, size: Float[np.ndarray, "members unknowns"]) -> Float[np.ndarray, "members unknowns"]:
    """D: lengths of the columns of J, and something positive for those that are zero."""
    norms = arrow.column_norms
    by_size = norms * size
    least = LEAST_COLUMN * by_size.max(axis=1, keepdims=True)
    if (by_size > least).all():
        return norms
    D = np.maximum(norms, least / size)
    return np.where(D > 0, D, 1.0)


def damped_step(arrow: Arrow, theta, D, damping, limits: Limits, cutoff: float) -> np.ndarray:
    """The damped step within the bounds."""
    g, low = arrow.gradient, np.where(limits.low > 0, np.maximum(limits.low, SHRINKS * theta), limits.low)
    held = limits.fixed | ((theta <= limits.low) & (g >= 0)) | ((theta >= limits.high) & (g <= 0))
    moved = np.zeros(theta.shape)
    for _ in range(RELEASES):
        d = arrow.step(damping, D, held, moved, cutoff)
        ended = theta + d
        within = np.minimum(np.maximum(ended, low), limits.high)
        over = (within != ended) & ~held
        if not over.any():
            return d
        held, moved = held | over, np.where(over, within - theta, moved)
    return np.clip(theta + d, low, limits.high) - theta


def is_small(change, size, d, control: Control) -> Bool[np.ndarray, "members"]:
    """Which steps end a minimisation."""
    small = change <= control.tolerance**2
    return small & (np.abs(d) <= control.tolerance * size).all(axis=1) if small.any() else small
