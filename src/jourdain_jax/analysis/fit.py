"""Identification: parameters and initial values of a scene from measured motions, by nonlinear least squares.

    minimise sum r(theta)^2,   r = (prediction - value) / sigma,   theta within its bounds

by Levenberg-Marquardt. Jacobians come by forward mode through the simulation, run by run; initial values of the runs are eliminated run by run.
Source: D. W. Marquardt, SIAM J. Appl. Math. 11 (1963) 431; G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989), chapter 3.
"""

from collections.abc import Iterable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.analysis.arrow import arrow, triangle
from jourdain_jax.analysis.fit_result import Fit
from jourdain_jax.analysis.information import information
from jourdain_jax.analysis.levenberg_marquardt import Control, Limits, Linearised, Minimum, minimise
from jourdain_jax.analysis.likelihood import as_runs
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

_NORMAL_95 = 1.959963984540054  # 97.5 % quantile of the standard normal distribution


def fit(
    scene: Scene | BuiltFor,
    data: Measurements | Sequence[Measurements],
    free: "Mapping[str, Range | None] | Iterable[str]" = (),
    *,
    cutoff: float = 1e-6,
    tolerance: float = 1e-4,
    max_iterations: int = 50,
    **simulation,
) -> Fit:
    """Estimate the `free` parameters of a scene, and unknown initial values of its runs, from measurements.

    **Arguments**
    - `scene`: its parameters are fixed, or first guesses where they are free.
    - `data`: one run or several, each with its own times, channels, start and inputs.
    - `free`: parameter names, or name -> `bounds(low, high)`, `positive()`, `unbounded()` or None (positive where the parameter
      is declared so).
    - `cutoff`: singular values of the scaled Jacobian below this fraction of the largest count as zero (`Information`). Keep it
      well above the relative accuracy of the simulation.
    - `tolerance`: the fit has converged when a step changes no residual by more than about this many sigmas, and no unknown by
      more than about this fraction. `max_iterations`: steps tried at most.
    - `simulation`: options of `simulate` such as `rtol`, `atol`, `solver`, `max_steps`. Stop events are ignored.

    **Returns** a `Fit`: estimates with covariance and 95 % intervals (the sigmas are taken as known), residuals, the fitted
    scene, and in words what the measurements cannot tell. `converged` is False where no minimum was found.

    **Raises** ValueError for names, shapes or numbers that do not fit, no or too many unknowns, and a start that contradicts the
    constraints.

    **Examples**

        truth, start, ts = jj.models.ChaplyginSleigh(offset=0.25), {"x_rate": 0.6, "heading_rate": 0.9}, jnp.linspace(0.0, 2.0, 21)
        motion = jj.simulate(truth, start, ts=ts)
        data = jj.Measurements(ts, {"x": motion["x"], "heading": motion["heading"]}, 0.01, start=start)       # sigma: 0.01 m, 0.01 rad
        found = jj.fit(jj.models.ChaplyginSleigh(), data, free={"offset": jj.bounds(0.05, 1.0)})
        print(found)                                              # estimates with 95 % intervals, and what the data cannot tell
        found["offset"].value, found.scene.offset                 # near 0.25 m
    """
    return _fit(scene, data, free, simulation, Control(tolerance, max_iterations, cutoff), repeats=False)


def fit_batch(
    scene: Scene | BuiltFor,
    data: Measurements | Sequence[Measurements],
    free: "Mapping[str, Range | None] | Iterable[str]" = (),
    *,
    cutoff: float = 1e-6,
    tolerance: float = 1e-4,
    max_iterations: int = 50,
    **simulation,
) -> Fit:
    """`fit` for many repeats of the same experiment, as one batch.

    Every array in the `values` of `data` has a leading axis `repeats`; all else is shared. `free`, `cutoff`, `tolerance`, `max_iterations` and
    `simulation` as in `fit`. **Returns** a `Fit` whose arrays have the leading axis; a repeat that fails has `converged` False and harms no other.
    **Raises** as `fit`.
    """
    return _fit(scene, data, free, simulation, Control(tolerance, max_iterations, cutoff), repeats=True)


def _fit(scene, data, free, simulation: dict, control: Control, repeats: bool) -> Fit:
    scene = as_scene(scene)
    if is_traced((scene, data, control.tolerance, control.cutoff, simulation)):
        raise DifferentiationModeError(
            "`fit` was called inside jit, vmap or a derivative, but its steps are chosen outside of compiled code. Call it with known numbers; "
            "for many repeats use `fit_batch`, for derivatives of the fit's objective `log_likelihood`."
        )
    runs = as_runs(scene, data, repeats=repeats)
    unknowns = unknowns_of(scene, runs, free)
    with reference_parameters(scene):
        check_starts(scene, runs, unknowns)
        members = _repeats(runs) if repeats else None
        _check_enough(runs, unknowns, repeats)
        problem = _Problem(scene, runs, unknowns, Lanes(scene, runs, unknowns.layout, simulation, members))
        theta = np.broadcast_to(unknowns.guess, (members or 1, unknowns.guess.size))
        limits = Limits(*unknowns.ends, unknowns.fixed, unknowns.sizes)
        return _result(problem, minimise(problem.linearised, theta, limits, control), limits, control)


def _repeats(runs: Sequence[Measurements]) -> int:
    counts = {values.shape[0] for run in runs for values in run.values.values()}
    if len(counts) != 1 or 0 in counts:
        raise ValueError(f"the channels hold {sorted(counts)} repeats; give every channel of every run the same leading axis, of one or more")
    return counts.pop()


def _check_enough(runs: Sequence[Measurements], unknowns: Unknowns, repeats: bool) -> None:
    samples = sum(int(np.prod(values.shape[int(repeats) :])) for run in runs for values in run.values.values())
    if samples < len(unknowns.labels):
        raise ValueError(
            f"{samples} measured values cannot determine {len(unknowns.labels)} unknowns; measure more, or free fewer of {', '.join(unknowns.labels)}"
        )


class _Problem:
    """Residuals with their derivatives, of any members at any numbers."""

    def __init__(self, scene: Scene, runs: tuple[Measurements, ...], unknowns: Unknowns, lanes: Lanes):
        self.scene, self.runs, self.unknowns, self.lanes = scene, runs, unknowns, lanes

    def linearised(self, theta: np.ndarray, members: np.ndarray) -> Linearised:
        """Half the sum of squares with its arrow, of some members."""
        shared, local = self.unknowns.split(theta)
        (_, runs, m), p = local.shape, shared.shape[1]
        triangles, costs = np.empty((len(theta), runs, m + p + 1, m + p + 1)), np.zeros(len(theta))
        residual = np.empty((len(theta), runs), object)
        for b, j, r, J in self.lanes.evaluate(shared, local, members):
            with np.errstate(over="ignore", invalid="ignore"):
                triangles[b, j] = triangle(r, J)
                np.add.at(costs, b, 0.5 * np.sum(r**2, axis=1))
            for place, one in zip(zip(b, j, strict=True), r, strict=True):
                residual[place] = one
            if len(theta) == 1 and not np.all(np.isfinite(triangles[b, j])):  # whatever the other runs say
                triangles.fill(np.nan)
                break
        finite = np.isfinite(triangles).all(axis=(1, 2, 3)) & np.isfinite(costs)
        return Linearised(np.where(finite, costs, np.inf), arrow(np.where(finite[:, None, None, None], triangles, 0.0), m), residual)


def _result(problem: _Problem, found: Minimum, limits: Limits, control: Control) -> Fit:
    unknowns, theta, single = problem.unknowns, found.theta, problem.lanes.members is None
    one = (lambda x: np.asarray(x[0])) if single else (lambda x: x)
    places, size, fails = unknowns.estimated, unknowns.sizes(theta), ~np.isfinite(found.at.cost)
    low, high = limits.low[places], limits.high[places]
    bound = (theta <= limits.low) | (theta >= limits.high)
    limit, beyond = (one(x[:, places]) for x in limits_at_bounds(problem.linearised, found, limits, control))
    known = information(found.at.arrow, size, places, bound, fails, control.cutoff, single)
    reach = _NORMAL_95 * known.standard_errors
    values = one(theta[:, places])
    shared, local = unknowns.split(theta)
    scene = unknowns.layout.scene(problem.scene, jnp.asarray(one(shared)))
    if not single:
        scene = jax.tree.map(lambda x, own: x if x is not own else jnp.broadcast_to(own, (len(theta), *own.shape)), scene, problem.scene)
    starts = tuple(unknowns.layout.start(run.start, one(local[:, i])) for i, run in enumerate(problem.runs))
    residuals = tuple(problem.lanes.by_channel(i, one(_stacked(found.at.residual[:, i]))) for i in range(len(problem.runs)))
    return Fit(
        scene=scene,
        starts=starts,
        values=values,
        sizes=one(size[:, places]),
        standard_errors=known.standard_errors,
        low=np.where(values <= low, low, np.where(values >= high, limit, np.maximum(values - reach, low))),
        high=np.where(values >= high, high, np.where(values <= low, limit, np.minimum(values + reach, high))),
        at_bound=one(bound[:, places]),
        beyond=beyond,
        information=known,
        residuals=residuals,
        chi_square=one(np.where(fails, np.nan, 2 * found.at.cost)),
        samples=np.asarray(sum(np.sum(np.isfinite(r), axis=tuple(range(0 if single else 1, r.ndim))) for run in residuals for r in run.values())),
        converged=one(found.converged),
        stuck=one(found.stuck),
        steps=one(found.steps),
        labels=unknowns.labels,
        units=unknowns.units,
        cutoff=control.cutoff,
    )


def _stacked(residuals: np.ndarray) -> np.ndarray:
    """Residuals of a run, of all members; NaN where they were not worked out, since another run had failed."""
    length = max((len(r) for r in residuals if r is not None), default=None)
    return np.stack([np.full(length or 0, np.nan) if r is None else r for r in residuals])
