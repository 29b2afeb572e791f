"""What fitted motions pass on their way: stop events before samples (a disc that has fallen), or none where one was observed, and jumps of loads."""

from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.problem import Problem
from jourdain_jax.analysis.runs import run_of
from jourdain_jax.analysis.stop_events import LATEST, StopEvent
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
