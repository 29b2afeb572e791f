"""Modes, and events after which the motion continues. A mode is an input that events switch; an event may
also make the state jump.

    at the time t_e when c(t, q, u) falls through zero:      (q, u) <- R(t, q, u),   mode <- its next value

Between events a mode is a constant number: the index of its value in the scene's list. Derivatives across
events are in `integrate/loop/transitions.py`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from jourdain_jax.calculus.reals import Parameter, Scalar, described, is_traced
from jourdain_jax.scene.coordinates import Labels, check_name, nearest


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


def modes(**values) -> Modes:
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
