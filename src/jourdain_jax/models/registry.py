"""All models by name."""

from collections.abc import Iterator, Mapping
from dataclasses import fields
from importlib import import_module

from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene

PLACES = {  # of the classes: modules of this package, which are imported on first use
    "two-wheel-axle-free": ("two_wheel_axle", "TwoWheelAxleFree"),
    "two-wheel-axle-coordinates": ("two_wheel_axle", "TwoWheelAxleCoordinates"),
    "two-wheel-axle-quasi": ("two_wheel_axle", "TwoWheelAxleQuasi"),
    "two-wheel-axle-redundant": ("two_wheel_axle", "TwoWheelAxleRedundant"),
    "skate": ("skate", "Skate"),
    "chaplygin-sleigh": ("chaplygin_sleigh", "ChaplyginSleigh"),
    "vertical-disc": ("vertical_disc", "VerticalDisc"),
    "tilting-disc": ("tilting_disc", "TiltingDisc"),
    "tilting-disc-quaternion": ("tilting_disc_quaternion", "TiltingDiscQuaternion"),
    "rosenberg-particle": ("rosenberg_particle", "RosenbergParticle"),
    "heisenberg-particle": ("heisenberg_particle", "HeisenbergParticle"),
    "ball-on-turntable": ("ball_on_turntable", "BallOnTurntable"),
    "suslov": ("suslov", "Suslov"),
    "snakeboard": ("snakeboard", "Snakeboard"),
    "rattleback": ("rattleback", "Rattleback"),
    "whipple-bicycle": ("whipple_bicycle", "WhippleBicycle"),
    "double-pendulum-rods": ("double_pendulum_rods", "DoublePendulumRods"),
    "double-pendulum-angles": ("double_pendulum_angles", "DoublePendulumAngles"),
    "free-rigid-body": ("free_rigid_body", "FreeRigidBody"),
    "spring-and-rod": ("spring_and_rod", "SpringAndRod"),
    "isokinetic-particle": ("isokinetic_particle", "IsokineticParticle"),
    "trailer-chain": ("trailer_chain", "TrailerChain"),
    "pendulum-chain": ("pendulum_chain", "PendulumChain"),
}


class _Models(Mapping[str, type[Scene]]):
    """The classes by the names of the models; read-only."""

    def __getitem__(self, name: str) -> type[Scene]:
        module, kind = PLACES[name]
        return getattr(import_module(f"{__package__}.{module}"), kind)

    def __iter__(self) -> Iterator[str]:
        return iter(PLACES)

    def __len__(self) -> int:
        return len(PLACES)


MODELS = _Models()


def model(name: str, **parameters) -> Scene:
    """A model by name, with parameters changed by name; a ValueError that lists the valid names otherwise."""
    kind = known_model(name)
    valid = [field.name for field in fields(kind) if field.init]
    for given in parameters:
        if given not in valid:
            raise ValueError(f"model `{name}` has no parameter `{given}`; {nearest(given, valid)}")
    return kind(**parameters)


def known_model(name: str) -> type[Scene]:
    """The class of a model; a ValueError with the nearest name where there is none."""
    if not isinstance(name, str) or name not in MODELS:
        raise ValueError(f"unknown model `{name}`; {nearest(name, MODELS)}")
    return MODELS[name]


def counts_of(kind: type[Scene]) -> tuple[str, ...]:
    """Names of the whole numbers that decide what a scene consists of, such as a number of links."""
    return tuple(field.name for field in fields(kind) if field.metadata.get("static") and isinstance(field.default, int))
