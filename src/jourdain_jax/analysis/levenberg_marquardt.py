"""Levenberg-Marquardt within bounds, for residuals that are expensive: one simulation with all its derivatives per step tried.

minimise F(theta), low <= theta <= high;      near theta   F + g' d + |J d|^2 / 2
step       (J'J + lambda D^2) d = - g          D: lengths of the columns of J;  unknowns that would pass a bound end there, and the others are solved for again
patience   where F is large, and has not become far smaller within so many steps, no more are tried: the member has neither converged nor is it stuck
converged  the undamped step is at most `tolerance` standard errors long, |J d|, and moves no unknown by more than that fraction of its size;
           or a step is at whose end it will be a tenth of that, as far as it shrank from the last one to this one: the end is then known without evaluation

Bounds end steps, since a bijection onto their inside never reaches them: of ten fits whose damping is zero, seven by its logarithm had not converged in 256
steps, and all ten do in 4 here. The method of optimistix is not used for three reasons. Its Jacobian is dense: each of many runs would be differentiated with
respect to the starts of all others. It has no bounds. It evaluates residuals and derivatives one after the other, and takes 1.7 to 2.0 times as long for a
single run (`bench/identification.py --only optimistix`).

Several problems of one shape (`members`) go side by side; those that have ended cost nothing. How damping changes: see `pace`.
Source: D. W. Marquardt, SIAM J. Appl. Math. 11 (1963) 431; J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jourdain_jax.analysis.arrow import Arrow
from jourdain_jax.analysis.joined import JoinedArrow
from jourdain_jax.analysis.pace import LEAST, MOST, SLOW, SURELY, Pace

LEAST_COLUMN = 1e-8  # of the longest column of J, both times the sizes of their unknowns: what counts as zero
SHRINKS = 0.1  # by what factor an unknown whose bound is above zero may shrink in one step: with far smaller masses and lengths, motions take long
ROUGHLY = 1e-2  # standard errors: tolerance where the value of F matters, not the place
RELEASES = 8  # times that unknowns which would pass a bound are put there and the others solved for again


@dataclass
class Linearised:
    """Value and slopes at some theta, of each member."""

    cost: Float[np.ndarray, "members"]  # F; not finite where the motion fails
    arrow: Any  # J and residuals with J'r = dF/dtheta: an `Arrow`; a `JoinedArrow` where pieces of runs have gaps
    rows: np.ndarray  # (members, runs) of [J r] with the run's own unknowns first, (samples, width); None where another run had failed
    sigma: Float[np.ndarray, "members channels"]  # of channels whose noise is estimated

    def at(self, members) -> "Linearised":
        """That of some members."""
        return Linearised(self.cost[members], self.arrow.at(members), self.rows[members], self.sigma[members])

    def moved(self, d: Float[np.ndarray, "members unknowns"], promised: Float[np.ndarray, "members"]) -> "Linearised":
        """Close by, at theta + d, to first order; there F is lower by what is `promised`."""
        shared, own = self.arrow.split(d)
        rows = self.rows.copy()
        for b, k in np.ndindex(*rows.shape):
            rows[b, k] = rows[b, k].copy()
            rows[b, k][:, -1] += rows[b, k][:, :-1] @ np.concatenate([own[b, k], shared[b]])
        return Linearised(self.cost - promised, self.arrow.moved(d), rows, self.sigma)

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
        return self.cost, self.rows, self.sigma, *self.arrow.arrays


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
    way = _Way(evaluate, limits, control, theta)
    for _ in range(control.most_steps):
        if not way.going.size:
            break
        if (step := way.foretold(way.next_step())).members.size:
            way.take(step)
    return way.minimum(what)


def minimum_beside(evaluate: Callable, theta: Float[np.ndarray, "1 unknowns"], place: int, value: float, limits: Limits, control: Control) -> Minimum:
    """The minimum over all unknowns but one, which is held at this value; to one per cent of a standard error."""
    begin, fixed = np.clip(theta, limits.low, limits.high), limits.fixed.copy()
    begin[0, place], fixed[place] = value, True
    return minimise(evaluate, begin, replace(limits, fixed=fixed), replace(control, tolerance=max(control.tolerance, ROUGHLY)))


@dataclass
class _Step:
    """The next step of some members."""

    members: Int[np.ndarray, "some"]
    x: Float[np.ndarray, "some unknowns"]  # where it begins
    d: Float[np.ndarray, "some unknowns"]
    size: Float[np.ndarray, "some unknowns"]  # of the unknowns
    change: Float[np.ndarray, "some"]  # |J d|^2
    fall: Float[np.ndarray, "some"]  # of F along the step, by its slope at the begin

    @property
    def promised(self) -> Float[np.ndarray, "some"]:
        """How much F falls, to second order."""
        return self.fall - 0.5 * self.change

    def at(self, chosen: Bool[np.ndarray, "some"]) -> "_Step":
        """That of the members that are chosen."""
        return self if chosen.all() else _Step(*(part[chosen] for part in vars(self).values()))


class _Way:
    """Members on their way to a minimum: where each is, and which still go on."""

    def __init__(self, evaluate: Callable, limits: Limits, control: Control, theta: np.ndarray):
        self._evaluate, self._limits, self._control, self._count = evaluate, limits, control, len(theta)
        self.going, self._converged, self._stuck = np.arange(self._count), np.zeros(self._count, bool), np.zeros(self._count, bool)
        self._paces = [Pace() for _ in range(self._count)]
        self._theta, self._at = theta.copy(), evaluate(theta, self.going)
        self._costs = [[cost] for cost in self._at.cost.tolist()]
        self._steps, self.going = np.zeros(self._count, int), self.going[np.isfinite(self._at.cost)]

    def next_step(self) -> _Step:
        """That of the members that go on; those have converged whose step is small, also without damping."""
        here, limits, control = self.going, self._limits, self._control
        arrow, x = (self._at.arrow, self._theta) if here.size == self._count else (self._at.arrow.at(here), self._theta[here])
        size, damping = limits.size(x), np.array([self._paces[b].damping for b in here.tolist()])
        scaling = column_scaling(arrow, size)
        d = damped_step(arrow, x, scaling, damping, limits, control.cutoff)
        change = arrow.change(d)
        done = _is_small(change, size, d, control)
        if (done & (damping > LEAST)).any():
            undamped = damped_step(arrow, x, scaling, np.full(here.size, LEAST), limits, control.cutoff)
            done &= _is_small(arrow.change(undamped), size, undamped, control)
        self._end(here[done])
        return _Step(here, x, d, size, change, -np.einsum("bi,bi->b", arrow.gradient, d)).at(~done)

    def foretold(self, step: _Step) -> _Step:
        """The step but for members that need no look at its end, since the one after it will be small, as far as steps have shrunk: they are put there."""
        here = step.members.tolist()
        self._steps[step.members] += 1
        shrank = np.array([self._paces[b].shrinkage(one) for b, one in zip(here, np.sqrt(step.change).tolist(), strict=True)])
        if not (last := shrank < 1).any():
            return step
        surely = replace(self._control, tolerance=SURELY * self._control.tolerance)
        last &= _is_small(step.change * np.square(shrank), step.size, step.d * shrank[:, None], surely)
        if not last.any():
            return step
        end = step.at(last)
        whole = end.members.size == self._count
        moved = (self._at if whole else self._at.at(end.members)).moved(end.d, end.promised)
        self._put(end, moved, np.ones(end.members.size, bool))
        self._end(end.members)
        return step.at(~last)

    def take(self, step: _Step) -> None:
        """Evaluates at its end; members stay where they are if F does not fall."""
        trial = self._evaluate(step.x + step.d, step.members)
        slopes, better = 0.5 * (step.fall - np.einsum("bi,bi->b", trial.arrow.gradient, step.d)), []
        numbers = (np.sqrt(step.change), trial.cost, step.promised, slopes)
        for b, length, cost, promised, slope in zip(step.members.tolist(), *(x.tolist() for x in numbers), strict=True):
            is_better, self._paces[b] = self._paces[b].after_trial(length, self._costs[b][-1], cost, promised, slope, self._control.tolerance)
            better.append(is_better)
        self._put(step, trial, np.array(better))
        self._give_up()

    def minimum(self, what: str) -> Minimum:
        """Where all members ended."""
        trace = np.empty(self._count, object)
        trace[:] = [((what, tuple(of_one)),) for of_one in self._costs]
        return Minimum(self._theta, self._at, self._converged, self._stuck, self._steps, np.zeros(self._count, bool), trace)

    def _put(self, step: _Step, there: Linearised, chosen: Bool[np.ndarray, "some"]) -> None:
        """Puts the chosen members at the end of the step, where all is as `there`."""
        self._theta[step.members[chosen]] = (step.x + step.d)[chosen]
        self._at = self._at.replaced(step.members, there, chosen)
        for b in step.members.tolist():
            self._costs[b].append(float(self._at.cost[b]))

    def _end(self, members: Int[np.ndarray, "some"]) -> None:
        if members.size:
            self._converged[members] = True
            self.going = self.going[~np.isin(self.going, members)]

    def _give_up(self) -> None:
        """Members for which no step is found are stuck; those that are far off and get nowhere go on no more."""
        lost = np.array([self._paces[b].damping > MOST for b in self.going.tolist()], bool)
        self._stuck[self.going[lost]], self.going = True, self.going[~lost]
        if self._control.patience is None:
            return
        before, near = -1 - self._control.patience, self._control.near
        slow = [len(self._costs[b]) >= -before and self._costs[b][-1] > max(near, SLOW * self._costs[b][before]) for b in self.going.tolist()]
        self.going = self.going[~np.array(slow, bool)]


def column_scaling(arrow: Arrow | JoinedArrow, size: Float[np.ndarray, "members unknowns"]) -> Float[np.ndarray, "members unknowns"]:
    """D: lengths of the columns of J, and something positive for those that are zero."""
    norms = arrow.column_norms
    by_size = norms * size
    least = LEAST_COLUMN * by_size.max(axis=1, keepdims=True)
    if (by_size > least).all():
        return norms
    D = np.maximum(norms, least / size)
    return np.where(D > 0, D, 1.0)


def damped_step(arrow: Arrow | JoinedArrow, theta, D, damping, limits: Limits, cutoff: float) -> np.ndarray:
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


def _is_small(change, size, d, control: Control) -> Bool[np.ndarray, "members"]:
    small = change <= control.tolerance**2
    return small & (np.abs(d) <= control.tolerance * size).all(axis=1) if small.any() else small
