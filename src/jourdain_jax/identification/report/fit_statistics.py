"""Statistics of a minimum: standard errors, intervals, residuals, the fitted scene.

    interval      estimate -+ q e, within the bounds; at a bound: up to a limit by profile likelihood
    freedom       samples - rank + tr(C P)

e: standard error; q: quantile (see `spread`); P: information of priors; C: covariance.

`events_met` warns of fitted motions with events before the last sample, missed observed events, or jumps of
loads.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jourdain_jax.calculus.reals import Entries
from jourdain_jax.identification.data.channels import LATEST, StopEvent
from jourdain_jax.identification.data.run_preparation import oddities
from jourdain_jax.identification.inference.bound_limits import (
    AtBounds,
    moved_from_bounds,
    too_narrow_near_bounds,
)
from jourdain_jax.identification.inference.information import Information, variances
from jourdain_jax.identification.inference.standard_errors import spread
from jourdain_jax.identification.solve.levenberg_marquardt import Minimum
from jourdain_jax.identification.solve.problem import Problem
from jourdain_jax.identification.solve.shooting import run_of
from jourdain_jax.identification.solve.unknowns import Unknowns
from jourdain_jax.integrate.inputs import as_inputs
from jourdain_jax.integrate.own_steps import moving_jumps
from jourdain_jax.motion.model import modelled
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.coordinates import Sentences
from jourdain_jax.scene.scene import Scene


def events_met(problem: Problem, theta: Float[np.ndarray, "places"]) -> Sentences:
    """Return one sentence for each run whose motion, with these unknowns, meets an event before its last
    sample, misses the observed event, or crosses a jump of its loads.
    """
    shared, local = problem.unknowns.split(theta)
    found, layout = [], problem.unknowns.layout
    options = replace(problem.asked.options, tried=True)
    for index, run in enumerate(problem.runs):
        one = run_of(run).at(layout, shared, local[index])
        scene = layout.scene(problem.scene, shared)
        motion = partial(one.motion, scene, simulate, options=options)
        jumps = partial(moving_jumps, modelled(scene).field(work=False), scene, as_inputs(scene, None), True)
        if (
            jumps(False)
            and (met := int(one.motion(scene, simulate, one.ts, replace(options, events=False)).crossings))
            and jumps(met > 0)
        ):
            found.append(
                f"the motion of run {index} crosses relations (`<`, `sign`, ...) at which loads jump: "
                "derivatives and standard errors omit the shift of jump times; make the jumps gradual"
            )
        if type(scene).events is Scene.events:
            continue
        if run.ended_by:
            if np.any(one.weights[run.ended_by] > 0) and not np.isfinite(
                one.stops(StopEvent(run.ended_by), run.ended_by, motion)
            ):
                found.append(
                    f"the motion of run {index} does not reach `{run.ended_by}` before {LATEST:g} times the "
                    "observed time; use a closer first guess"
                )
            continue
        motion = motion(one.ts)
        late = np.asarray(one.ts) > float(motion.t_end)
        samples = sum(int(np.count_nonzero(weight[late])) for weight in one.weights.values())
        if motion.event >= 0 and samples:
            event = f"its event `{motion.event_names[int(motion.event)]}` at {float(motion.t_end):.4g} s"
            found.append(
                f"the motion of run {index} meets {event}, before {samples} of its samples: it is fitted as "
                "if it continued; omit these, or give the observed time of the event in `events`"
            )
    return tuple(found)


Counts = Int[np.ndarray, "*repeats"]
PerRepeat = Float[np.ndarray, "*repeats"]
PerUnknown = Float[np.ndarray, "*repeats unknowns"]


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of a minimum."""

    scene: Scene  # with the estimates
    starts: tuple[dict[str, Float[Entries, "..."]], ...]  # initial values of each run, with the estimates
    sizes: PerUnknown  # magnitudes of the unknowns, which scale the Jacobian for its rank
    standard_errors: PerUnknown  # NaN if not identifiable
    low: PerUnknown  # ends of the 95 % intervals; NaN if not identifiable
    high: PerUnknown
    at_bound: Bool[np.ndarray, "*repeats unknowns"]  # they have a one-sided interval, no standard error
    quantiles: PerUnknown  # q
    information: Information  # covariance in blocks, and undetermined directions
    # (prediction - value) / sigma of each run by channel; NaN if missing
    residuals: tuple[dict[str, Float[np.ndarray, "..."]], ...]
    # residuals; for correlated noise, minus their prediction from the previous sample
    whitened: tuple[dict[str, Float[np.ndarray, "..."]], ...]
    sigma: dict[str, PerRepeat]  # of channels with estimated noise
    correlation_time: dict[str, PerRepeat]  # s, of channels with an estimate; near zero: white
    untold: Sentences  # channels that do not determine their sigma, in any repeat
    chi_square: PerRepeat  # sum of squared whitened residuals; NaN if the motion fails
    samples: Counts  # with a finite sigma
    degrees_of_freedom: PerRepeat  # samples minus the directions that they determine; priors reduce these
    of_rise: PerUnknown  # divisor of 2 (F - F_min), for an interval that ends where it is `RISE_95`
    from_prior: PerUnknown  # distance in standard deviations of the prior; zero without a prior
    oddities: Sentences  # sentences about probable mistakes in the data
    # sentences about events before the end of a run, and missed events; empty for a batch or multiple
    # shooting
    events_met: Sentences
    too_narrow: Sentences  # sentences about intervals that bounds make too narrow; empty for a batch


@np.errstate(over="ignore", invalid="ignore")  # unbounded unknowns may be enormous
def statistics(problem: Problem, found: Minimum, at_bounds: AtBounds) -> Statistics:
    """Return the statistics of the minimum."""
    unknowns, theta, single, one = problem.unknowns, found.theta, problem.single, problem.one
    places, size, fails = unknowns.estimated, unknowns.sizes(theta), ~np.isfinite(found.at.cost)
    here = lambda x: one(x[:, places])
    low, high, bound = unknowns.low[places], unknowns.high[places], unknowns.reached(theta)
    limit = here(at_bounds.limit)
    about = spread(problem, found, bound)
    levels = about.levels
    known = about.known.only() if single else about.known
    reach = one(about.quantiles * about.known.standard_errors)
    residuals, white = (
        tuple(
            {name: one(r) for name, r in problem.by_channel(run, levels.at, flag).items()}
            for run in range(len(problem.runs))
        )
        for flag in (False, True)
    )
    over = lambda r: tuple(range(0 if single else 1, r.ndim))
    samples = sum(np.sum(np.isfinite(r), axis=over(r)) for run in residuals for r in run.values())
    determined = np.where(fails, 0.0, _determined(levels.known, unknowns))

    too_narrow = []
    if single and found.converged[0]:
        too_narrow = moved_from_bounds(at_bounds, theta[0], reach, places, unknowns.labels)
        if problem.asked.errors == "sigmas":
            too_narrow += too_narrow_near_bounds(problem, found, at_bounds, about.rise.errors[0])
    values = here(theta)
    shared, local = unknowns.split(theta)
    scene = unknowns.layout.scene(problem.scene, one(shared))
    if not single:
        scene = jax.tree.map(
            lambda x, own: jnp.asarray(x if x is not own else np.broadcast_to(own, (len(theta), *own.shape))),
            scene,
            problem.scene,
        )
    return Statistics(
        scene=scene,
        starts=tuple(
            unknowns.layout.start(run.start, one(shared), one(local[:, i]))
            for i, run in enumerate(problem.runs)
        ),
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
        untold=tuple(
            name for name, wrong in zip(problem.estimated, levels.untold.T, strict=True) if wrong.any()
        ),
        chi_square=np.where(
            one(fails), np.nan, sum(np.nansum(r**2, axis=over(r)) for run in white for r in run.values())
        ),
        samples=np.asarray(samples),
        degrees_of_freedom=np.asarray(samples - one(determined)),
        of_rise=one(np.where(bound[:, places], at_bounds.if_free.of_rise[:, places], about.rise.of_rise)),
        from_prior=(values - unknowns.prior_mean[places]) * unknowns.prior_weight[places],
        oddities=oddities(problem.scene, problem.runs, not single),
        events_met=events_met(problem, theta[0]) if single and problem.asked.shooting is None else (),
        too_narrow=tuple(too_narrow),
    )


def _determined(known: Information, unknowns: Unknowns) -> Float[np.ndarray, "members"]:
    """Return the number of unknowns determined by the samples: rank - tr(C P)."""
    p, weight = len(unknowns.whitening), unknowns.prior_weight
    rows = unknowns.whitening * weight[:p]
    of_shared = np.einsum("ij,bjk,ik->b", rows, known.shared, rows)
    return known.rank - of_shared - variances(known.shared, known.own, known.follow)[:, p:] @ weight[p:] ** 2
