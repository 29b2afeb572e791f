"""How a minimum is looked for: from first guesses, over growing spans where they are far off, in turns with correlation times, and away from bounds."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np

from jourdain_jax.analysis.at_bounds import Around, AtBounds, limits_at_bounds
from jourdain_jax.analysis.levenberg_marquardt import Control, Limits, Minimum
from jourdain_jax.analysis.piecewise import Piecewise
from jourdain_jax.analysis.problem import Problem, Span
from jourdain_jax.analysis.spread import if_free

_POOR = 10.0  # times the sum of squares that noise alone leaves, one for each sample
_SPANS = (1 / 32, 1 / 16, 1 / 8, 3 / 16, 1 / 4, 3 / 8, 1 / 2, 3 / 4)  # shares of the span that a fit grows over
_PATIENCE = 3  # steps within which a fit of whole runs is to make F far smaller, or spans grow
_STEPS, _ROUGHLY = 8, 1.0  # tried on each of them, and their tolerance
_FOLLOWED = 100.0  # times the squares that noise leaves, up to which a motion is followed, and a longer span can be next
_SOME = 12  # steps between two estimates of correlation times
_WHOLE, _WITH_MEMORY = "whole runs", "whole runs, after a turn of correlation times"  # what is minimised
_OFF_BOUND = "whole runs, off a bound"
_TURNS, _SETTLED = 20, 1e-3  # of correlation times and unknowns at most; change of the correlation of neighbouring samples that ends them


def minimum(problem: Problem, theta: np.ndarray, limits: Limits, control: Control, one_will_do: bool) -> Minimum:
    """The minimum from each `theta`; where none is found, or residuals are far beyond their sigmas, the lower one of it and that over growing spans.

    Over a short span a motion depends on its unknowns almost linearly, also an unstable one; each fit begins where that over the shorter span ended, and what
    a short span does not tell stays near the first guess. After a few steps, what is far off gives way to growing spans, and goes on only where these do not
    lead to small residuals either. `one_will_do`: spans grow only where no theta led to a minimum with small residuals.
    """
    samples = problem.samples
    few = replace(control, most_steps=min(_STEPS, control.most_steps), patience=_PATIENCE, near=0.5 * _POOR * samples)
    rest = replace(control, most_steps=control.most_steps - few.most_steps)
    in_parts = samples > 0 and not (one_will_do and len(theta) > 1)
    found = problem.minimum(theta, np.arange(len(theta)), limits, few if in_parts else control, _WHOLE)
    unfinished = ~found.converged & ~found.stuck & in_parts & (rest.most_steps > 0)

    def of(members: np.ndarray, begin: np.ndarray, how: Control, span: Span | None = None) -> Minimum:
        return problem.minimum(begin, members, limits, how, _WHOLE, span)

    def far() -> np.ndarray:
        return found.at.cost > 0.5 * _POOR * samples

    if (near := np.flatnonzero(unfinished & ~far())).size:
        found, unfinished[near] = found.replaced(near, of(near, found.theta[near], rest)), False
    poor = np.flatnonzero(~found.converged | far())
    if not poor.size or not samples or (one_will_do and np.argmin(found.at.cost) not in poor):
        return found
    ended, begin, steps, place = found.theta.copy(), theta[poor], found.steps[poor], np.zeros(len(poor), int)
    trace = found.trace[poor]
    while (some := np.flatnonzero(place < len(_SPANS))).size:
        span = Span(np.array(_SPANS)[place[some]], theta[poor[some]])
        grown = of(poor[some], begin[some], replace(few, tolerance=_ROUGHLY, patience=None), span)
        begin[some], steps[some] = grown.theta, steps[some] + grown.steps
        for i, (_, costs), k in zip(some.tolist(), (of_one[0] for of_one in grown.trace), place[some].tolist(), strict=True):
            trace[i] += ((f"the first {_SPANS[k]:.3g} of each run", costs),)
        place[some] += 1
        followed = problem.is_followed(grown.at, np.array(_SPANS), _FOLLOWED)
        for k in range(1, len(_SPANS)):
            place[some] += (place[some] == k) & followed[:, k]  # the next one is followed, and left out
    grown = of(poor, begin, control)
    steps, trace = steps + grown.steps, trace + grown.trace
    found = found.lowered(poor, replace(grown, steps=steps, trace=trace, grown=np.ones(len(poor), bool)))
    if (late := np.flatnonzero(unfinished & (~found.converged | far()))).size:
        more = of(late, ended[late], rest)
        found = found.lowered(late, replace(more, steps=found.steps[late] + more.steps, trace=found.trace[late] + more.trace))
    return found


def with_memory(problem: Problem, found: Minimum, limits: Limits, control: Control) -> Minimum:
    """The minimum with the correlation times of the noise estimated: these and the unknowns take turns, from what was found as if the noise were white."""
    if not problem.with_memory:
        return found
    going = np.flatnonzero(np.isfinite(found.at.cost))
    some = replace(control, most_steps=min(_SOME, control.most_steps))
    for _ in range(_TURNS):
        if not going.size:
            break
        changed = problem.restrict(found.theta[going], going)
        again = problem.minimum(found.theta[going], going, limits, some, _WITH_MEMORY)
        found = found.replaced(going, again)
        going = going[(changed > _SETTLED) | ~again.converged]
    found.converged[going] = False
    return found


def off_bounds(
    problem: Problem, found: Minimum, limits: Limits, control: Control, pieces: Piecewise | None, errors: str = "sigmas"
) -> tuple[Minimum, AtBounds]:
    """The minimum, gone on from where unknowns at a bound let it be lower away from it; and what is known of those that stay. `errors`: as of `fit`."""
    for _ in range(_TURNS):
        with nullcontext() if pieces is None else pieces.unmoved():
            around = Around(problem.linearised, found, limits, control)
            told = limits_at_bounds(around, if_free(problem, found, around.at_bound, limits, control, errors))
        if not told.lower:
            break
        members = np.array(list(told.lower))
        again = problem.minimum(np.stack([theta for _, theta in told.lower.values()]), members, limits, control, _OFF_BOUND)
        again = replace(again, steps=found.steps[members] + again.steps, trace=found.trace[members] + again.trace, grown=found.grown[members])
        found = with_memory(problem, found.lowered(members, again), limits, control)
    return found, told
