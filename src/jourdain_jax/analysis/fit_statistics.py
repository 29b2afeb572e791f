"""What follows from the minimum that a fit found: standard errors and intervals, residuals by channel, the fitted scene.

interval      estimate -+ q e,  within the bounds      e: standard error, q: 97.5 % quantile of the normal distribution, or Student's t where noise is estimated
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jourdain_jax.analysis.arrow import Arrow
from jourdain_jax.analysis.asked import Asked
from jourdain_jax.analysis.at_bounds import Around, AtBounds, moved_from_bounds, too_narrow_near_bounds
from jourdain_jax.analysis.events_met import events_met
from jourdain_jax.analysis.information import Information, information, students_t_95
from jourdain_jax.analysis.levenberg_marquardt import LEAST, Limits, Minimum
from jourdain_jax.analysis.oddities import oddities
from jourdain_jax.analysis.problem import Problem
from jourdain_jax.scene.scene import Scene

_NORMAL_95 = 1.959963984540054  # 97.5 % quantile of the standard normal distribution
_FEWEST_DEGREES = 4  # of freedom


@dataclass(frozen=True, eq=False)
class Statistics:
    """All that is told of a minimum besides where it lies."""

    scene: Scene
    starts: tuple[dict[str, Float[Array | np.ndarray, "..."]], ...]
    sizes: Float[np.ndarray, "*repeats unknowns"]
    standard_errors: Float[np.ndarray, "*repeats unknowns"]
    low: Float[np.ndarray, "*repeats unknowns"]
    high: Float[np.ndarray, "*repeats unknowns"]
    at_bound: Bool[np.ndarray, "*repeats unknowns"]
    quantiles: Float[np.ndarray, "*repeats unknowns"]  # q
    information: Information
    residuals: tuple[dict[str, Float[np.ndarray, "..."]], ...]
    whitened: tuple[dict[str, Float[np.ndarray, "..."]], ...]
    sigma: dict[str, Float[np.ndarray, "*repeats"]]
    correlation_time: dict[str, Float[np.ndarray, "*repeats"]]
    chi_square: Float[np.ndarray, "*repeats"]
    samples: Int[np.ndarray, "*repeats"]
    from_prior: Float[np.ndarray, "*repeats unknowns"]  # in standard deviations of the prior; NaN where there is none
    oddities: tuple[str, ...]  # sentences about what is odd in the runs
    events_met: tuple[str, ...]  # sentences about events before the end of a run, or not met; none in a batch, and where runs were fitted in pieces
    too_narrow: tuple[str, ...]  # sentences about intervals that bounds make too narrow; none in a batch


@np.errstate(over="ignore", invalid="ignore")  # of unknowns that no bound kept from growing beyond all measure
def statistics(problem: Problem, found: Minimum, limits: Limits, asked: Asked, errors: str, at_bounds: AtBounds) -> Statistics:
    """Statistics of the minimum of each member; without the axis of members where the problem has none."""
    control, unknowns, theta, single = asked.control, problem.unknowns, found.theta, problem.lanes.members is None
    one = (lambda x: np.asarray(x[0])) if single else (lambda x: x)
    places, size, fails = unknowns.estimated, unknowns.sizes(theta), ~np.isfinite(found.at.cost)
    low, high = limits.low[places], limits.high[places]
    bound = (theta <= limits.low) | (theta >= limits.high)
    limit = one(at_bounds.limit[:, places])
    residuals = tuple(problem.by_channel(run, found.at, one) for run in range(len(problem.runs)))
    white = tuple(problem.by_channel(run, found.at, one, white=True) for run in range(len(problem.runs)))
    samples = sum(np.sum(np.isfinite(r), axis=tuple(range(0 if single else 1, r.ndim))) for run in residuals for r in run.values())
    known = information(found.at.arrow, size, places, bound, fails, control.cutoff, single)

    def elsewhere(arrow: Arrow) -> tuple[np.ndarray, np.ndarray]:
        norms = np.where(arrow.column_norms > 0, arrow.column_norms, 1.0)
        moved = arrow.step(np.full(len(theta), LEAST), norms, limits.fixed | bound, np.zeros_like(theta), control.cutoff)
        return information(arrow, size, places, bound, fails, control.cutoff, False).standard_errors, moved[:, places]

    more, doubt = (one(x) for x in problem.doubt(theta, elsewhere))
    quantiles = _normal_or_t(doubt, (samples - known.rank)[..., None] if problem.all_estimated else np.inf) * np.sqrt(1 + more)
    inflation = one(problem.inflation(residuals, samples, known.rank))
    plain, known = known.standard_errors, known.times(inflation)
    if errors == "runs":
        known, quantiles = known.between_runs(one(found.at.arrow.scores)), students_t_95(len(problem.runs) - 1)
    reach = quantiles * known.standard_errors
    too_narrow = []
    if single and found.converged[0]:
        too_narrow = moved_from_bounds(at_bounds, theta[0], reach, places, unknowns.labels)
        if errors == "sigmas":
            too_narrow += too_narrow_near_bounds(Around(problem.linearised, found, limits, control), at_bounds, plain, unknowns.labels)
    values = one(theta[:, places])
    shared, local = unknowns.split(theta)
    scene = unknowns.layout.scene(problem.scene, one(shared))
    if not single:
        scene = jax.tree.map(lambda x, own: jnp.asarray(x if x is not own else np.broadcast_to(own, (len(theta), *own.shape))), scene, problem.scene)
    return Statistics(
        scene=scene,
        starts=tuple(unknowns.layout.start(run.start, one(local[:, i])) for i, run in enumerate(problem.runs)),
        sizes=one(size[:, places]),
        standard_errors=known.standard_errors,
        low=np.where(values <= low, low, np.where(values >= high, limit, np.maximum(values - reach, low))),
        high=np.where(values >= high, high, np.where(values <= low, limit, np.minimum(values + reach, high))),
        at_bound=one(bound[:, places]),
        quantiles=np.broadcast_to(quantiles, reach.shape),
        information=known,
        residuals=residuals,
        whitened=white,
        sigma={name: one(found.at.sigma[:, k]) for k, name in enumerate(problem.estimated)},
        correlation_time={name: one(problem.tau[:, k]) for k, name in enumerate(problem.with_memory)},
        chi_square=np.where(one(fails), np.nan, sum(_sum_of_squares(r, single) for run in white for r in run.values())),
        samples=np.asarray(samples),
        from_prior=(values - unknowns.prior_mean[places]) / unknowns.prior_sigma[places],
        oddities=oddities(problem.scene, problem.runs, not single),
        events_met=events_met(problem, theta[0], asked.simulation) if single and asked.shooting is None else (),
        too_narrow=tuple(too_narrow),
    )


def _normal_or_t(doubt: np.ndarray, left) -> np.ndarray:
    """97.5 % quantile by which a standard error is multiplied: normal where correlation times are known, else Student's t of that standard deviation.

    Its degrees of freedom are 2 / var(log C): F. E. Satterthwaite, Biometrics Bulletin 2 (1946) 110. `left`: samples less unknowns, where sigmas are estimated.
    """
    if not np.any(doubt > 0):
        return np.asarray(_NORMAL_95)
    doubt = np.clip(doubt, 1e-12, 2 / _FEWEST_DEGREES)
    return students_t_95(np.maximum(2 / (doubt + 2 / left), _FEWEST_DEGREES)) * np.sqrt(1 - doubt)  # t has the variance n / (n - 2)


def _sum_of_squares(r: np.ndarray, single: bool) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.asarray(np.nansum(r**2, axis=tuple(range(0 if single else 1, r.ndim))))
