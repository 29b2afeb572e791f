"""Running a curve: error and warm time at every setting."""

import time

import jax.numpy as jnp

from work_precision_cases import record as records
from work_precision_cases.curve import Curve, NotApplicable, Solved

SECONDS_PER_POINT = 0.25
MOST_REPEATS, LONGEST = 25, 8.0  # s: after a run as long as that, smaller settings are left out


def fastest(run, seconds=SECONDS_PER_POINT):
    """Wall time of the fastest of some warm runs, s: as many as fit in `seconds`, at least two, at most 25;
    one where a run takes longer than that.
    """
    laps = []
    while (len(laps) < MOST_REPEATS and sum(laps) < seconds) or (len(laps) < 2 and laps[0] < seconds):
        begin = time.perf_counter()
        run()
        laps.append(time.perf_counter() - begin)
    return min(laps)


def error_of(problem, solved: Solved):
    """None where the run failed."""
    if solved.failed:
        return None
    state = (solved.q, solved.u) if solved.y is None else problem.completed(jnp.asarray(solved.y))
    return problem.error(*state)


def points(problem, curve: Curve, say):
    """Records of a curve, and the method ready to run again; none where it cannot be run, with the reason
    said.
    """
    try:
        ready = curve.prepare(problem)
    except (NotApplicable, ImportError) as reason:
        say(f"  {curve.method}: not measured: {reason}")
        return [], None
    found = []
    for setting in curve.settings:
        try:
            raw = ready.run(setting)
        except Exception as failure:  # a peer that breaks down is told, and the others go on
            said = "".join(str(failure).splitlines()[:1])
            say(f"  {curve.method}, {setting:.1e}: {type(failure).__name__}: {said}")
            return found, None
        solved = ready.read(raw)
        seconds = fastest(lambda setting=setting: ready.run(setting))
        entry = records.record(
            problem=problem.name, method=curve.method, kind=curve.kind, setting=setting,
            setting_unit=curve.setting_unit, batch=1, seconds=seconds, steps=solved.steps,
            error=error_of(problem, solved), note=solved.failed or curve.note,
            versions=records.versions(*curve.packages),
        )  # fmt: skip
        found.append(entry)
        if seconds > LONGEST:
            break
    return found, ready
