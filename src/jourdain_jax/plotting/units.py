"""Units of what is plotted: factors from SI, by what is measured in them."""

from collections.abc import Iterable, Mapping

import numpy as np

from jourdain_jax.calculus.reals import described
from jourdain_jax.scene.names import UnknownNameError, nearest

# one of these units, in those of SI
TIMES = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
COORDINATES = {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "turn": 2 * np.pi}
SPEEDS = {"m/s": 1.0, "km/h": 1 / 3.6, "cm/s": 1e-2, "mm/s": 1e-3, "rad/s": 1.0, "deg/s": np.pi / 180, "turn/s": 2 * np.pi, "rpm": np.pi / 30}
ENERGIES = {"J": 1.0, "kJ": 1e3, "mJ": 1e-3}


def checked_units(units, known: Mapping[str, Iterable[str]]) -> dict[str, tuple[str, float]]:
    """Name -> unit and its size in SI, of `units`; `known`: names by what they are, "time", "coordinate", "speed" or "energy".

    KeyError for an unknown name; ValueError for an unknown unit, or one of something else.
    """
    if units is None:
        return {}
    if not isinstance(units, Mapping):
        raise ValueError(f'`units` is {described(units)}, expected a dictionary from names to units, such as {{"lean": "deg"}}')
    sizes = {"time": TIMES, "coordinate": COORDINATES, "speed": SPEEDS, "energy": ENERGIES}
    kinds = {name: kind for kind, names in known.items() for name in names}
    found = {}
    for name, unit in units.items():
        if name not in kinds:
            raise UnknownNameError(f"`units` names `{name}`, which is nothing to plot; {nearest(str(name), tuple(kinds))}")
        kind = kinds[name]
        if unit not in sizes[kind]:
            raise ValueError(f"`{unit}` is no unit of the {kind} `{name}` that is known here; {nearest(str(unit), tuple(sizes[kind]))}")
        found[name] = unit, sizes[kind][unit]
    return found
