"""Batches of motions with different starts, parameters, or both. Each sample has its own result, and a
failed sample does not affect the others.

The samples of a chunk are integrated together; chunks run one after the other in the same compiled program.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from tqdm import tqdm

from jourdain_jax.calculus.compilation import with_nan_as_a_mark
from jourdain_jax.calculus.reals import (
    at_index,
    checked_real,
    checked_whole,
    described,
    is_traced,
    known_numbers,
    real_type,
    static,
)
from jourdain_jax.integrate import result_codes
from jourdain_jax.integrate.explicit_steps import Taylor
from jourdain_jax.integrate.inputs import as_inputs, check_inputs_in_rows, for_programs
from jourdain_jax.integrate.setup import MEMORY
from jourdain_jax.integrate.state import State
from jourdain_jax.integrate.vector_fields.field import VectorField
from jourdain_jax.motion.integration import integrate_lanes
from jourdain_jax.motion.model import modelled
from jourdain_jax.motion.options import SPAN, AllOptions, MotionFields, Options, as_options
from jourdain_jax.motion.retries import RERUN_FIELDS, lanes_retried
from jourdain_jax.motion.sensitivity import warn_of_jumps
from jourdain_jax.motion.simulate import DEFAULT_SAMPLES, saved_times, set_up, solver_of, span_and_times
from jourdain_jax.motion.trajectories import labels
from jourdain_jax.motion.trajectories.trajectory import Trajectory, sketch_of_lanes
from jourdain_jax.scene.arguments import BuiltFor, as_scene, one_time, shown_from_users_lines
from jourdain_jax.scene.coordinates import check_names, parameters_of
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene, state_names
from jourdain_jax.structure.structure import Reference


class Rollout(Printed, eqx.Module):
    """Many motions of one scene: a `Trajectory` whose arrays have a leading batch axis."""

    lanes: Trajectory
    reruns: tuple[tuple[int, tuple], ...] = static(default=())  # (fallback, `RERUN_FIELDS` of these samples)

    def __len__(self) -> int:
        return self.lanes.q.shape[0]

    def __getitem__(self, name: str) -> Float[Array, "lanes times *shape"]:
        """Return the coordinate or speed `name` of all samples at all times."""
        return jax.vmap(lambda lane: lane[name])(self.lanes)

    def __contains__(self, name: str) -> bool:
        return name in self.lanes

    def lane(self, index: int) -> Trajectory:
        """Return the motion of sample `index` as a `Trajectory`; IndexError if there is none."""
        if not -len(self) <= index < len(self):
            raise IndexError(
                f"lane {index} does not exist; this rollout has {len(self)} lanes, 0 to {len(self) - 1}"
            )
        lane = at_index(self.lanes, index)
        for way, how in self.reruns:
            if np.any(known_numbers(lane.fallback) == way):
                return dataclasses.replace(lane, **dict(zip(RERUN_FIELDS, how, strict=True)))
        return lane

    @property
    def result(self) -> np.ndarray:
        """Return the result code of every sample, shape (lanes,); see
        `jourdain_jax.integrate.result_codes`.
        """
        return np.asarray(self.lanes.result)

    @property
    def failed(self) -> np.ndarray:
        """Return the indices of samples that reached neither their end nor an event."""
        return np.flatnonzero(self.result > result_codes.EVENT)

    @property
    def continued(self) -> np.ndarray:
        """Return the indices of samples that were retried with the full state because their independent
        speeds became invalid.
        """
        return np.flatnonzero(np.asarray(self.lanes.fallback) & result_codes.FULL_STATE)

    def quantiles(self, name: str, levels: Sequence[float] = (0.025, 0.5, 0.975)) -> np.ndarray:
        """Return quantiles of the coordinate or speed `name` over the batch, for `levels` between 0 and 1.
        Shape (levels, times).

        A sample counts until it ends; NaN once all have ended. Raises ValueError if samples have different
        saved times.
        """
        if not np.all((ts := np.asarray(self.lanes.ts)) == ts[:1]):
            raise ValueError(
                "lanes have different saved times, so there are no common quantiles; pass one "
                "start time for all, or one `ts`"
            )
        values = np.asarray(self[name])
        quantiles = np.asarray(checked_real(levels, "`levels`", advice="pass numbers from 0 to 1"))
        if quantiles.ndim != 1 or not np.all((quantiles >= 0) & (quantiles <= 1)):
            raise ValueError(f"`levels` are {levels}, expected a list of numbers from 0 to 1")
        out = np.full((len(levels), *values.shape[1:]), np.nan)
        reached = np.isfinite(values).any(axis=0)
        out[:, reached] = np.nanquantile(values[:, reached], levels, axis=0)
        return out

    def to_xarray(self, units: Mapping[str, str] | None = None) -> Any:
        """Return coordinates, speeds, result codes and parameters as an `xarray.Dataset`
        along `lane` and `time` (s).

        `units`: units of coordinates and speeds by name, as in `Trajectory.to_xarray`. Raises ImportError
        without xarray.
        """
        return labels.to_xarray(self.lanes, units)

    def to_pandas(self) -> Any:
        """Return coordinates and speeds as a `pandas.DataFrame`, one row per sample and time (s). Raises
        ImportError without pandas.
        """
        return labels.to_pandas(self.lanes)

    def _picture(self) -> str:
        return sketch_of_lanes(self.lanes)

    def _text(self) -> str:
        lines = [f"Rollout of {type(self.lanes.scene).__name__}: {len(self)} lanes"]
        for code, message in result_codes.MESSAGES.items():
            lanes = np.flatnonzero(self.result == code)
            if lanes.size == 0:
                continue
            named = ""
            if code == result_codes.EVENT:
                events = np.asarray(self.lanes.event)[lanes]
                named = " " + ", ".join(
                    f"`{self.lanes.event_names[i]}` {int(np.sum(events == i))}" for i in np.unique(events)
                )
            elif code != result_codes.SUCCESS:
                faults = dict.fromkeys(name for i in lanes[:10] for name in self.lane(int(i)).faults)
                named = (
                    f" ({', '.join(faults)})" * bool(faults)
                    + ": lanes "
                    + ", ".join(map(str, lanes[:10]))
                    + (" ..." if lanes.size > 10 else "")
                )
            lines.append(f"  {lanes.size} {message}{named}")
        if self.continued.size:
            lines.append(
                f"  {len(self.continued)} were run again with the full state, because their "
                "independent speeds became invalid"
            )
        stiff = int(np.count_nonzero(np.asarray(self.lanes.fallback) & result_codes.IMPLICIT))
        if stiff:
            lines.append(f"  {stiff} were run again with an implicit solver, because they are stiff")
        steps = np.asarray(self.lanes.accepted)
        lines.append(f"  steps accepted: {steps.min()} to {steps.max()}, median {int(np.median(steps))}")
        return "\n".join(lines)


@shown_from_users_lines
@with_nan_as_a_mark
def rollout(
    scene: Scene | BuiltFor,
    starts: "State | Mapping[str, Any] | None" = None,
    *,
    parameters: "Mapping[str, Any] | None" = None,
    chunk: int | None = None,
    progress: bool | None = None,
    options: Options | None = None,
    **by_name: Unpack[MotionFields],
) -> Rollout:
    """Simulate a batch of motions. The samples of the batch are called lanes.

    - `starts`: start values by name, each a number or an array of shape (lanes,) (as in `jj.start`, which
      solves for omitted values), or a `State` with a leading axis of lanes.
    - `parameters`: parameters that differ between lanes, by name: arrays with a leading axis of lanes.
    - `chunk`: number of lanes that run together (default: 512 on a CPU, otherwise all). It is reduced to stay
      within the `memory` given to `jj.build` (default: 4 GiB). `progress`: show a progress bar (default: if
      there are several chunks).
    - `options`: a `jj.Options`; `by_name`: its fields, and `t0`, `t1`, `ts`, `inputs`, as in `simulate`. All
      lanes have the same inputs; for different inputs use `jax.vmap` of `simulate`.

    Raises ValueError for unknown names and unequal lengths. A failed lane raises no error: see
    `Rollout.failed` and `print(rollout)`. Derivatives of a failed motion are NaN;
    `jnp.where(rollout.lanes.succeeded, ..., 0.0)` excludes failed lanes from a loss and from its derivatives.

    **Examples**

        disc = jj.models.TiltingDisc()
        starts = {"lean": 0.3, "spin_rate": jnp.linspace(-6.0, -3.0, 16)}
        lanes = jj.rollout(disc, starts, parameters={"mass": jnp.full(16, 2.0)}, t1=1.0)
        print(lanes)                                          # how many arrived, and why others did not
        lanes["lean"].shape, lanes.quantiles("lean").shape    # (16, 201) and (3, 201)
        lanes.failed, lanes.lane(3).energies().balance        # indices of failed lanes; energy of one motion
    """
    span = {name: by_name.pop(name, None) for name in SPAN}
    options = as_options(options, by_name, "rollout", scene=scene)
    model, scene = modelled(scene, options.formulation, options.backend), as_scene(scene)
    starts = dict(scene.example) if starts is None else starts
    for what, given in (("starts", starts), ("parameters", parameters)):
        if (
            given is not None
            and not isinstance(given, Mapping)
            and not (what == "starts" and isinstance(given, State))
        ):
            raise ValueError(
                f'`{what}` is {described(given)}, expected a dictionary by name, such as {{"x": '
                "jnp.linspace(0.0, 1.0, 8)}"
            )
    advice = (
        "pass an array with one entry per lane; to vary a field that is a module, use `equinox.filter_vmap`"
        " of `simulate`"
    )
    parameters = {
        name: checked_real(value, f"parameter `{name}`", advice=advice)
        for name, value in (parameters or {}).items()
    }
    fixed, varied, count = _lanes(scene, starts, parameters)
    chunk = _chunk(scene, count, chunk, span["ts"], options.memory or MEMORY)
    span["inputs"] = as_inputs(scene, span["inputs"])
    _check_times_of_lanes(scene, starts, span)
    times = {
        name: None if span[name] is None else checked_real(span[name], f"`{name}`").astype(real_type())
        for name in ("t0", "t1", "ts")
    }

    reference = Reference(model.reference.scene, parameters)

    def run(options: AllOptions, varied, parameters) -> Trajectory:
        program = _compiled(span["inputs"].programs)
        return program(reference, scene, fixed, span | times, _with_arrays(options), varied, parameters)

    def form(options: AllOptions) -> VectorField:
        return modelled(model, options.formulation, options.backend).field(
            span["inputs"].constant, bool(options.work)
        )

    if is_traced((scene, fixed, varied, parameters, span, options)):
        lanes = run(options, varied, parameters)  # differentiated or batched: one chunk, no loop on the host
        warn_of_jumps(form(options), lanes, is_traced((scene, parameters)))
        return Rollout(lanes)

    def run_some(options: AllOptions, index: np.ndarray) -> Trajectory:
        return run(options, *at_index((varied, parameters), index))

    every: list[Array] = []
    bar = tqdm(total=count, unit="lane", disable=not (count > chunk if progress is None else progress))
    for first in range(0, count, chunk):
        begin = min(first, count - chunk)  # the last chunk overlaps the one before
        piece = jax.block_until_ready(run_some(options, np.arange(begin, begin + chunk)))
        some, treedef = jax.tree.flatten(piece)
        if chunk < count:  # stored in place on the device; the first sample stands for the missing ones
            every = every or [jnp.broadcast_to(x[:1], (count, *x.shape[1:])) for x in some]
            some = _stored(every, some, begin)
        every = some
        bar.update(min(chunk, count - first))
    bar.close()
    lanes = jax.tree.unflatten(treedef, every)
    reruns = ()
    if options.retry:
        own_times = isinstance(varied, State) and span["t0"] is None
        begun = varied.t if own_times else 0.0 if span["t0"] is None else span["t0"]
        lanes, reruns = lanes_retried(run_some, form, lanes, begun, options, chunk)
    return Rollout(lanes, reruns)


@partial(jax.jit, donate_argnums=0)
def _stored(every: list[Array], some: list[Array], first: Array) -> list[Array]:
    """Return all samples with those of a chunk, from sample `first` on, stored in place on the device."""
    put = jax.lax.dynamic_update_slice_in_dim
    return [put(x, new, first, 0) for x, new in zip(every, some, strict=True)]


def _check_times_of_lanes(scene: Scene, starts, span: dict) -> None:
    """Check the times, and the inputs over the span, if all samples share one known span.

    Otherwise times are traced, and a sample with invalid times gets a result code.
    """
    ts, t0, t1 = (span[name] for name in ("ts", "t0", "t1"))
    if t0 is None and isinstance(starts, State):
        if ts is not None:
            saved_times(ts)
        one_time(t1, "t1")
        return
    t0, _, t1 = span_and_times(scene, None, t0, t1, ts)
    check_inputs_in_rows(scene, span["inputs"], t0, t1)


def _lanes_in_lockstep(
    reference: Reference, scene, fixed, span, options: AllOptions, varied, parameters
) -> Trajectory:
    def lane(varied, parameters):
        own = scene.replace(**parameters) if parameters else scene
        return set_up(
            own, varied if isinstance(varied, State) else {**fixed, **varied}, **span, options=options
        )

    with reference.stands_in():
        return integrate_lanes(lane, (varied, parameters))


_compiled = for_programs(_lanes_in_lockstep)


def _with_arrays(options: AllOptions) -> AllOptions:
    """Return the options with numbers as arrays, so that new values need no compilation."""
    real, (solver, order) = real_type(), solver_of(options)
    numbers = {name: getattr(options, name) for name in ("rtol", "atol", "max_step")}
    arrays = {name: jnp.asarray(value, real) for name, value in numbers.items() if value is not None}
    return dataclasses.replace(options, solver=solver if order is None else Taylor(order), **arrays)


def _lanes(scene: Scene, starts, parameters: dict):
    """Return the start values that all samples share, the others, and the size of the batch."""
    known = [name for name, _, _ in parameters_of(scene)]
    check_names(parameters, known, f"scene `{type(scene).__name__}` has no parameter `{{}}`")
    lengths = {
        f"parameter `{name}`": value.shape[0] if value.ndim else None for name, value in parameters.items()
    }
    if isinstance(starts, State):
        many = starts.q.shape[:1] if starts.q.ndim == 2 else ()
        # a `State` made directly has one `guess` for all samples
        fixed, varied = {}, eqx.tree_at(lambda s: s.guess, starts, jnp.broadcast_to(starts.guess, many))
        lengths["`starts`"] = starts.q.shape[0] if starts.q.ndim == 2 else None
    else:
        arrays = {
            name: checked_real(value, f"start `{name}`").astype(real_type()) for name, value in starts.items()
        }
        # quaternions and their rates
        groups = {
            group for names in (scene.coordinate_names, scene.speed_names) for group, _, _ in names.groups
        }
        fixed = {name: value for name, value in arrays.items() if value.ndim == (1 if name in groups else 0)}
        varied = {name: value for name, value in arrays.items() if name not in fixed}
        lengths |= {f"start `{name}`": value.shape[0] for name, value in varied.items()}
    return fixed, varied, _common_length(lengths)


def _common_length(lengths: dict) -> int:
    for what, length in lengths.items():
        if length is None:
            raise ValueError(
                f"{what} has no axis of lanes; pass an array with one entry per lane, or set it on the scene"
            )
    counts = set(lengths.values())
    if len(counts) > 1:
        raise ValueError(
            "lanes differ in number: "
            + ", ".join(f"{what} has {length}" for what, length in lengths.items())
            + "; pass arrays of one length"
        )
    if not counts or counts == {0}:
        raise ValueError(
            "no lanes: pass at least one start value or parameter as an array with one entry "
            "per lane, or use `simulate` for one motion"
        )
    return counts.pop()


def _chunk(scene: Scene, count: int, chunk: int | None, ts, memory: int) -> int:
    usual = 512 if jax.default_backend() == "cpu" else count
    chunk = usual if chunk is None else checked_whole(chunk, "`chunk`", 1, expected="of at least one lane")
    times = DEFAULT_SAMPLES if ts is None else np.shape(ts)[0]
    per_lane = 8 * times * (len(state_names(scene)) + 2)
    # the stages of 512 samples fit the cache of a core, and a GPU runs some ten thousand samples at once;
    # four copies of a chunk's saved states exist
    return max(1, min(count, chunk, memory // (4 * per_lane)))
