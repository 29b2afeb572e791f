"""Running a curve: error and warm time at every setting."""

import time
from collections.abc import Callable

import jax.numpy as jnp

from work_precision_cases import record as records
from work_precision_cases.curve import Curve, NotApplicable, Prepared, Solved
from work_precision_cases.problem import Problem

SECONDS_PER_POINT = 0.25
MOST_REPEATS, LONGEST = 25, 8.0  # s: after a run as long as that, smaller settings are left out


def fastest(run: Callable[[], object], seconds: float = SECONDS_PER_POINT) -> float:
    """Wall time of the fastest of some warm runs, s: as many as fit in `seconds`, at least two, at most 25;
    one where a run takes longer than that.
    """
    laps: list[float] = []
    while (len(laps) < MOST_REPEATS and sum(laps) < seconds) or (len(laps) < 2 and laps[0] < seconds):
        begin = time.perf_counter()
        run()
        laps.append(time.perf_counter() - begin)
    return min(laps)


def error_of(problem: Problem, solved: Solved) -> float | None:
    """None where the run failed."""
    if solved.failed:
        return None
    return problem.error(
        *(problem.completed(jnp.asarray(solved.y)) if solved.y is not None else (solved.q, solved.u))
    )


def points(problem: Problem, curve: Curve, say: Callable[[str], None]) -> tuple[list[dict], Prepared | None]:
    """Records of a curve, and the method ready to run again; none where it cannot be run, with the reason
    said.
    """
    try:
        ready = curve.prepare(problem)
    except (NotApplicable, ImportError) as reason:
        say(f"  {curve.method}: not measured: {reason}")
        return [], None
    found: list[dict] = []
    for setting in curve.settings:
        begin = time.perf_counter()
        try:
            raw = ready.run(setting)
        except Exception as failure:  # a peer that breaks down is told, and the others go on
            say(
                f"  {curve.method}, {setting:.1e}: {type(failure).__name__}:"
                f" {str(failure).splitlines()[0] if str(failure) else ''}"
            )
            return found, None
        first = time.perf_counter() - begin
        solved = ready.read(raw)
        seconds = fastest(lambda setting=setting: ready.run(setting))
        entry = records.record(
            problem=problem.name,
            method=curve.method,
            kind=curve.kind,
            setting=setting,
            setting_unit=curve.setting_unit,
            batch=1,
            seconds=seconds,
            steps=solved.steps,
            error=error_of(problem, solved),
            note=solved.failed or curve.note,
            versions=records.versions(*curve.packages),
        )
        found.append(entry)
        say(f"  {curve.method:42s} {setting:8.1e}  {line(entry)}   (first call {first:.2f} s)")
        if seconds > LONGEST:
            break
    return found, ready


def line(entry: dict) -> str:
    """The figures of a record, for reading."""
    error = f"{entry['note']:>9}" if entry["error"] is None else f"{entry['error']:9.1e}"
    return f"error {error}  {1e3 * entry['seconds']:10.4f} ms"
