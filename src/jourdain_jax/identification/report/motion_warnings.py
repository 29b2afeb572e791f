"""Warnings of fitted motions: events before the last sample, missed observed events, and jumps of loads."""

from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from jourdain_jax.identification.data.channels import LATEST, StopEvent
from jourdain_jax.identification.solve.problem import Problem
from jourdain_jax.identification.solve.run_residuals import run_of
from jourdain_jax.integrate.inputs import as_inputs
from jourdain_jax.integrate.own_steps import moving_jumps
from jourdain_jax.motion.model import modelled
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.names import Sentences
from jourdain_jax.scene.scene import Scene


def events_met(problem: Problem, theta: Float[np.ndarray, "places"]) -> Sentences:
    """Return one sentence for each run whose motion, with these unknowns, meets an event before its last
    sample, misses the observed event, or crosses a jump of its loads.
    """
    shared, local = problem.unknowns.split(theta)
    found, layout, options = [], problem.unknowns.layout, problem.asked.options
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
