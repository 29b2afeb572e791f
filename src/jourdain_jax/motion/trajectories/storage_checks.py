"""Whether what a file holds can be a motion: every entry there, of its kind, shape and type, and finite where a motion is.

A file is believed in nothing: it may be of another version of a scene's class, written by another program, or damaged in a way that its format does not show.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.build.trace import velocity_quantities
from jourdain_jax.calculus.reals import described
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.motion.retries import RERUN_FIELDS
from jourdain_jax.motion.trajectories.results import BAD_PARAMETER, EVENT, FALLBACKS, MESSAGES, SUCCESS
from jourdain_jax.scene.parameters import parameter_faults
from jourdain_jax.scene.scene import Scene

COUNTS = ("result", "event", "accepted", "rejected", "fallback", "crossings")
# arrays and their axes, after that of the lanes of a rollout
AXES: dict[str, tuple[str, ...]] = {"ts": ("times",), "q": ("times", "coordinates"), "u": ("times", "speeds"), "inputs": ("times", "input_names")}
AXES |= {"q_end": ("coordinates",), "u_end": ("speeds",)} | dict.fromkeys(
    ("t_end", "last_step", "moved_q", "moved_u", "smallest_pivot", "together", *COUNTS), ()
)
AXES |= {"work": ("times",)}  # absent where it is not tracked
# entries of the header: their type, in words too
HEADER: dict[str, tuple[type, str]] = dict.fromkeys(("scene", "state_form", "reduction", "solver", "unwatched", "kind"), (str, "a text"))
_LISTS = ("coordinates", "speeds", "input_names", "event_names", "arrays")
HEADER |= dict.fromkeys(_LISTS, (list, "a list of names"))
HEADER |= {"static": (dict, "a dictionary"), "units": (dict, "a dictionary"), "projected": (bool, "true or false"), "reruns": (list, "a list")}


def refused(path, sentence: str) -> ValueError:
    """The error for a file that cannot be what it says."""
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
    sizes = {"times": times} | {name: len(header[name]) for name in ("coordinates", "speeds", "input_names")}
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
        kinds, text = ("iu", "whole numbers") if name in COUNTS else ("f", "floating-point numbers")
        if array.dtype.kind not in kinds:
            raise refused(path, f"has `{name}` of type {array.dtype}, expected {text}")
    _check_codes(path, header, arrays)
    _check_finite(path, arrays)


def _check_codes(path, header: dict, arrays: dict) -> None:
    events = np.where(arrays["result"] == EVENT, np.arange(len(header["event_names"]) + 1).max() - 1, -1)
    ranges = {"result": np.isin(arrays["result"], list(MESSAGES)), "fallback": np.isin(arrays["fallback"], list(FALLBACKS))}
    ranges["event"] = (arrays["event"] <= events) & (arrays["event"] >= np.where(arrays["result"] == EVENT, 0, -1))
    ranges |= {name: arrays[name] >= 0 for name in ("accepted", "rejected")} | {"crossings": arrays["crossings"] >= -1}
    for name, right in ranges.items():
        if not np.all(right):
            raise refused(path, f"has {arrays.get(name, header.get(name))} as `{name}`, which no motion has")


def _check_finite(path, arrays: dict) -> None:
    """Motions that reached their end, or an event, are finite as far as they went; failed ones may hold anything."""
    whole = np.isin(arrays["result"], (SUCCESS, EVENT))
    for name in ("t_end", "q_end", "u_end", "moved_q", "moved_u"):
        good = np.isfinite(arrays[name])
        if not np.all(good.reshape(*whole.shape, -1)[whole]):
            raise refused(path, f"has numbers in `{name}` that are not finite, in a motion that did not fail")
    for name in ("ts", "together"):
        if np.any(np.isnan(arrays[name])):
            raise refused(path, f"has times in `{name}` that are no numbers")
    reached = np.all(np.isfinite(arrays["q"]), axis=-1)
    if np.any(whole & ~_go_one_way(arrays, reached)):
        raise refused(path, "has times in `ts` that do not go one way, towards the end of the motion")
    due = np.isfinite(arrays["ts"]) & (np.asarray(arrays["result"]) == SUCCESS)[..., None]
    for name in ("q", "u", "inputs", *(["work"] if "work" in arrays else [])):
        values = arrays[name].reshape(*arrays["ts"].shape, -1)
        finite = np.all(np.isfinite(values), axis=-1)
        apart = (np.any(np.isfinite(values), axis=-1) if name in ("q", "u") else reached) & ~finite
        if np.any((due | (apart & whole[..., None])) & ~finite):
            raise refused(path, f"has numbers in `{name}` that are not finite at times that were reached")


def _go_one_way(arrays: dict, reached: np.ndarray) -> np.ndarray:
    """Whether the saved times that each lane reached go one way, and to its end but for round-off."""
    ts, end = np.asarray(arrays["ts"], float), np.asarray(arrays["t_end"], float)[..., None]
    with np.errstate(invalid="ignore"):  # of motions that failed
        steps = np.diff(np.concatenate([np.where(np.isfinite(ts) & reached, ts, end), end], axis=-1), axis=-1)
    slack = 1e-6 * np.max(np.abs(steps), axis=-1, keepdims=True)
    return np.asarray(np.all(steps >= -slack, axis=-1) | np.all(steps <= slack, axis=-1))


def check_scenes(path, scene: Scene, result) -> None:
    """ValueError where parameters of lanes are wrong in a motion that did not end for it, or of shapes that do not make the scene."""
    for name, fault in jax.vmap(parameter_faults)(scene).items():
        wrong = np.flatnonzero(np.asarray(fault) & (np.asarray(result) != BAD_PARAMETER))
        if wrong.size:
            value = f"{np.asarray(getattr(scene, name))[wrong[0]]} as a value of the parameter `{name}`"
            raise refused(path, f"has {value}, which is not finite or has the wrong sign, in a motion that did not fail for it")

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
