"""Identification: parameters and initial values of a scene from measured motions, by nonlinear least squares.

    minimise sum r(theta)^2,   r = (prediction - value) / sigma,   theta = theta(z) within its bounds

by Levenberg-Marquardt in z. The Jacobian comes by forward mode through the simulation, once per step and as a matrix.
Source: D. W. Marquardt, SIAM J. Appl. Math. 11 (1963) 431; G. A. F. Seber and C. J. Wild, Nonlinear Regression (1989), chapter 3.
"""

import math
from collections.abc import Iterable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.bijections import Bijection
from jourdain_jax.analysis.fit_result import Fit
from jourdain_jax.analysis.information import information
from jourdain_jax.analysis.least_squares import LeastSquaresSolution, least_squares
from jourdain_jax.analysis.likelihood import as_runs, residuals
from jourdain_jax.analysis.measurements import Measurements
from jourdain_jax.analysis.unknowns import Unknowns, check_starts, unknowns_of
from jourdain_jax.build.reference_parameters import reference_parameters
from jourdain_jax.motion.integrators.forward_mode import simulate_forward
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.scene import Scene

_NORMAL_95 = 1.959963984540054  # 97.5 % quantile of the standard normal distribution


def fit(
    scene: Scene | BuiltFor,
    data: Measurements | Sequence[Measurements],
    free: "Mapping[str, Bijection | None] | Iterable[str]" = (),
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
    scene = as_scene(scene)
    problem = _problem(scene, data, free, repeats=False)
    with reference_parameters(scene):
        return _fit(problem, problem.measured(), simulation, cutoff, tolerance, max_iterations)


def fit_batch(
    scene: Scene | BuiltFor,
    data: Measurements | Sequence[Measurements],
    free: "Mapping[str, Bijection | None] | Iterable[str]" = (),
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
    scene = as_scene(scene)
    problem = _problem(scene, data, free, repeats=True)
    counts = {values.shape[0] for run in problem.measured() for values in run.values()}
    if len(counts) != 1 or 0 in counts:
        raise ValueError(f"the channels hold {sorted(counts)} repeats; give every channel of every run the same leading axis, of one or more")
    with reference_parameters(scene):
        return _fit_batch(problem, problem.measured(), simulation, cutoff, tolerance, max_iterations)


class _Problem(eqx.Module):
    scene: Scene
    runs: tuple[Measurements, ...]
    unknowns: Unknowns

    def measured(self) -> tuple[dict[str, Array], ...]:
        return tuple(run.values for run in self.runs)

    def with_measured(self, values: tuple[dict[str, Array], ...]) -> "_Problem":
        return eqx.tree_at(lambda p: tuple(run.values for run in p.runs), self, values)

    def residuals(self, z, simulation) -> list[dict[str, Array]]:
        scene, runs = self.unknowns.put_into(self.scene, self.runs, self.unknowns.values(z))
        return residuals(scene, runs, simulate_forward, simulation)


def _problem(scene: Scene, data, free, *, repeats: bool) -> _Problem:
    runs = as_runs(scene, data, repeats=repeats)
    unknowns = unknowns_of(scene, runs, free)
    check_starts(scene, runs, unknowns)
    samples = sum(math.prod(values.shape[int(repeats) :]) for run in runs for values in run.values.values())
    if samples < len(unknowns.labels):
        raise ValueError(
            f"{samples} measured values cannot determine {len(unknowns.labels)} unknowns; measure more, or free fewer of {', '.join(unknowns.labels)}"
        )
    return _Problem(scene, runs, unknowns)


@eqx.filter_jit
def _fit_batch(problem: _Problem, values, simulation, cutoff, tolerance, max_iterations) -> Fit:
    return eqx.filter_vmap(lambda v: _fit(problem, v, simulation, cutoff, tolerance, max_iterations))(values)


@eqx.filter_jit
def _fit(problem: _Problem, values, simulation, cutoff, tolerance, max_iterations) -> Fit:
    problem = problem.with_measured(values)
    numbers, rest = eqx.partition(problem, eqx.is_array)

    def flat_residuals(z, numbers):
        return jnp.concatenate([jnp.ravel(r) for r in jax.tree.leaves(eqx.combine(numbers, rest).residuals(z, simulation))])

    solution = least_squares(flat_residuals, problem.unknowns.first_guess(), numbers, tolerance=tolerance, max_steps=max_iterations)
    return _result(problem, solution, cutoff)


def _result(problem: _Problem, solution: LeastSquaresSolution, cutoff: float) -> Fit:
    unknowns, z, J = problem.unknowns, solution.z, solution.jacobian
    theta, slope = jax.jvp(unknowns.values, (z,), (jnp.ones_like(z),))
    bound, moves = unknowns.at_bound(theta), slope != 0
    # d r / d theta = (d r / dz) / (d theta / dz)
    known = information(jnp.where(moves, J / jnp.where(moves, slope, 1.0), 0.0), unknowns.sizes(theta), cutoff)
    error = jnp.sqrt(jnp.diagonal(known.covariance))
    reach = _NORMAL_95 * error / jnp.where(moves & ~bound, slope, jnp.nan)
    ends = jnp.sort(jnp.stack([unknowns.values(z - reach), unknowns.values(z + reach)]), axis=0)
    scene, runs = unknowns.put_into(problem.scene, problem.runs, theta)
    return Fit(
        scene=scene,
        starts=tuple(run.start for run in runs),
        values=theta,
        sizes=unknowns.sizes(theta),
        standard_errors=error,
        low=ends[0],
        high=ends[1],
        at_bound=bound,
        information=known,
        residuals=_by_channel(runs, solution.residual),
        chi_square=jnp.sum(solution.residual**2),
        samples=sum(run.counted() for run in runs),
        converged=solution.converged,
        steps=solution.steps,
        labels=unknowns.labels,
        units=unknowns.units,
        cutoff=cutoff,
    )


def _by_channel(runs: Sequence[Measurements], flat: Float[Array, "samples"]) -> tuple[dict[str, Array], ...]:
    """The flat residuals by run and channel; NaN where a sample is missing."""
    sigmas, structure = jax.tree.flatten(tuple({name: run.sigma_of(name) for name in run.values} for run in runs))
    parts = jnp.split(flat, np.cumsum([sigma.size for sigma in sigmas])[:-1])
    found = [jnp.where(jnp.isfinite(sigma), part.reshape(sigma.shape), jnp.nan) for part, sigma in zip(parts, sigmas, strict=True)]
    return jax.tree.unflatten(structure, found)
