"""All models by name."""

from dataclasses import fields

from jourdain_jax.models.ball_on_turntable import BallOnTurntable
from jourdain_jax.models.chaplygin_sleigh import ChaplyginSleigh
from jourdain_jax.models.double_pendulum_angles import DoublePendulumAngles
from jourdain_jax.models.double_pendulum_rods import DoublePendulumRods
from jourdain_jax.models.free_rigid_body import FreeRigidBody
from jourdain_jax.models.heisenberg_particle import HeisenbergParticle
from jourdain_jax.models.isokinetic_particle import IsokineticParticle
from jourdain_jax.models.pendulum_chain import PendulumChain
from jourdain_jax.models.rattleback import Rattleback
from jourdain_jax.models.rosenberg_particle import RosenbergParticle
from jourdain_jax.models.skate import Skate
from jourdain_jax.models.snakeboard import Snakeboard
from jourdain_jax.models.spring_and_rod import SpringAndRod
from jourdain_jax.models.suslov import Suslov
from jourdain_jax.models.tilting_disc import TiltingDisc
from jourdain_jax.models.tilting_disc_quaternion import TiltingDiscQuaternion
from jourdain_jax.models.trailer_chain import TrailerChain
from jourdain_jax.models.two_wheel_axle import (
    TwoWheelAxleCoordinates,
    TwoWheelAxleFree,
    TwoWheelAxleQuasi,
    TwoWheelAxleRedundant,
)
from jourdain_jax.models.vertical_disc import VerticalDisc
from jourdain_jax.models.whipple_bicycle import WhippleBicycle
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene

MODELS: dict[str, type[Scene]] = {
    "two-wheel-axle-free": TwoWheelAxleFree,
    "two-wheel-axle-coordinates": TwoWheelAxleCoordinates,
    "two-wheel-axle-quasi": TwoWheelAxleQuasi,
    "two-wheel-axle-redundant": TwoWheelAxleRedundant,
    "skate": Skate,
    "chaplygin-sleigh": ChaplyginSleigh,
    "vertical-disc": VerticalDisc,
    "tilting-disc": TiltingDisc,
    "tilting-disc-quaternion": TiltingDiscQuaternion,
    "rosenberg-particle": RosenbergParticle,
    "heisenberg-particle": HeisenbergParticle,
    "ball-on-turntable": BallOnTurntable,
    "suslov": Suslov,
    "snakeboard": Snakeboard,
    "rattleback": Rattleback,
    "whipple-bicycle": WhippleBicycle,
    "double-pendulum-rods": DoublePendulumRods,
    "double-pendulum-angles": DoublePendulumAngles,
    "free-rigid-body": FreeRigidBody,
    "spring-and-rod": SpringAndRod,
    "isokinetic-particle": IsokineticParticle,
    "trailer-chain": TrailerChain,
    "pendulum-chain": PendulumChain,
}


def model(name: str, **parameters) -> Scene:
    """A model by name, with parameters changed by name; a ValueError that lists the valid names otherwise."""
    kind = known_model(name)
    valid = [field.name for field in fields(kind)]
    for given in parameters:
        if given not in valid:
            raise ValueError(f"model `{name}` has no parameter `{given}`; {nearest(given, valid)}")
    return kind(**parameters)


def known_model(name: str) -> type[Scene]:
    """The class of a model; a ValueError with the nearest name where there is none."""
    if name not in MODELS:
        raise ValueError(f"unknown model `{name}`; {nearest(name, MODELS)}")
    return MODELS[name]


def counts_of(kind: type[Scene]) -> tuple[str, ...]:
    """Names of the whole numbers that decide what a scene consists of, such as a number of links."""
    return tuple(field.name for field in fields(kind) if field.metadata.get("static") and isinstance(field.default, int))
