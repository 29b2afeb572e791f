"""Declarations that friction adds to a scene: a mode, three events and a direction of slip per contact.

Which contacts have friction depends only on the structure of the scene, and is determined once for each
structure. Velocity constraints that hold until their force exceeds a limit count as contacts; "rolls" is then
called "holds". For a contact `rim` the scene gets

    mode `rim`                                     flies, rolls, slips, creeps
    events `rim normal`, `rim tangent`, `rim speed`
    coordinates `rim_slip_1`, `rim_slip_2`         the direction of slip, zero unless it slips

`equations/phases.py` has the mechanics.
"""

from dataclasses import dataclass, replace
from types import CodeType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.code import functions_in, names_in
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.scene.coordinates import Coordinates, Labels, Names
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.loads import held_rows
from jourdain_jax.scene.modes import Modes
from jourdain_jax.scene.motion_state import BodyMotion, Motion

FLIES, ROLLS, SLIPS, CREEPS = range(4)
# values of a mode that tell why a motion cannot continue
GAINS_ENERGY, PAINLEVE, UNDECIDED, FLAT = -1, -2, -3, -4
MODES_OF_CONTACT = ("flies", "rolls", "slips", "creeps")
MODES_OF_ROW = ("flies", "holds", "slips", "creeps")  # a constraint never flies
EVENTS_OF_CONTACT = ("normal", "tangent", "speed")


@dataclass(frozen=True)
class Switching:
    """The contacts with friction of a scene, and their declarations."""

    contacts: Labels = ()
    coordinates: Coordinates | None = None
    inputs: Names | None = None
    modes: Modes | None = None
    rows: Labels = ()  # the names of velocity constraints among `contacts`

    @property
    def events(self) -> Labels:
        """Names of the events, by contact."""
        return tuple(f"{name} {what}" for name in self.contacts for what in EVENTS_OF_CONTACT)


NONE_SWITCHES = Switching()


class Declared:
    """A class attribute that returns the class's own declarations; for a scene with friction it returns the
    extended ones.
    """

    def __init__(self, name: str, stated: Any):
        self.name, self.stated = name, stated

    def __get__(self, scene, kind):
        switching = NONE_SWITCHES if scene is None else scene.switching
        if switching.contacts:
            return getattr(switching, self.name)
        return self.stated.__get__(scene, kind) if hasattr(self.stated, "__get__") else self.stated


def has_friction(kind: type) -> bool:
    """Return whether methods of a class mention friction."""
    return any(
        word in _words(function.__code__)
        for method, word in (
            ("contacts", "friction"),
            ("velocity_constraints", "holds"),
            ("loads", "joint_friction"),
        )
        for owner in kind.__mro__
        for function in functions_in(vars(owner).get(method))
    )


def _words(code: CodeType) -> set[str]:
    found = set(names_in(code))
    for constant in code.co_consts:  # names of keyword arguments are among the constants
        if isinstance(constant, CodeType):
            found |= _words(constant)
        else:
            found |= set(constant) if isinstance(constant, tuple) else {constant}
    return found


@once_per_class
def switching_of(scene) -> Switching:
    """Return the contacts with friction of a scene, and their declarations."""
    leaves, structure = jax.tree.flatten(scene)
    names: dict[str, Labels] = {}

    def look(leaves) -> None:
        scene = jax.tree.unflatten(structure, leaves)
        names_of_state = scene.coordinates.names, scene.speed_names, scene.inputs
        t, at_rest = jnp.zeros(()), jnp.zeros(3)
        q, u, inputs = (of.view(jnp.zeros(len(of))) for of in names_of_state)
        bodies = {name: BodyMotion(name, body, at_rest, at_rest) for name, body in scene.bodies(t, q).items()}
        motion = Motion(t, q, u, q, inputs, bodies)
        contacts = scene.contacts(motion.pose())
        names.update({name: MODES_OF_CONTACT for name, c in contacts.items() if c.friction is not None})
        held = held_rows(scene.velocity_constraints(motion), scene.loads(motion))
        names.update(dict.fromkeys(held, MODES_OF_ROW))

    leaves = [jax.ShapeDtypeStruct(np.shape(x), real_type()) for x in leaves]
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
        Modes((*scene.modes.pairs, *names.items())),
        tuple(name for name, modes in names.items() if modes == MODES_OF_ROW),
    )
