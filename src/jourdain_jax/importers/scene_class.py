"""A class of scenes made from a description: its parameters become fields with defaults, like those that a user writes."""

from typing import Any

from jourdain_jax.scene.scene import Scene


def scene_class(base: type[Scene], name: str, about: str, fields: dict[str, Any], attributes: dict[str, Any]) -> type[Scene]:
    """A subclass of `base` called `name`, whose docstring is `about`, with `fields`, made by `parameter`, and further class `attributes`."""
    annotations = dict.fromkeys(fields, object)
    namespace = {"__module__": base.__module__, "__qualname__": name, "__doc__": about, "__annotations__": annotations, **fields, **attributes}
    return type(base)(name, (base,), namespace)
