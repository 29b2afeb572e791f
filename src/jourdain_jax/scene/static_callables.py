"""Functions in the fields of a scene, such as the activation of a network: part of what the scene is, no numbers of its equations."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import equinox as eqx
import jax

from jourdain_jax.calculus.reals import described
from jourdain_jax.scene.what_is_read import WhatIsRead, is_function, is_read_by


class HeldFunction(eqx.Module):
    """A function that JAX takes for part of the structure of the scene, as it takes a static field."""

    function: Callable[..., Any] = eqx.field(static=True)
    read: WhatIsRead

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self.read = is_read_by(function) if is_function(function) else is_read_by()

    def __call__(self, *args, **kwargs):
        """What the function returns."""
        return self.function(*args, **kwargs)


def hold_functions(scene) -> None:
    """Holds the functions in a scene that is being built, however deep in its fields; a ValueError for texts, which nothing can hold but a static field."""

    def held(leaf):
        return HeldFunction(leaf) if callable(leaf) else leaf

    static = tuple(value for field in fields(scene) if field.metadata.get("static") and is_function(value := getattr(scene, field.name)))
    object.__setattr__(scene, "_read", is_read_by(type(scene), *static))
    for field in fields(scene):
        if field.metadata.get("static") or field.metadata.get("parameter"):
            continue
        value = getattr(scene, field.name)
        leaves = jax.tree.leaves(value)
        text = next((leaf for leaf in leaves if isinstance(leaf, str)), None)
        if text is not None:
            raise ValueError(
                f"field `{field.name}` of `{type(scene).__name__}` holds {described(text)}, expected numbers; "
                f"for what is no number write `{field.name}: str = eqx.field(static=True, default={text!r})`"
            )
        if any(callable(leaf) for leaf in leaves):
            object.__setattr__(scene, field.name, jax.tree.map(held, value))
