"""What is odd about measurements though nothing forbids it: inputs that are not sampled where a run needs them, and angles that jump by a turn."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.motion.inputs import Inputs, Sampled
from jourdain_jax.scene.scene import Scene

_BEYOND = 1.5  # intervals between samples, that an end may be away from that of a run
_GAP, _REGULAR = 5.0, 0.9  # intervals that are missing; share of the others that are nearly equal: those of a log
_TURN = 2 * np.pi


def oddities(scene: Scene, runs: Sequence[Experiment], repeats: bool) -> tuple[str, ...]:
    """One sentence for each, of runs that were `checked`; traced numbers are not looked at. `repeats`: values have a leading axis, and the first one counts."""
    found: list[str] = []
    for index, run in enumerate(runs):
        for name, signal in zip(scene.inputs.entries, run.inputs.channels if isinstance(run.inputs, Inputs) else (), strict=False):
            if isinstance(signal, Sampled) and not is_traced((signal, run.ts, run.t0)) and np.ptp(np.asarray(signal.values)) > 0:
                found += _of_input(f"input `{name}` of run {index}", np.asarray(signal.ts), float(run.t0), float(run.ts[-1]))
        for name, values in run.values.items():
            quantity, shown = run.sensors[name].quantity if name in run.sensors else name, values[0] if repeats else values
            is_angle = quantity in scene.coordinate_names.entries if isinstance(quantity, str) else callable(quantity)
            if is_angle and shown.ndim == 1 and not is_traced((shown, run.ts)):
                found += _of_angle(f"channel `{name}` of run {index}", shown, run.ts)
    return tuple(found)


def _of_input(what: str, ts: Float[np.ndarray, "samples"], begin: float, end: float) -> Iterator[str]:
    """Where samples of an input that changes leave a run at an end, and where some are missing from a log in between.

    The last interval may be a jump, such as those of commands that are held; then the one before it counts.
    """
    intervals = np.diff(ts)
    spans = [f"its first value until {ts[0]:.6g} s"] if ts[0] - begin > _BEYOND * intervals[0] else []
    spans += [f"its last value from {ts[-1]:.6g} to {end:.6g} s"] if end - ts[-1] > _BEYOND * max(intervals[-2:]) else []
    if spans:
        yield (
            f"{what} is not sampled over all of the run and keeps {' and '.join(spans)}; if it did so, repeat that value in its samples, otherwise give more "
            "of them, or measurements of less"
        )
    usual = float(np.median(intervals))
    (gaps,) = np.nonzero((intervals > _GAP * usual) & (ts[:-1] < end) & (ts[1:] > begin))
    if gaps.size and np.mean(np.abs(intervals / usual - 1) < 0.1) > _REGULAR:
        k = int(gaps[0])
        more = f" (the first of {gaps.size} gaps)" if gaps.size > 1 else ""
        yield (
            f"{what} is sampled every {usual:.3g} s, but not from {ts[k]:.6g} to {ts[k + 1]:.6g} s{more}, where it is a straight line; if that is not what it "
            "did, give the samples, or measurements of less"
        )


def _of_angle(what: str, values: Float[np.ndarray, "times"], ts: Float[np.ndarray, "times"]) -> Iterator[str]:
    """Where values lie in [-pi, pi] or [0, 2 pi], and neighbours are nearly one turn apart, but near each other without it."""
    known = np.isfinite(values)
    x, t = values[known], ts[known]
    if x.size < 2 or not any(low <= x.min() and x.max() <= low + _TURN for low in (-np.pi, 0.0)):
        return
    steps = np.diff(x)
    (jumps,) = np.nonzero(np.abs(steps) > 0.75 * _TURN)
    if jumps.size and np.max(np.abs(steps - _TURN * np.round(steps / _TURN))) < 0.25 * _TURN:
        yield (
            f"{what} jumps by {steps[jumps[0]]:.3g} at {t[jumps[0] + 1]:.6g} s and stays within one turn: an angle that was wrapped, where coordinates go on; "
            "give `np.unwrap` of it"
        )
