"""Saving and loading motions as NumPy's `.npz`.

Format 1. Arrays: `ts` (times), `q` (times, coordinates), `u` (times, speeds), `work` (times; absent where not tracked), `t_end`, `q_end`, `u_end`,
`result`, `event`, `accepted`, `rejected`, `moved_q`, `moved_u`, `smallest_pivot`, `last_step`, `crossings`,
`fallback`, `inputs` (times, inputs;
sampled at `ts`), `phases.NAME` for every array of `motion.phases` (absent where there is one phase, without modes), and `parameter:NAME` for every field that
is an array. `header` is JSON text: `format`, `kind`, `scene` (class name), `coordinates`,
`speeds`, `input_names`, `units` of the parameters, `static` (fields that are plain numbers or texts),
`state_form`, `reduction`, `solver`, `projected`, `unwatched`, `event_names`, `arrays` (names of all arrays), `versions`.
`kind` is "trajectory" or "rollout"; in a rollout every array has a leading axis of lanes (so `result` is one code per lane), and `reruns` in its header
says how lanes with a `fallback` were run.

What is absent, or is not what the names and the number of times ask for, is an error, and so is a parameter of the scene's class that the file lacks.
A file is believed in nothing: it may be of another version of a scene's class, written by another program, or damaged in a way that its format does not show.
"""

import io
import json
import math
import os
import zipfile
from dataclasses import fields
from operator import attrgetter
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jourdain_jax.build.trace import velocity_quantities
from jourdain_jax.calculus.files import check_depth, check_place, parsed, write_whole
from jourdain_jax.calculus.on_first_use import version_of
from jourdain_jax.calculus.reals import described, largest
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.motion.batches.rollout import Rollout
from jourdain_jax.motion.inputs import Inputs, Mode, Sampled
from jourdain_jax.motion.marks import with_nan_as_a_mark
from jourdain_jax.motion.retries import RERUN_FIELDS
from jourdain_jax.motion.trajectories.over_times import Phases, Record, one_phase
from jourdain_jax.motion.trajectories.results import BAD_PARAMETER, EVENT, FALLBACKS, MESSAGES, SUCCESS
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.names import check_names
from jourdain_jax.scene.parameters import parameter_faults, parameters_of
from jourdain_jax.scene.scene import Scene

# arrays and their axes, after that of the lanes of a rollout, as a trajectory states them; `work` is absent where it is not tracked
_STATED: dict[str, Any] = {field.name: (get_args(field.type) or (field.type,))[0] for field in fields(Record)}
_PHASES = tuple(f"phases.{field.name}" for field in fields(Phases) if hasattr(field.type, "dim_str"))
_STATED |= {f"phases.{field.name}": field.type for field in fields(Phases)}
AXES = {name: tuple(kind.dim_str.split()) for name, kind in _STATED.items() if hasattr(kind, "dim_str")} | {"inputs": ("times", "input_names")}
# entries of the header: their type, in words too
HEADER: dict[str, tuple[type, str]] = dict.fromkeys(("scene", "state_form", "reduction", "solver", "unwatched", "kind"), (str, "a text"))
_LISTS = ("coordinates", "speeds", "input_names", "event_names", "arrays")
HEADER |= dict.fromkeys(_LISTS, (list, "a list of names"))
HEADER |= {"static": (dict, "a dictionary"), "units": (dict, "a dictionary"), "projected": (bool, "true or false"), "reruns": (list, "a list")}
_ARRAYS = tuple(name for name in AXES if name not in ("inputs", "work", *_PHASES))
_NEEDS_NUMBERS = jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError
_READERS = {"trajectory": "jj.load_trajectory(path, scene)", "rollout": "jj.load_rollout(path, scene)"}


@of_known_numbers
def save(motion: Trajectory | Rollout, path: str | os.PathLike) -> None:
    """Write a `motion`, one trajectory or a whole rollout, to `path` (`.npz`, format 1 of `motion/trajectories/storage.py`).

    A file that is there already is replaced at once, when the new one is whole: an interruption leaves the old one.
    Inputs are stored as samples at the saved times. ValueError where the path is a folder, or the scene has a
    field that is not an array, number or text.
    Read it with `load_trajectory` or `load_rollout`.
    """
    if not isinstance(motion, Trajectory | Rollout):
        raise ValueError(f"`save` was given {described(motion)}, expected a `Trajectory` from `jj.simulate` or a `Rollout` from `jj.rollout`")
    trajectory, kind, reruns = (motion.lanes, "rollout", motion.reruns) if isinstance(motion, Rollout) else (motion, "trajectory", ())
    if trajectory is motion and motion.q.ndim != 2:
        raise ValueError(
            f"`save` takes one motion and was given a batch of shape {motion.q.shape[:-2]}; save a `Rollout`, `jj.Rollout(batch)` for one axis of lanes"
        )
    scene = trajectory.scene
    parameters, static = _stored_fields(scene)
    for field in fields(scene):
        if field.init and field.name not in (*parameters, *static) and getattr(scene, field.name) is not field.default:
            raise ValueError(
                f"field `{field.name}` of `{type(scene).__name__}` is {described(getattr(scene, field.name))}, which `save` cannot store; "
                "expected arrays, numbers or texts, or the class's default"
            )
    check_place(path)
    arrays = {name: np.asarray(getattr(trajectory, name)) for name in (*_ARRAYS, "work") if getattr(trajectory, name) is not None}
    if any(x.size for x in jax.tree.leaves(trajectory.phases)):
        arrays |= {name: np.asarray(attrgetter(name)(trajectory)) for name in _PHASES}
    arrays["inputs"] = np.asarray((jax.vmap(_sampled) if isinstance(motion, Rollout) else _sampled)(trajectory.inputs, trajectory.ts))
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
    content = io.BytesIO()
    np.savez_compressed(content, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]
    write_whole(os.path.realpath(path), content.getbuffer(), wait=True)


def _sampled(inputs: Inputs, ts):
    return jax.vmap(inputs)(ts).reshape(ts.shape[0], len(inputs.channels))


@with_nan_as_a_mark
def load_trajectory(path: str | os.PathLike, scene: Scene | type[Scene]) -> Trajectory:
    """Read a trajectory written by `save` from `path`. `scene`: the scene's class, or any scene of that class; parameters come from the file.

    ValueError where the file cannot be read, is of another format, holds a rollout, or belongs to another scene.
    """
    header, arrays, kind = _read(path, scene, "trajectory")
    lanes = _lanes(path, kind, header, {name: x[None] for name, x in arrays.items()})
    return jax.tree.map(lambda x: x[0], lanes)


@with_nan_as_a_mark
def load_rollout(path: str | os.PathLike, scene: Scene | type[Scene]) -> Rollout:
    """Read a rollout written by `save` from `path`: all its lanes, failed ones too, each with its result code.

    `scene`: the scene's class, or any scene of that class; parameters come from the file. ValueError where the file cannot be read, is of another
    format, holds one trajectory, or belongs to another scene.
    """
    header, arrays, kind = _read(path, scene, "rollout")
    ways = tuple((int(way), tuple(tuple(x) if isinstance(x, list) else x for x in how)) for way, how in header["reruns"])
    return Rollout(_lanes(path, kind, header, arrays), ways)


def _lanes(path, kind: type[Scene], header: dict, arrays: dict) -> Trajectory:
    """Trajectories from arrays with a leading axis of lanes, which may be failed ones: built under `vmap`, where no value is refused."""
    samples = [_samples(ts, inputs) for ts, inputs in zip(arrays["ts"], arrays["inputs"], strict=True)]
    longest = max(len(times) for times, _ in samples)  # lanes with fewer are filled up with their last sample
    arrays["input_ts"] = np.stack([np.pad(times, (0, longest - len(times)), mode="edge") for times, _ in samples])
    arrays["inputs"] = np.stack([np.pad(values, ((0, longest - len(values)), (0, 0)), mode="edge") for _, values in samples])
    arrays = {name: jnp.asarray(x) for name, x in arrays.items()}  # `vmap` hands on what is given to it as it is
    try:
        lanes = jax.vmap(lambda arrays: _trajectory(path, kind, header, arrays))(arrays)
    except _NEEDS_NUMBERS:  # a class that looks at them when a scene is made
        each = [_trajectory(path, kind, header, {name: x[i] for name, x in arrays.items()}) for i in range(len(arrays["result"]))]
        lanes = jax.tree.map(lambda *x: jnp.stack(x), *each)
    check_scenes(path, lanes.scene, lanes.result)
    return lanes


def _trajectory(path, kind: type[Scene], header: dict, arrays: dict) -> Trajectory:
    values = _parameters(arrays)
    try:
        scene = kind(**values, **header["static"])
    except _NEEDS_NUMBERS:
        raise
    except TypeError as error:
        raise refused(path, f"lacks the data of a `{kind.__name__}` ({str(error).splitlines()[0]})") from None
    parameters, static = _stored_fields(scene)
    if missing := sorted({*parameters, *static} - {*values, *header["static"]}):  # their defaults would replace what moved
        raise ValueError(
            f"`{path}` lacks the parameter `{missing[0]}` of `{kind.__name__}`; it is damaged, or was written before the class had it: "
            "pass the class as it was when the file was written"
        )
    then, now = header["units"], {name: about["unit"] for name, _, about in parameters_of(scene)}
    for name in sorted({*then, *now}):
        if then.get(name) != now.get(name):
            was, takes = (f"in {units[name]}" if units.get(name) else "without a unit" for units in (then, now))
            raise ValueError(
                f"`{path}` holds the parameter `{name}` {was}, but `{kind.__name__}` takes it {takes}; pass the class as it was when the file was written"
            )
    for name, now in (("coordinates", scene.coordinate_names), ("speeds", scene.speed_names), ("input_names", scene.inputs)):
        if tuple(header[name]) != now.entries:
            raise ValueError(
                f"the file holds the {name.replace('_', ' ')} {', '.join(header[name])}, but `{kind.__name__}` has {', '.join(now.entries) or 'none'}; "
                "pass the class as it was when the file was written"
            )
    channels = [Sampled(arrays["input_ts"], column) for column in arrays["inputs"].T]
    phases = one_phase(tuple(header["event_names"]))
    if "phases.ts" in arrays:
        phases = Phases(**{name.removeprefix("phases."): arrays[name] for name in _PHASES}, event_names=tuple(header["event_names"]), named=scene.modes)
        direction = jnp.where(arrays["t_end"] < arrays["ts"][0], -1.0, 1.0)
        ts = jnp.where(jnp.isfinite(phases.ts), phases.ts * direction, jnp.inf)
        channels[len(channels) - len(phases.modes) :] = [Mode(modes[0], ts, modes[1:], direction) for modes in phases.modes]
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
    """Samples of the inputs in increasing time, also of a motion in reversed time, without times that were not reached."""
    reached = np.flatnonzero(np.isfinite(ts))
    times, first = np.unique(ts[reached], return_index=True)
    return (times, inputs[reached][first]) if times.size else (np.zeros(1), np.zeros((1, inputs.shape[1])))


def _checked_class(path, scene: Scene | type[Scene], header: dict, arrays: dict) -> type[Scene]:
    """Return the class of the scene; a ValueError if it is not the one in the file, or its parameters or
    names have changed.
    """
    kind = scene if isinstance(scene, type) else type(scene)
    if not issubclass(kind, Scene):
        raise ValueError(f"`scene` is {described(scene)}, expected the class of the simulated scene, or a scene of that class")
    if header["scene"] != kind.__name__:
        raise ValueError(f"`{path}` holds a {header['kind']} of `{header['scene']}`, expected `{kind.__name__}`; pass its class")
    known, parameters = [field.name for field in fields(kind)], _parameters(arrays)
    check_names((*parameters, *header["static"]), known, f"`{path}` has a parameter `{{}}` that `{kind.__name__}` has not")
    for name, value in parameters.items():
        if value.dtype.kind not in "fiub":
            raise refused(path, f"has `{name}` of type {value.dtype}, expected numbers")
        if header["kind"] == "rollout" and value.shape[:1] != arrays["result"].shape:
            raise refused(path, f"has `{name}` of shape {value.shape}, expected one value for each of {len(arrays['result'])} lanes")
    return kind


def _read(path, scene: Scene | type[Scene], kind: str) -> tuple[dict, dict, type[Scene]]:
    """Header and arrays of a file of this kind, and the class of its scene."""
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"`path` is {described(path)}, expected the name of a file")
    what = f"{kind} file written by `save`"
    try:
        with open(path, "rb") as file:
            arrays = parsed(_unpacked, file, f"`{path}`", what)
    except OSError as error:
        said = f"there is no file `{path}`" if isinstance(error, FileNotFoundError) else f"`{path}` cannot be read ({error.strerror})"
        raise ValueError(f"{said}; check the path") from None
    header = parsed(json.loads, str(arrays.pop("header", "")), f"`{path}`", what)
    check_depth(header, lambda x: x.values() if isinstance(x, dict) else x if isinstance(x, list) else (), f"`{path}`")
    if not isinstance(header, dict):
        raise refused(path, "has a header that is no dictionary")
    if header.get("format") != 1 or isinstance(header["format"], bool):
        raise ValueError(f"`{path}` has format {header.get('format')}, expected 1; read it with the version of jourdain-jax that wrote it")
    found = header.get("kind")
    if found != kind:
        raise ValueError(f"`{path}` holds a {found}, expected a {kind}; read it with `{_READERS.get(str(found), 'the version of jourdain-jax that wrote it')}`")
    missing = [name for name in (*_ARRAYS, "inputs") if name not in arrays]
    missing += [name for name in _PHASES if name not in arrays and any(one in arrays for one in _PHASES)]
    missing += [name for name in HEADER if name not in header]
    if not missing:
        check_header(path, header)
        missing = [name for name in header["arrays"] if name in AXES and name not in arrays]
    if missing:
        raise refused(path, f"lacks `{missing[0]}`")
    check_arrays(path, header, arrays)
    return header, arrays, _checked_class(path, scene, header, arrays)


def _unpacked(file) -> dict[str, np.ndarray]:
    """Return the arrays of a zip archive by name, each as large as its content: claims beyond that are never
    allocated.
    """
    found = {}
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name not in (*AXES, "header") and not name.startswith("parameter:"):
                continue
            # bytes that a compressed one stands for, at most: deflate's longest match
            if name in found or member.file_size > 1100 * member.compress_size + 1000:
                raise ValueError(f"`{name}` occurs twice" if name in found else f"`{name}` claims {member.file_size} bytes")
            content = archive.read(member)
            head = io.BytesIO(content)
            of_version = np.lib.format.read_array_header_1_0 if np.lib.format.read_magic(head) == (1, 0) else np.lib.format.read_array_header_2_0
            shape, by_columns, dtype = of_version(head)
            if dtype.hasobject or head.tell() + dtype.itemsize * math.prod(shape) != len(content):
                raise ValueError(f"`{name}` claims an array of shape {shape} in {len(content)} bytes")
            found[name] = np.ndarray(shape, dtype, content, head.tell(), order="F" if by_columns else "C")
    return found


def _parameters(arrays: dict) -> dict:
    """Return the parameters of the scene among the arrays of a file."""
    return {name.removeprefix("parameter:"): value for name, value in arrays.items() if name.startswith("parameter:")}


def _stored_fields(scene: Scene) -> tuple[dict, dict]:
    """Return fields that are arrays, including parameters, and plain numbers or texts, such as a number of
    bodies.
    """
    values = {field: getattr(scene, field.name) for field in fields(scene) if field.init}
    arrays = {field.name: value for field, value in values.items() if isinstance(value, jax.Array | np.ndarray) and not field.metadata.get("static")}
    return arrays, {field.name: value for field, value in values.items() if isinstance(value, int | float | str | bool)}


def refused(path, sentence: str) -> ValueError:
    """Return the error for an inconsistent file."""
    return ValueError(f"`{path}` {sentence}; it is damaged or was not written by `save`")


def check_header(path, header: dict) -> None:
    """ValueError for an entry of the header that is of another kind than `save` writes."""
    for name, (kind, text) in HEADER.items():
        if not isinstance(header[name], kind) or (name in _LISTS and not all(isinstance(x, str) for x in header[name])):
            raise refused(path, f"has {described(header[name])} as `{name}` of its header, expected {text}")
    if header["state_form"] not in ("minimal", "full"):
        raise refused(path, f"has the state form {header['state_form']!r}, expected 'minimal' or 'full'")
    for way in header["reruns"]:
        if not (isinstance(way, list) and len(way) == 2 and way[0] in FALLBACKS and isinstance(way[1], list) and len(way[1]) == len(RERUN_FIELDS)):
            raise refused(path, f"has {way!r} among the `reruns` of its header, expected a code of a fallback and how such lanes were run")


def check_arrays(path, header: dict, arrays: dict) -> None:
    """ValueError for an array of another shape or type than the others ask for, or with numbers that no motion has."""
    lead = arrays["result"].shape[:1] if header["kind"] == "rollout" else ()
    times = arrays["ts"].shape[-1] if arrays["ts"].ndim else 0
    sizes = dict(zip(("modes", "phases"), arrays["phases.modes"].shape[-2:], strict=False)) if "phases.modes" in arrays else {}
    sizes |= {"times": times, "transitions": sizes.get("phases", 1) - 1} | {name: len(header[name]) for name in ("coordinates", "speeds", "input_names")}
    for name in ("q", "u", "inputs"):
        found, what = arrays[name].shape[-1:], AXES[name][1]
        if found not in ((), (sizes[what],)):
            raise refused(path, f"has {found[0]} columns for {sizes[what]} {what.replace('_', ' ')}")
    for name, axes in AXES.items():
        if name not in arrays:
            continue
        array, expected = arrays[name], (*lead, *(sizes[axis] for axis in axes))
        if array.shape != expected or not times or 0 in lead:
            raise refused(path, f"has `{name}` of shape {array.shape}, expected {expected if times else 'at least one time'}")
        kinds, text = ("iu", "whole numbers") if getattr(_STATED[name], "dtype", None) is Int else ("f", "floating-point numbers")
        if array.dtype.kind not in kinds:
            raise refused(path, f"has `{name}` of type {array.dtype}, expected {text}")
    _check_codes(path, header, arrays)
    _check_finite(path, arrays)


def _check_codes(path, header: dict, arrays: dict) -> None:
    events = np.where(arrays["result"] == EVENT, np.arange(len(header["event_names"]) + 1).max() - 1, -1)
    ranges = {"result": np.isin(arrays["result"], list(MESSAGES)), "fallback": np.isin(arrays["fallback"], list(FALLBACKS))}
    ranges["event"] = (arrays["event"] <= events) & (arrays["event"] >= np.where(arrays["result"] == EVENT, 0, -1))
    ranges |= {name: arrays[name] >= 0 for name in ("accepted", "rejected")} | {"crossings": arrays["crossings"] >= -1}
    if "phases.events" in arrays:
        ranges["phases.events"] = (arrays["phases.events"] >= -1) & (arrays["phases.events"] < len(header["event_names"]))
    for name, right in ranges.items():
        if not np.all(right):
            raise refused(path, f"has {arrays.get(name, header.get(name))} as `{name}`, impossible for a motion")


def _check_finite(path, arrays: dict) -> None:
    """Motions that reached their end, or an event, are finite as far as they went; failed ones may hold anything."""
    whole = np.asarray(arrays["result"] <= EVENT)
    for name in ("t_end", "q_end", "u_end", "moved_q", "moved_u"):
        good = np.isfinite(arrays[name])
        if not np.all(good.reshape(*whole.shape, -1)[whole]):
            raise refused(path, f"has numbers in `{name}` that are not finite, though the motion did not fail")
    if np.any(np.isnan(arrays["ts"])):
        raise refused(path, "has times in `ts` that are NaN")
    reached = np.all(np.isfinite(arrays["q"]), axis=-1)
    if np.any(whole & ~_go_one_way(arrays, reached)):
        raise refused(path, "has times in `ts` that are not ordered towards the end of the motion")
    due = np.isfinite(arrays["ts"]) & (np.asarray(arrays["result"]) == SUCCESS)[..., None]
    for name in ("q", "u", "inputs", *(["work"] if "work" in arrays else [])):
        values = arrays[name].reshape(*arrays["ts"].shape, -1)
        finite = np.all(np.isfinite(values), axis=-1)
        apart = (np.any(np.isfinite(values), axis=-1) if name in ("q", "u") else reached) & ~finite
        if np.any((due | (apart & whole[..., None])) & ~finite):
            raise refused(path, f"has numbers in `{name}` that are not finite at times that the motion reached")


def _go_one_way(arrays: dict, reached: np.ndarray) -> np.ndarray:
    """Return whether the saved times that each sample reached are monotonic, up to its end within round-off.
    """
    ts, end = np.asarray(arrays["ts"], float), np.asarray(arrays["t_end"], float)[..., None]
    with np.errstate(invalid="ignore"):  # of motions that failed
        steps = np.diff(np.concatenate([np.where(np.isfinite(ts) & reached, ts, end), end], axis=-1), axis=-1)
    slack = 1e-6 * largest(steps, -1, keepdims=True)
    return np.asarray(np.all(steps >= -slack, axis=-1) | np.all(steps <= slack, axis=-1))


def check_scenes(path, scene: Scene, result) -> None:
    """ValueError where parameters of lanes are wrong in a motion that did not end for it, or of shapes that do not make the scene."""
    for name, fault in jax.vmap(parameter_faults)(scene).items():
        wrong = np.flatnonzero(np.asarray(fault) & (np.asarray(result) != BAD_PARAMETER))
        if wrong.size:
            value = f"{np.asarray(getattr(scene, name))[wrong[0]]} as a value of the parameter `{name}`"
            raise refused(path, f"has {value}, which is not finite or has the wrong sign, though the motion did not fail")

    def quantities(scene):
        q, u, _ = scene.named()
        return velocity_quantities(scene, motion_at(scene, jnp.zeros(()), q, u), with_events=False)

    try:
        jax.eval_shape(quantities, jax.tree.map(lambda x: x[0], scene))
    except (ValueError, TypeError, IndexError) as error:
        said = str(error).splitlines()[0]
        raise ValueError(
            f"`{path}` holds parameters that do not make a `{type(scene).__name__}` ({said}); pass the class as it was when it was written"
        ) from None
