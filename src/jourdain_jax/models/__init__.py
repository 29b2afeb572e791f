"""Textbook scenes, and their registry by name."""

from typing import TYPE_CHECKING

from jourdain_jax.calculus.lazy_imports import names_on_first_use
from jourdain_jax.models.registry import MODELS, model

if TYPE_CHECKING:
    from jourdain_jax.models.blades import ChaplyginSleigh, Skate, Snakeboard, TrailerChain
    from jourdain_jax.models.discs import TiltingDisc, TiltingDiscQuaternion, VerticalDisc
    from jourdain_jax.models.particles import HeisenbergParticle, IsokineticParticle, RosenbergParticle
    from jourdain_jax.models.pendulums import DoublePendulumAngles, DoublePendulumRods, PendulumChain, SpringAndRod
    from jourdain_jax.models.rolling_solids import BallOnTurntable, Rattleback
    from jourdain_jax.models.turning_bodies import FreeRigidBody, Suslov
    from jourdain_jax.models.two_wheel_axle import TwoWheelAxleCoordinates, TwoWheelAxleFree, TwoWheelAxleQuasi, TwoWheelAxleRedundant
    from jourdain_jax.models.whipple_bicycle import WhippleBicycle
else:
    __getattr__, __dir__ = names_on_first_use(globals())

__all__ = [
    "MODELS",
    "BallOnTurntable",
    "ChaplyginSleigh",
    "DoublePendulumAngles",
    "DoublePendulumRods",
    "FreeRigidBody",
    "HeisenbergParticle",
    "IsokineticParticle",
    "PendulumChain",
    "Rattleback",
    "RosenbergParticle",
    "Skate",
    "Snakeboard",
    "SpringAndRod",
    "Suslov",
    "TiltingDisc",
    "TiltingDiscQuaternion",
    "TrailerChain",
    "TwoWheelAxleCoordinates",
    "TwoWheelAxleFree",
    "TwoWheelAxleQuasi",
    "TwoWheelAxleRedundant",
    "VerticalDisc",
    "WhippleBicycle",
    "model",
]
