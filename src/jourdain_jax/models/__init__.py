"""Textbook scenes, one file each, and their registry by name."""

from typing import TYPE_CHECKING

from jourdain_jax.calculus.on_first_use import names_on_first_use
from jourdain_jax.models.registry import MODELS, PLACES, model

if TYPE_CHECKING:
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
    from jourdain_jax.models.two_wheel_axle import TwoWheelAxleCoordinates, TwoWheelAxleFree, TwoWheelAxleQuasi, TwoWheelAxleRedundant
    from jourdain_jax.models.vertical_disc import VerticalDisc
    from jourdain_jax.models.whipple_bicycle import WhippleBicycle

__getattr__, __dir__ = names_on_first_use(globals(), {kind: module for module, kind in PLACES.values()}, {})

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
