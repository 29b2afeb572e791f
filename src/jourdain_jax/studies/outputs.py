"""Outputs of a study: one number per motion, with its unit.

Outputs are functions of a `Trajectory`, evaluated on all samples of a block by one compiled program. They are
NaN for failed motions.

A `Task` computes a study in blocks of a fixed number of samples, each by one `rollout` and one compiled
program for the outputs.

Block b of B samples holds samples b B to (b + 1) B - 1, independently of the chunks in which results are
stored. The last block is padded with copies of its last sample. All blocks run the same compiled programs on
arrays of the same shapes, so the results of a sample do not depend on chunks, order or processes.
"""

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.files import shortened
from jourdain_jax.calculus.reals import Scalar, described
from jourdain_jax.equations.rows import names_of_events
from jourdain_jax.integrate.result_codes import EVENT
from jourdain_jax.motion.options import AllOptions, stated
from jourdain_jax.motion.trajectories.labels import OF_LANES
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.coordinates import check_name, nearest, parameters_of
from jourdain_jax.scene.digests import digest
from jourdain_jax.scene.scene import Scene
from jourdain_jax.studies.along_motion import integral, largest, sampled
from jourdain_jax.studies.design import Design
from jourdain_jax.studies.store import Column


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


# tuning, samples: one slow sample costs little, and a block takes a fraction of a second
LARGEST_BLOCK = 2048
AT_START = "_at_start"  # suffix of columns of start values, after the coordinate or speed
RESERVED = ("lane", "saved_lane", "run", "zarr.json")  # axes, and names of files next to the arrays
SAVES = ("statistics", "outputs")


@dataclass(frozen=True)
class Task:
    """Everything that determines the results of a study."""

    scene: Scene
    design: Design  # parameters by name, start values by name and AT_START
    constants: Mapping[str, object]  # start values shared by all samples
    outputs: Mapping[str, Output]
    span: Mapping[str, Any]  # t0, t1, ts, inputs
    options: AllOptions
    save: str
    keep_every: int | None  # interval of samples whose states at `ts` are stored; None: none
    # samples of a block, equal in all processes; a GPU takes some ten thousand at once
    largest_block: int = field(
        default_factory=lambda: LARGEST_BLOCK if jax.default_backend() == "cpu" else 2**17
    )
    memory: int | None = None  # bytes allowed for each computing process

    @property
    def block(self) -> int:
        """Return the number of samples of a block."""
        block = min(self.largest_block, max(8, 1 << (len(self.design) - 1).bit_length()))
        # limit on the bytes of saved states of a block
        while block > 8 and block * self.bytes_of_lane > (2**26):
            block //= 2
        return block

    @property
    def bytes_of_lane(self) -> int:
        """Return the bytes of the saved states of a sample during its computation."""
        return 8 * (len(self.scene.coordinate_names) + len(self.scene.speed_names) + 2) * len(self.ts)

    @property
    def bytes_of_kept_lane(self) -> float:
        """Return the stored bytes per sample, on average."""
        return sum(
            np.dtype(column.dtype).itemsize * math.prod(length for _, length in column.more) / column.every
            for column in self.columns().values()
        )

    @property
    def stride(self) -> int:
        """Return the interval between samples whose states are stored."""
        return self.keep_every or 1

    @property
    def ts(self) -> np.ndarray:
        """Return the saved times, s."""
        return np.asarray(self.span["ts"])

    def starts_and_parameters(self, values: Mapping) -> tuple[dict, dict]:
        """Return start values (including shared ones) and parameters, from columns of the design by name."""
        starts = {
            name.removesuffix(AT_START): column for name, column in values.items() if name.endswith(AT_START)
        }
        return dict(self.constants) | starts, {
            name: column for name, column in values.items() if not name.endswith(AT_START)
        }

    def outputs_of_lane(self, motion: Trajectory) -> Float[Array, "outputs"]:
        """Return the outputs of one motion; NaN if it failed."""
        sound = motion.nan_if_failed()
        return jnp.stack(
            [jnp.where(motion.succeeded, output.of(sound), jnp.nan) for output in self.outputs.values()]
        )

    @property
    def settled(self) -> dict[str, Any]:
        """Return the given span, inputs and options by name."""
        return {name: value for name, value in self.span.items() if value is not None} | stated(self.options)

    def columns(self) -> dict[str, Column]:
        """Return the arrays of the store. Raises ValueError if two have one name, or one has the name of an
        axis or of another file in the store.
        """
        units = {name: about["unit"] for name, _, about in parameters_of(self.scene)}
        found: list[tuple[str, Column]] = []
        if self.save == "statistics" and self.keep_every is None:
            return {}
        every = self.stride if self.save == "statistics" else 1

        def number(name: str, about: str, unit: str, **role: str) -> None:
            attributes = {"long_name": about} | role | ({"units": unit} if unit else {})
            found.append((name, Column("float64", math.nan, attributes, every=every)))

        for name in self.design.names:
            if name.endswith(AT_START):
                about = f"start value of {name.removesuffix(AT_START)}"
            else:
                about = f"parameter {name}"
            number(name, about, units.get(name, ""), role="varied")
        for name, (_, dtype, fill, attributes) in OF_LANES.items():
            events: dict = {"event_names": list(names_of_events(self.scene))} if name == "event" else {}
            found.append((name, Column(dtype, fill, attributes | events, every=every)))
        for name, output in self.outputs.items():
            number(name, name, output.unit, role="output")
        along = (*self.scene.coordinate_names, *self.scene.speed_names) if self.keep_every else ()
        for name in along:
            about = {"long_name": f"{name} along the motion"}
            found.append((name, Column("float64", math.nan, about, (("time", len(self.ts)),), self.stride)))
        names = [*(name for name, _ in found), *(("time",) if along else ()), *RESERVED]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(
                f"`{twice[0]}` would name two arrays of the study, which has {', '.join(map(repr, names))}; "
                "give the output another name"
            )
        return dict(found)

    def identity(self) -> dict[str, str]:
        """Return digests of all arguments that determine the results, by name."""
        drawn = self.design
        design = dict(drawn.variables), drawn.sampler, len(drawn), drawn.seed, drawn.correlation
        return {
            "scene": digest((type(self.scene), self.scene)),
            "start": digest(dict(self.constants)),
            "design": digest(design),
            "outputs": digest(dict(self.outputs)),
            "options": digest(dict(sorted(self.settled.items()))),
            "save": digest((self.save, self.keep_every)),
            "precision": digest(str(jnp.result_type(float))),
            "backend": jax.default_backend(),
        }
