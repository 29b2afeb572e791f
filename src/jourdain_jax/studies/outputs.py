"""Outputs of a study: one number per motion, with its unit.

Outputs are functions of a `Trajectory`, evaluated on all samples of a block by one compiled program. They are
NaN for failed motions.
"""

import re
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax.numpy as jnp

from jourdain_jax.calculus.files import shortened
from jourdain_jax.calculus.reals import Scalar, described
from jourdain_jax.equations.scene_parts import names_of_events
from jourdain_jax.integrate.result_codes import EVENT
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.names import check_name, nearest
from jourdain_jax.scene.scene import Scene
from jourdain_jax.studies.along_motion import integral, largest, sampled


class Output:
    """Base of the outputs. `of(motion)` returns the number, `unit` is its unit; `over_times`: whether the
    number depends on all saved times, or only on the end.
    """

    unit: str = ""
    over_times: bool = True

    @abstractmethod
    def of(self, motion: Trajectory) -> Scalar:
        """Return the number of one `motion`, by operations of JAX."""

    def check(self, scene: Scene) -> None:
        """Raise ValueError for names that the `scene` lacks."""


def _check_name(output: Output, name, scene: Scene) -> None:
    valid = (*scene.coordinate_names, *scene.speed_names)
    what = f"{type(output).__name__}({name!r}): `{type(scene).__name__}` has no such coordinate or speed"
    check_name(name, valid, what)


@dataclass(frozen=True)
class End(Output):
    """The value of the coordinate or speed `name` at the end of the motion, at its last time or at an event.
    `unit`: a text stored with it.
    """

    name: str
    unit: str = ""
    over_times = False

    def check(self, scene: Scene) -> None:
        _check_name(self, self.name, scene)

    def of(self, motion: Trajectory) -> Scalar:
        names = motion.scene.coordinate_names
        if self.name in names.entries:
            return motion.q_end[names.entries.index(self.name)]
        return motion.u_end[motion.scene.speed_names.entries.index(self.name)]


@dataclass(frozen=True)
class _Along(Output):
    """A number that summarises a `quantity` along the motion: the name of a coordinate or speed, or a
    function of a trajectory that returns its values at all times, such as `lambda motion:
    jnp.hypot(motion["x"], motion["y"])`.

    Between saved times the quantity is a polynomial. For a smooth quantity saved every h seconds, the error
    of extremes is of order h^5, that of integrals of order h^4.
    """

    quantity: str | Callable
    unit: str = ""

    def check(self, scene: Scene) -> None:
        if not callable(self.quantity):
            _check_name(self, self.quantity, scene)

    def of(self, motion: Trajectory) -> Scalar:
        return self._number(*sampled(motion, self.quantity))

    @staticmethod
    @abstractmethod
    def _number(times, values, count) -> Scalar:
        """Return the number for the first `count` values of the quantity at these times."""


@dataclass(frozen=True)
class Largest(_Along):
    """The largest value of a `quantity` along the motion, also between saved times. `unit`: a text stored
    with it.

    `quantity`: the name of a coordinate or speed, or a function of a trajectory that returns its values at
    all times.
    """

    _number = staticmethod(largest)


@dataclass(frozen=True)
class Smallest(_Along):
    """The smallest value of a `quantity`, computed like `Largest`. `unit`: a text stored with it."""

    @staticmethod
    def _number(times, values, count):
        return -largest(times, -values, count)


@dataclass(frozen=True)
class LargestMagnitude(_Along):
    """The largest magnitude of a `quantity`, computed like `Largest`. `unit`: a text stored with it."""

    @staticmethod
    def _number(times, values, count):
        return jnp.maximum(largest(times, values, count), largest(times, -values, count))


@dataclass(frozen=True)
class Integral(_Along):
    """The integral of a `quantity` over time, from the start to the end of the motion. `unit`: a text stored
    with it, the quantity's unit times s.

    `quantity`: as in `Largest`.
    """

    _number = staticmethod(integral)


@dataclass(frozen=True)
class OfEvent(Output):
    """Base of outputs about the stop event named `event`, or about any stop event for None."""

    event: str | None = None
    over_times = False

    def check(self, scene: Scene) -> None:
        valid = names_of_events(scene)
        if not valid:
            raise ValueError(
                f"{type(self).__name__}({self.event!r}): `{type(scene).__name__}` has no stop events; "
                "give it a method `events`"
            )
        if self.event is not None and self.event not in valid:
            raise ValueError(
                f"{type(self).__name__}({self.event!r}): `{type(scene).__name__}` has no such "
                f"stop event; {nearest(self.event, valid)}"
            )

    def _happened(self, motion: Trajectory):
        stopped = motion.result == EVENT
        if self.event is None:
            return stopped
        return stopped & (motion.event == motion.event_names.index(self.event))


@dataclass(frozen=True)
class EventTime(OfEvent):
    """The time (s) at which the stop event `event` (default: any) ended the motion; NaN if it did not."""

    unit = "s"

    def of(self, motion: Trajectory) -> Scalar:
        return jnp.where(self._happened(motion), motion.t_end, jnp.nan)


@dataclass(frozen=True)
class Happened(OfEvent):
    """1 if the stop event `event` (default: any event) ended the motion, otherwise 0. The mean is the
    fraction of samples that ended so.
    """

    def of(self, motion: Trajectory) -> Scalar:
        return jnp.where(self._happened(motion), 1.0, 0.0)


@dataclass(frozen=True)
class Quantity(Output):
    """A number computed by `function` from a `Trajectory` with operations of JAX, and its `unit` as a text.

    jj.studies.Quantity(lambda motion: jnp.hypot(motion.q_end[0], motion.q_end[1]), "m")
    """

    function: Callable
    unit: str = ""

    def of(self, motion: Trajectory) -> Scalar:
        found = self.function(motion)
        shape = getattr(found, "shape", None if not isinstance(found, int | float) else ())
        if shape != () or jnp.iscomplexobj(found):
            raise ValueError(
                f"an output is {described(found)}, expected one real number for a motion; take "
                "one entry, reduce the array, or give one output for each entry"
            )
        return jnp.asarray(found, motion.q_end.dtype)


def as_outputs(scene: Scene, outputs: Mapping | None) -> dict[str, Output]:
    """Return the checked outputs by name. A function becomes a `Quantity`; None means the end values of all
    coordinates and speeds.
    """
    if outputs is None:
        outputs = {f"{name} at the end": End(name) for name in (*scene.coordinate_names, *scene.speed_names)}
    if not isinstance(outputs, Mapping) or not outputs:
        raise ValueError(
            f"`outputs` is {described(outputs)}, expected a dictionary by name, such as "
            '{"final lean": jj.studies.End("lean", "rad")}'
        )
    found = {}
    for name, output in outputs.items():
        # the name of an output becomes the name of a folder
        printable = isinstance(name, str) and name.isprintable() and len(name.encode()) <= 200
        if not printable or not re.fullmatch(r"[^/\\_.][^/\\]*", name):
            raise ValueError(
                f"an output is called {shortened(repr(name))}, expected printable text of at most "
                "200 bytes, without `/` and `\\`, and without `_` or `.` at its beginning"
            )
        if isinstance(output, type) or not (isinstance(output, Output) or callable(output)):
            raise ValueError(
                f"output `{name}` is {described(output)}, expected an output such as "
                "jj.studies.End('lean'), or a function of a trajectory"
            )
        found[name] = output if isinstance(output, Output) else Quantity(output)
        found[name].check(scene)
    return found
