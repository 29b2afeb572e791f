"""Warnings of measurements that are permitted, but probably wrong: inputs without samples over the whole run,
gaps in a log, and angles that jump by a turn.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import holds, is_traced, largest
from jourdain_jax.identification.data.experiment import Experiment
from jourdain_jax.integrate.inputs import Inputs, Sampled
from jourdain_jax.scene.names import Sentences
from jourdain_jax.scene.scene import Scene


def oddities(scene: Scene, runs: Sequence[Experiment], repeats: bool) -> Sentences:
    """Return one sentence for each probable mistake in runs prepared by `checked`. Traced numbers are not
    examined. `repeats`: values have a leading axis, of which only the first entry is examined.
    """
    found: list[str] = []
    for index, run in enumerate(runs):
        for name, signal in zip(
            scene.inputs, run.inputs.channels if isinstance(run.inputs, Inputs) else (), strict=False
        ):
            if isinstance(signal, Sampled) and not holds(
                lambda x, *_: np.ptp(x) == 0, signal.values, signal.ts, run.ts, run.t0
            ):
                found += _of_input(
                    f"input `{name}` of run {index}", np.asarray(signal.ts), float(run.t0), float(run.ts[-1])
                )
        for name, values in run.values.items():
            quantity = run.sensors[name].quantity if name in run.sensors else name
            shown = values[0] if repeats else values
            if isinstance(quantity, str):
                is_angle = quantity in scene.coordinate_names.entries
            else:
                is_angle = callable(quantity)
            if is_angle and shown.ndim == 1 and not is_traced((shown, run.ts)):
                found += _of_angle(f"channel `{name}` of run {index}", shown, run.ts)
    return tuple(found)


def _of_input(what: str, ts: Float[np.ndarray, "samples"], begin: float, end: float) -> Iterator[str]:
    """Yield sentences on inputs whose samples do not cover a run, and on gaps in a log.

    The last interval of a held command may be a jump; then the previous interval is used.
    """
    intervals, beyond = np.diff(ts), 1.5  # permitted gap at each end of the run, in intervals
    spans = [f"its first value until {ts[0]:.6g} s"] if ts[0] - begin > beyond * intervals[0] else []
    if end - ts[-1] > beyond * max(intervals[-2:]):
        spans.append(f"its last value from {ts[-1]:.6g} to {end:.6g} s")
    if spans:
        yield (
            f"{what} does not cover the whole run and keeps {' and '.join(spans)}; if this is intended, add "
            "a sample with that value; otherwise give more samples, or a shorter run"
        )
    usual = float(np.median(intervals))
    (gaps,) = np.nonzero((intervals > 5.0 * usual) & (ts[:-1] < end) & (ts[1:] > begin))  # missing intervals
    # a log: nearly all intervals are equal
    if gaps.size and np.mean(np.abs(intervals / usual - 1) < 0.1) > 0.9:
        k = int(gaps[0])
        more = f" (the first of {gaps.size} gaps)" if gaps.size > 1 else ""
        yield (
            f"{what} is sampled every {usual:.3g} s, but not from {ts[k]:.6g} to {ts[k + 1]:.6g} s{more}, "
            "where it is interpolated linearly; if this is wrong, add samples, or give a shorter run"
        )


def _of_angle(what: str, values: Float[np.ndarray, "times"], ts: Float[np.ndarray, "times"]) -> Iterator[str]:
    """Yield a sentence on angles that appear wrapped: values in [-pi, pi] or [0, 2 pi] with jumps of nearly
    one turn between neighbours.
    """
    known, turn = np.isfinite(values), 2 * np.pi
    x, t = values[known], ts[known]
    if x.size < 2 or not any(low <= x.min() and x.max() <= low + turn for low in (-np.pi, 0.0)):
        return
    steps = np.diff(x)
    (jumps,) = np.nonzero(np.abs(steps) > 0.75 * turn)
    if jumps.size and largest(steps - turn * np.round(steps / turn)) < 0.25 * turn:
        yield (
            f"{what} jumps by {steps[jumps[0]]:.3g} at {t[jumps[0] + 1]:.6g} s and stays within one turn, "
            "like a wrapped angle; coordinates are continuous: apply `np.unwrap`"
        )
