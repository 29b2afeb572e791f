"""The registry of all models by name."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

from jourdain_jax import models
from jourdain_jax.scene.coordinates import Labels, check_name, nearest
from jourdain_jax.scene.scene import Scene

NAMES = (
    "two-wheel-axle-free",
    "two-wheel-axle-coordinates",
    "two-wheel-axle-quasi",
    "two-wheel-axle-redundant",
    "skate",
    "chaplygin-sleigh",
    "snakeboard",
    "trailer-chain",
    "vertical-disc",
    "tilting-disc",
    "tilting-disc-quaternion",
    "rosenberg-particle",
    "heisenberg-particle",
    "isokinetic-particle",
    "ball-on-turntable",
    "rattleback",
    "suslov",
    "free-rigid-body",
    "whipple-bicycle",
    "double-pendulum-rods",
    "double-pendulum-angles",
    "spring-and-rod",
    "pendulum-chain",
)


class _Models(Mapping[str, type[Scene]]):
    """A read-only mapping from the names of models to their classes."""

    def __getitem__(self, name: str) -> type[Scene]:
        if name not in NAMES:
            raise KeyError(name)
        return getattr(models, "".join(map(str.capitalize, name.split("-"))))  # imported on first use

    def __iter__(self) -> Iterator[str]:
        return iter(NAMES)

    def __len__(self) -> int:
        return len(NAMES)


MODELS = _Models()


def model(name: str, **parameters: Any) -> Scene:
    """Return a model by name, with the given parameters changed. Raises ValueError, with the valid names, for
    an unknown name.
    """
    kind = known_model(name)
    valid = [field.name for field in fields(kind) if field.init]
    for given in parameters:
        check_name(given, valid, f"model `{name}` has no parameter `{given}`")
    return kind(**parameters)


def known_model(name: str) -> type[Scene]:
    """Return the class of a model. Raises ValueError, with the nearest name, if there is none."""
    if not isinstance(name, str) or name not in MODELS:
        raise ValueError(f"unknown model `{name}`; {nearest(name, MODELS)}")
    return MODELS[name]


def counts_of(kind: type[Scene]) -> Labels:
    """Return names of the integer fields that determine the structure of a scene, such as a number of
    links.
    """
    return tuple(
        field.name
        for field in fields(kind)
        if field.metadata.get("static") and isinstance(field.default, int)
    )
