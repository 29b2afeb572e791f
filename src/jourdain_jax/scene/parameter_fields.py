"""Physical parameters of a scene: differentiable leaves, checked where their values are known."""

from collections.abc import Iterator
from dataclasses import MISSING
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jourdain_jax.calculus.reals import Flag, all_finite, as_real, described, has_unit, known_numbers


def _as_leaf(value):
    """Return a number or an array as a floating-point array. Any other value stays unchanged, and
    `check_parameters` rejects it with the field's name.
    """
    try:
        return as_real(value)
    except (TypeError, ValueError):
        return value


def parameter(
    default: Any = ..., *, unit: str = "", positive: bool = False, non_negative: bool = False, about: str = ""
) -> Any:
    """Declare a field of a scene as a physical parameter. It is converted to a floating-point array and is
    differentiable.

    - `default`: a number or an array; without it the parameter must be given. `unit` and `about` describe it.
    - `positive`, `non_negative`: required sign. A scene with a known value of another sign, or with numbers
      that are not finite, raises ValueError.
    """
    whole = np.ndim(default) == 0
    options = {"default": default} if whole else {"default_factory": lambda: default}
    metadata = {"parameter": True, "unit": unit, "about": about}
    metadata |= {"positive": positive, "non_negative": non_negative}
    return eqx.field(converter=_as_leaf, metadata=metadata, **({} if default is ... else options))


def parameters_of(scene) -> Iterator[tuple[str, Array, dict]]:
    """Yield name, value and metadata (unit, ...) of every parameter of a scene."""
    for name, field in scene.__dataclass_fields__.items():
        if field.metadata.get("parameter"):
            yield name, getattr(scene, name), dict(field.metadata)


def parameter_faults(scene) -> dict[str, Flag]:
    """Return for each parameter whether it is not finite or has the wrong sign. This works under jit and
    vmap, unlike `check_parameters`.
    """
    faults = {}
    for name, value, metadata in parameters_of(scene):
        right = jnp.isfinite(value)
        if metadata["positive"] or metadata["non_negative"]:
            right = right & (value > 0 if metadata["positive"] else value >= 0)
        faults[name] = ~jnp.all(right)
    return faults


def check_parameters(scene) -> None:
    """Raise ValueError for a parameter that is not finite or has the wrong sign. Traced values are not
    checked.
    """
    for name, value, metadata in parameters_of(scene):
        where = f"parameter `{name}` of `{type(scene).__name__}`"
        if has_unit(value) or not hasattr(value, "dtype"):
            raise ValueError(
                f"{where} is {described(value)}, expected a number{_in(metadata)} or an array of numbers"
            )
        if not jnp.issubdtype(value.dtype, jnp.floating):
            raise ValueError(
                f"{where} is of type {value.dtype}, expected real numbers{_in(metadata)}; check "
                "where it was computed"
            )
        numbers = known_numbers(value)
        if not all_finite(numbers):
            raise ValueError(f"{where} is {numbers}, expected finite numbers; check where it was computed")
        if metadata["positive"] and not np.all(numbers > 0):
            raise ValueError(
                f"{where} is {numbers}, expected a positive number{_in(metadata)}; give a value above zero"
            )
        if metadata["non_negative"] and not np.all(numbers >= 0):
            raise ValueError(
                f"{where} is {numbers}, expected a number >= 0{_in(metadata)}; give a value "
                "that is not negative"
            )


def stacked_parameters(scene) -> str:
    """Return an error message about parameters with one axis more than their defaults, as in a batch of
    scenes; empty if there are none.
    """
    shapes = {name: np.shape(value) for name, value, _ in parameters_of(scene)}
    usual = {name: np.shape(value) for name, value in _defaults(type(scene))}
    many = [
        f"`{name}` has the shape {shape}"
        for name, shape in shapes.items()
        if name in usual and shape[1:] == usual[name] != shape
    ]
    if not many:
        return ""
    return (
        f"`{type(scene).__name__}` cannot be evaluated: its {', '.join(many)}, one axis more than the "
        "default; for many scenes use `jax.vmap`, or `rollout` with `parameters={name: values}`"
    )


def _defaults(kind) -> Iterator[tuple[str, object]]:
    for name, field in kind.__dataclass_fields__.items():
        if field.metadata.get("parameter"):
            if field.default is not MISSING:
                yield name, field.default
            elif field.default_factory is not MISSING:
                yield name, field.default_factory()


def _in(metadata: dict) -> str:
    return f" in {metadata['unit']}" if metadata["unit"] else ""
