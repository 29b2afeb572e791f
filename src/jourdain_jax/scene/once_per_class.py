"""What depends on a scene's class and the shapes of its parameters only, worked out once."""

from collections.abc import Callable, Hashable
from functools import wraps
from threading import Lock

import jax
import numpy as np

from jourdain_jax.scene.parameters import stacked_parameters
from jourdain_jax.scene.scene import Scene

_UNKNOWN = object()


def once_per_class(describe: Callable, most: int = 1024) -> Callable:
    """A function of a scene (and of what else tells its cases apart) that depends on its class and the shapes of its parameters only: worked out once.

    `most`: cases that are kept.
    """
    known: dict = {}
    keeping = Lock()  # threads may ask at the same time; they may work the same out

    @wraps(describe)
    def of(scene: Scene, *case: Hashable):
        leaves, treedef = jax.tree.flatten(scene)
        key = (treedef, tuple(np.shape(x) for x in leaves), jax.config.jax_enable_x64, case)
        found = known.get(key, _UNKNOWN)
        if found is _UNKNOWN:
            found = _described(describe, scene, case)
            with keeping:
                known[key] = found
                if len(known) > most:
                    known.pop(next(iter(known)))  # the oldest
        return found

    vars(of)["cache_clear"] = known.clear
    return of


def _described(describe: Callable, scene: Scene, case: tuple):
    try:
        return describe(scene, *case)
    except (TypeError, ValueError) as error:
        if many := stacked_parameters(scene):
            raise ValueError(f"{many} ({error})") from error
        raise
