"""The computation of a study: blocks of a fixed number of samples, each computed by one `rollout` and one
compiled program for the outputs.

Block b of B samples holds samples b B to (b + 1) B - 1, independently of the chunks in which results are
stored. The last block is padded with copies of its last sample. All blocks run the same compiled programs on
arrays of the same shapes, so the numbers of a sample do not depend on chunks, order or processes.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.equations.scene_parts import names_of_events
from jourdain_jax.motion.options import AllOptions, stated
from jourdain_jax.motion.trajectories.labels import OF_LANES
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.digests import digest
from jourdain_jax.scene.parameter_fields import parameters_of
from jourdain_jax.scene.scene import Scene
from jourdain_jax.studies.design import Design
from jourdain_jax.studies.outputs import Output
from jourdain_jax.studies.store import Column

LARGEST_BLOCK = 2048  # samples: one slow sample costs little, and a block takes a fraction of a second
AT_START = "_at_start"  # suffix of columns of start values, after the coordinate or speed
RESERVED = ("lane", "saved_lane", "run", "zarr.json")  # axes, and names of files next to the arrays
SAVES = ("statistics", "outputs")


@dataclass(frozen=True)
class Task:
    """Everything that determines the numbers of a study."""

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
        """Return digests of everything that determines the numbers, under the names of the arguments."""
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
