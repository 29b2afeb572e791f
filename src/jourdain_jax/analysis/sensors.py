"""Sensors and actuators: what lies between a motion and its measurements, and between a command and the scene.

    sensor      reading(t) = gain y(t - delay) + bias,      lag y' + y = x,      y(t0) = x(t0)      x: a quantity of the motion
    actuator    input(t) = gain y(t - delay) + bias         the same, of a command; y is its first value until then

Each number is known, or a `jj.Estimate`. Source: L. Ljung, System Identification, 2nd ed. (1999), sections 4.2 and 4.4.
"""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.channels import Channel
from jourdain_jax.analysis.estimate import Estimate
from jourdain_jax.analysis.instruments import Instrument
from jourdain_jax.analysis.lagged import filtered, filtered_held, held, read
from jourdain_jax.analysis.ranges import positive, unbounded
from jourdain_jax.analysis.stop_events import StopEvent
from jourdain_jax.calculus.reals import checked_real, described, is_traced
from jourdain_jax.motion.inputs import Sampled
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.motion_state import Motion

NUMBERS = {"gain": 1.0, "bias": 0.0, "delay": 0.0, "lag": 0.0}  # and those of an ideal sensor
UNITS = {"gain": "", "bias": "", "delay": "s", "lag": "s"}
OF_TIME = ("delay", "lag")


class Sensor(eqx.Module):
    """How a channel shows a quantity of the motion: `reading(t) = gain y(t - delay) + bias`, `lag y' + y = quantity`.

        jj.Sensor("lean_rate", gain=jj.Estimate(1.0), bias=jj.Estimate(0.0, per_run=True), delay=jj.Estimate(0.02, range=jj.bounds(0.0, 0.1)), lag=0.01)

    - `quantity`: a coordinate, a speed, an `Accelerometer`, a `LoadCell`, or a function of a `Motion` (one instant) such as
      `lambda motion: motion["sleigh"].place((0.3, 0.0, 0.0))`; default: what the channel is called.
    - `gain`, `bias` (in the unit of the channel): one number, or one for each component of a channel that is a vector.
    - `delay` in s. No sample that counts may show a time before the start of the run: its time less the largest delay is at or after `t0`.
    - `lag` in s: time constant of a first-order low-pass, which starts at rest: at `t0` it shows the quantity as it is then.

    Each number may be an `Estimate`. By default an estimated lag is positive, gain and bias may be any number; a delay needs `range=jj.bounds(low, high)`.

    With a delay or a lag, a motion (a piece of one, with `shooting`) is worked out at equal intervals, 64 or more and none longer than the median interval of
    the samples, and read between them by polynomials of degree 5: with intervals h and an angular frequency w, to 0.02 (w h)^6 of the amplitude. Where the
    slope of the quantity jumps by J (a speed under a force that steps), the error nearby is up to 0.26 J h; where its second derivative jumps by J, up to
    0.08 J h^2.

    Inside `jit`, where times are not known, there are two intervals for each of the samples: take the first sample at or near `t0`.

    **Raises** ValueError for numbers that are not finite, and delays or lags below zero.
    """

    quantity: str | Callable | Instrument | None
    gain: Float[Array, "..."] | Estimate
    bias: Float[Array, "..."] | Estimate
    delay: Float[Array, ""] | Estimate  # s
    lag: Float[Array, ""] | Estimate  # s

    def __init__(self, quantity=None, *, gain=1.0, bias=0.0, delay=0.0, lag=0.0):
        if not (quantity is None or isinstance(quantity, str | Instrument) or callable(quantity)):
            raise ValueError(f"`quantity` of `Sensor` is {described(quantity)}, expected a coordinate, a speed, or a function of a motion")
        self.quantity = quantity
        self.gain, self.bias, self.delay, self.lag = _checked("Sensor", gain=gain, bias=bias, delay=delay, lag=lag)


class Actuator(eqx.Module):
    """How an input follows its command: `input(t) = gain y(t - delay) + bias`, `lag y' + y = command`.

        inputs={"steer_torque": jj.Actuator(jj.Sampled(ts, command), delay=jj.Estimate(0.02, range=jj.bounds(0.0, 0.1)), lag=jj.Estimate(0.03))}

    - `command`: `Sampled`; it has its first value at all times before.
    - `gain`, `bias` (in the unit of the input), `delay` (s), `lag` (s): numbers, or `Estimate`, as of a `Sensor`.

    - `hold`: whether the command keeps each value until the next sample, as that of a digital controller does; otherwise it is linear between its samples.
      Two knots then stand for a sample, and a motion takes as many more steps.

    The low-pass is exact at the samples of the command, and linear in between (of a command that holds, take a lag of an interval or more); it does not go on
    after the last of them.

    **Raises** ValueError for a command of another kind, a `hold` that is neither True nor False, numbers that are not finite, and delays or lags below zero.
    """

    command: Sampled
    gain: Float[Array, ""] | Estimate
    bias: Float[Array, ""] | Estimate
    delay: Float[Array, ""] | Estimate  # s
    lag: Float[Array, ""] | Estimate  # s
    hold: bool = eqx.field(static=True)

    def __init__(self, command, *, gain=1.0, bias=0.0, delay=0.0, lag=0.0, hold=False):
        if not isinstance(command, Sampled):
            raise ValueError(f"`command` of `Actuator` is {described(command)}, expected `jj.Sampled(ts, values)`")
        if not isinstance(hold, bool):
            raise ValueError(f"`hold` of `Actuator` is {described(hold)}, expected True (each value until the next) or False (linear between samples)")
        self.command, self.hold = command, hold
        self.gain, self.bias, self.delay, self.lag = _checked("Actuator", gain=gain, bias=bias, delay=delay, lag=lag)


def _checked(owner: str, **numbers) -> list:
    found = []
    for name, value in numbers.items():
        where = f"`{name}` of `{owner}`"
        if not isinstance(value, Estimate):
            value = checked_real(value, where, () if name in OF_TIME or owner == "Actuator" else None, advice="give a number, or an `Estimate`").astype(
                jnp.result_type(float)
            )
            if not is_traced(value) and not np.all(np.isfinite(value)):
                raise ValueError(f"{where} is {value}, expected a finite number")
            if name in OF_TIME and not is_traced(value) and value < 0:
                raise ValueError(f"{where} is {float(value):g} s, expected zero or more; where the clock of a channel is ahead, shift its times")
        else:
            _check_estimate(where, name, value)
        found.append(value)
    return found


def _check_estimate(where: str, name: str, value: Estimate) -> None:
    if value.guess is None:
        raise ValueError(f"{where} is to be estimated, but has no first guess; give one: `jj.Estimate({NUMBERS[name]})`")
    if name not in OF_TIME:
        return
    if isinstance(value.guess, tuple):
        raise ValueError(f"{where} is to be estimated from {len(value.guess)} guesses, expected one number")
    if name == "delay" and (value.range is None or not np.isfinite(value.range.high)):
        raise ValueError(f"{where} is to be estimated, but nothing says how long it may be; give `range=jj.bounds(low, high)`, in s")
    if value.range is not None and value.range.low < 0:
        raise ValueError(f"{where} may fall to {value.range.low:g} s, expected a range from zero or more")


def default_range(name: str):
    """The range of an estimated number that states none."""
    return positive() if name == "lag" else unbounded()


class Reading(eqx.Module):
    """A sensor of one run made ready: its quantity looked up, numbers in place of what is to be estimated."""

    operation: Channel | Instrument | StopEvent | None  # None: a coordinate or speed by name
    name: str = eqx.field(static=True)  # of that
    numbers: dict[str, Float[Array | np.ndarray, "..."] | float]
    unknown: tuple[str, ...] = eqx.field(static=True)  # names of numbers that are estimated
    used: tuple[str, ...] = eqx.field(static=True)  # names of numbers that are not those of an ideal sensor

    @property
    def is_late(self) -> bool:
        """Whether it shows something else than what is now."""
        return any(name in self.used for name in OF_TIME)

    def quantity(self, motion: Trajectory, states: Motion | None) -> Float[Array, "times *channel"]:
        """What it measures, along a motion; `states`: the same as bodies, where a channel is a function of them."""
        if self.operation is None:
            return motion[self.name]
        return self.operation.over_times(motion) if isinstance(self.operation, Instrument) else jax.vmap(self.operation)(states)

    @property
    def has_filter(self) -> bool:
        """Whether it has a low-pass."""
        return "lag" in self.used

    def shown(self, x, grid, ts, begin=None) -> tuple[Float[Array, "times *channel"], Float[Array | np.ndarray, "grid entries"] | None]:
        """What it shows at `ts` of a quantity with values `x` at these times, or on a grid; and y on the grid, from what it is at first (None: at rest)."""
        y = None
        if grid is not None:
            x, y = read(x, grid, ts, self.numbers["delay"], self.numbers["lag"] if self.has_filter else None, begin)
        x = self.numbers["gain"] * x if "gain" in self.used else x
        return x + self.numbers["bias"] if "bias" in self.used else x, y


def ideal(name: str, event: StopEvent | None = None) -> Reading:
    """An ideal sensor of a coordinate or speed; or what shows the time of an event."""
    return Reading(event, name, dict(NUMBERS), (), ())


class Drive(eqx.Module):
    """An actuator of one run made ready; see `Reading`."""

    command: Sampled
    index: int = eqx.field(static=True)  # of its input
    numbers: dict[str, Float[Array | np.ndarray, ""]]
    unknown: tuple[str, ...] = eqx.field(static=True)
    used: tuple[str, ...] = eqx.field(static=True)
    hold: bool = eqx.field(static=True)

    def signal(self) -> Sampled:
        """What the scene is given."""
        ts, values = jnp.asarray(self.command.ts), jnp.asarray(self.command.values)
        if "lag" in self.used:
            values = (filtered_held if self.hold else filtered)(ts, values, self.numbers["lag"])
        elif self.hold and ts.shape[0] > 1:
            ts, values = held(ts, values)
        values = self.numbers["gain"] * values if "gain" in self.used else values
        values = values + self.numbers["bias"] if "bias" in self.used else values
        return eqx.tree_at(lambda s: (s.ts, s.values), self.command, (ts + self.numbers["delay"], values))


def numbers_of(owner: Sensor | Actuator) -> tuple[dict, tuple[str, ...], tuple[str, ...]]:
    """Its numbers (first guesses where they are estimated), names of those that are, and names of all that matter."""
    given = {name: getattr(owner, name) for name in NUMBERS}
    unknown = tuple(name for name, value in given.items() if isinstance(value, Estimate))
    numbers = {}
    for name, value in given.items():
        number = value.guess if isinstance(value, Estimate) else value
        numbers[name] = (jnp if is_traced(number) else np).asarray(number, jnp.result_type(float))
    used = tuple(n for n, x in numbers.items() if n in unknown or is_traced(x) or not np.all(x == NUMBERS[n]))
    return numbers, unknown, used


def with_numbers(parts: Mapping[str, "Reading | Drive"], known: Mapping[str, Array | np.ndarray]) -> dict:
    """Readings or drives with these numbers (`gyro.gain` -> number) in place of those that are estimated."""
    changed = {}
    for label, part in parts.items():
        numbers = part.numbers | {name: known[f"{label}.{name}"] for name in part.unknown}
        changed[label] = eqx.tree_at(lambda p: p.numbers, part, numbers) if part.unknown else part
    return changed


def latest(delay: Array | Estimate) -> float:
    """The largest delay that a sensor may have, s."""
    return float(delay.range.high if isinstance(delay, Estimate) else delay)
