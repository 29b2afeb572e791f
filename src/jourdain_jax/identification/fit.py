"""Identification of parameters and initial values of a scene from measured motions, by nonlinear least
squares.

    minimise sum r(theta)^2 + sum ((theta - mean) / s)^2,   r = (prediction - value) / sigma

over the unknowns theta within their bounds, by Levenberg-Marquardt; mean, s: of priors. Jacobians are
computed in forward mode, run by run, and initial values of the runs are eliminated run by run. Source: D. W.
Marquardt, SIAM J. Appl. Math. 11 (1963) 431; G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989),
chapter 3.

The search for a minimum starts from one or more first guesses. If these are far off, it fits growing spans of
the runs. It alternates with the estimation of correlation times, and moves unknowns off their bounds if this
helps.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, Unpack

import numpy as np

from jourdain_jax.calculus.derivative_errors import DifferentiationModeError
from jourdain_jax.calculus.reals import checked_whole, is_traced
from jourdain_jax.identification.data.estimate import Estimate, Range
from jourdain_jax.identification.data.experiment import Data, Experiment
from jourdain_jax.identification.data.run_preparation import as_fit_options, as_runs, in_all_or_none
from jourdain_jax.identification.inference.bound_limits import AtBounds, limits_at_bounds
from jourdain_jax.identification.report.fit_result import Fit
from jourdain_jax.identification.report.fit_statistics import statistics
from jourdain_jax.identification.solve.body_inertia import PossibleInertia
from jourdain_jax.identification.solve.levenberg_marquardt import LEAST_SQUARES, Control, Loss, Minimum
from jourdain_jax.identification.solve.piecewise import Piecewise
from jourdain_jax.identification.solve.problem import Asked, Problem, Span
from jourdain_jax.identification.solve.shooting import MultipleShooting, check_shooting
from jourdain_jax.identification.solve.shooting_steps import cutoff_of, shot
from jourdain_jax.identification.solve.unknowns import Unknowns, check_starts, unknowns_of
from jourdain_jax.motion.options import OptionFields, Options
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines
from jourdain_jax.scene.coordinates import as_names
from jourdain_jax.scene.scene import Scene


class FitFields(OptionFields, total=False):
    """Arguments of `fit` and `fit_batch` by name."""

    cutoff: float
    tolerance: float
    max_iterations: int
    loss: Loss | None
    errors: str
    options: Options | None


def minimum(problem: Problem, theta: np.ndarray) -> Minimum:
    """Return the minimum reached from each `theta`. If none is reached, or if residuals are far beyond their
    sigmas, fit over growing spans as well, and return the lower of both results.

    Over a short span, a motion depends almost linearly on its unknowns, even if it is unstable. Each fit
    starts at the result over the shorter span. Unknowns that a short span does not determine stay near the
    first guess. A fit that makes no progress far from a minimum is interrupted. It is resumed only if growing
    spans do not lead to small residuals. With several first guesses, growing spans are used only if no
    guess led to small residuals.
    """
    samples, control = problem.samples, problem.asked.control
    large = 5.0 * samples  # F: ten times the expected value for noise alone, one half per sample
    impatient = samples > 0 and not (problem.single and len(theta) > 1)

    def of(members: np.ndarray, begin: np.ndarray, how: Control, span: Span | None = None) -> Minimum:
        return problem.minimum(begin, members, "whole runs", how, span)

    found = of(
        np.arange(len(theta)), theta, replace(control, patience=3, near=large) if impatient else control
    )
    left, ended = ~(found.going | found.converged | found.stuck), found.theta.copy()
    poor = np.flatnonzero(~found.converged | (found.at.cost > large))
    if not poor.size or not samples or (problem.single and np.argmin(found.at.cost) not in poor):
        return found
    spans = np.array([1 / 32, 1 / 16, 1 / 8, 3 / 16, 1 / 4, 3 / 8, 1 / 2, 3 / 4])  # shares of each run
    way, place = replace(found.of(poor), theta=theta[poor]), np.zeros(len(poor), int)
    roughly = replace(control, most_steps=min(8, control.most_steps), tolerance=1.0)
    while (some := np.flatnonzero(place < len(spans))).size:
        grown = of(poor[some], way.theta[some], roughly, Span(spans[place[some]], theta[poor[some]]))
        grown.trace[:] = [
            ((f"the first {spans[k]:.3g} of each run", costs),)
            for k, ((_, costs),) in zip(place[some], grown.trace, strict=True)
        ]
        way = way.continued(some, grown)
        place[some] += 1
        followed = problem.is_followed(grown.at, spans, 100.0)  # times the squares expected from noise
        for k in range(1, len(spans)):
            # skip the next span if the motion follows it already
            place[some] += (place[some] == k) & followed[:, k]
    grown = of(poor, way.theta, control).after(way, np.arange(len(poor)))
    found = found.lowered(poor, replace(grown, grown=np.ones(len(poor), bool)))
    if (late := np.flatnonzero(left & (~found.converged | (found.at.cost > large)))).size:
        more = of(late, ended[late], control)
        found = found.lowered(late, replace(more.after(found, late), grown=more.grown))
    return found


def with_memory(problem: Problem, found: Minimum) -> Minimum:
    """Return the minimum with estimated correlation times of the noise. Correlation times and unknowns are
    estimated alternately, starting from white noise.
    """
    if not problem.with_memory:
        return found
    going = np.flatnonzero(np.isfinite(found.at.cost))
    some = replace(problem.asked.control, most_steps=min(12, problem.asked.control.most_steps))
    for _ in range(20):
        if not going.size:
            break
        changed = problem.restrict(found.theta[going], going)
        again = problem.minimum(
            found.theta[going], going, "whole runs, after an update of correlation times", some
        )
        found = found.continued(going, again)
        going = going[(changed > 1e-3) | ~again.converged]
    found.converged[going] = False
    return found


def off_bounds(problem: Problem, found: Minimum) -> tuple[Minimum, AtBounds]:
    """Return the minimum after moving unknowns off their bounds where this lowers F, and the statistics of
    the unknowns that stay at a bound.
    """
    for _ in range(20):
        with problem.unmoved() if isinstance(problem, Piecewise) else nullcontext():
            told = limits_at_bounds(problem, found)
        if not told.lower:
            break
        members = np.array(list(told.lower))
        again = problem.minimum(
            np.stack([theta for _, theta in told.lower.values()]), members, "whole runs, off a bound"
        )
        found = with_memory(problem, found.lowered(members, again.after(found, members)))
    return found, told


@shown_from_users_lines
def fit(
    scene: Scene | BuiltFor,
    data: Data,
    free: "Mapping[str, Range | Estimate | PossibleInertia | Callable[..., Any] | None] | Iterable[str]" = (),
    *,
    guesses: int = 1,
    shooting: MultipleShooting | None = None,
    **by_name: Unpack[FitFields],
) -> Fit:
    """Estimate the `free` parameters of a scene, unknown initial values of its runs and parameters of their
    sensors, from measurements.

    **Arguments**

    - `scene`: its parameters are fixed, or first guesses if they are free.
    - `data`: one run or several, each with its own times, channels, start and inputs.
    - `free`: parameter names, or name -> `bounds(low, high)`, `positive()`, `unbounded()` or None (positive
      if the parameter is declared so), a prior `Normal(mean, sigma)`, or an `Estimate`. A function of the
      scene ties a parameter to others: `free={"radius": None, "inertia": lambda scene: 0.5 * scene.mass *
      scene.radius**2}`. The measured sigmas of a bicycle are such priors:
      `free=measured_bicycle("Browser").prior`; for parameters that were measured together, use
      `joint_normal(means, covariance)`. The name of a body, with `possible_inertia()`, frees its moments of
      inertia. Unknowns in `unknown_start`, sensors and actuators of the runs are free as well.
    - `guesses`: number of first guesses, fitted as a batch. The first one comes from the scene and the runs;
      the others lie on a Latin hypercube within the bounds, or within a factor of five of a `positive()`
      unknown. The result is the lowest minimum; `Fit.agreeing` is the number of guesses that led to it.
    - `shooting`: `MultipleShooting(duration=...)` or `MultipleShooting(pieces=...)` for unstable and chaotic
      motions: the runs are fitted in pieces with their own starts, which are constrained to join. The
      objective is unchanged.

    Further keyword arguments (`by_name`):

    - `cutoff` (1e-6): singular values of the scaled Jacobian below this fraction of the largest count as zero
      (`Information`). Keep it well above the relative accuracy of the simulation.
    - `tolerance` (1e-4): the fit has converged when a step changes no residual by more than about this many
      sigmas, and no unknown by more than about this fraction.
    - `max_iterations` (50): the largest number of steps over each span.
    - `loss`: `huber()` or `student_t()` for data with outliers (default: least squares).
    - `errors`: the source of standard errors and intervals. "sigmas" (default): the sigmas, valid for white
      noise. "runs": the differences between at least five runs (the cluster sandwich), valid for any noise
      within a run, even if the scene is slightly wrong. Unknowns of single runs still assume white noise.
    - `options`: a `jj.Options`; or its fields, such as `rtol`, `solver`, `max_step`, `max_steps`.

    The simulated motion continues beyond stop events, since otherwise a motion that ends early would have
    fewer residuals. `Fit.warnings` names events that the fitted motion meets before a sample. Give only
    samples before the event of the real motion.

    If a fit finds no minimum, or residuals far beyond their sigmas, it is repeated over growing spans, unless
    `shooting` is given. The first span is 1/32 of each run; the next ones are longer, as far as the fitted
    motion follows the data. During this search the first guess is a weak prior, with its own size as sigma.
    Unstable motions are fitted in this way, too. The result is the lower minimum; `Fit.grown` is True if it
    came from growing spans.

    **Returns** a `Fit`: estimates with covariance and 95 % intervals, residuals, the fitted scene, and
    undetermined combinations of unknowns. Given sigmas count as known. Sigmas that are None, and robust
    losses, give intervals of Student's t. An unknown at its bound has a one-sided interval, by profile
    likelihood. `converged` is False if no minimum was found. Runs of equal structure share one compiled
    program, independent of their number and lengths; time and memory are proportional to the number of runs.

    **Raises** ValueError for names, shapes or numbers that do not fit, for no or too many unknowns, and for a
    start that contradicts the constraints. Raises DifferentiationModeError inside `jit`, `vmap` or a
    derivative, since steps are chosen outside of compiled code.

    **Examples**

        truth = jj.models.ChaplyginSleigh(offset=0.25)
        start, ts = {"x_rate": 0.6, "heading_rate": 0.9}, jnp.linspace(0.0, 2.0, 21)
        motion = jj.simulate(truth, start, ts=ts)
        # sigma: 0.01 m, 0.01 rad
        data = jj.Experiment(ts, {"x": motion["x"], "heading": motion["heading"]}, 0.01, start=start)
        found = jj.fit(jj.models.ChaplyginSleigh(), data, free={"offset": jj.bounds(0.05, 1.0)})
        print(found)                               # estimates with 95 % intervals
        found["offset"].value, found.scene.offset  # near 0.25 m
    """
    guesses = checked_whole(guesses, "`guesses`", 1, expected="of at least 1: the number of first guesses")
    check_shooting(shooting)
    return _fit(replace(_asked(scene, free, by_name, "fit"), guesses=guesses, shooting=shooting), data)


def fit_batch(
    scene: Scene | BuiltFor,
    data: Data,
    free: "Mapping[str, Range | Estimate | PossibleInertia | Callable[..., Any] | None] | Iterable[str]" = (),
    **by_name: Unpack[FitFields],
) -> Fit:
    """Return the fits of many repeats of one experiment, computed as one batch.

    Every array in the `values` of `data` has a leading axis `repeats`; everything else is shared. `free` and
    `by_name` are as in `fit`.

    **Returns** a `Fit` whose arrays have the leading axis. `converged` is False for a repeat that fails or
    has fewer samples than unknowns; it does not affect the others. **Raises** errors as in `fit`.
    """
    return _fit(_asked(scene, free, by_name, "fit_batch"), data, repeats=True)


def _asked(
    scene: Scene | BuiltFor, free: Mapping | Iterable[str], by_name: FitFields, function: str
) -> Asked:
    """Return the checked arguments of a fit with one first guess and without shooting."""
    rest: dict[str, Any] = dict(by_name)
    cutoff, tolerance, most_steps = (
        rest.pop(name, value)
        for name, value in (("cutoff", 1e-6), ("tolerance", 1e-4), ("max_iterations", 50))
    )
    loss, errors, options = rest.pop("loss", None), rest.pop("errors", "sigmas"), rest.pop("options", None)
    settled = as_fit_options(scene, options, rest, function)
    if loss is not None and not isinstance(loss, Loss):
        raise ValueError(f"`loss` is {loss!r}, expected `huber()`, `student_t()`, or None for least squares")
    if errors not in ("sigmas", "runs"):
        raise ValueError(f'`errors` is {errors!r}, expected "sigmas" or "runs"')
    named = free if isinstance(free, Mapping) else tuple(as_names(free))
    control = Control(tolerance, most_steps, cutoff)
    return Asked(as_scene(scene), named, settled, loss or LEAST_SQUARES, control, errors, 1, None)


def _fit(asked: Asked, data: Data, repeats: bool = False) -> Fit:
    scene, data = asked.scene, tuple(data) if isinstance(data, Iterator) else data
    if is_traced((scene, data, asked.control.tolerance, asked.control.cutoff, asked.options)):
        raise DifferentiationModeError(
            "`fit` was called inside jit, vmap or a derivative, but its steps are chosen outside of compiled "
            "code. Call it with known numbers; for many repeats use `fit_batch`, for derivatives of the "
            "fit's objective `log_likelihood`."
        )
    _check_control(asked.control)
    runs = as_runs(scene, data, repeats=repeats)
    _check_noise(runs, asked)
    unknowns = unknowns_of(scene, runs, asked.free, apart=asked.shooting is not None)
    members = None
    if repeats:
        counts = {values.shape[0] for run in runs for values in run.values.values()}
        if len(counts) != 1 or 0 in counts:
            said = "give every channel of every run a leading axis of the same length, one or more"
            raise ValueError(f"the channels hold {sorted(counts)} repeats; {said}")
        members = counts.pop()
    enough = _check_enough(runs, unknowns, repeats)
    if members is None:
        theta = unknowns.first_guesses(asked.guesses)
    else:
        theta = np.broadcast_to(unknowns.guess, (members, unknowns.guess.size))
    if asked.shooting is None:
        problem = Problem(asked, runs, unknowns, members)
    else:
        problem = Piecewise(asked, runs, unknowns)
    found = shot(problem, theta) if isinstance(problem, Piecewise) else minimum(problem, theta)
    # the fit made no step or failed: starts may contradict the constraints when unknowns change
    if problem.failed or not found.steps.all():
        check_starts(scene, runs, unknowns)
    same = np.zeros(members, int) if members else np.asarray(found.agreeing(0.05))
    if isinstance(problem, Piecewise):
        problem.keep(int(np.argmin(found.at.cost)))
        problem.asked = replace(
            asked, control=replace(asked.control, cutoff=cutoff_of(problem, asked.control, np.array([0])))
        )
    found = with_memory(problem, found if members else found.lowest())
    found, at_bounds = off_bounds(problem, found)
    found.converged &= enough
    if isinstance(problem, Piecewise):
        found.converged &= problem.closed(np.array([0]))
    return _result(problem, found, at_bounds, same)


def _check_control(control: Control) -> None:
    if not 0 < control.cutoff < 1:
        raise ValueError(
            f"`cutoff` is {control.cutoff!r}, expected a number between 0 and 1: the fraction of the "
            "largest singular value below which others count as zero"
        )
    if not control.tolerance > 0:
        raise ValueError(
            f"`tolerance` is {control.tolerance!r}, expected a number above zero: the step in "
            "sigmas that ends the fit"
        )
    checked_whole(control.most_steps, "`max_iterations`", 0, expected="of steps")


def _check_noise(runs: Sequence[Experiment], asked: Asked) -> None:
    if asked.errors == "runs" and len(runs) < 5:
        raise ValueError(
            'errors="runs" computes standard errors from differences between runs, but there are '
            f'only {len(runs)}; give 5 or more, or errors="sigmas"'
        )
    robust = asked.loss != LEAST_SQUARES
    unknown = in_all_or_none(runs, "sigma", lambda run: run.unknown_sigma)
    if unknown and robust:
        raise ValueError(
            f"sigma of channel `{unknown[0]}` is None, but a robust loss needs the scale of "
            "outliers; give a number"
        )
    coloured = sorted({name for run in runs for name in run.correlation_time})
    if coloured and robust:
        raise ValueError(
            f"the noise of channel `{coloured[0]}` has a correlation time, but a robust loss "
            "assumes independent samples; omit one of them"
        )
    in_all_or_none(runs, "the correlation time", lambda run: run.unknown_correlation)


def _check_enough(runs: Sequence[Experiment], unknowns: Unknowns, repeats: bool) -> np.ndarray:
    """Return which repeats have at least as many measured values as unknowns. Raises ValueError if
    none has.
    """
    known = [
        np.isfinite(values) & np.isfinite(run.sigma_of(name, repeats))
        for run in runs
        for name, values in run.values.items()
    ]
    counts = [one.reshape(*one.shape[: int(repeats)], -1).sum(axis=-1) for one in known]
    each = sum(counts) + np.count_nonzero(unknowns.prior_weight)
    sigmas = len({name for run in runs for name in run.unknown_sigma})
    samples = int(np.max(each))
    if samples < len(unknowns.labels) + sigmas:
        and_sigmas = f" and {sigmas} sigmas" if sigmas else ""
        raise ValueError(
            f"{samples} measured values cannot determine {len(unknowns.labels)} unknowns{and_sigmas}; "
            f"measure more, or free fewer of {', '.join(unknowns.labels)}"
        )
    return np.asarray(each >= len(unknowns.labels) + sigmas)


def _result(problem: Problem, found: Minimum, at_bounds: AtBounds, agreeing: np.ndarray) -> Fit:
    places, one = problem.unknowns.estimated, problem.one
    told = Fit(
        values=one(found.theta[:, places]),
        beyond=one(at_bounds.beyond[:, places]),
        converged=one(found.converged),
        stuck=one(found.stuck),
        steps=one(found.steps),
        grown=one(found.grown),
        agreeing=agreeing,
        shooting=problem.told() if isinstance(problem, Piecewise) else None,
        trace=found.trace[0] if problem.single else (),
        asked=problem.asked,
        unknowns=problem.unknowns,
        work_out=partial(statistics, problem, found, at_bounds),
    )
    if problem.with_memory:  # statistics need motions: compute them in the present context
        told.statistics  # noqa: B018
    return told
