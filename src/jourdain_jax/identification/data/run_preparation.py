"""Preparation of a measured run for a scene: `checked` checks its channels, sensors, actuators and inputs.

`oddities` warns of measurements that are permitted, but probably wrong: inputs without samples over the whole
run, gaps in a log, and angles that jump by a turn.

`as_fit_options` and `as_runs` check arguments that fits, likelihoods and plans share.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import Shape, check_kind, described, holds, is_traced, largest
from jourdain_jax.identification.data.channels import Instrument, StopEvent, channel
from jourdain_jax.identification.data.estimate import Estimate
from jourdain_jax.identification.data.experiment import (
    Data,
    Drive,
    Experiment,
    Reading,
    ideal,
    latest,
    response,
)
from jourdain_jax.identification.data.sensors import Actuator, Sensor
from jourdain_jax.integrate.inputs import Inputs, Sampled, as_inputs
from jourdain_jax.motion.options import AllOptions, Options, as_options
from jourdain_jax.scene.arguments import BuiltFor, as_scene, warn
from jourdain_jax.scene.coordinates import Labels, Sentences, nearest
from jourdain_jax.scene.scene import Scene, entries_named

_NO_INPUTS = Inputs(())


def checked(scene: Scene, run: Experiment, index: int, repeats: bool) -> Experiment:
    """Return the run with prepared inputs and sensors, after checking channels and shapes against the scene.

    `repeats`: whether values have a leading axis. Raises ValueError for an unknown channel, start value or
    input, for wrong shapes, and for samples that may refer to times before the start.
    """
    where = f"run {index} of `{type(scene).__name__}`"
    entries_named(scene, run.start)
    times = run.ts.shape[0]
    readings: dict[str, Reading] = {}
    estimates: dict[str, Estimate] = {}
    for name, values in run.values.items():
        if name == run.ended_by:
            readings[name], shape = ideal("", StopEvent.of(scene, name, where)), ()
        else:
            quantity, shape = _quantity(
                scene, run.sensors[name].quantity if name in run.sensors else None, name, where
            )
        if name in run.sensors:
            readings[name] = _reading(run.sensors[name], name, where, quantity, shape, estimates)
            _check_begin(run, name, where, repeats)
        shape = (times, *shape)
        if (values.shape[1:] if repeats else values.shape) != shape:
            expected = f"(repeats, {', '.join(map(str, shape))})" if repeats else f"{shape}"
            hint = "; for many repeats use `fit_batch`" if values.shape[1:] == shape and not repeats else ""
            hint = "; take its only column, `[:, 0]`" if values.shape == (*shape, 1) else hint
            raise ValueError(
                f"channel `{name}` of {where} has shape {values.shape}, expected {expected} for "
                f"{times} times{hint}"
            )
        if run.sigma[name].shape not in ((), (times,), shape):
            raise ValueError(
                f"sigma of channel `{name}` of {where} has shape {run.sigma[name].shape}, "
                f"expected (), {(times,)} or {shape}"
            )
    inputs, drives = _inputs(scene, run, where, estimates)
    by_name = {
        field: getattr(run, field)
        for field in ("values", "sigma", "start", "unknown_start", "sensors", "correlation_time")
    }
    by_name |= {"readings": readings, "drives": drives, "estimates": estimates}
    # sorted as JAX orders them
    return run.changed(
        inputs=inputs, **{field: dict(sorted(value.items())) for field, value in by_name.items()}
    )


def _quantity(scene: Scene, given: str | Callable | Instrument | None, channel_name: str, where: str):
    """Return the quantity that a sensor measures (a traced function, an instrument, or a name) and
    its shape.
    """
    if isinstance(given, Instrument):
        given.check(scene, channel_name, where)
        return given, (3,)
    if callable(given):
        operation = channel(given, scene)
        return operation, operation.shape
    name = channel_name if given is None else given
    return name, _named_shape(scene, name, channel_name, where)


def _reading(sensor: Sensor, name: str, where: str, quantity, shape: Shape, estimates: dict) -> Reading:
    numbers, unknown, used = response(sensor)
    for number in ("gain", "bias"):
        if numbers[number].shape not in ((), shape):
            raise ValueError(
                f"`{number}` of sensor `{name}` of {where} has shape {numbers[number].shape}, "
                f"expected () or {shape}"
            )
    estimates |= {f"{name}.{number}": getattr(sensor, number) for number in unknown}
    named = isinstance(quantity, str)
    return Reading(numbers, unknown, used, None if named else quantity, quantity if named else "")


def _check_begin(run: Experiment, name: str, where: str, repeats: bool) -> None:
    """Raise ValueError if an available sample may refer to a time before the start."""
    delay, values = run.sensors[name].delay, run.values[name]
    if is_traced((delay, run.ts, run.t0, values, run.sigma[name])) or latest(delay) == 0:
        return
    counts = np.isfinite(np.asarray(values)) & np.isfinite(np.asarray(run.sigma_of(name, repeats)))
    axis = int(repeats)
    at_times = counts.any(axis=tuple(i for i in range(counts.ndim) if i != axis))
    first, t0 = float(run.ts[np.argmax(at_times)]), float(run.t0)
    if first - latest(delay) < t0 - 1e-9 * (float(run.ts[-1]) - t0):
        raise ValueError(
            f"channel `{name}` of {where} starts at {first:g} s, with a delay of up to {latest(delay):g} s: "
            f"its first samples refer to times before t0 = {t0:g} s; give an earlier `t0` and its start, "
            "or NaN for these samples"
        )


def _inputs(scene: Scene, run: Experiment, where: str, estimates: dict) -> tuple[Inputs, dict[str, Drive]]:
    """Return all inputs at the first guesses, and the actuators with estimated parameters."""
    if run.inputs is None and not len(scene.inputs):
        return _NO_INPUTS, {}
    given = run.inputs if isinstance(run.inputs, Mapping) else {}
    for name, one in given.items():
        _check_overlap(run, name, one.command if isinstance(one, Actuator) else one, where)
    actuators = {name: one for name, one in given.items() if isinstance(one, Actuator)}
    if not actuators:
        return as_inputs(scene, run.inputs), {}
    inputs = as_inputs(scene, {**given} | {name: one.command for name, one in actuators.items()})
    drives = {}
    for name, actuator in actuators.items():
        drive = Drive(*response(actuator), actuator.command, scene.inputs.entries.index(name), actuator.hold)
        for number in drive.unknown:
            if f"{name}.{number}" in estimates:
                raise ValueError(
                    f"{where} has a channel and an input `{name}`, both with an estimated "
                    f"{number}; give the channel another name"
                )
            estimates[f"{name}.{number}"] = getattr(actuator, number)
        if drive.has_filter and not holds(
            lambda command, ts: command[-1] >= ts[-1], actuator.command.ts, run.ts
        ):
            raise ValueError(
                f"the command of input `{name}` of {where} ends at {float(actuator.command.ts[-1]):g} s, "
                f"before the last sample at {float(run.ts[-1]):g} s, but its lag needs all of the run; "
                "repeat the last value at a later time"
            )
        inputs = drive.put_into(inputs)
        if drive.unknown:
            drives[name] = drive
    return inputs, drives


def _check_overlap(run: Experiment, name: str, signal, where: str) -> None:
    """Raise ValueError if all samples of a varying input lie before the run, or all after it."""

    def overlaps(knots, x, ts, t0):
        return np.ptp(x) == 0 or (knots[0] < ts[-1] and knots[-1] > t0)

    if isinstance(signal, Sampled) and not holds(overlaps, signal.ts, signal.values, run.ts, run.t0):
        first, last, begin, end = (
            f"{float(t):.10g}" for t in (signal.ts[0], signal.ts[-1], run.t0, run.ts[-1])
        )
        raise ValueError(
            f"input `{name}` of {where} is sampled from {first} to {last} s, but the run is from {begin} to "
            f"{end} s; take both from one clock, or give a number for a constant input"
        )


def _named_shape(scene: Scene, name: str, channel_name: str, where: str) -> Shape:
    """Return the shape of a coordinate or speed: (4,) for a quaternion, (3,) for its rates."""
    both = scene.coordinate_names, scene.speed_names
    entries = both[0].entries + both[1].entries
    if name in entries:
        return ()
    groups = {group: length for names in both for group, _, length in names.groups}
    if name not in groups:
        if name == channel_name:
            unknown = f"unknown channel `{name}`"
        else:
            unknown = f"channel `{channel_name}`, whose sensor measures an unknown quantity `{name}`"
        raise ValueError(
            f"{where} has {unknown}; {nearest(name, (*groups, *entries))} For other quantities "
            "give a function of the motion in `sensors`."
        )
    return (groups[name],)


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


_REFUSED = dict.fromkeys(
    ("start", "t0", "t1", "ts", "inputs", "events", "work"),
    "each `Experiment` states start, times and inputs, and its motion ends with its last sample",
)
_REFUSED["retry"] = "it computes each motion by one compiled method"


def as_fit_options(
    scene: Scene | BuiltFor, options: Options | None, by_name: Mapping, function: str
) -> AllOptions:
    """Return the options of the motions of a fit or a likelihood."""
    found = as_options(options, by_name, function, _REFUSED, scene)
    return replace(found, work=False, retry=False)


def as_runs(scene: Scene, data: Data, *, repeats: bool = False) -> tuple[Experiment, ...]:
    """Return one run or several as a tuple, checked against the scene. Raises ValueError as in `checked`, and
    if there is no run. Probable mistakes (`oddities`) cause warnings.
    """
    as_scene(scene)
    check_kind(data, Experiment | Iterable, "`data`", "an `Experiment` or a sequence of at least one")
    runs = (data,) if isinstance(data, Experiment) else tuple(data)
    if runs:
        wrong = [f"`data` holds {described(run)}" for run in runs if not isinstance(run, Experiment)]
    else:
        wrong = ["`data` is empty"]
    if wrong:
        raise ValueError(f"{wrong[0]}, expected an `Experiment` or a sequence of at least one")
    found = tuple(checked(scene, run, index, repeats) for index, run in enumerate(runs))
    for sentence in oddities(scene, found, repeats):
        warn(sentence)
    return found


def in_all_or_none(runs: Sequence[Experiment], what: str, unknown: Callable[[Experiment], Labels]) -> Labels:
    """Return the channels whose value is None and therefore estimated. Raises ValueError for a channel with
    None in one run and a value in another.
    """
    names = tuple(sorted({name for run in runs for name in unknown(run)}))
    for name in names:
        if any(name in run.values and name not in unknown(run) for run in runs):
            raise ValueError(
                f"{what} of channel `{name}` is None in one run and given in another; give it "
                "in all runs, or in none"
            )
    return names


def check_known(runs: Sequence[Experiment], what: str) -> None:
    """Raise ValueError if a sigma, or a parameter of a sensor or actuator, is unknown."""
    for run in runs:
        for name in run.unknown_sigma:
            raise ValueError(
                f"sigma of channel `{name}` is None, but {what} needs the standard deviation of "
                "its noise; give a number"
            )
        for label in run.estimates:
            raise ValueError(
                f"`{label}` is to be estimated, but {what} needs its value; give a number, "
                "which may be traced, in place of the `Estimate`"
            )
