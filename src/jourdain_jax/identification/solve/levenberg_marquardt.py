"""Levenberg-Marquardt within bounds for expensive residuals: each trial step needs one simulation with
derivatives.

    minimise F(theta), low <= theta <= high;      near theta   F + g' d + |J d|^2 / 2
    step       (J'J + lambda D^2) d = - g          D: lengths of the columns of J
               steps end at bounds, and the other unknowns are solved again
    patience   a member stops if F is large and has not decreased much within this number of steps
    converged  the undamped step has |J d| <= `tolerance`, in standard errors, and moves no unknown
               by more than that fraction of its size

Unknowns can lie exactly at a bound, which a transformation onto the interior never reaches. Ten fits of a
damping whose true value is zero converge in 4 steps; with the logarithm as unknown, seven had not converged
in 256. optimistix is not used, because its Jacobian is dense (each run would be differentiated with respect
to the starts of all others), it has no bounds, and it evaluates residuals and derivatives separately.

Several problems of one shape (`members`) run as a batch; finished members are not evaluated. Source: D. W.
Marquardt, SIAM J. Appl. Math. 11 (1963) 431; J. J. Moré, Lecture Notes in Mathematics 630 (1978) 105; for the
use of slopes instead of values near the minimum, W. W. Hager and H. Zhang, SIAM J. Optim. 16 (2005) 170.

A `Loss` rho(r) grows like r^2 for small residuals r, and more slowly for outliers:

    minimise sum rho(r)
    weights     w = rho'(r) / r     least squares of sqrt(w) r and sqrt(w) J has the same gradient
    Huber       rho = r^2/2 for |r| <= k, else k |r| - k^2/2      w = min(1, k / |r|)
    Student-t   rho = (nu + 1)/2 log(1 + r^2/nu)                  w = (nu + 1) / (nu + r^2)
    covariance  K^2 (J'J)^-1 sum psi^2 / (n - p) / mean(psi')^2,   K = 1 + p var(psi') / (n mean(psi')^2)

psi = rho'; n residuals, p unknowns; J = dr/dtheta. J'J is the weighted J'WJ, divided by the mean weight.
Source: P. J. Huber and E. M. Ronchetti, Robust Statistics, 2nd ed. (2009), section 7.6; K. L. Lange, R. J. A.
Little and J. M. G. Taylor, JASA 84 (1989) 881.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Number, checked_real
from jourdain_jax.identification.solve.arrow import Arrow, ByMember, ByUnknown, Flags, Members, PerMember
from jourdain_jax.identification.solve.unknowns import Unknowns

LEAST = 1e-9  # numerics: damping lambda


@dataclass
class Linearised(ByMember):
    """Value and derivatives at some theta, for each member."""

    cost: PerMember  # F; not finite if the motion fails
    arrow: Arrow  # J and residuals with J'r = dF/dtheta
    # residuals of all samples, not whitened, by (member, run); None if another run has failed
    residuals: np.ndarray
    sigma: Float[np.ndarray, "members channels"]  # of channels with estimated noise
    # triangles of Jacobian and residuals [J r]: first for all channels with known sigma, then for each other
    # channel
    triangles: Float[np.ndarray, "members runs kinds width width"]
    squares: Float[np.ndarray, "members kinds"]  # sums of their squared residuals


@dataclass(frozen=True)
class Control:
    """Criteria for stopping."""

    tolerance: float
    most_steps: int
    cutoff: float
    patience: int = 2**31  # steps within which F must fall to a quarter
    near: float = 0.0  # F below which it may decrease more slowly


@dataclass
class Minimum(ByMember):
    """The current or final state of the minimisation of each member."""

    theta: ByUnknown
    at: Linearised
    going: Flags
    converged: Flags
    stuck: Flags  # no step lowers F, but the point is no minimum
    steps: Members  # number of trial steps
    grown: Flags  # whether growing spans found the minimum
    trace: np.ndarray  # (members,) of tuples of (objective, F initially and after each tried step)

    @staticmethod
    def begun(theta: ByUnknown, at: Linearised, what: str) -> "Minimum":
        """Return the state before the first step. Members whose motion fails at `theta` take no steps.
        `what`: the name of the objective in the trace.
        """
        none, trace = np.zeros(len(theta), bool), np.empty(len(theta), object)
        trace[:] = [((what, (cost,)),) for cost in at.cost.tolist()]
        return Minimum(
            theta.copy(), at, np.isfinite(at.cost), none, none.copy(), none.astype(int), none.copy(), trace
        )

    def here(self) -> tuple[Members, Arrow, ByUnknown]:
        """Return the running members, with their linearised problems and unknowns."""
        here = np.flatnonzero(self.going)
        arrow = self.at.arrow if here.size == self.going.size else self.at.arrow.of(here)
        return here, arrow, self.theta[here]

    def arrived(self, here: Members, done: Flags) -> np.ndarray:
        """Stop the converged members (`done`), and return all others."""
        self.converged[here[done]], self.going[here[done]] = True, False
        self.steps[here[~done]] += 1
        return here[~done]

    def go(self, here: Members, end: ByUnknown, trial: Linearised, better: Flags) -> None:
        """Accept the steps marked as `better`."""
        self.theta[here[better]] = end[better]
        self.at = self.at.replaced(here, trial, better)
        for b in here.tolist():
            ((what, costs),) = self.trace[b]
            self.trace[b] = ((what, (*costs, float(self.at.cost[b]))),)

    def give_up(self, members) -> None:
        """Stop these members, for which no step lowers F."""
        self.stuck[members], self.going[members] = True, False

    def lowest(self) -> "Minimum":
        """Return the member with the lowest value."""
        return self if len(self.theta) == 1 else self.of([int(np.argmin(self.at.cost))])

    def agreeing(self, apart: float) -> int:
        """Return the number of members that converged to an F at most `apart` above the lowest."""
        return int(np.sum(self.converged & (self.at.cost <= np.min(self.at.cost) + apart)))

    def lowered(self, members: Members, other: "Minimum") -> "Minimum":
        """Return all members, with the `other` minima if these are lower, and their step counts."""
        found = self.replaced(members, other, other.at.cost < self.at.cost[members])
        found.steps[members] = other.steps
        return found

    def continued(self, members: Members, new: "Minimum") -> "Minimum":
        """Return all members. `members` get the results of `new`, which continued from them; steps add up."""
        return self.replaced(members, new.after(self, members), np.ones(len(members), bool))

    def after(self, before: "Minimum", members: Members) -> "Minimum":
        """Return these members with the steps and the trace of the earlier attempt `before` added."""
        return replace(
            self,
            steps=before.steps[members] + self.steps,
            trace=before.trace[members] + self.trace,
            grown=before.grown[members],
        )


def minimise(
    evaluate: Callable[[np.ndarray, np.ndarray], Linearised],
    theta: ByUnknown,
    unknowns: Unknowns,
    control: Control,
    what: str = "",
) -> Minimum:
    """Return the minimum found from `theta`. `evaluate(theta, members)` returns value and derivatives for
    some members; `what`: the name of the objective in the trace.
    """
    way = Minimum.begun(theta, evaluate(theta, np.arange(len(theta))), what)
    full = np.ones(len(theta))
    # factors of growth after a failed step, and of decrease after a good one
    damping, growth, fall = 1e-3 * full, 4.0 * full, 10.0 * full
    for _ in range(control.most_steps):
        here, arrow, x = way.here()
        if not here.size:
            break
        size = unknowns.sizes(x)
        scaling = column_scaling(arrow, size)
        d = damped_step(arrow, x, scaling, damping[here], unknowns, control.cutoff)
        change = arrow.change(d)
        done = is_small(change, size, d, control)
        if (done & (damping[here] > LEAST)).any():
            undamped = damped_step(arrow, x, scaling, np.full(here.size, LEAST), unknowns, control.cutoff)
            done &= is_small(arrow.change(undamped), size, undamped, control)
        slope = -np.einsum("bi,bi->b", arrow.gradient, d)
        here, x, d, change, slope = way.arrived(here, done), x[~done], d[~done], change[~done], slope[~done]
        if not here.size:
            break
        trial, promised = evaluate(x + d, here), slope - 0.5 * change
        gained = fallen(way.at.cost[here], trial, d, slope, promised, control)
        better = np.isfinite(gained) & (gained > 1e-4 * promised)
        # more damping after overshooting: with large residuals, undamped steps oscillate along poorly
        # determined directions
        by = np.where(gained > 0.9 * promised, 1 / fall[here], np.where(gained < 0.6 * promised, 3.0, 1.0))
        damping[here] = np.maximum(damping[here] * np.where(better, by, growth[here]), LEAST)
        # damping decreases slowly after a failed step; otherwise every other step fails in a curved valley
        fall[here] = np.where(better, np.minimum(1.5 * fall[here], 10.0), 2.0)
        growth[here] = np.where(better, 4.0, 2 * growth[here])
        way.go(here, x + d, trial, better)
        way.give_up(damping > 1e9)
        for b in here.tolist():
            ((_, costs),) = way.trace[b]
            way.going[b] &= len(costs) <= control.patience or costs[-1] <= max(
                control.near, 0.25 * costs[-1 - control.patience]
            )
    return way


def fallen(
    before: PerMember, trial: Linearised, d: ByUnknown, slope, promised, control: Control
) -> PerMember:
    """Return the decrease of F along a step d.

    Near the minimum, errors of the simulation hide small changes of F, which jumps when the number of steps
    of a motion changes. There the decrease is computed from the derivatives of F at both ends of the step;
    `slope` is the first.
    """
    found = before - trial.cost
    by_slopes = 0.5 * (slope - np.einsum("bi,bi->b", trial.arrow.gradient, d))
    unsure = (np.abs(found) < 1e-6 * np.abs(before)) | (
        (promised < 100 * control.tolerance**2) & (np.abs(found) < control.tolerance)
    )
    return np.where(unsure, by_slopes, found)


def column_scaling(arrow: Arrow, size: ByUnknown) -> ByUnknown:
    """Return D, the lengths of the columns of J. Length times size of an unknown is at least 1e-8 of the
    largest such product.
    """
    norms = arrow.column_norms
    by_size = norms * size
    least = 1e-8 * by_size.max(axis=1, keepdims=True)
    if (by_size > least).all():
        return norms
    D = np.maximum(norms, least / size)
    return np.where(D > 0, D, 1.0)


def damped_step(arrow: Arrow, theta, D, damping, unknowns: Unknowns, cutoff: float) -> np.ndarray:
    """Return the damped step within the bounds."""
    # an unknown with a bound above zero shrinks at most to a tenth per step: motions with tiny masses and
    # lengths need many steps
    g, low = arrow.gradient, np.where(unknowns.low > 0, np.maximum(unknowns.low, 0.1 * theta), unknowns.low)
    held = unknowns.fixed | ((theta <= unknowns.low) & (g >= 0)) | ((theta >= unknowns.high) & (g <= 0))
    moved = np.zeros(theta.shape)
    for _ in range(8):
        d = arrow.step(damping, D, held, moved, cutoff)
        ended = theta + d
        within = np.minimum(np.maximum(ended, low), unknowns.high)
        over = (within != ended) & ~held
        if not over.any():
            return d
        held, moved = held | over, np.where(over, within - theta, moved)
    return np.clip(theta + d, low, unknowns.high) - theta


def is_small(change, size, d, control: Control) -> Flags:
    """Return which steps are small enough to stop."""
    small = change <= control.tolerance**2
    return small & (np.abs(d) <= control.tolerance * size).all(axis=1) if small.any() else small


Residuals = Float[np.ndarray, "samples"]
Samples = Float[np.ndarray, "*samples"]


@dataclass(frozen=True)
class Loss:
    """A loss, `huber(k)` or `student_t(degrees)`. An infinite parameter means least squares."""

    kind: str
    parameter: float

    def value(self, r: Float[np.ndarray, "*batch samples"]) -> Float[np.ndarray, "*batch"]:
        """Return the sum of rho over the last axis."""
        k = self.parameter
        if math.isinf(k):
            return 0.5 * np.einsum("...i,...i->...", r, r)
        if self.kind == "student-t":
            return np.sum((k + 1) / 2 * np.log1p(r**2 / k), axis=-1)
        inside = np.minimum(abs(r), k)
        return np.sum(
            inside * (np.minimum(abs(r), np.finfo(float).max / max(k, 1.0)) - 0.5 * inside), axis=-1
        )

    def weight(self, r: Samples) -> Samples:
        """Return the weight `w = rho'(r) / r`."""
        k = self.parameter
        if self.kind == "student-t":
            return (k + 1) / (k + r**2)
        return np.minimum(1.0, k / np.maximum(abs(r), np.finfo(float).tiny))

    def weighted(self, rows: Float[np.ndarray, "*samples width"], r: Samples):
        """Return `rows`, each multiplied by the root of its weight."""
        return rows if math.isinf(self.parameter) else np.sqrt(self.weight(r))[..., None] * rows

    def inflation(self, r: Residuals, determined: float) -> float:
        """Return the factor of the covariance `(J'WJ)^-1`, after `determined` unknowns were fitted to `r`."""
        if not np.isfinite(bend := self.bend(r)):
            return bend
        psi, slope = self.weight(r) * r, self._slope(r)
        left, K = max(r.size - determined, 1.0), 1 + determined / r.size * np.var(slope) / np.mean(slope) ** 2
        return bend * K**2 * float(np.sum(psi**2) / left / np.mean(slope))

    def bend(self, r: Residuals) -> float:
        """Return `mean(w) / mean(rho'')` over the residuals, the factor from `(J'WJ)^-1` to the inverse of
        the second derivative of F with respect to the unknowns; infinite unless `mean(rho'') > 0`.
        """
        slope = float(np.mean(self._slope(r)))
        return float(np.mean(self.weight(r))) / slope if slope > 0 else math.inf

    def _slope(self, r: Residuals) -> Residuals:
        """Return `psi' = rho''`, the second derivative of the loss."""
        k = self.parameter
        if self.kind == "student-t":
            return (k + 1) * (k - r**2) / (k + r**2) ** 2
        return (np.abs(r) <= k).astype(float)


LEAST_SQUARES = Loss("least squares", np.inf)


def huber(k: Number = 1.345) -> Loss:
    """Return a loss that grows with the magnitude of residuals beyond `k` sigmas instead of their square:
    `jj.fit(..., loss=jj.identification.huber())`. The default has 95 % of the efficiency of least squares for
    normal noise.

    Raises ValueError unless k is positive and finite.
    """
    return Loss("huber", _positive(k, "k", "huber"))


def student_t(degrees: Number = 4.0) -> Loss:
    """Return the loss for noise distributed as Student's t, in which outliers have little weight. Fewer
    `degrees` of freedom mean heavier tails. Sigma is then the scale of the noise.

    Raises ValueError unless the degrees are positive and finite.
    """
    return Loss("student-t", _positive(degrees, "degrees", "student_t"))


def _positive(x: Number, name: str, function: str) -> float:
    checked_real(x, f"`{name}` of `{function}`", ())
    if not (np.isfinite(x) and x > 0):
        raise ValueError(
            f"{function}({x}): expected a positive finite number for `{name}`; omit it for the default"
        )
    return float(x)
