"""The registry of all models by name."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from importlib import import_module

from jourdain_jax.scene.coordinates import Labels, check_name, nearest
from jourdain_jax.scene.scene import Scene

PLACES = {  # module -> names of its models; modules are imported on first use
    "two_wheel_axle": (
        "two-wheel-axle-free",
        "two-wheel-axle-coordinates",
        "two-wheel-axle-quasi",
        "two-wheel-axle-redundant",
    ),
    "blades": ("skate", "chaplygin-sleigh", "snakeboard", "trailer-chain"),
    "discs": ("vertical-disc", "tilting-disc", "tilting-disc-quaternion"),
    "particles": ("rosenberg-particle", "heisenberg-particle", "isokinetic-particle"),
    "rolling_solids": ("ball-on-turntable", "rattleback"),
    "turning_bodies": ("suslov", "free-rigid-body"),
    "whipple_bicycle": ("whipple-bicycle",),
    "pendulums": ("double-pendulum-rods", "double-pendulum-angles", "spring-and-rod", "pendulum-chain"),
}
CLASSES = {
    "".join(map(str.capitalize, name.split("-"))): module
    for module, names in PLACES.items()
    for name in names
}
_CLASS_OF = dict(zip((name for names in PLACES.values() for name in names), CLASSES, strict=True))


class _Models(Mapping[str, type[Scene]]):
    """A read-only mapping from the names of models to their classes."""

    def __getitem__(self, name: str) -> type[Scene]:
        kind = _CLASS_OF[name]
        return getattr(import_module(f"{__package__}.{CLASSES[kind]}"), kind)

    def __iter__(self) -> Iterator[str]:
        return iter(_CLASS_OF)

    def __len__(self) -> int:
        return len(_CLASS_OF)


MODELS = _Models()


def model(name: str, **parameters) -> Scene:
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
