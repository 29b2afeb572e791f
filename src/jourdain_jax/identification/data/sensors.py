"""Sensors and actuators: models of how measurements follow from a motion, and inputs from a command.

    sensor      reading(t) = gain y(t - delay) + bias,   lag y' + y = x,   y(t0) = x(t0)
    actuator    input(t) = gain y(t - delay) + bias,     lag y' + y = command

x: a quantity of the motion. A command has its first value at all earlier times. Each number is known, or a
`jj.Estimate`. Source: L. Ljung, System Identification, 2nd ed. (1999), sections 4.2 and 4.4.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Number,
    Scalar,
    check_kind,
    checked_real,
    described,
    holds,
    real_type,
    static,
)
from jourdain_jax.identification.data.channels import Instrument
from jourdain_jax.identification.data.estimate import Estimate, positive, unbounded
from jourdain_jax.integrate.inputs import Sampled

NUMBERS = {"gain": 1.0, "bias": 0.0, "delay": 0.0, "lag": 0.0}  # names, with the values of an ideal sensor
UNITS = {"gain": "", "bias": "", "delay": "s", "lag": "s"}
OF_TIME = ("delay", "lag")
Stated: TypeAlias = Number | Sequence[Number] | Estimate


class Sensor(eqx.Module):
    """A sensor of a channel: `reading(t) = gain y(t - delay) + bias`, `lag y' + y = quantity`.

        delay = jj.Estimate(0.02, range=jj.bounds(0.0, 0.1))
        bias = jj.Estimate(0.0, per_run=True)
        Sensor("lean_rate", gain=jj.Estimate(1.0), bias=bias, delay=delay, lag=0.01)

    - `quantity`: a coordinate, a speed, an `Accelerometer`, a `LoadCell`, or a function of a `Motion` (one
      instant) such as `lambda motion: motion["sleigh"].place((0.3, 0.0, 0.0))`; default: the coordinate or
      speed with the channel's name.
    - `gain`, `bias` (in the unit of the channel): one number, or one per component of a vector channel.
    - `delay` in s. Every sample must come at least the largest delay after `t0`, or be NaN, since the motion
      before `t0` is unknown.
    - `lag` in s: time constant of a first-order low-pass filter, whose initial output is the quantity at
      `t0`.

    Each number may be an `Estimate`. By default an estimated lag is positive, and gain and bias are
    unbounded; a delay needs `range=jj.bounds(low, high)`.

    With a delay or a lag, the motion (with `shooting`, each piece of it) is computed at 64 or more equal
    intervals, none longer than the median interval of the samples, and interpolated by quintic polynomials.
    For intervals h and an angular frequency w, the error is about `0.02 (w h)^6` of the amplitude. Near a
    jump J of the slope, such as that of a speed when a force jumps, the error is up to `0.26 J h`. Near a
    jump J of the second derivative, it is up to `0.08 J h^2`.

    Under `jit` times are unknown, and there are two intervals per sample: give a first sample at or near
    `t0`.

    **Raises** ValueError for numbers that are not finite, and for negative delays or lags.
    """

    quantity: str | Callable | Instrument | None
    gain: Float[Array, "..."] | Estimate
    bias: Float[Array, "..."] | Estimate
    delay: Scalar | Estimate  # s
    lag: Scalar | Estimate  # s

    def __init__(
        self,
        quantity: str | Callable | Instrument | None = None,
        *,
        gain: Stated = 1.0,
        bias: Stated = 0.0,
        delay: Stated = 0.0,
        lag: Stated = 0.0,
    ):
        if not (quantity is None or isinstance(quantity, str | Instrument) or callable(quantity)):
            raise ValueError(
                f"`quantity` of `Sensor` is {described(quantity)}, expected a coordinate, a "
                "speed, or a function of a motion"
            )
        self.quantity = quantity
        self.gain, self.bias, self.delay, self.lag = _checked(
            "Sensor", gain=gain, bias=bias, delay=delay, lag=lag
        )


class Actuator(eqx.Module):
    """An actuator that drives an input from its command: `input(t) = gain y(t - delay) + bias`, `lag y' + y =
    command`.

        delay = jj.Estimate(0.02, range=jj.bounds(0.0, 0.1))
        motor = jj.identification.Actuator(jj.Sampled(ts, command), delay=delay, lag=jj.Estimate(0.03))
        inputs = {"steer_torque": motor}

    - `command`: `Sampled`, with its first value at all earlier times.
    - `gain`, `bias` (in the unit of the input), `delay` (s), `lag` (s): numbers or `Estimate`, as in
      `Sensor`.
    - `hold`: whether the command keeps each value until the next sample, as in a digital controller;
      otherwise it is linear between samples. Holding doubles the number of samples, and a motion takes more
      steps.

    The output of the low-pass filter is exact at the samples of the command and linear in between. A held
    command therefore needs a lag of at least one interval. The output ends with the last sample.

    **Raises** ValueError for a command or `hold` of another type, numbers that are not finite, and negative
    delays or lags.
    """

    command: Sampled
    gain: Scalar | Estimate
    bias: Scalar | Estimate
    delay: Scalar | Estimate  # s
    lag: Scalar | Estimate  # s
    hold: bool = static()

    def __init__(
        self,
        command: Sampled,
        *,
        gain: Stated = 1.0,
        bias: Stated = 0.0,
        delay: Stated = 0.0,
        lag: Stated = 0.0,
        hold: bool = False,
    ):
        check_kind(command, Sampled, "`command` of `Actuator`", "`jj.Sampled(ts, values)`")
        kinds = "True (each value until the next) or False (linear between samples)"
        check_kind(hold, bool, "`hold` of `Actuator`", kinds)
        self.command, self.hold = command, hold
        self.gain, self.bias, self.delay, self.lag = _checked(
            "Actuator", gain=gain, bias=bias, delay=delay, lag=lag
        )


def _checked(owner: str, **numbers) -> list:
    return [
        _checked_number(f"`{name}` of `{owner}`", name, value, owner == "Actuator")
        for name, value in numbers.items()
    ]


def _checked_number(where: str, name: str, value, is_one: bool) -> "Float[Array, '...'] | Estimate":
    if isinstance(value, Estimate):
        _check_estimate(where, name, value)
        return value
    number = checked_real(
        value, where, () if name in OF_TIME or is_one else None, advice="give a number, or an `Estimate`"
    ).astype(real_type())
    if not holds(np.isfinite, number):
        raise ValueError(f"{where} is {number}, expected a finite number")
    if name in OF_TIME and not holds(lambda x: x >= 0, number):
        raise ValueError(
            f"{where} is {float(number):g} s, expected zero or more; if the clock of a "
            "channel is ahead, shift its times"
        )
    return number


def _check_estimate(where: str, name: str, value: Estimate) -> None:
    if value.guess is None:
        raise ValueError(
            f"{where} is to be estimated, but has no first guess; give one: `jj.Estimate({NUMBERS[name]})`"
        )
    if name not in OF_TIME:
        return
    if isinstance(value.guess, tuple):
        raise ValueError(f"{where} has {len(value.guess)} guesses, expected one number")
    if name == "delay" and (value.range is None or not np.isfinite(value.range.high)):
        raise ValueError(
            f"{where} is to be estimated, but has no upper limit; give `range=jj.bounds(low, high)`, in s"
        )
    if value.range is not None and value.range.low < 0:
        raise ValueError(
            f"{where} may fall to {value.range.low:g} s, expected a range that begins at zero or above"
        )


def default_range(name: str):
    """Return the default range of an estimated parameter of a sensor or actuator."""
    return positive() if name == "lag" else unbounded()
