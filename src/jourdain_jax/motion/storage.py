"""Saving and loading trajectories: NumPy's `.npz`, readable by anything that reads `.npz`.

Format 1. Arrays: `ts` (times), `q` (times, coordinates), `u` (times, speeds), `work` (times; absent where not tracked), `t_end`, `q_end`, `u_end`,
`result`, `event`, `accepted`, `rejected`, `moved_q`, `moved_u`, `smallest_pivot`, `inputs` (times, inputs; sampled at `ts`), and `parameter:NAME` for every
parameter. `header` is JSON text: `format`, `scene` (class name), `coordinates`, `speeds`, `input_names`, `units` of the parameters,
`static` (fields that are no parameters), `state_form`, `reduction`, `solver`, `projected`, `event_names`, `versions`.
"""

import json
import os
import zipfile
from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.motion.inputs import Inputs, Sampled
from jourdain_jax.motion.trajectory import Trajectory
from jourdain_jax.motion.versions import version_of
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.numbers import described
from jourdain_jax.scene.parameters import parameters_of
from jourdain_jax.scene.scene import Scene

_ARRAYS = ("ts", "q", "u", "t_end", "q_end", "u_end", "result", "event", "accepted", "rejected", "moved_q", "moved_u", "smallest_pivot")
_ENTRIES = ("scene", "coordinates", "speeds", "static", "event_names")
_TEXTS = ("state_form", "reduction", "solver", "projected")


def save(trajectory: Trajectory, path: str | os.PathLike) -> None:
    """Write a `trajectory` to `path` (`.npz`, format 1 above). Inputs are stored as samples at the saved times."""
    _check_saved(trajectory, path)
    scene = trajectory.scene
    arrays = {name: np.asarray(getattr(trajectory, name)) for name in _ARRAYS}
    if trajectory.work is not None:
        arrays["work"] = np.asarray(trajectory.work)
    arrays["inputs"] = np.asarray(jax.vmap(trajectory.inputs)(trajectory.ts)).reshape(len(trajectory.ts), len(scene.inputs))
    arrays |= {f"parameter:{name}": np.asarray(value) for name, value, _ in parameters_of(scene)}
    header = {name: getattr(trajectory, name) for name in _TEXTS} | {
        "format": 1,
        "scene": type(scene).__name__,
        "coordinates": scene.coordinate_names.entries,
        "speeds": scene.speed_names.entries,
        "input_names": scene.inputs.entries,
        "units": {name: metadata["unit"] for name, _, metadata in parameters_of(scene)},
        "static": {name: getattr(scene, name) for name in _static_fields(scene)},
        "event_names": trajectory.event_names,
        "versions": {name: version_of(name) for name in ("jourdain-jax", "jax", "diffrax", "numpy")},
    }
    with open(path, "wb") as file:  # a handle, so that numpy does not append a suffix to the name
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


def _check_saved(trajectory, path) -> None:
    """One motion, and a path that can be written."""
    if hasattr(trajectory, "lane"):
        raise ValueError("`save` takes one motion and was given a rollout; save its lanes one by one: jj.save(rollout.lane(0), 'lane-0.npz')")
    if not isinstance(trajectory, Trajectory):
        raise ValueError(f"`save` was given {described(trajectory)}, expected a `Trajectory` from `jj.simulate`")
    if trajectory.q.ndim != 2:
        raise ValueError(f"`save` takes one motion and was given a batch of shape {trajectory.q.shape[:-2]}; save them one by one")
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"`path` is {described(path)}, expected the name of a file")
    folder = os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise ValueError(f"cannot write `{os.fspath(path)}`: there is no folder `{folder}`; make it first")
    if os.path.isdir(path):
        raise ValueError(f"cannot write `{os.fspath(path)}`: it is a folder; give the name of a file in it, such as motion.npz")


def load(path: str | os.PathLike, scene: Scene | type[Scene]) -> Trajectory:
    """Read a trajectory written by `save` from `path`. `scene`: the scene's class, or any scene of that class; parameters come from the file.

    ValueError where the file cannot be read, is of another format, or belongs to another scene.
    """
    kind = scene if isinstance(scene, type) else type(scene)
    if not issubclass(kind, Scene):
        raise ValueError(f"`scene` is {described(scene)}, expected the class of the scene that moved, or any scene of that class")
    header, arrays = _read(path)
    if header["scene"] != kind.__name__:
        raise ValueError(f"`{path}` holds a trajectory of `{header['scene']}`, expected `{kind.__name__}`; pass the class it was made with")
    values = {name.removeprefix("parameter:"): value for name, value in arrays.items() if name.startswith("parameter:")}
    known = [field.name for field in fields(kind)]
    unknown = [name for name in (*values, *header["static"]) if name not in known]
    if unknown:
        raise ValueError(f"`{path}` has a parameter `{unknown[0]}` that `{kind.__name__}` has not; {nearest(unknown[0], known)}")
    rebuilt = kind(**values, **header["static"])
    _check_shapes(path, rebuilt, header, arrays)
    forward = np.argsort(arrays["ts"])  # of a motion in reversed time
    inputs = Inputs(tuple(Sampled(arrays["ts"][forward], column[forward]) for column in arrays["inputs"].T))
    return Trajectory(
        scene=rebuilt,
        work=jnp.asarray(arrays["work"]) if "work" in arrays else None,
        inputs=inputs,
        event_names=tuple(header["event_names"]),
        **{name: jnp.asarray(arrays[name]) for name in _ARRAYS},
        **{name: header[name] for name in _TEXTS},
    )


def _check_shapes(path, scene: Scene, header: dict, arrays: dict) -> None:
    """The file's coordinates, speeds and shapes are those of the scene."""
    for what, names, stored in (("coordinates", scene.coordinate_names.entries, "q"), ("speeds", scene.speed_names.entries, "u")):
        if tuple(header[what]) != names:
            listed = ", ".join(map(str, header[what]))
            raise ValueError(f"`{path}` has the {what} {listed}, but `{type(scene).__name__}` has {', '.join(names)}; pass the class it was made with")
        for name, shape in ((stored, (*arrays["ts"].shape, len(names))), (f"{stored}_end", (len(names),))):
            if arrays[name].shape != shape:
                raise ValueError(f"the array `{name}` of `{path}` has shape {arrays[name].shape}, expected {shape}; the file is damaged")


def _read(path) -> tuple[dict, dict]:
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"`path` is {described(path)}, expected the name of a file")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop("header")))
    except FileNotFoundError:
        raise ValueError(f"there is no file `{path}`; check the path") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"`{path}` is no trajectory file, or is damaged ({error}); expected an .npz written by `save`") from None
    if not isinstance(header, dict):
        raise ValueError(f"`{path}` is no trajectory file, or is damaged (its header is no dictionary); expected an .npz written by `save`")
    if header.get("format") != 1:
        raise ValueError(f"`{path}` has format {header.get('format')}, expected 1; read it with the version of jourdain-jax that wrote it")
    missing = [name for name in (*_ARRAYS, "inputs") if name not in arrays]
    if missing:
        raise ValueError(f"`{path}` lacks the array `{missing[0]}`; it is damaged or was not written by `save`")
    absent = [name for name in (*_TEXTS, *_ENTRIES) if name not in header]
    if absent:
        raise ValueError(f"the header of `{path}` lacks `{absent[0]}`; it is damaged or was not written by `save`")
    return header, arrays


def _static_fields(scene: Scene) -> list[str]:
    """Fields that are plain numbers or texts, such as a number of bodies."""
    parameters = {name for name, _, _ in parameters_of(scene)}
    return [field.name for field in fields(scene) if field.name not in parameters and isinstance(getattr(scene, field.name), int | float | str | bool)]
