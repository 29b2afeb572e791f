"""Sensors and actuators: models between a motion and its measurements, and between a command and the scene.

    sensor      reading(t) = gain y(t - delay) + bias,      lag y' + y = x,      y(t0) = x(t0)      x: a quantity of the motion
    actuator    input(t) = gain y(t - delay) + bias         the same for a command; y is its first value at all earlier times

Each number is known, or a `jj.Estimate`. Source: L. Ljung, System Identification, 2nd ed. (1999), sections
4.2 and 4.4.

With a delay or lag, the motion is computed at equal intervals h. Between these times, x is the polynomial of
degree 5 through the six nearest points. Its error for an angular frequency w is 0.005 (w h)^6 of the
amplitude, or 0.02 (w h)^6 in the first and last two intervals. Near a jump J of the slope it is up to 0.18 J
h, at the ends 0.26 J h; near a jump J of the second derivative up to 0.032 J h^2, at the ends 0.075 J h^2.
The filter is exact for that polynomial. With rho = lag / h:

    small rho     y = P + (y_k - P_k) exp(-s / rho),   P = sum_j (-rho)^j p^(j)       (P solves the equation; s: intervals since time k)
    large rho     y = y_k exp(-s / rho) + integral_0^s exp(-(s - a) / rho) p(a) da / rho       by Gauss-Legendre quadrature

Both are smooth in delay and lag, even at a lag of zero. Source: M. Abramowitz and I. A. Stegun, Handbook of
Mathematical Functions (1964), 25.2 and 25.4.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Entries,
    Number,
    Scalar,
    array_module,
    check_kind,
    checked_real,
    described,
    holds,
    is_traced,
    real_type,
    static,
)
from jourdain_jax.identification.data.channels import Channel, Instrument, StopEvent
from jourdain_jax.identification.data.estimate import Estimate, positive, unbounded
from jourdain_jax.integrate.inputs import Inputs, Sampled
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.names import Labels

FEWEST_INTERVALS = 64  # up to the end of a run, or to the next node of a piece
Numbers = Float[Entries, "..."]
Times = Float[Entries, "times"]
Knots = Float[Array, "knots"]
Stated: TypeAlias = Number | Sequence[Number] | Estimate


def intervals(t0, ts: Times, node) -> int:
    """Return the number of equal intervals from the start to the last sample. Equally spaced samples keep
    their intervals; otherwise no interval is longer than the median interval of the samples.

    If times are traced, only the number of samples is known, and there are two intervals per sample. For a
    piece of a run, intervals are counted to the next `node`, after which the grid continues.
    """
    if is_traced((t0, ts)):
        return max(FEWEST_INTERVALS, 2 * (ts.shape[0] - 1))
    steps, end = np.diff(np.asarray(ts, float)), ts[-1] if node is None else node
    needed = float(end - t0) / np.median(steps) if steps.size else 1.0
    count = round(needed) if abs(needed - round(needed)) < 1e-6 * needed else int(np.ceil(needed))
    count *= -(-FEWEST_INTERVALS // count)
    return int(np.ceil(count * float((ts[-1] - t0) / (end - t0)) - 1e-9))


def grid(t0, ts: Times, count: int, node=None) -> Float[Entries, "grid"]:
    """Return the grid of `count` intervals to the last sample. For a piece it extends by at most one more
    interval, so that the next `node` is a grid time.
    """
    end = ts[-1] if node is None else node
    until = count if node is None or node == ts[-1] else int(count * float((end - t0) / (ts[-1] - t0)) + 1e-9)
    xp = array_module((t0, end))
    found = xp.asarray(t0 + (end - t0) * xp.arange(count + 1) / until, real_type())
    return xp.where(xp.arange(count + 1) == until, end, found)  # without round-off at this time


POINTS = 6  # of the grid, that a polynomial goes through
_MIDDLE = (POINTS - 1) / 2
# values -> coefficients, highest power first
_COEFFICIENTS = np.linalg.inv(np.vander(np.arange(POINTS) - _MIDDLE))
_LEAST = 1e-3  # lower limit of rho in exp(-s / rho)


def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of the quadrature from 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


_NODES, _WEIGHTS = gauss_legendre(10)


def read(
    values: Float[Entries, "grid *channel"],
    grid: Float[Entries, "grid"],
    ts: Times,
    delay,
    lag=None,
    begin: Float[Array, "entries"] | None = None,
) -> tuple[Float[Array, "times *channel"], Float[Entries, "grid entries"]]:
    """Return the reading at `ts` of a quantity with these `values` at the times `grid` (s; six or more,
    equally spaced), and y on the grid. `lag`: None for no filter.

    Times before the grid count as its first time. `delay`, `lag` in s. `begin`: the initial output of the
    filter; None: its steady value.
    """
    count, step = grid.shape[0], (grid[-1] - grid[0]) / (grid.shape[0] - 1)
    x = jnp.maximum((ts - delay - grid[0]) / step, 0.0)
    interval = jnp.clip(jnp.floor(jax.lax.stop_gradient(x)), 0, count - 2).astype(int)
    flat = values.reshape(count, -1)
    coefficients = _COEFFICIENTS.astype(flat.dtype)
    begins = np.arange(count - 1)
    first = np.clip(begins - (POINTS // 2 - 1), 0, count - POINTS)  # of the points about each interval
    some = flat[first[:, None] + np.arange(POINTS)]
    polynomials = jnp.einsum("ij,kjc->kic", coefficients, some)  # (intervals, powers, channel)
    left = jnp.asarray(begins - first - _MIDDLE, flat.dtype)  # place of the interval's begin
    since = x - interval
    if lag is None:
        found, y = jax.vmap(jnp.polyval)(polynomials[interval], left[interval] + since), flat
    else:
        rho = lag / step

        def next_one(y, here):
            polynomial, begin = here
            return _relaxed(y, polynomial, begin, jnp.ones((), flat.dtype), rho), y

        end, at_begins = jax.lax.scan(next_one, flat[0] if begin is None else begin, (polynomials, left))
        found = jax.vmap(_relaxed, (0, 0, 0, 0, None))(
            at_begins[interval], polynomials[interval], left[interval], since, rho
        )
        y = jnp.concatenate([at_begins, end[None]])
    return found.reshape(ts.shape[0], *values.shape[1:]), y


def _relaxed(
    y: Float[Array, "channel"], polynomial: Float[Array, "powers channel"], begin, since, rho
) -> Float[Array, "channel"]:
    """Return the filter's output `since` intervals after the time `begin`, at which it was `y`."""
    small = rho < 0.2
    quick, slow = jnp.where(small, rho, 0.1), jnp.where(small, 1.0, rho)
    # P = p - rho p' + rho^2 p'' - ...
    particular, derivative = polynomial, polynomial
    for order in range(1, POINTS):
        powers = np.arange(POINTS - 1, 0, -1, polynomial.dtype)[:, None]
        derivative = jnp.concatenate([jnp.zeros_like(derivative[:1]), powers * derivative[:-1]])
        particular = particular + (-quick) ** order * derivative
    decay = jnp.exp(-since / jnp.maximum(quick, _LEAST))
    by_formula = jnp.polyval(particular, begin + since) + (y - jnp.polyval(particular, begin)) * decay
    weights = (
        since
        / slow
        * jnp.asarray(_WEIGHTS, polynomial.dtype)
        * jnp.exp(-since * (1 - _NODES.astype(polynomial.dtype)) / slow)
    )
    inside = jax.vmap(lambda node: jnp.polyval(polynomial, begin + since * node))(
        jnp.asarray(_NODES, polynomial.dtype)
    )
    by_quadrature = y * jnp.exp(-since / slow) + weights @ inside
    return jnp.where(small, by_formula, by_quadrature)


def held(ts: Knots, values: Knots) -> tuple[Float[Array, "more_knots"], Float[Array, "more_knots"]]:
    """Return times and values of a command that keeps each value until the next sample. Each change takes a
    thousandth of the shortest interval, with its middle at the stated time.
    """
    half = 0.5e-3 * jnp.min(jnp.diff(ts))
    late = jnp.stack([ts[1:] - half, ts[1:] + half], axis=1).reshape(-1)
    return jnp.concatenate([ts[:1], late]), jnp.concatenate(
        [values[:1], jnp.stack([values[:-1], values[1:]], axis=1).reshape(-1)]
    )


def filtered(ts: Knots, values: Knots, lag, hold: bool = False) -> Knots:
    """Return the exact output of the filter at the samples of a command that is linear between samples, or
    held until the next sample.

        y_k+1 = x_k+1 - lag m + (y_k - x_k + lag m) exp(-h / lag),     m = (x_k+1 - x_k) / h;      held: y_k+1 = x_k + (y_k - x_k) exp(-h / lag)
    """
    steps = jnp.diff(ts)
    decay = jnp.exp(-steps / jnp.maximum(lag, _LEAST * steps))
    behind = 0 * steps if hold else lag * jnp.diff(values) / steps  # lag behind a steady slope
    ends = values[:-1] if hold else values[1:]

    def next_one(y, here):
        x, end, b, d = here
        y = end - b + (y - x + b) * d
        return y, y

    _, found = jax.lax.scan(next_one, values[0], (values[:-1], ends, behind, decay))
    return jnp.concatenate([values[:1], found])


NUMBERS = {"gain": 1.0, "bias": 0.0, "delay": 0.0, "lag": 0.0}  # names, with the values of an ideal sensor
UNITS = {"gain": "", "bias": "", "delay": "s", "lag": "s"}
OF_TIME = ("delay", "lag")


class Sensor(eqx.Module):
    """A sensor of a channel: `reading(t) = gain y(t - delay) + bias`, `lag y' + y = quantity`.

        Sensor("lean_rate", gain=jj.Estimate(1.0), bias=jj.Estimate(0.0, per_run=True), delay=jj.Estimate(0.02, range=jj.bounds(0.0, 0.1)), lag=0.01)

    - `quantity`: a coordinate, a speed, an `Accelerometer`, a `LoadCell`, or a function of a `Motion` (one
      instant) such as `lambda motion: motion["sleigh"].place((0.3, 0.0, 0.0))`; default: the coordinate or
      speed with the channel's name.
    - `gain`, `bias` (in the unit of the channel): one number, or one per component of a vector channel.
    - `delay` in s. Every sample that counts must come at least the largest delay after `t0`, since the
      earlier motion is unknown.
    - `lag` in s: time constant of a first-order low-pass filter, whose initial output is the quantity at
      `t0`.

    Each number may be an `Estimate`. By default an estimated lag is positive, and gain and bias are
    unbounded; a delay needs `range=jj.bounds(low, high)`.

    With a delay or a lag, the motion (or, with `shooting`, a piece of it) is computed at equal intervals, at
    least 64 and none longer than the median interval of the samples. It is interpolated by polynomials of
    degree 5. For intervals h and an angular frequency w, the error is about 0.02 (w h)^6 of the amplitude.
    Near a jump J of the slope (a speed under a force that steps) the error is up to 0.26 J h; near a jump J
    of the second derivative, up to 0.08 J h^2.

    Under `jit`, where times are unknown, each interval between samples is halved: give a first sample at or
    near `t0`.

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

        inputs={"steer_torque": jj.identification.Actuator(jj.Sampled(ts, command), delay=jj.Estimate(0.02, range=jj.bounds(0.0, 0.1)), lag=jj.Estimate(0.03))}

    - `command`: `Sampled`, with its first value at all earlier times.
    - `gain`, `bias` (in the unit of the input), `delay` (s), `lag` (s): numbers or `Estimate`, as in
      `Sensor`.
    - `hold`: whether the command keeps each value until the next sample, as in a digital controller;
      otherwise it is linear between samples. Holding doubles the number of samples, and a motion takes more
      steps.

    The low-pass filter is exact at the samples of the command and linear in between. A held command therefore
    needs a lag of at least one interval. The output ends with the last sample.

    **Raises** ValueError for a command of another type, a `hold` that is neither True nor False, numbers that
    are not finite, and negative delays or lags.
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
        check_kind(
            hold,
            bool,
            "`hold` of `Actuator`",
            "True (each value until the next) or False (linear between samples)",
        )
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
            f"{where} is {float(number):g} s, expected zero or more; where the clock of a "
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
    """Return the default range of an estimated number."""
    return positive() if name == "lag" else unbounded()


class Response(eqx.Module):
    """The numbers of a sensor or actuator of one run, with first guesses for the estimated ones."""

    numbers: dict[str, Numbers | float]
    unknown: Labels = static()  # names of estimated numbers
    used: Labels = static()  # names of numbers with an effect

    @property
    def is_late(self) -> bool:
        """Return whether it has a delay or a lag."""
        return any(name in self.used for name in OF_TIME)

    @property
    def has_filter(self) -> bool:
        """Return whether it has a low-pass filter."""
        return "lag" in self.used

    def scaled(self, x):
        """Apply gain and bias."""
        x = self.numbers["gain"] * x if "gain" in self.used else x
        return x + self.numbers["bias"] if "bias" in self.used else x


class Reading(Response):
    """A sensor of one run, with its quantity looked up."""

    operation: Channel | Instrument | StopEvent | None  # None: a coordinate or speed by name
    name: str = static()  # of the coordinate, speed or event

    def quantity(self, motion: Trajectory, states: Motion | None) -> Float[Array, "times *channel"]:
        """Return the measured quantity along a motion. `states`: the motions of bodies, for functions of a
        `Motion`.
        """
        if self.operation is None:
            return motion[self.name]
        return (
            self.operation.over_times(motion)
            if isinstance(self.operation, Instrument)
            else jax.vmap(self.operation)(states)
        )

    def shown(
        self, x, grid, ts, begin=None
    ) -> tuple[Float[Array, "times *channel"], Float[Entries, "grid entries"] | None]:
        """Return the reading at `ts` of a quantity with values `x` at these times or on a grid, and y on the
        grid. `begin`: initial output of the filter (None: its steady value).
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
        """Return the scene's input."""
        ts, values = jnp.asarray(self.command.ts), jnp.asarray(self.command.values)
        if self.has_filter:
            values = filtered(ts, values, self.numbers["lag"], self.hold)
        elif self.hold and ts.shape[0] > 1:
            ts, values = held(ts, values)
        return eqx.tree_at(
            lambda s: (s.ts, s.values), self.command, (ts + self.numbers["delay"], self.scaled(values))
        )

    def put_into(self, inputs) -> Inputs:
        """Return `inputs` with this signal."""
        return eqx.tree_at(lambda i: i.channels[self.index], inputs, self.signal())


def response(owner: Sensor | Actuator) -> tuple[dict, Labels, Labels]:
    """Return the numbers of a sensor (first guesses for estimated ones), the names of the estimated ones, and
    the names of all numbers that have an effect.
    """
    given = {name: getattr(owner, name) for name in NUMBERS}
    unknown = tuple(name for name, value in given.items() if isinstance(value, Estimate))
    numbers = {name: value.guess if name in unknown else value for name, value in given.items()}
    numbers = {name: array_module(x).asarray(x, real_type()) for name, x in numbers.items()}
    return (
        numbers,
        unknown,
        tuple(
            n for n, x in numbers.items() if n in unknown or holds(lambda x, n=n: np.any(x != NUMBERS[n]), x)
        ),
    )


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
