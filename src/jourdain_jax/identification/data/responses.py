"""Sensors and actuators of one run with numbers in place of estimates: `Reading` and `Drive`."""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Entries, array_module, holds, real_type, static
from jourdain_jax.identification.data.channels import Channel, Instrument, StopEvent
from jourdain_jax.identification.data.delay_filter import filtered, held, read
from jourdain_jax.identification.data.estimate import Estimate
from jourdain_jax.identification.data.sensors import NUMBERS, OF_TIME, Actuator, Sensor
from jourdain_jax.integrate.inputs import Inputs, Sampled
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.names import Labels

Numbers = Float[Entries, "..."]


class Response(eqx.Module):
    """The numbers of a sensor or actuator of one run; estimated numbers have their first guesses."""

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
    name: str = static()  # of the coordinate, speed or event

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
    """Return the numbers of a sensor or actuator (first guesses of estimated ones), the names of estimated
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
