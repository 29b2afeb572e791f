"""Textbook scenes, imported on first use; static tools read them here."""

from .blades import ChaplyginSleigh, Skate, Snakeboard, TrailerChain
from .discs import TiltingDisc, TiltingDiscQuaternion, VerticalDisc
from .particles import HeisenbergParticle, IsokineticParticle, RosenbergParticle
from .pendulums import DoublePendulumAngles, DoublePendulumRods, PendulumChain, SpringAndRod
from .registry import MODELS, model
from .rolling_solids import BallOnTurntable, Rattleback
from .turning_bodies import FreeRigidBody, Suslov
from .two_wheel_axle import (
    TwoWheelAxleCoordinates,
    TwoWheelAxleFree,
    TwoWheelAxleQuasi,
    TwoWheelAxleRedundant,
)
from .whipple_bicycle import WhippleBicycle

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
