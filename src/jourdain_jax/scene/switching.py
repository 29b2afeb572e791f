"""Contacts with friction as declarations of a scene: a mode, three events and a direction of slip each.

Which contacts have friction is a fact of structure, found when a scene is made, once for each structure. It
then has, besides that which its class states,

    mode `rim`                                     flies, rolls, slips, creeps
    events `rim normal`, `rim tangent`, `rim speed`
    coordinates `rim_slip_1`, `rim_slip_2`         the direction of slip, zero where it does not slip

The mechanics of it: `equations/switching.py`.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from types import CodeType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import real_type
from jourdain_jax.scene.coordinates import Coordinates, Names
from jourdain_jax.scene.modes import Modes
from jourdain_jax.scene.motion_state import BodyPose, Pose
from jourdain_jax.scene.names_read import functions_in, names_in

FLIES, ROLLS, SLIPS, CREEPS = range(4)
GAINS_ENERGY, PAINLEVE, UNDECIDED, FLAT = -1, -2, -3, -4  # in place of a mode: why a motion cannot continue
MODES_OF_CONTACT = ("flies", "rolls", "slips", "creeps")
EVENTS_OF_CONTACT = ("normal", "tangent", "speed")


@dataclass(frozen=True)
class Switching:
    """The contacts with friction of a scene, and their declarations."""

    contacts: tuple[str, ...] = ()
    coordinates: Coordinates | None = None
    inputs: Names | None = None
    modes: Modes | None = None

    @property
    def events(self) -> tuple[str, ...]:
        """Names of the events, by contact."""
        return tuple(f"{name} {what}" for name in self.contacts for what in EVENTS_OF_CONTACT)


NONE_SWITCHES = Switching()


class Declared:
    """Declarations of a class, extended by an instance that has contacts with friction."""

    def __init__(self, name: str, stated: Any):
        self.name, self.stated = name, stated

    def __get__(self, scene, kind):
        switching = NONE_SWITCHES if scene is None else scene.switching
        if switching.contacts:
            return getattr(switching, self.name)
        return self.stated.__get__(scene, kind) if hasattr(self.stated, "__get__") else self.stated


def has_friction(kind: type) -> bool:
    """Return whether the methods `contacts` of a class speak of friction."""
    return any("friction" in _words(function.__code__) for owner in kind.__mro__ for function in functions_in(vars(owner).get("contacts")))


def _words(code: CodeType) -> set[str]:
    found = set(names_in(code))
    for constant in code.co_consts:  # names of arguments are among the constants
        found |= _words(constant) if isinstance(constant, CodeType) else set(constant) if isinstance(constant, tuple) else {constant}
    return found


def switching_of(scene) -> Switching:
    """Return the contacts of a scene that switch."""
    leaves, structure = jax.tree.flatten(scene)
    return _switching(structure, tuple(np.shape(x) for x in leaves))


@lru_cache(maxsize=256)
def _switching(structure, shapes: tuple[tuple[int, ...], ...]) -> Switching:
    """`structure`, `shapes`: of the scene."""
    names: list[str] = []

    def look(leaves) -> None:
        scene = jax.tree.unflatten(structure, leaves)
        t, q = jnp.zeros(()), scene.coordinates.names.view(jnp.zeros(len(scene.coordinates.names)))
        pose = Pose(t, q, {name: BodyPose(name, body) for name, body in scene.bodies(t, q).items()})
        names.extend(name for name, contact in scene.contacts(pose).items() if contact.friction is not None)

    leaves = [jax.ShapeDtypeStruct(shape, real_type()) for shape in shapes]
    jax.eval_shape(look, leaves)
    if not names:
        return NONE_SWITCHES
    scene = jax.tree.unflatten(structure, leaves)
    own = scene.coordinates
    directions = tuple(f"{name}_slip_{i}" for name in names for i in (1, 2))
    return Switching(
        tuple(names),
        replace(own, names=Names((*own.names.entries, *directions), own.names.groups)),
        Names((*scene.inputs.entries, *names), scene.inputs.groups),
        Modes((*scene.modes.pairs, *((name, MODES_OF_CONTACT) for name in names))),
    )
