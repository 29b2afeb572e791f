"""Modes, and events after which the motion continues. A mode is an input that events switch; an event may
also make the state jump.

    at the time t_e when c(t, q, u) falls through zero:      (q, u) <- R(t, q, u),   mode <- its next value

Between events a mode is a constant number: the index of its value in the scene's list. Derivatives across
events are in `integrate/loop/transitions.py`.

Declarations that friction adds to a scene: a mode, three events and a direction of slip per contact.

Which contacts have friction depends only on the structure of the scene, and is determined once for each
structure. Velocity constraints that hold until their force exceeds a limit count as contacts; "rolls" is then
called "holds". For a contact `rim` the scene gets

    mode `rim`                                     flies, rolls, slips
    events `rim normal`, `rim tangent`, `rim law`
    coordinates `rim_slip_1`, `rim_slip_2`         its direction while it slips; else zero, or the speed
                                                   of its last rebound, and 0; during the last flight of
                                                   its bounces the time at which they end, and 1

and one input for all contacts, `slow_slip` (m/s): the speed below which a slip changes its direction as if it
had this speed. `equations/phases.py` has the mechanics.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import CodeType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.code import functions_in, names_in
from jourdain_jax.calculus.reals import Parameter, Scalar, described, is_traced, real_type
from jourdain_jax.scene.coordinates import Coordinates, Labels, Names, check_name, nearest
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.loads import held_rows
from jourdain_jax.scene.motion_state import BodyMotion, Motion


@dataclass(frozen=True)
class Modes:
    """Names of modes, and of the values of each mode."""

    pairs: tuple[tuple[str, Labels], ...] = ()

    @property
    def values(self) -> dict[str, Labels]:
        """Return a dictionary: mode -> names of its values."""
        return dict(self.pairs)

    @property
    def names(self) -> Labels:
        """Return the modes, in order."""
        return tuple(name for name, _ in self.pairs)

    def number(self, name: str, value, where: str):
        """Return the number of a mode's `value`, which is a name or a number. Raises ValueError for an
        unknown value. `where`: the origin of the value, for the message.
        """
        names = self.values[name]
        if isinstance(value, str):
            check_name(value, names, f"{where} gives mode `{name}` the value `{value}`")
            return float(names.index(value))
        if not is_traced(value) and not (np.shape(value) == () and float(value) in range(len(names))):
            raise ValueError(
                f"{where} gives mode `{name}` the value {described(value)}; "
                f"{nearest('', names)} Or give its number"
            )
        return value


def modes(**values: Any) -> Modes:
    """Declare modes: name -> names of its values. A motion starts with the first value.

    `motion.modes.name` is the number of the value: constant between events, and switched by
    `jj.Event(..., to={name: value})`. `inputs={name: value}` starts a motion with another value.

    **Examples**

        modes = jj.modes(gear=("first", "second"))

    **Raises** ValueError for fewer than two values, or values that are not texts.
    """
    for name, of_mode in values.items():
        texts = not isinstance(of_mode, str) and all(isinstance(value, str) for value in of_mode)
        if not texts or len(set(of_mode)) < 2:
            raise ValueError(
                f"mode `{name}` has the values {of_mode!r}, expected two names or more: "
                f"jj.modes({name}=('open', 'closed'))"
            )
    return Modes(tuple((name, tuple(of_mode)) for name, of_mode in values.items()))


@dataclass(frozen=True)
class Event:
    """An event after which the motion continues. `events` returns it in place of a plain value.

    - `value`: the event occurs where it falls through zero. A smooth dip of an event's value that is shorter
      than the longest step may be missed, and so may a condition such as `jnp.linalg.norm(x) < r` that holds
      only briefly. Use values that fall only once, or a smaller `max_step`.
    - `to`: mode -> name of its value afterwards.
    - `jump`: coordinate or speed -> its value afterwards; all others keep their values. The new state must
      satisfy the velocity constraints.
    - `stop`: whether the motion ends here, as at a plain value.

    **Examples**

        def events(self, motion):
            return {"floor": jj.Event(motion.q.z, jump={"z_rate": -self.bounce * motion.u.z_rate})}
    """

    value: Scalar
    to: Mapping[str, str | Parameter] = field(default_factory=dict)
    jump: Mapping[str, Parameter] = field(default_factory=dict)
    stop: bool = False


FLIES, ROLLS, SLIPS = map(float, range(3))
# values of a mode that tell why a motion cannot continue, in the order of the result codes
GAINS_ENERGY, PAINLEVE, UNDECIDED, FLAT, _, _, AMBIGUOUS = map(float, range(-1, -8, -1))
MODES_OF_CONTACT = ("flies", "rolls", "slips")
MODES_OF_ROW = ("flies", "holds", "slips")  # a constraint never flies
EVENTS_OF_CONTACT = ("normal", "tangent", "law")


@dataclass(frozen=True)
class Switching:
    """The contacts with friction of a scene, and their declarations."""

    contacts: Labels = ()
    coordinates: Coordinates | None = None
    inputs: Names | None = None
    modes: Modes | None = None
    rows: Labels = ()  # the names of velocity constraints among `contacts`
    phase: tuple[tuple[str, float], ...] = ()  # in place of `contacts`: those that keep these modes

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


def switched(scene, switching: Switching):
    """Return a scene with other declarations of its contacts with friction."""
    scene = jax.tree.unflatten(*jax.tree.flatten(scene)[::-1])
    object.__setattr__(scene, "switching", switching)
    return scene


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
        Names(("slow_slip", *scene.inputs.entries, *names), scene.inputs.groups),
        Modes((*scene.modes.pairs, *names.items())),
        tuple(name for name, modes in names.items() if modes == MODES_OF_ROW),
    )
