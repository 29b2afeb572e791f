"""Identification: parameters and initial values of a scene from measured motions, by nonlinear least squares.

    minimise sum r(theta)^2 + sum ((theta - mean) / s)^2,   r = (prediction - value) / sigma,   theta within its bounds;   mean, s: of priors

by Levenberg-Marquardt. Jacobians come by forward mode through the simulation, run by run; initial values of the runs are eliminated run by run.
Source: D. W. Marquardt, SIAM J. Appl. Math. 11 (1963) 431; G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989), chapter 3.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.analysis.arrow import arrow, triangle, with_prior
from jourdain_jax.analysis.estimate import Estimate
from jourdain_jax.analysis.fit_result import Fit
from jourdain_jax.analysis.information import information, students_t_95
from jourdain_jax.analysis.levenberg_marquardt import Control, Limits, Linearised, Minimum, minimise
from jourdain_jax.analysis.likelihood import as_runs
from jourdain_jax.analysis.losses import LEAST_SQUARES, Loss
from jourdain_jax.analysis.measurements import Measurements
from jourdain_jax.analysis.predictions import Lanes
from jourdain_jax.analysis.profile import limits_at_bounds
from jourdain_jax.analysis.ranges import Range
from jourdain_jax.analysis.starts import check_starts
from jourdain_jax.analysis.unknowns import Unknowns, unknowns_of
from jourdain_jax.build.reference_parameters import reference_parameters
from jourdain_jax.calculus.guards import DifferentiationModeError
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.numbers import is_traced
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.tracebacks import shown_from_users_lines

_NORMAL_95 = 1.959963984540054  # 97.5 % quantile of the standard normal distribution
_LEAST_SIGMA = 1e-12  # of a channel that is met exactly
_POOR = 10.0  # times the sum of squares that noise alone leaves, one for each sample
_SPANS = (1 / 32, 1 / 16, 1 / 8, 3 / 16, 1 / 4, 3 / 8, 1 / 2, 3 / 4)  # shares of the span that a fit grows over
_STEPS, _ROUGHLY = 12, 0.05  # tried on each of them, and their tolerance
_SAME = 0.05  # of half the sum of squares, by which the same minimum is found lower from elsewhere
_FEWEST_RUNS = 5  # that tell how much runs differ


@shown_from_users_lines
def fit(
    scene: Scene | BuiltFor,
    data: Measurements | Sequence[Measurements],
    free: "Mapping[str, Range | Estimate | None] | Iterable[str]" = (),
    *,
    cutoff: float = 1e-6,
    tolerance: float = 1e-4,
    max_iterations: int = 50,
    loss: Loss | None = None,
    errors: str = "sigmas",
    guesses: int = 1,
    **simulation,
) -> Fit:
    """Estimate the `free` parameters of a scene, unknown initial values of its runs and numbers of their sensors, from measurements.

    **Arguments**
    - `scene`: its parameters are fixed, or first guesses where they are free.
    - `data`: one run or several, each with its own times, channels, start and inputs.
    - `free`: parameter names, or name -> `bounds(low, high)`, `positive()`, `unbounded()` or None (positive where the parameter
      is declared so), or an `Estimate` with a prior. What `unknown_start`, sensors and actuators of the runs name is free as well.
    - `cutoff`: singular values of the scaled Jacobian below this fraction of the largest count as zero (`Information`). Keep it
      well above the relative accuracy of the simulation.
    - `tolerance`: the fit has converged when a step changes no residual by more than about this many sigmas, and no unknown by
      more than about this fraction. `max_iterations`: steps tried at most, over each span.
    - `loss`: `huber()` or `student_t()` where some samples are far out (default: least squares).
    - `errors`: whence standard errors and intervals come. "sigmas": from the sigmas, which holds for noise that is white. "runs": from how much runs differ
      (the sandwich of clusters, which needs five runs or more), which holds whatever the noise within a run, also where the scene is not quite right.
    - `guesses`: how many first guesses are tried side by side: that of the scene and the runs, and others on a Latin hypercube over the bounds of all
      unknowns, or within a factor of five of a `positive()` one. The lowest minimum counts; `Fit.agreeing` says how many led to it.
    - `simulation`: options of `simulate` such as `rtol`, `atol`, `solver`, `max_steps`. Stop events are ignored.

    Where that finds no minimum, or one whose residuals are far beyond their sigmas, the fit is made once more over growing spans: the first 1/32 of each
    run, then more of it, each from where the shorter one ended, with the first guess as a weak prior (known to its own size). So unstable motions are fitted
    that no first guess would follow to their end. The lower minimum counts, and `Fit.grown` says which one it was.

    **Returns** a `Fit`: estimates with covariance and 95 % intervals (sigmas that were given are taken as known), residuals, the fitted
    scene, and in words what the measurements cannot tell. An unknown at its bound has a one-sided interval, by profile likelihood. `converged` is False
    where no minimum was found. Runs of equal structure go through one compiled program, whatever their number and lengths; time and memory are
    proportional to the number of runs.

    **Raises** ValueError for names, shapes or numbers that do not fit, no or too many unknowns, and a start that contradicts the
    constraints; DifferentiationModeError inside `jit`, `vmap` or a derivative, since steps are chosen outside of compiled code.

    **Examples**

        truth, start, ts = jj.models.ChaplyginSleigh(offset=0.25), {"x_rate": 0.6, "heading_rate": 0.9}, jnp.linspace(0.0, 2.0, 21)
        motion = jj.simulate(truth, start, ts=ts)
        data = jj.Measurements(ts, {"x": motion["x"], "heading": motion["heading"]}, 0.01, start=start)       # sigma: 0.01 m, 0.01 rad
        found = jj.fit(jj.models.ChaplyginSleigh(), data, free={"offset": jj.bounds(0.05, 1.0)})
        print(found)                                              # estimates with 95 % intervals, and what the data cannot tell
        found["offset"].value, found.scene.offset                 # near 0.25 m
    """
    if isinstance(guesses, bool) or not isinstance(guesses, int | np.integer) or guesses < 1:
        raise ValueError(f"`guesses` is {guesses!r}, expected a whole number of at least 1: how many first guesses to begin from")
    return _fit(scene, data, free, simulation, Control(tolerance, max_iterations, cutoff), loss, errors, repeats=False, guesses=int(guesses))


def fit_batch(
    scene: Scene | BuiltFor,
    data: Measurements | Sequence[Measurements],
    free: "Mapping[str, Range | Estimate | None] | Iterable[str]" = (),
    *,
    cutoff: float = 1e-6,
    tolerance: float = 1e-4,
    max_iterations: int = 50,
    loss: Loss | None = None,
    errors: str = "sigmas",
    **simulation,
) -> Fit:
    """`fit` for many repeats of the same experiment, as one batch.

    Every array in the `values` of `data` has a leading axis `repeats`; all else is shared. `free`, `cutoff`, `tolerance`,
    `max_iterations`, `loss`, `errors` and `simulation` as in `fit`. **Returns** a `Fit` whose arrays have the leading axis; a repeat that fails has
    `converged` False and harms no other. **Raises** as `fit`.
    """
    return _fit(scene, data, free, simulation, Control(tolerance, max_iterations, cutoff), loss, errors, repeats=True)


def _fit(scene, data, free, simulation: dict, control: Control, loss: Loss | None, errors: str, repeats: bool, guesses: int = 1) -> Fit:
    scene = as_scene(scene)
    if is_traced((scene, data, control.tolerance, control.cutoff, simulation)):
        raise DifferentiationModeError(
            "`fit` was called inside jit, vmap or a derivative, but its steps are chosen outside of compiled code. Call it with known numbers; "
            "for many repeats use `fit_batch`, for derivatives of the fit's objective `log_likelihood`."
        )
    runs = as_runs(scene, data, repeats=repeats)
    _check_choices(runs, loss, errors)
    unknowns = unknowns_of(scene, runs, free)
    with reference_parameters(scene):
        check_starts(scene, runs, unknowns)
        members = _repeats(runs) if repeats else None
        _check_enough(runs, unknowns, repeats)
        problem = _Problem(scene, runs, unknowns, Lanes(scene, runs, unknowns.layout, simulation, members), loss or LEAST_SQUARES)
        theta = unknowns.first_guesses(guesses) if members is None else np.broadcast_to(unknowns.guess, (members, unknowns.guess.size))
        limits = Limits(*unknowns.ends, unknowns.fixed, unknowns.sizes)
        found = _minimum(problem, theta, limits, control, one_will_do=members is None)
        same = np.zeros(members, int) if members else np.asarray(found.agreeing(_SAME))
        return _result(problem, found if members else found.lowest(), limits, control, errors, guesses, same)


def _minimum(problem: "_Problem", theta: np.ndarray, limits: Limits, control: Control, one_will_do: bool) -> Minimum:
    """The minimum from each `theta`; where none is found, or residuals are far beyond their sigmas, the lower one of it and that over growing spans.

    Over a short span a motion depends on its unknowns almost linearly, also an unstable one; each fit begins where that over the shorter span ended, and what
    a short span does not tell stays near the first guess. `one_will_do`: spans grow
    only where no theta led to a minimum with small residuals.
    """
    found = minimise(problem.linearised, theta, limits, control)
    is_poor = ~found.converged | (found.at.cost > 0.5 * _POOR * problem.samples)
    poor = np.flatnonzero(is_poor)
    if not poor.size or not problem.samples or (one_will_do and not is_poor[np.argmin(found.at.cost)]):
        return found
    begin, steps, problem.begun = theta[poor], found.steps[poor], theta
    roughly = replace(control, most_steps=min(_STEPS, control.most_steps), tolerance=_ROUGHLY)
    for problem.share, how in (*((share, roughly) for share in _SPANS), (1.0, control)):
        grown = minimise(lambda x, here: problem.linearised(x, poor[here]), begin, limits, how)
        begin, steps = grown.theta, steps + grown.steps
    return found.lowered(poor, replace(grown, steps=steps))


def _check_choices(runs: Sequence[Measurements], loss, errors) -> None:
    if loss is not None and not isinstance(loss, Loss):
        raise ValueError(f"`loss` is {loss!r}, expected `huber()`, `student_t()`, or None for least squares")
    if errors not in ("sigmas", "runs"):
        raise ValueError(f'`errors` is {errors!r}, expected "sigmas" or "runs"')
    if errors == "runs" and len(runs) < _FEWEST_RUNS:
        raise ValueError(
            f'errors="runs" takes standard errors from how runs differ, but there are {len(runs)}; give {_FEWEST_RUNS} or more, or errors="sigmas"'
        )
    unknown = sorted({name for run in runs for name in run.unknown_sigma})
    if unknown and loss is not None:
        raise ValueError(f"sigma of channel `{unknown[0]}` is None, but a robust loss needs to know what is far out; give a number")
    for name in unknown:
        if any(name in run.values and name not in run.unknown_sigma for run in runs):
            raise ValueError(f"sigma of channel `{name}` is None in one run and given in another; give it in all runs, or in none")


def _repeats(runs: Sequence[Measurements]) -> int:
    counts = {values.shape[0] for run in runs for values in run.values.values()}
    if len(counts) != 1 or 0 in counts:
        raise ValueError(f"the channels hold {sorted(counts)} repeats; give every channel of every run the same leading axis, of one or more")
    return counts.pop()


def _check_enough(runs: Sequence[Measurements], unknowns: Unknowns, repeats: bool) -> None:
    samples = sum(int(np.prod(values.shape[int(repeats) :])) for run in runs for values in run.values.values()) + len(unknowns.with_prior)
    if samples < len(unknowns.labels):
        raise ValueError(
            f"{samples} measured values cannot determine {len(unknowns.labels)} unknowns; measure more, or free fewer of {', '.join(unknowns.labels)}"
        )


class _Problem:
    """Residuals with their derivatives, of any members at any numbers."""

    def __init__(self, scene: Scene, runs: tuple[Measurements, ...], unknowns: Unknowns, lanes: Lanes, loss: Loss):
        self.scene, self.runs, self.unknowns, self.lanes, self.loss = scene, runs, unknowns, lanes, loss
        self.estimated = tuple(sorted({name for run in runs for name in run.unknown_sigma}))  # channels whose sigma is
        self.share = 1.0  # of each run's span, from its start: samples beyond do not count
        self.begun = np.zeros((0, 0))  # first guesses of the members, where spans grow

    def linearised(self, theta: np.ndarray, members: np.ndarray) -> Linearised:
        """What is minimised, with its arrow, of some members: sum of rho(r); for channels whose sigma is not known, n log sigma with sigma^2 = mean r^2."""
        shared, local = self.unknowns.split(theta)
        (count, runs, m), p, kinds = local.shape, shared.shape[1], 1 + len(self.estimated)
        triangles = np.zeros((count, runs, kinds, m + p + 1, m + p + 1))
        cost, squares, samples = np.zeros(count), np.zeros((count, kinds)), self.lanes.counted(self.estimated, members)
        residual = np.empty((count, runs), object)
        for b, j, r, J in self.lanes.evaluate(shared, local, members):
            if self.share < 1:
                early = self.lanes.within(j, self.share)
                r, J = np.where(early, r, 0.0), np.where(early[..., None], J, 0.0)
            with np.errstate(over="ignore", invalid="ignore"):
                for k, (rows, counted) in enumerate(self._kinds(int(j[0]), r)):
                    root = np.sqrt(self.loss.weight(rows))
                    triangles[b, j, k] = triangle(root * rows, root[..., None] * J[:, counted])
                    np.add.at(squares, (b, k), np.sum(rows**2, axis=1))
                    if k == 0:
                        np.add.at(cost, b, self.loss.value(rows))
            for place, one in zip(zip(b, j, strict=True), r, strict=True):
                residual[place] = one
            if count == 1 and not np.all(np.isfinite(triangles[b, j])):  # whatever the other runs say
                triangles.fill(np.nan)
                break
        sigma = np.sqrt(np.maximum(squares[:, 1:] / samples, _LEAST_SIGMA**2))
        cost = cost + np.sum(samples * np.log(sigma), axis=1)
        mean, spread = self._known_before(theta, members)
        with_mean = np.isfinite(mean)
        cost = cost + 0.5 * np.sum(np.where(with_mean, (theta - np.where(with_mean, mean, 0.0)) / spread, 0.0) ** 2, axis=1)
        finite = np.isfinite(triangles).all(axis=(1, 2, 3, 4)) & np.isfinite(cost)
        scaled = np.where(finite[:, None, None, None, None], triangles, 0.0) / np.concatenate([np.ones((count, 1)), sigma], axis=1)[:, None, :, None, None]
        together = scaled[:, :, 0] if kinds == 1 else np.linalg.qr(scaled.reshape(count, runs, -1, m + p + 1), mode="r")
        whole = arrow(together, m)
        return Linearised(np.where(finite, cost, np.inf), with_prior(whole, theta, mean, spread) if with_mean.any() else whole, residual, sigma)

    def _known_before(self, theta: np.ndarray, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation of priors, (members, unknowns); NaN where there is none.

        Over part of the span the first guess is a weak prior, known to its own size: what so few samples do not tell stays there.
        """
        mean, spread = (np.broadcast_to(x, theta.shape) for x in (self.unknowns.prior_mean, self.unknowns.prior_sigma))
        if self.share == 1:
            return mean, spread
        begun = self.begun[members]
        none = ~np.isfinite(mean) & ~self.unknowns.fixed
        return np.where(none, begun, mean), np.where(none, self.unknowns.sizes(begun), spread)

    @property
    def samples(self) -> int:
        """How many samples there are of channels whose sigma is known, in one repeat."""
        channels = [(run, name) for i, run in enumerate(self.runs) for name in run.values if name not in self.estimated]
        return sum(int(np.prod(np.shape(run.values[name])[int(self.lanes.members is not None) :])) for run, name in channels)

    def by_channel(self, run: int, found: Minimum, one: Callable) -> dict[str, np.ndarray]:
        """Residuals of a run in units of sigma by channel; NaN where a sample is missing, or they were not worked out since another run had failed."""
        flat = [np.zeros(0) if r is None else r for r in found.at.residual[:, run]]
        longest = max(map(len, flat))
        parts = self.lanes.by_channel(run, one(np.stack([np.full(longest, np.nan) if len(r) < longest else r for r in flat])))
        for k, name in enumerate(self.estimated):
            if name in parts:
                sigma = one(found.at.sigma[:, k])
                parts[name] = parts[name] / sigma.reshape(sigma.shape + (1,) * (parts[name].ndim - sigma.ndim))
        return parts

    def inflation(self, residuals, samples, rank) -> np.ndarray:
        """By what the covariance of each member is to be multiplied: for the loss, and for sigmas that are estimated."""
        members = self.lanes.members or 1
        by_member = [np.concatenate([r.reshape(members, -1)[b] for run in residuals for r in run.values()]) for b in range(members)]
        of_loss = np.array([self.loss.inflation(r[np.isfinite(r)]) if np.isfinite(r).any() else np.nan for r in by_member])
        every = bool(self.estimated) and all(set(run.values) <= set(self.estimated) for run in self.runs)
        left = np.maximum(samples - rank, 1)
        return of_loss * np.broadcast_to(samples / left if every else 1.0, (members,))

    def _kinds(self, run: int, r: np.ndarray):
        """Residuals and their places: those of channels whose sigma is known, then those of each other channel."""
        if not self.estimated:
            yield r, slice(None)
            return
        channels = self.lanes.channels(run)
        known = [np.arange(r.shape[1])[where] for name, where in channels.items() if name not in self.estimated]
        for counted in (np.concatenate([np.zeros(0, int), *known]), *(np.arange(r.shape[1])[channels.get(name, slice(0))] for name in self.estimated)):
            yield r[:, counted], counted


def _result(problem: _Problem, found: Minimum, limits: Limits, control: Control, errors: str, guesses: int, agreeing: np.ndarray) -> Fit:
    unknowns, theta, single = problem.unknowns, found.theta, problem.lanes.members is None
    one = (lambda x: np.asarray(x[0])) if single else (lambda x: x)
    places, size, fails = unknowns.estimated, unknowns.sizes(theta), ~np.isfinite(found.at.cost)
    low, high = limits.low[places], limits.high[places]
    bound = (theta <= limits.low) | (theta >= limits.high)
    limit, beyond = (one(x[:, places]) for x in limits_at_bounds(problem.linearised, found, limits, control))
    residuals = tuple(problem.by_channel(run, found, one) for run in range(len(problem.runs)))
    samples = sum(np.sum(np.isfinite(r), axis=tuple(range(0 if single else 1, r.ndim))) for run in residuals for r in run.values())
    known = information(found.at.arrow, size, places, bound, fails, control.cutoff, single)
    known = known.times(one(problem.inflation(residuals, samples, known.rank)))
    reach = _NORMAL_95 * known.standard_errors
    if errors == "runs":
        known = known.between_runs(one(found.at.arrow.scores))
        reach = students_t_95(len(problem.runs) - 1) * known.standard_errors
    values = one(theta[:, places])
    shared, local = unknowns.split(theta)
    scene = unknowns.layout.scene(problem.scene, one(shared))
    if not single:
        scene = jax.tree.map(lambda x, own: jnp.asarray(x if x is not own else np.broadcast_to(own, (len(theta), *own.shape))), scene, problem.scene)
    return Fit(
        scene=scene,
        starts=tuple(unknowns.layout.start(run.start, one(local[:, i])) for i, run in enumerate(problem.runs)),
        values=values,
        sizes=one(size[:, places]),
        standard_errors=known.standard_errors,
        low=np.where(values <= low, low, np.where(values >= high, limit, np.maximum(values - reach, low))),
        high=np.where(values >= high, high, np.where(values <= low, limit, np.minimum(values + reach, high))),
        at_bound=one(bound[:, places]),
        beyond=beyond,
        information=known,
        residuals=residuals,
        sigma={name: one(found.at.sigma[:, k]) for k, name in enumerate(problem.estimated)},
        chi_square=np.where(one(fails), np.nan, sum(_sum_of_squares(r, single) for run in residuals for r in run.values())),
        samples=np.asarray(samples),
        converged=one(found.converged),
        stuck=one(found.stuck),
        steps=one(found.steps),
        grown=one(found.grown),
        guesses=guesses,
        agreeing=agreeing,
        labels=unknowns.labels,
        units=unknowns.units,
        cutoff=control.cutoff,
        errors=errors,
    )


def _sum_of_squares(r: np.ndarray, single: bool) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.asarray(np.nansum(r**2, axis=tuple(range(0 if single else 1, r.ndim))))
