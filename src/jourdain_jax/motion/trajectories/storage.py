"""Save and load motions as `.npz` files of NumPy.

Format 1. Arrays: `ts` (times), `q` (times, coordinates), `u` (times, speeds), `work` (times; absent if not
integrated), `t_end`, `q_end`, `u_end`, `result`, `event`, `accepted`, `rejected`, `moved_q`, `moved_u`,
`smallest_pivot`, `last_step`, `crossings`, `fallback`, `inputs` (times, inputs; sampled at `ts`),
`phases.NAME` for every array of `motion.phases` (absent with a single phase and no modes), and
`parameter:NAME` for every field that is an array. `header` is JSON text: `format`, `kind`, `scene` (class
name), `coordinates`, `speeds`, `input_names`, `units` of the parameters, `static` (fields that are plain
numbers or texts), `state_form`, `reduction`, `solver`, `projected`, `unwatched`, `event_names`, `arrays`
(names of all arrays), `versions`, `digest` (SHA-256 of the rest of the header and of all arrays; files of
earlier versions have none).

`kind` is "trajectory" or "rollout". In a rollout every array has a leading batch axis: `result` has one code
per sample. `reruns` in the header describes how samples with a `fallback` were retried.

Loading raises an error if the digest does not match (the file is damaged or was changed), or if names,
parameters or units in the file differ from those of the scene's class.
"""

import hashlib
import io
import json
import math
import os
import zipfile
from dataclasses import fields
from operator import attrgetter

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.compilation import with_nan_as_a_mark
from jourdain_jax.calculus.files import FilePath, check_depth, check_place, opened, parsed, write_whole
from jourdain_jax.calculus.lazy_imports import version_of
from jourdain_jax.calculus.reals import at_index, described
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.integrate.inputs import Inputs, Mode, Sampled
from jourdain_jax.motion.retries import RERUN_FIELDS
from jourdain_jax.motion.rollout import Rollout
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.trajectories.values_in_time import Phases, Record, one_phase
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.coordinates import check_names, parameters_of
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.trace import velocity_quantities

# excluding `work`, which may be absent
_ARRAYS = tuple(field.name for field in fields(Record) if hasattr(field.type, "dim_str"))
_PHASES = tuple(f"phases.{field.name}" for field in fields(Phases) if hasattr(field.type, "dim_str"))
_HEADER = (
    "scene",
    "static",
    "units",
    "coordinates",
    "speeds",
    "input_names",
    "event_names",
    "reruns",
    *RERUN_FIELDS,
)
_NEEDS_NUMBERS = jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError
_READERS = {"trajectory": "jj.load_trajectory(path, scene)", "rollout": "jj.load_rollout(path, scene)"}


@of_known_numbers
def save(motion: Trajectory | Rollout, path: FilePath) -> None:
    """Write a `motion`, one trajectory or a whole rollout, to the file `path` (`.npz`, format 1 of
    `motion/trajectories/storage.py`).

    An existing file is replaced only once the new one is complete, so that an interruption does not damage
    it. Inputs are stored as samples at the saved times. Raises ValueError if the path is a folder, or if the
    scene has a field that is not an array, number or text. Read the file with `load_trajectory` or
    `load_rollout`.
    """
    if not isinstance(motion, Trajectory | Rollout):
        raise ValueError(
            f"`save` was given {described(motion)}, expected a `Trajectory` from `jj.simulate` or a `Rollout`"
            " from `jj.rollout`"
        )
    trajectory, kind, reruns = (
        (motion.lanes, "rollout", motion.reruns)
        if isinstance(motion, Rollout)
        else (motion, "trajectory", ())
    )
    if trajectory is motion and motion.q.ndim != 2:
        raise ValueError(
            f"`save` takes one motion, but was given a batch of shape {motion.q.shape[:-2]}; for one batch "
            "axis, save `jj.Rollout(batch)`"
        )
    scene = trajectory.scene
    parameters, static = _stored_fields(scene)
    for field in fields(scene):
        if (
            field.init
            and field.name not in (*parameters, *static)
            and getattr(scene, field.name) is not field.default
        ):
            raise ValueError(
                f"field `{field.name}` of `{type(scene).__name__}` is "
                f"{described(getattr(scene, field.name))}, which `save` cannot store; expected arrays, "
                "numbers or texts, or the class's default"
            )
    check_place(path)
    arrays = {
        name: np.asarray(getattr(trajectory, name))
        for name in (*_ARRAYS, "work")
        if getattr(trajectory, name) is not None
    }
    if any(x.size for x in jax.tree.leaves(trajectory.phases)):
        arrays |= {name: np.asarray(attrgetter(name)(trajectory)) for name in _PHASES}
    arrays["inputs"] = np.asarray(
        (jax.vmap(_sampled) if isinstance(motion, Rollout) else _sampled)(trajectory.inputs, trajectory.ts)
    )
    arrays |= {f"parameter:{name}": np.asarray(value) for name, value in parameters.items()}
    header = {name: getattr(trajectory, name) for name in RERUN_FIELDS} | {
        "format": 1,
        "kind": kind,
        "reruns": reruns,
        "scene": type(scene).__name__,
        "coordinates": scene.coordinate_names.entries,
        "speeds": scene.speed_names.entries,
        "input_names": scene.inputs.entries,
        "units": {name: metadata["unit"] for name, _, metadata in parameters_of(scene)},
        "static": static,
        "event_names": trajectory.event_names,
        "arrays": sorted(arrays),
        "versions": {name: version_of(name) for name in ("jourdain-jax", "jax", "diffrax", "numpy")},
    }
    header["digest"] = _digest(header, arrays)
    content = io.BytesIO()
    np.savez_compressed(content, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
    write_whole(os.path.realpath(path), content.getbuffer(), wait=True)


def _digest(header: dict, arrays: dict) -> str:
    """Return the digest of all arrays and of the header, excluding its own digest."""
    found = hashlib.sha256(json.dumps(header | {"digest": ""}, sort_keys=True).encode())
    for name, x in sorted(arrays.items()):
        found.update(f"{name} {x.dtype.str} {x.shape} ".encode() + x.tobytes())
    return found.hexdigest()


def _sampled(inputs: Inputs, ts):
    return jax.vmap(inputs)(ts).reshape(ts.shape[0], len(inputs.channels))


@with_nan_as_a_mark
def load_trajectory(path: FilePath, scene: Scene | type[Scene]) -> Trajectory:
    """Read a trajectory that `save` wrote to `path`. `scene`: the scene's class, or any scene of that class;
    parameters come from the file.

    Raises ValueError if the file cannot be read, has another format, contains a rollout, or belongs to
    another scene.
    """
    header, arrays, kind = _read(path, scene, "trajectory")
    lanes = _lanes(path, kind, header, {name: x[None] for name, x in arrays.items()})
    return at_index(lanes, 0)


@with_nan_as_a_mark
def load_rollout(path: FilePath, scene: Scene | type[Scene]) -> Rollout:
    """Read a rollout that `save` wrote to `path`, with all samples, including failed ones, and result codes.

    `scene`: the scene's class, or any scene of that class; parameters come from the file. Raises ValueError
    if the file cannot be read, has another format, contains one trajectory, or belongs to another scene.
    """
    header, arrays, kind = _read(path, scene, "rollout")
    ways = tuple(
        (int(way), tuple(tuple(x) if isinstance(x, list) else x for x in how))
        for way, how in header["reruns"]
    )
    return Rollout(_lanes(path, kind, header, arrays), ways)


def _lanes(path, kind: type[Scene], header: dict, arrays: dict) -> Trajectory:
    """Return trajectories from arrays with a batch axis. Scenes are created under `vmap`, so that their
    checks of values reject none.
    """
    samples = [_samples(ts, inputs) for ts, inputs in zip(arrays["ts"], arrays["inputs"], strict=True)]
    longest = max(len(times) for times, _ in samples)  # samples with fewer input times repeat their last one
    arrays["input_ts"] = np.stack(
        [np.pad(times, (0, longest - len(times)), mode="edge") for times, _ in samples]
    )
    arrays["inputs"] = np.stack(
        [np.pad(values, ((0, longest - len(values)), (0, 0)), mode="edge") for _, values in samples]
    )
    arrays = {name: jnp.asarray(x) for name, x in arrays.items()}  # `vmap` would not trace NumPy arrays
    try:
        lanes = jax.vmap(lambda arrays: _trajectory(path, kind, header, arrays))(arrays)
    except _NEEDS_NUMBERS:  # the class reads the values when a scene is created
        each = [
            _trajectory(path, kind, header, {name: x[i] for name, x in arrays.items()})
            for i in range(len(arrays["result"]))
        ]
        lanes = jax.tree.map(lambda *x: jnp.stack(x), *each)
    _check_scene(path, at_index(lanes.scene, 0))
    return lanes


def _trajectory(path, kind: type[Scene], header: dict, arrays: dict) -> Trajectory:
    values = _parameters(arrays)
    try:
        scene = kind(**values, **header["static"])
    except _NEEDS_NUMBERS:
        raise
    except TypeError as error:
        raise _refused(
            path, f"lacks the data of a `{kind.__name__}` ({str(error).splitlines()[0]})"
        ) from None
    parameters, static = _stored_fields(scene)
    # otherwise their defaults would replace the missing values
    if missing := sorted({*parameters, *static} - {*values, *header["static"]}):
        raise ValueError(
            f"`{path}` lacks the parameter `{missing[0]}` of `{kind.__name__}`; it is damaged or older than "
            "the parameter: pass the class as it was when the file was written"
        )
    then, now = header["units"], {name: about["unit"] for name, _, about in parameters_of(scene)}
    for name in sorted({*then, *now}):
        if then.get(name) != now.get(name):
            was, takes = (
                f"in {units[name]}" if units.get(name) else "without a unit" for units in (then, now)
            )
            raise ValueError(
                f"`{path}` holds the parameter `{name}` {was}, but `{kind.__name__}` takes it {takes}; pass "
                "the class as it was when the file was written"
            )
    for name, now in (
        ("coordinates", scene.coordinate_names),
        ("speeds", scene.speed_names),
        ("input_names", scene.inputs),
    ):
        if tuple(header[name]) != now.entries:
            raise ValueError(
                f"the file holds the {name.replace('_', ' ')} {', '.join(header[name])}, but"
                f" `{kind.__name__}` has {', '.join(now.entries) or 'none'}; pass the class as it was when"
                " the file was written"
            )
    channels = [Sampled(arrays["input_ts"], column) for column in arrays["inputs"].T]
    phases = one_phase(tuple(header["event_names"]))
    if "phases.ts" in arrays:
        phases = Phases(
            **{name.removeprefix("phases."): arrays[name] for name in _PHASES},
            event_names=tuple(header["event_names"]),
            named=scene.modes,
        )
        direction = jnp.where(arrays["t_end"] < arrays["ts"][0], -1.0, 1.0)
        ts = jnp.where(jnp.isfinite(phases.ts), phases.ts * direction, jnp.inf)
        channels[len(channels) - len(phases.modes) :] = [
            Mode(modes[0], ts, modes[1:], direction) for modes in phases.modes
        ]
    return Trajectory(
        scene=scene,
        work=arrays.get("work"),
        inputs=Inputs(tuple(channels)),
        phases=phases,
        event_names=tuple(header["event_names"]),
        **{name: arrays[name] for name in _ARRAYS},
        **{name: header[name] for name in RERUN_FIELDS},
    )


def _samples(ts: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the input samples at the reached times, in order of increasing time even for reversed time."""
    reached = np.flatnonzero(np.isfinite(ts))
    times, first = np.unique(ts[reached], return_index=True)
    return (times, inputs[reached][first]) if times.size else (np.zeros(1), np.zeros((1, inputs.shape[1])))


def _checked_class(path, scene: Scene | type[Scene], header: dict, arrays: dict) -> type[Scene]:
    """Return the class of the scene. Raises ValueError if the file belongs to another class, or has
    parameters that the class lacks.
    """
    kind = scene if isinstance(scene, type) else type(scene)
    if not issubclass(kind, Scene):
        raise ValueError(
            f"`scene` is {described(scene)}, expected the class of the simulated scene, or a scene of that"
            " class"
        )
    if header["scene"] != kind.__name__:
        raise ValueError(
            f"`{path}` holds a {header['kind']} of `{header['scene']}`, expected `{kind.__name__}`; pass its"
            " class"
        )
    known, parameters = [field.name for field in fields(kind)], _parameters(arrays)
    check_names(
        (*parameters, *header["static"]),
        known,
        f"`{path}` has a parameter `{{}}` that `{kind.__name__}` lacks",
    )
    return kind


def _read(path, scene: Scene | type[Scene], kind: str) -> tuple[dict, dict, type[Scene]]:
    """Return the header and the arrays of a file of this kind, and the class of its scene."""
    what = f"a {kind} file written by `save`"
    with opened(path, what) as file:
        arrays = parsed(_unpacked, file, f"`{path}`", what)
    header = parsed(json.loads, str(arrays.pop("header", "")), f"`{path}`", what)
    check_depth(
        header, lambda x: x.values() if isinstance(x, dict) else x if isinstance(x, list) else (), f"`{path}`"
    )
    if not isinstance(header, dict):
        raise _refused(path, "has an invalid header")
    if header.get("format") != 1:
        raise ValueError(
            f"`{path}` has format {header.get('format')}, expected 1; read it with the version of"
            " jourdain-jax that wrote it"
        )
    found = header.get("kind")
    if found != kind:
        raise ValueError(
            f"`{path}` holds a {found}, expected a {kind}; read it with"
            f" `{_READERS.get(str(found), 'the version of jourdain-jax that wrote it')}`"
        )
    missing = [name for name in (*_ARRAYS, "inputs") if name not in arrays] + [
        name for name in _HEADER if name not in header
    ]
    if missing:
        raise _refused(path, f"lacks `{missing[0]}`")
    if header.get("digest", own := _digest(header, arrays)) != own:
        raise _refused(path, "does not match its digest")
    return header, arrays, _checked_class(path, scene, header, arrays)


def _unpacked(file) -> dict[str, np.ndarray]:
    """Return the arrays of a zip archive by name. Memory is allocated for the actual content only, even if an
    entry claims a larger size.
    """
    found = {}
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            # limit of the compression ratio: deflate's longest match
            if name in found or member.file_size > 1100 * member.compress_size + 1000:
                raise ValueError(
                    f"`{name}` occurs twice" if name in found else f"`{name}` claims {member.file_size} bytes"
                )
            content = archive.read(member)
            head = io.BytesIO(content)
            of_version = (
                np.lib.format.read_array_header_1_0
                if np.lib.format.read_magic(head) == (1, 0)
                else np.lib.format.read_array_header_2_0
            )
            shape, by_columns, dtype = of_version(head)
            if dtype.hasobject or head.tell() + dtype.itemsize * math.prod(shape) != len(content):
                raise ValueError(f"`{name}` claims an array of shape {shape} in {len(content)} bytes")
            found[name] = np.ndarray(shape, dtype, content, head.tell(), order="F" if by_columns else "C")
    return found


def _parameters(arrays: dict) -> dict:
    """Return the scene's parameters from the arrays of a file, by name."""
    return {
        name.removeprefix("parameter:"): value
        for name, value in arrays.items()
        if name.startswith("parameter:")
    }


def _stored_fields(scene: Scene) -> tuple[dict, dict]:
    """Return the scene's fields that are arrays, including parameters, and the fields that are plain numbers
    or texts, such as a number of bodies.
    """
    values = {field: getattr(scene, field.name) for field in fields(scene) if field.init}
    arrays = {
        field.name: value
        for field, value in values.items()
        if isinstance(value, jax.Array | np.ndarray) and not field.metadata.get("static")
    }
    return arrays, {
        field.name: value for field, value in values.items() if isinstance(value, int | float | str | bool)
    }


def _refused(path, sentence: str) -> ValueError:
    """Return the error for a file that `save` did not write."""
    return ValueError(f"`{path}` {sentence}; it is damaged or was not written by `save`")


def _check_scene(path, scene: Scene) -> None:
    """Raise ValueError if the shapes of parameters do not suit the scene."""

    def quantities(scene):
        q, u, _ = scene.named()
        return velocity_quantities(scene, motion_at(scene, jnp.zeros(()), q, u), with_events=False)

    try:
        jax.eval_shape(quantities, scene)
    except (ValueError, TypeError, IndexError) as error:
        said = str(error).splitlines()[0]
        raise ValueError(
            f"`{path}` holds parameters that do not make a `{type(scene).__name__}` ({said}); pass the class "
            "as it was when it was written"
        ) from None
