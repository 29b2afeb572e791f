"""A class of scenes made from a description: its parameters become fields with defaults, like those that a user writes."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jourdain_jax.scene.parameters import parameter
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True)
class Parameter:
    """A number, or several, that the scene can replace and be differentiated by."""

    value: float | np.ndarray
    unit: str = ""
    about: str = ""
    positive: bool = False


def scene_class(base: type[Scene], name: str, about: str, parameters: dict[str, Parameter], attributes: dict[str, Any]) -> type[Scene]:
    """A subclass of `base` called `name`, whose docstring is `about`, with a field for each of the `parameters` and further class attributes."""
    fields = {key: parameter(p.value, unit=p.unit, about=p.about, positive=p.positive) for key, p in parameters.items()}
    annotations = dict.fromkeys(fields, object)
    namespace = {"__module__": base.__module__, "__qualname__": name, "__doc__": about, "__annotations__": annotations, **fields, **attributes}
    return type(base)(name, (base,), namespace)
