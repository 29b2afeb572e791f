"""Preparation of a measured run for a scene: its channels, sensors, actuators and inputs, checked."""

from collections.abc import Callable, Mapping

import numpy as np

from jourdain_jax.calculus.reals import Shape, holds, is_traced
from jourdain_jax.identification.data.channels import Instrument, StopEvent, channel
from jourdain_jax.identification.data.estimate import Estimate
from jourdain_jax.identification.data.experiment import Experiment
from jourdain_jax.identification.data.responses import Drive, Reading, ideal, latest, response
from jourdain_jax.identification.data.sensors import Actuator, Sensor
from jourdain_jax.integrate.inputs import Inputs, Sampled, as_inputs
from jourdain_jax.scene.names import nearest
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
    """Return all inputs at the first guesses, and the actuators with estimated numbers."""
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
