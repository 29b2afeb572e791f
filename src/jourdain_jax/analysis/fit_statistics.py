"""What follows from the minimum that a fit found: standard errors and intervals, residuals by channel, the fitted scene.

interval      estimate -+ q e,  within the bounds      e: standard error, q: quantile (see `spread`); at a bound: up to a limit by profile likelihood
freedom       samples - rank + tr(C P)       what the samples determined is less than the rank by what priors tell; P: their information, C: covariance

What fitted motions pass on their way: stop events before samples (a disc that has fallen), or none where one was observed, and jumps of loads.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jourdain_jax.analysis.information import Information, variances
from jourdain_jax.analysis.levenberg_marquardt import Control, Limits, Minimum
from jourdain_jax.analysis.likelihood import oddities
from jourdain_jax.analysis.problem import Problem
from jourdain_jax.analysis.quantities import LATEST, StopEvent
from jourdain_jax.analysis.runs import run_of
from jourdain_jax.analysis.spread import Around, AtBounds, moved_from_bounds, spread, too_narrow_near_bounds
from jourdain_jax.analysis.unknowns import Unknowns
from jourdain_jax.motion.inputs import as_inputs
from jourdain_jax.motion.options import AllOptions
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.motion.vector_fields.choice import vector_field
from jourdain_jax.motion.watched import moving_jumps
from jourdain_jax.scene.scene import Scene


def events_met(problem: Problem, theta: Float[np.ndarray, "places"], options: AllOptions) -> tuple[str, ...]:
    """One sentence for each run whose motion, with these unknowns, meets an event before a sample that counts, or not the one that was observed, or crosses
    a jump of its loads.
    """
    shared, local = problem.unknowns.split(theta)
    found, layout = [], problem.unknowns.layout
    for index, run in enumerate(problem.runs):
        one = run_of(run).at(layout, shared, local[index])
        scene = layout.scene(problem.scene, shared)
        motion = partial(one.motion, scene, simulate, options=options)
        jumps = moving_jumps(vector_field(scene, work=False), scene, as_inputs(scene, None), True)
        if jumps and one.motion(scene, simulate, one.ts, replace(options, events=False)).crossings:
            found.append(
                f"the motion of run {index} crosses relations (`<`, `sign`, ...) at which loads jump: the slopes that are fitted by leave out how the times of "
                "jumps move, and so do standard errors; let loads change within a short time or length"
            )
        if type(scene).events is Scene.events:
            continue
        if run.ended_by:
            if np.any(one.weights[run.ended_by] > 0) and not np.isfinite(one.stops(StopEvent(run.ended_by), run.ended_by, motion)):
                found.append(f"the motion of run {index} does not meet `{run.ended_by}` before {LATEST:g} times the observed time; start nearer")
            continue
        motion = motion(one.ts)
        late = np.asarray(one.ts) > float(motion.t_end)
        samples = sum(int(np.count_nonzero(weight[late])) for weight in one.weights.values())
        if motion.event >= 0 and samples:
            event = f"its event `{motion.event_names[int(motion.event)]}` at {float(motion.t_end):.4g} s"
            found.append(
                f"the motion of run {index} meets {event}, before {samples} of its samples: it is fitted as if it went on; leave these out, or give "
                "the time at which it was observed, in `events`"
            )
    return tuple(found)


PerRepeat = Float[np.ndarray, "*repeats"]
PerUnknown = Float[np.ndarray, "*repeats unknowns"]
@dataclass(frozen=True, eq=False)
class Statistics:
    """All that is told of a minimum besides where it lies."""

    scene: Scene  # with the estimates
    starts: tuple[dict[str, Float[Array | np.ndarray, "..."]], ...]  # initial values of each run, with the estimates
    sizes: PerUnknown  # magnitudes of the unknowns, against which the rank is judged
    standard_errors: PerUnknown  # NaN where not identifiable
    low: PerUnknown  # ends of the 95 % intervals; NaN where not identifiable
    high: PerUnknown
    at_bound: Bool[np.ndarray, "*repeats unknowns"]  # these have no standard error, and a one-sided interval
    quantiles: PerUnknown  # q
    information: Information  # covariance in blocks, and the directions that do not show
    residuals: tuple[dict[str, Float[np.ndarray, "..."]], ...]  # of each run by channel: (prediction - value) / sigma; NaN where missing
    whitened: tuple[dict[str, Float[np.ndarray, "..."]], ...]  # residuals, where their noise has a memory less what the sample before foretells
    sigma: dict[str, PerRepeat]  # of channels whose noise was estimated
    correlation_time: dict[str, PerRepeat]  # s, of channels where they were estimated; near zero: white
    untold: tuple[str, ...]  # channels that do not tell their sigma, in any repeat
    chi_square: PerRepeat  # sum of squared whitened residuals; NaN where the motion fails
    samples: Int[np.ndarray, "*repeats"]  # with a finite sigma
    degrees_of_freedom: PerRepeat  # samples less the directions that they determined; priors take their share
    of_rise: PerUnknown  # by what 2 (F - F_min) is to be divided, for an interval that ends where it is `RISE_95`
    from_prior: PerUnknown  # in standard deviations of the prior; NaN where there is none
    oddities: tuple[str, ...]  # sentences about what is odd in the runs
    events_met: tuple[str, ...]  # sentences about events before the end of a run, or not met; none in a batch, and where runs were fitted in pieces
    too_narrow: tuple[str, ...]  # sentences about intervals that bounds make too narrow; none in a batch


@np.errstate(over="ignore", invalid="ignore")  # of unknowns that no bound kept from growing beyond all measure
def statistics(problem: Problem, found: Minimum, limits: Limits, control: Control, errors: str, at_bounds: AtBounds, options: AllOptions | None) -> Statistics:
    """Statistics of the minimum of each member; without the axis of members where the problem has none.

    `options`: for the motions whose events are looked at; None: they are not.
    """
    unknowns, theta, single = problem.unknowns, found.theta, problem.single
    one = (lambda x: np.asarray(x[0])) if single else (lambda x: x)
    places, size, fails = unknowns.estimated, unknowns.sizes(theta), ~np.isfinite(found.at.cost)
    here = lambda x: one(x[:, places])  # noqa: E731
    low, high = limits.low[places], limits.high[places]
    bound = (theta <= limits.low) | (theta >= limits.high)
    limit = here(at_bounds.limit)
    about = spread(problem, found, bound, limits, control, errors)
    levels, known, reach = about.levels, about.known.only() if single else about.known, one(about.quantiles * about.known.standard_errors)
    residuals = tuple(problem.by_channel(run, levels.at, one) for run in range(len(problem.runs)))
    white = tuple(problem.by_channel(run, levels.at, one, white=True) for run in range(len(problem.runs)))
    over = lambda r: tuple(range(0 if single else 1, r.ndim))  # noqa: E731
    samples = sum(np.sum(np.isfinite(r), axis=over(r)) for run in residuals for r in run.values())
    determined = np.where(fails, 0.0, _determined(levels.known, unknowns))

    too_narrow = []
    if single and found.converged[0]:
        too_narrow = moved_from_bounds(at_bounds, theta[0], reach, places, unknowns.labels)
        if errors == "sigmas":
            too_narrow += too_narrow_near_bounds(Around(problem.linearised, found, limits, control), at_bounds, about.rise.errors[0], unknowns.labels)
    values = here(theta)
    shared, local = unknowns.split(theta)
    scene = unknowns.layout.scene(problem.scene, one(shared))
    if not single:
        scene = jax.tree.map(lambda x, own: jnp.asarray(x if x is not own else np.broadcast_to(own, (len(theta), *own.shape))), scene, problem.scene)
    return Statistics(
        scene=scene,
        starts=tuple(unknowns.layout.start(run.start, one(local[:, i])) for i, run in enumerate(problem.runs)),
        sizes=here(size),
        standard_errors=known.standard_errors,
        low=np.where(values <= low, low, np.where(values >= high, limit, np.maximum(values - reach, low))),
        high=np.where(values >= high, high, np.where(values <= low, limit, np.minimum(values + reach, high))),
        at_bound=here(bound),
        quantiles=one(about.quantiles),
        information=known,
        residuals=residuals,
        whitened=white,
        sigma={name: one(levels.at.sigma[:, k]) for k, name in enumerate(problem.estimated)},
        correlation_time={name: one(problem.tau[:, k]) for k, name in enumerate(problem.with_memory)},
        untold=tuple(name for name, wrong in zip(problem.estimated, levels.untold.T, strict=True) if wrong.any()),
        chi_square=np.where(one(fails), np.nan, sum(np.nansum(r**2, axis=over(r)) for run in white for r in run.values())),
        samples=np.asarray(samples),
        degrees_of_freedom=np.asarray(samples - one(determined)),
        of_rise=one(np.where(bound[:, places], at_bounds.if_free.of_rise[:, places], about.rise.of_rise)),
        from_prior=(values - unknowns.prior_mean[places]) / unknowns.prior_sigma[places],
        oddities=oddities(problem.scene, problem.runs, not single),
        events_met=() if options is None else events_met(problem, theta[0], options),
        too_narrow=tuple(too_narrow),
    )


def _determined(known: Information, unknowns: Unknowns) -> Float[np.ndarray, "members"]:
    """How many unknowns the samples determined: rank - tr(C P)."""
    q, p = known.shared.shape[-1], len(unknowns.whitening)
    M, weight = np.eye(q), np.where(np.isfinite(unknowns.prior_mean), 1 / unknowns.prior_sigma, 0.0)
    M[:p, :p] = unknowns.whitening
    rows = M * weight[:q]
    of_shared = np.einsum("ij,bjk,ik->b", rows, known.shared, rows)
    return known.rank - of_shared - variances(known.shared, known.own, known.follow)[:, q:] @ weight[q:] ** 2
