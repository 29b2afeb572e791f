"""Convert motions to labelled arrays: an `xarray.Dataset` or a `pandas.DataFrame`.

A scene states the units of its parameters. Of coordinates and speeds, only quaternions and their angular
velocities have known units; the user may supply the others.
"""

import math
from collections.abc import Mapping

import numpy as np

from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.integrate.result_codes import CODES
from jourdain_jax.motion.trajectories.values_in_time import Record
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.coordinates import Labels, check_names, parameters_of
from jourdain_jax.scene.scene import state_names

# by name: field of a motion, type, missing value, attributes
OF_LANES: dict[str, tuple[str, str, float, dict]] = {
    "result": (
        "result",
        "int8",
        -1,
        {
            "long_name": "how the motion ended",
            "flag_values": list(range(len(CODES))),
            "flag_meanings": " ".join(CODES),
        },
    ),
    "event": ("event", "int8", -1, {"long_name": "which stop event ended the motion; -1: none"}),
    "steps": ("accepted", "int32", -1, {"long_name": "accepted steps"}),
    "rejected_steps": ("rejected", "int32", -1, {"long_name": "rejected steps"}),
    "retries": (
        "fallback",
        "int8",
        -1,
        {
            "long_name": "how the motion was retried",
            "flag_masks": [1, 2],
            "flag_meanings": "full_state implicit_solver",
        },
    ),
    "end_time": ("t_end", "float64", math.nan, {"long_name": "time at which the motion ended", "units": "s"}),
}


@of_known_numbers
def to_xarray(record: Record, units: Mapping[str, str] | None = None):
    """Return a motion, or a batch of motions, as an `xarray.Dataset`. `units`: units of coordinates and
    speeds by name.
    """
    xarray = needed("xarray", "a motion as labelled arrays")
    lanes = _lanes(record)
    units = _units(record.scene, units)
    ts = np.asarray(record.ts)
    shared = not lanes or bool(np.all(ts == ts[:1]))
    along = (*lanes, "time" if shared else "save")
    about_time = {"long_name": "time", "units": "s"}
    found: dict[str, tuple] = {
        "time": ("time", ts[0] if lanes else ts, about_time) if shared else (along, ts, about_time)
    }
    if lanes:
        found["lane"] = ("lane", np.arange(len(ts)), {"long_name": "index of the motion"})

    def add(name: str, axes: tuple, values, about: dict) -> None:
        if name in found or name == "lane":
            raise ValueError(
                f"`{name}` would name two arrays of the dataset of a `{type(record.scene).__name__}`; "
                "rename it in the scene (names other than "
                f"{', '.join(('time', 'lane', *OF_LANES))}), or use `to_pandas()`"
            )
        found[name] = (axes, values, about)

    for name, values in _columns(record).items():
        add(name, along, values, {"long_name": name} | ({"units": units[name]} if name in units else {}))
    for name, (field, dtype, _, about) in OF_LANES.items():
        more = {"event_names": list(record.event_names)} if name == "event" else {}
        add(name, lanes, np.asarray(getattr(record, field)).astype(dtype), about | more)
    for name, value, about in parameters_of(record.scene):
        values = np.asarray(value)
        axes = tuple(f"{name}_{k}" for k in range(values.ndim - len(lanes)))
        unit = {"units": about["unit"]} if about["unit"] else {}
        add(name, (*lanes, *axes), values, {"long_name": about["about"] or name, "role": "parameter"} | unit)
    held = xarray.Dataset(
        {name: value for name, value in found.items() if name not in ("time", "lane")},
        {n: found[n] for n in ("time", "lane") if n in found},
    )
    return held.assign_attrs(
        scene=type(record.scene).__name__, conventions=record.scene.conventions, solver=record.solver
    )


@of_known_numbers
def to_pandas(record: Record):
    """Return coordinates and speeds as a `pandas.DataFrame`: one row per time, or per sample and time."""
    pandas = needed("pandas", "a table of a motion")
    lanes, ts = _lanes(record), np.asarray(record.ts)
    if not lanes:
        return pandas.DataFrame(_columns(record), index=pandas.Index(ts, name="time"))
    numbers = np.repeat(np.arange(len(ts)), ts.shape[1])
    index = pandas.MultiIndex.from_arrays([numbers, ts.ravel()], names=["lane", "time"])
    return pandas.DataFrame({name: values.ravel() for name, values in _columns(record).items()}, index=index)


def _lanes(record: Record) -> Labels:
    return ("lane",) * (record.q.ndim - 2)


def _columns(record: Record) -> dict[str, np.ndarray]:
    names = (record.scene.coordinate_names.entries, record.scene.speed_names.entries)
    return {
        name: np.asarray(array)[..., k]
        for entries, array in zip(names, (record.q, record.u), strict=True)
        for k, name in enumerate(entries)
    }


def _units(scene, given: Mapping[str, str] | None) -> dict[str, str]:
    """Return the units of quaternions and their angular velocities, and the given ones, by name."""
    known: dict[str, str] = {}
    for names, unit in (
        (scene.coordinate_names, "1"),
        *(((scene.speed_names, "rad/s"),) if scene.speeds is None else ()),
    ):
        known |= {
            name: unit for _, first, length in names.groups for name in names.entries[first : first + length]
        }
    valid = state_names(scene)
    check_names(
        given or {},
        valid,
        f"`units` names `{{}}`, which is not a coordinate or speed of `{type(scene).__name__}`",
    )
    return known | dict(given or {})
