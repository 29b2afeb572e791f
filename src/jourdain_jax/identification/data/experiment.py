"""An experiment: the measurements of one run. It has times, a start, sampled inputs, and named channels with
a sigma and a sensor each.

    value_k = reading of the channel's sensor at t_k + sigma_k e_k,   e_k independent, standard normal

`Reading` and `Drive` are the sensors and actuators of one run, with a value in place of each estimate.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Entries,
    Number,
    array_module,
    check_kind,
    checked_unless_traced,
    holds,
    real_type,
    static,
)
from jourdain_jax.identification.data.channels import Channel, Instrument, StopEvent, cut
from jourdain_jax.identification.data.delay_filter import Times, filtered, held, read
from jourdain_jax.identification.data.estimate import Estimate, Range
from jourdain_jax.identification.data.sensors import NUMBERS, OF_TIME, Actuator, Sensor
from jourdain_jax.integrate.inputs import Inputs, Sampled
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import one_time, vector_of_times
from jourdain_jax.scene.coordinates import Labels, as_names, check_names
from jourdain_jax.scene.motion_state import Motion

Numbers = Float[Entries, "..."]


class Response(eqx.Module):
    """The parameters of a sensor or actuator of one run; estimated ones have their first guesses."""

    numbers: dict[str, Numbers | float]
    unknown: Labels = static()  # names of estimated numbers
    used: Labels = static()  # names of numbers that affect the reading or signal

    @property
    def is_late(self) -> bool:
        """Return whether the sensor or actuator has a delay or a lag."""
        return any(name in self.used for name in OF_TIME)

    @property
    def has_filter(self) -> bool:
        """Return whether the sensor or actuator has a low-pass filter."""
        return "lag" in self.used

    def scaled(self, x):
        """Apply gain and bias."""
        x = self.numbers["gain"] * x if "gain" in self.used else x
        return x + self.numbers["bias"] if "bias" in self.used else x


class Reading(Response):
    """A sensor of one run, with the quantity that it measures."""

    operation: Channel | Instrument | StopEvent | None  # None: a coordinate or speed by name
    name: str = static()  # name of the coordinate, speed or event

    def quantity(self, motion: Trajectory, states: Motion | None) -> Float[Array, "times *channel"]:
        """Return the measured quantity along a motion. `states`: the motions of bodies, for functions of a
        `Motion`.
        """
        if self.operation is None:
            return motion[self.name]
        if isinstance(self.operation, Instrument):
            return self.operation.over_times(motion)
        return jax.vmap(self.operation)(states)

    def shown(
        self, x, grid, ts, begin=None
    ) -> tuple[Float[Array, "times *channel"], Float[Entries, "grid entries"] | None]:
        """Return the reading at the times `ts`, and the output of the filter on the grid (None without a
        grid). `x`: the quantity on the grid, or at `ts`; `begin`: initial output of the filter (None: its
        steady value).
        """
        y = None
        if grid is not None:
            x, y = read(
                x, grid, ts, self.numbers["delay"], self.numbers["lag"] if self.has_filter else None, begin
            )
        return self.scaled(x), y


def ideal(name: str, event: StopEvent | None = None) -> Reading:
    """Return an ideal sensor of a coordinate or speed, or of the time of an event."""
    return Reading(dict(NUMBERS), (), (), event, name)


class Drive(Response):
    """An actuator of one run."""

    command: Sampled
    index: int = static()  # of the input
    hold: bool = static()

    def signal(self) -> Sampled:
        """Return the input of the scene: the command after delay, filter, gain and bias."""
        ts, values = jnp.asarray(self.command.ts), jnp.asarray(self.command.values)
        if self.has_filter:
            values = filtered(ts, values, self.numbers["lag"], self.hold)
        elif self.hold and ts.shape[0] > 1:
            ts, values = held(ts, values)
        return eqx.tree_at(
            lambda s: (s.ts, s.values), self.command, (ts + self.numbers["delay"], self.scaled(values))
        )

    def put_into(self, inputs) -> Inputs:
        """Return `inputs` with the signal of this actuator."""
        return eqx.tree_at(lambda i: i.channels[self.index], inputs, self.signal())


def response(owner: Sensor | Actuator) -> tuple[dict, Labels, Labels]:
    """Return the parameters of a sensor or actuator (first guesses of estimated ones), the names of estimated
    numbers, and the names of all numbers that have an effect.
    """
    given = {name: getattr(owner, name) for name in NUMBERS}
    unknown = tuple(name for name, value in given.items() if isinstance(value, Estimate))
    numbers = {name: value.guess if name in unknown else value for name, value in given.items()}
    numbers = {name: array_module(x).asarray(x, real_type()) for name, x in numbers.items()}
    acts = lambda name, x: name in unknown or holds(lambda x: np.any(x != NUMBERS[name]), x)
    return numbers, unknown, tuple(name for name, x in numbers.items() if acts(name, x))


def with_numbers(parts: Mapping[str, "Reading | Drive"], known: Mapping[str, Array | np.ndarray]) -> dict:
    """Return readings or drives with these numbers (`gyro.gain` -> number) in place of the estimated ones."""
    numbers = {
        label: part.numbers | {name: known[f"{label}.{name}"] for name in part.unknown}
        for label, part in parts.items()
    }
    return {
        label: eqx.tree_at(lambda p: p.numbers, part, numbers[label]) if part.unknown else part
        for label, part in parts.items()
    }


def latest(delay: Array | Estimate) -> float:
    """Return the largest possible delay of a sensor, s."""
    return float(delay.range.high if isinstance(delay, Estimate) else delay)


class Experiment(eqx.Module):
    """The measurements of one run of a scene. Several runs are a list of experiments.

        gyro = jj.identification.Sensor("heading_rate", lag=0.01)
        sigma = {"x": 0.01, "gyro": 0.02}
        jj.Experiment(ts, {"x": x, "gyro": w}, sigma, start={"x_rate": 0.6}, sensors={"gyro": gyro})

    **Arguments**

    - `ts`: times in s, strictly increasing.
    - `values`: channel -> measured values, shape (times, *channel). A channel is a coordinate, a speed, or a
      name in `sensors`.
    - `sigma`: standard deviation of the noise, in the unit of the channel: channel -> number, (times,) or the
      shape of its values; or one number for all channels. None: unknown; `fit` estimates one sigma for all
      samples of the channel in all runs. NaN in `values`, the mask of a masked array, or an infinite sigma
      marks a missing sample.
    - `correlation_time`: of noise whose correlation falls as exp(-|t - t'| / correlation time), in s: channel
      -> number, or one number for all. Zero, or no entry, means white noise. None: unknown; `fit` estimates
      one value for all components of the channel in all runs.
    - `start`: coordinate or speed -> value at `t0`. These values are fixed; the others follow from the
      constraints, as in `jj.start`.
    - `unknown_start`: names in `start` whose values are first guesses and are estimated; or name ->
      `bounds(...)`, `positive()`, `unbounded()` (None: unbounded), or an `Estimate` with a prior.
    - `inputs`: as in `simulate`: name -> number, function of time, or `Sampled`; or an `Actuator`.
    - `sensors`: channel -> `Sensor`; or the quantity of an ideal sensor: a coordinate, a speed, an
      `Accelerometer`, a `LoadCell`, or a function of a `Motion` (one instant), such as `lambda motion:
      motion["sleigh"].place((0.3, 0.0, 0.0))`.
    - `t0`: time of the start in s; default: the first of `ts`.
    - `events`: the stop event of the scene that ended the run, with its observed time and the sigma of this
      time, both in s: `events={"has_fallen": (1.83, 0.005)}`. The difference between simulated and observed
      time is a residual. Later samples are omitted.

    **Raises** ValueError for times that do not increase, infinite values, channels without values, sigmas
    that are not positive, unknown names, several events, an event before the start, and samples that may
    refer to times before the start.
    """

    ts: Times  # s; this and all other known numbers are NumPy arrays
    values: dict[str, Numbers]
    sigma: dict[str, Numbers]
    start: dict[str, Numbers]
    unknown_start: dict[str, Range | None]
    inputs: dict | Inputs | None
    sensors: dict[str, Sensor]
    readings: dict[str, Reading]  # prepared sensors; `checked` fills this and the next two fields
    drives: dict[str, Drive]  # actuators with estimated parameters, by input
    estimates: dict[str, Estimate]  # of sensors and actuators, as "gyro.gain"
    t0: Float[Entries, ""]  # s
    # s, of channels with correlated noise; zero if it is estimated
    correlation_time: dict[str, Float[Entries, ""]]
    unknown_sigma: Labels = static()  # channels with estimated sigma; their `sigma` is 1 here
    unknown_correlation: Labels = static()  # channels with estimated correlation time
    ended_by: str = static()  # channel of the observed event time; empty if there is none

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
        if isinstance(correlation_time, Mapping):
            memory = correlation_time
        else:
            memory = dict.fromkeys(self.values, correlation_time)
        self.unknown_correlation = tuple(sorted(name for name, value in memory.items() if value is None))
        self.correlation_time = _correlation_times(memory)
        self.start = _reals("start value", start)
        if isinstance(unknown_start, Mapping):
            self.unknown_start = dict(unknown_start)
        else:
            self.unknown_start = dict.fromkeys(as_names(unknown_start))
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
                f"`t0` is {self.t0} s, expected at most the time of the first sample ({self.ts[0]} s) and "
                f"less than the last ({self.ts[-1]} s); give an earlier `t0`"
            )
        if not self.values:
            raise ValueError(
                "`values` is empty; give the measured values of at least one channel by name, or in `events` "
                "the time of an event"
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

    # Equinox's `__getattribute__` costs a microsecond per access, and a fit reads a hundred fields
    __getattribute__ = object.__getattribute__

    def changed(self, **fields: Any) -> "Experiment":
        """Return this run with some fields replaced, without checking it again."""
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
    what: str, given: Mapping, advice: str = "check its elements", shape: tuple[()] | None = None
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
