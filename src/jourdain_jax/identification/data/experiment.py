"""An experiment, the measurements of one run: times, named channels with a sigma and a sensor each, start,
and sampled inputs.

    value_k = reading of the channel's sensor at t_k + sigma_k e_k,   e_k independent, standard normal
"""

from collections.abc import Callable, Iterable, Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Entries,
    Number,
    Shape,
    array_module,
    check_kind,
    checked_unless_traced,
    holds,
    is_traced,
    static,
)
from jourdain_jax.identification.data.channels import Instrument, StopEvent, channel, cut
from jourdain_jax.identification.data.estimate import Estimate, Range
from jourdain_jax.identification.data.sensors import (
    Actuator,
    Drive,
    Numbers,
    Reading,
    Sensor,
    Times,
    ideal,
    latest,
    response,
)
from jourdain_jax.integrate.inputs import Inputs, Sampled, as_inputs
from jourdain_jax.scene.arguments import one_time, vector_of_times
from jourdain_jax.scene.names import Labels, as_names, check_names, nearest
from jourdain_jax.scene.scene import Scene, entries_named

_NO_INPUTS = Inputs(())


class Experiment(eqx.Module):
    """Measurements of one run of a scene; several runs are a list of these.

        gyro = jj.identification.Sensor("heading_rate", lag=0.01)
        Experiment(ts, {"x": x, "gyro": w}, {"x": 0.01, "gyro": 0.02}, start={"x_rate": 0.6}, sensors={"gyro": gyro})

    **Arguments**

    - `ts`: times in s, strictly increasing.
    - `values`: channel -> measured values, shape (times, *channel). A channel is a coordinate, a speed, or a
      name in `sensors`.
    - `sigma`: standard deviation of the noise, in the unit of the channel: channel -> number, (times,) or the
      shape of its values; or one number for all channels. None: unknown; one sigma for all samples of the
      channel in all runs is estimated. NaN in `values`, the mask of a masked array, or an infinite sigma
      marks a missing sample.
    - `correlation_time`: s, of noise whose correlation falls as exp(-|t - t'| / correlation time): channel ->
      number, or one number for all; zero, and omitted channels: white noise. None: unknown; one for all
      components of the channel in all runs is estimated.
    - `start`: coordinate or speed -> value at `t0`. These are fixed; missing ones are solved for, as by
      `jj.start`.
    - `unknown_start`: names in `start` whose values are first guesses, to be estimated; or name ->
      `bounds(...)`, `positive()`, `unbounded()` (None: unbounded), or an `Estimate` with a prior.
    - `inputs`: as in `simulate`: name -> number, function of time, or `Sampled`; or an `Actuator`.
    - `sensors`: channel -> `Sensor`; or the quantity of an ideal sensor: a coordinate, a speed, an
      `Accelerometer`, a `LoadCell`, or a function of a `Motion` (one instant), such as `lambda motion:
      motion["sleigh"].place((0.3, 0.0, 0.0))`.
    - `t0`: time of the start in s; default: the first of `ts`.
    - `events`: the stop event of the scene that ended the run, with its observed time and the sigma of this
      time, both in s: `events={"has_fallen": (1.83, 0.005)}`. The difference between simulated and observed
      time is a residual. Later samples do not count.

    **Raises** ValueError for times that do not increase, infinite values, channels without any value, sigmas
    that are not positive, names that do not match, more than one event, an event that is not after the start,
    and samples that may refer to times before the start.
    """

    ts: Times  # s; all on NumPy if known
    values: dict[str, Numbers]
    sigma: dict[str, Numbers]
    start: dict[str, Numbers]
    unknown_start: dict[str, Range | None]
    inputs: dict | Inputs | None
    sensors: dict[str, Sensor]
    readings: dict[str, Reading]  # the prepared sensors; this and the next two are empty before `checked`
    drives: dict[str, Drive]  # actuators with estimated numbers, by input
    estimates: dict[str, Estimate]  # of sensors and actuators, as "gyro.gain"
    t0: Float[Entries, ""]  # s
    # s, of channels with correlated noise; zero if to be estimated
    correlation_time: dict[str, Float[Entries, ""]]
    unknown_sigma: Labels = static()  # channels; their sigma is 1 here
    unknown_correlation: Labels = static()  # channels
    ended_by: str = static()  # channel of the event with an observed time; empty: none

    def __init__(
        self,
        ts,
        values: Mapping,
        sigma,
        *,
        start: Mapping,
        unknown_start: Mapping | Iterable[str] = (),
        inputs: "dict | Inputs | None" = None,
        sensors: "Mapping[str, Sensor | str | Callable | Instrument] | None" = None,
        t0: Number | None = None,
        correlation_time: "Mapping | Number | None" = 0.0,
        events: Mapping | None = None,
    ):
        self.ts = vector_of_times(ts)
        _check_times(self.ts)
        for what, part in (
            ("values", values),
            ("start", start),
            ("sensors", sensors or {}),
            ("events", events or {}),
        ):
            check_kind(part, Mapping, f"`{what}` of `Experiment`", 'a dictionary by name, such as {"x": ...}')
        masked = {
            name for name, x in values.items() if isinstance(x, np.ma.MaskedArray) and x.dtype.kind in "iuf"
        }
        filled = {
            name: np.ma.filled(x.astype(float), np.nan) if name in masked else x for name, x in values.items()
        }
        self.values = _reals("values of channel", filled, "give numbers, NaN where a sample is missing")
        given = sigma if isinstance(sigma, Mapping) else dict.fromkeys(self.values, sigma)
        self.unknown_sigma = tuple(sorted(name for name, value in given.items() if value is None))
        self.sigma = _reals(
            "sigma of channel", {name: 1.0 if value is None else value for name, value in given.items()}
        )
        memory = (
            correlation_time
            if isinstance(correlation_time, Mapping)
            else dict.fromkeys(self.values, correlation_time)
        )
        self.unknown_correlation = tuple(sorted(name for name, value in memory.items() if value is None))
        self.correlation_time = _correlation_times(memory)
        self.start = _reals("start value", start)
        self.unknown_start = (
            dict(unknown_start)
            if isinstance(unknown_start, Mapping)
            else dict.fromkeys(as_names(unknown_start))
        )
        self.inputs = inputs
        self.sensors = {
            name: one if isinstance(one, Sensor) else Sensor(one) for name, one in (sensors or {}).items()
        }
        self.readings, self.drives, self.estimates = {}, {}, {}
        self.t0 = self.ts[:1].reshape(()) if t0 is None else one_time(t0, "t0")
        self.ended_by = next(iter(events or {}), "")
        if events:
            self.ts, self.values, self.sigma = cut(events, self.t0, self.ts, self.values, self.sigma)

    def __check_init__(self):
        if not holds(lambda t0, ts: (t0 <= ts[0]) & (t0 < ts[-1]), self.t0, self.ts):
            raise ValueError(
                f"the start at t0 = {self.t0} s comes after the first sample ({self.ts[0]} s) or is not "
                f"before the last one ({self.ts[-1]} s); give an earlier `t0`"
            )
        if not self.values:
            raise ValueError(
                "`values` is empty; give at least one channel: name -> measured values; or the "
                "time of an event, in `events`"
            )
        for names, what, known in (
            (self.sigma, "`sigma` names channel `{}`, which has no values", self.values),
            (
                self.correlation_time,
                "`correlation_time` names channel `{}`, which has no values",
                self.values,
            ),
            (self.sensors, "sensor `{}` has no measured values", self.values),
            (
                self.unknown_start,
                "unknown start value `{}` has no first guess; give one in `start`",
                self.start,
            ),
        ):
            check_names(names, known, what)
        for name in self.values:
            if name not in self.sigma:
                raise ValueError(
                    f"channel `{name}` has no sigma; give `sigma` a number for it, or one "
                    "number for all channels"
                )
        if self.ended_by in (*self.sensors, *self.correlation_time):
            raise ValueError(
                f"`{self.ended_by}` is an event, whose time has no sensor or correlation time; omit them, or "
                "rename the channel"
            )
        for name, value in self.values.items():
            if not holds(lambda x: ~np.isinf(x), value):
                raise ValueError(
                    f"channel `{name}` holds infinite values, the first at sample "
                    f"{int(np.argwhere(np.isinf(np.asarray(value)))[0][0])}; give NaN for missing samples"
                )
            if not holds(lambda x: ~np.all(np.isnan(x)), value):
                raise ValueError(f"channel `{name}` holds only NaN; omit the channel")
        for name, value in self.sigma.items():
            if not holds(lambda x: x > 0, value):
                raise ValueError(
                    f"sigma of channel `{name}` must be above zero (and not NaN); give the "
                    "standard deviation of its noise"
                )

    # Equinox's own costs a microsecond per access, and a fit reads a hundred fields
    __getattribute__ = object.__getattribute__

    def changed(self, **fields) -> "Experiment":
        """Return this run with other fields, without repeated checks."""
        found = object.__new__(type(self))
        vars(found).update(vars(self) | fields)
        return found

    def sigma_of(self, name: str, repeats: bool = False) -> Numbers:
        """Return sigma for each measured value of the channel `name`, in its unit. `repeats`: whether values
        have a leading axis of repeats.
        """
        sigma, values = self.sigma[name], self.values[name]
        # one sigma per time acts on all components of the channel
        dimensions = values.ndim - int(repeats)
        xp = array_module(sigma)
        aligned = xp.reshape(sigma, sigma.shape + (1,) * (dimensions - sigma.ndim)) if sigma.ndim else sigma
        return xp.broadcast_to(aligned, values.shape)


Data = Experiment | Sequence[Experiment]


def _reals(
    what: str, given: Mapping, advice: str = "check how it is put together", shape: tuple[()] | None = None
) -> dict[str, Array | np.ndarray]:
    return {
        name: checked_unless_traced(value, f"{what} `{name}`", shape, advice=advice)
        for name, value in given.items()
    }


def _correlation_times(given: Mapping) -> dict[str, Array | np.ndarray]:
    """Return the nonzero correlation times; zero for unknown ones."""
    numbers = {name: 0.0 if value is None else value for name, value in given.items()}
    found = _reals(
        "correlation time of channel", numbers, "give a time in s, or None where it is not known", ()
    )
    for name, time in found.items():
        if not holds(lambda x: np.isfinite(x) & (x >= 0), time):
            raise ValueError(
                f"the correlation time of channel `{name}` is {float(time):g} s, expected zero or more; None "
                "if unknown"
            )
    return {
        name: time for name, time in found.items() if given[name] is None or holds(lambda x: x != 0, time)
    }


def _check_times(ts) -> None:
    @np.errstate(invalid="ignore")
    def good(ts):
        return np.isfinite(ts) & (np.diff(ts, prepend=-np.inf) > 0)

    if not holds(good, ts):
        k = int(np.argmin(good(ts)))
        after = f" after {ts[k - 1]:.10g} s" if k else ""
        raise ValueError(
            f"`ts` must be finite and strictly increasing, but sample {k} is at {ts[k]:.10g} s{after}; sort "
            "the samples by time and merge repeated ones"
        )


def checked(scene: Scene, run: Experiment, index: int, repeats: bool) -> Experiment:
    """Return the run with its inputs and sensors prepared, after checking channels and shapes against the
    scene.

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
            hint = "; many repeats go to `fit_batch`" if values.shape[1:] == shape and not repeats else ""
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
    """Return the quantity that a sensor measures (a prepared function, an instrument, or a name) and its
    shape.
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
    """Raise ValueError if a sample that counts may refer to a time before the start."""
    delay, values = run.sensors[name].delay, run.values[name]
    if is_traced((delay, run.ts, run.t0, values, run.sigma[name])) or latest(delay) == 0:
        return
    counts = np.isfinite(np.asarray(values)) & np.isfinite(np.asarray(run.sigma_of(name, repeats)))
    axis = int(repeats)
    at_times = counts.any(axis=tuple(i for i in range(counts.ndim) if i != axis))
    first, t0 = float(run.ts[np.argmax(at_times)]), float(run.t0)
    if first - latest(delay) < t0 - 1e-9 * (float(run.ts[-1]) - t0):
        raise ValueError(
            f"channel `{name}` of {where} starts at {first:g} s; minus its delay of up to {latest(delay):g} "
            f"s, this is before the start of the motion at t0 = {t0:g} s; give an earlier `t0` with the "
            "start there, or NaN for the first samples"
        )


def _inputs(scene: Scene, run: Experiment, where: str, estimates: dict) -> tuple[Inputs, dict[str, Drive]]:
    """Return all inputs, with first guesses for estimated numbers, and the actuators with estimated numbers."""
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
                f"before the last sample at {float(run.ts[-1]):g} s, and its lag ends there; repeat the last "
                "value at a later time"
            )
        inputs = drive.put_into(inputs)
        if drive.unknown:
            drives[name] = drive
    return inputs, drives


def _check_overlap(run: Experiment, name: str, signal, where: str) -> None:
    """Raise ValueError if all samples of a varying input are before the run, or all after it."""

    def overlaps(knots, x, ts, t0):
        return np.ptp(x) == 0 or (knots[0] < ts[-1] and knots[-1] > t0)

    if isinstance(signal, Sampled) and not holds(overlaps, signal.ts, signal.values, run.ts, run.t0):
        first, last, begin, end = (
            f"{float(t):.10g}" for t in (signal.ts[0], signal.ts[-1], run.t0, run.ts[-1])
        )
        raise ValueError(
            f"input `{name}` of {where} is sampled from {first} to {last} s, but the run is from {begin} to "
            f"{end} s, where the input would be constant; take both from one clock, or give a number"
        )


def _named_shape(scene: Scene, name: str, channel_name: str, where: str) -> Shape:
    """Return the shape of a coordinate or speed: (4,) for a quaternion, (3,) for its rates."""
    both = scene.coordinate_names, scene.speed_names
    entries = both[0].entries + both[1].entries
    if name in entries:
        return ()
    groups = {group: length for names in both for group, _, length in names.groups}
    if name not in groups:
        unknown = (
            f"unknown channel `{name}`"
            if name == channel_name
            else f"channel `{channel_name}`, whose sensor measures an unknown quantity `{name}`"
        )
        raise ValueError(
            f"{where} has {unknown}; {nearest(name, (*groups, *entries))} For other quantities "
            "give a function of the motion in `sensors`."
        )
    return (groups[name],)
