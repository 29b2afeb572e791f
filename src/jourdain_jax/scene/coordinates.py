"""Names of generalized coordinates `q` and generalized speeds `u`, and the default speeds of coordinates.

A plain coordinate `x` has the speed `x_rate = xdot`. A quaternion `attitude` has the three body components
of the angular velocity as speeds, `attitude_omega_x`, `..._y`, `..._z`, with `d attitude/dt = 1/2 attitude
(0, omega)`.
"""

import keyword
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Speeds, check_kind, described, real_type
from jourdain_jax.calculus.rotations import quaternion_rate
from jourdain_jax.scene.names import Labels, Named, check_name


@dataclass(frozen=True)
class Quaternion:
    """An attitude without singularity: four coordinates `(w, x, y, z)`, and three speeds, the body angular
    velocity (rad/s).
    """

    name: str


@dataclass(frozen=True)
class Names:
    """Names of the entries of a flat vector, and of groups of adjacent entries."""

    entries: Labels
    groups: tuple[tuple[str, int, int], ...] = ()  # name, first entry, length

    def view(self, array: Float[Array, "*shape"]) -> Named:
        """Return `array` with access by name."""
        return Named(array, tuple((name, i, 0) for i, name in enumerate(self.entries)) + self.groups)

    def index(self, name: str, kind: str) -> int:
        """Return the index of `name`. Raises ValueError, with the valid names, if it is unknown; `kind`: the
        kind of name, for the message.
        """
        check_name(name, self.entries, f"unknown {kind} `{name}`")
        return self.entries.index(name)

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __contains__(self, name: object) -> bool:
        return name in self.entries or any(name == group for group, _, _ in self.groups)


@dataclass(frozen=True)
class Coordinates:
    """The names of a scene's coordinates and of their default speeds."""

    names: Names
    default_speeds: Names
    quaternions: tuple[tuple[int, int], ...]  # first coordinate, first speed
    plain: tuple[tuple[int, int], ...]  # coordinate, speed

    def reference(self) -> Float[np.ndarray, "coordinates"]:
        """Return the reference configuration: zero, and the identity for every quaternion."""
        q = np.zeros(len(self.names), real_type())
        for first, _ in self.quaternions:
            q[first] = 1.0
        return q

    def default_rates(self, q: Float[Array, "coordinates"], u: Speeds) -> Float[Array, "coordinates"]:
        """Return `qdot` from the default speeds: `xdot = x_rate`, `d quaternion/dt = 1/2 quaternion (0,
        omega)`.
        """
        parts: list[tuple[int, Array]] = [(i, u[k : k + 1]) for i, k in self.plain]
        parts += [(i, quaternion_rate(q[i : i + 4], u[k : k + 3])) for i, k in self.quaternions]
        return (
            jnp.concatenate([part for _, part in sorted(parts, key=lambda p: p[0])])
            if parts
            else jnp.zeros(0)
        )


def quaternion(name: str) -> Quaternion:
    """Return a quaternion coordinate called `name`, for `coordinates(...)`: four coordinates `name_w`, ...,
    and three speeds `name_omega_x`, ...

    The speeds are the body components of the angular velocity (rad/s), `d name/dt = 1/2 name (0, omega)`.
    """
    check_kind(name, str, "the name of a quaternion", "a text, such as jj.quaternion('attitude')")
    return Quaternion(name)


def coordinates(*parts: str | Quaternion) -> Coordinates:
    """Return the names of a scene's coordinates from `parts`: strings of names separated by spaces, and
    quaternions, in order.

    Example: `coordinates("x y z", quaternion("attitude"))` has 7 coordinates and 6 default speeds: `x_rate`,
    ..., `attitude_omega_z`. Raises ValueError for a name that is not an identifier, is used twice or is
    reserved.
    """
    names: list[str] = []
    speeds: list[str] = []
    q_groups, u_groups, quaternions, plain = [], [], [], []
    for part in parts:
        if isinstance(part, Quaternion):
            quaternions.append((len(names), len(speeds)))
            q_groups.append((part.name, len(names), 4))
            u_groups.append((f"{part.name}_omega", len(speeds), 3))
            names += [f"{part.name}_{c}" for c in "wxyz"]
            speeds += [f"{part.name}_omega_{c}" for c in "xyz"]
            continue
        for name in _split(part, "coordinates"):
            plain.append((len(names), len(speeds)))
            names.append(name)
            speeds.append(f"{name}_rate")
    if not names:
        raise ValueError("`coordinates` was given no name; give at least one, such as jj.coordinates('x y')")
    _check_names(names, "coordinate")
    return Coordinates(
        Names(tuple(names), tuple(q_groups)),
        Names(tuple(speeds), tuple(u_groups)),
        tuple(quaternions),
        tuple(plain),
    )


def speeds(names: str) -> Names:
    """Return the names of user-defined generalized speeds (quasi-velocities, eqs. (53)-(56)) from `names`, a
    text separated by spaces.

    A scene with such speeds must define `coordinate_rates(t, q, u)`. Raises the same errors as `coordinates`.
    """
    return _named(names, "speed")


def inputs(names: str) -> Names:
    """Return the names of a scene's inputs, such as actuator torques, from `names`, a text separated by
    spaces. The scene defines their units. Raises the same errors as `coordinates`.
    """
    return _named(names, "input")


def _named(names, kind: str) -> Names:
    entries = _split(names, f"{kind}s")
    _check_names(entries, kind)
    return Names(tuple(entries))


def _split(names, what: str) -> list[str]:
    if not isinstance(names, str):
        raise ValueError(
            f"`{what}` was given {described(names)}, expected names in one text, separated by "
            f"spaces: jj.{what}('a b c')"
        )
    return names.split()


def _check_names(names: Sequence[str], kind: str) -> None:
    counts = Counter(names)
    for name in names:
        if not name.isidentifier():
            raise ValueError(
                f"{kind} name `{name}` is not an identifier; use letters, digits and underscores"
            )
        if keyword.iskeyword(name):
            raise ValueError(
                f"{kind} name `{name}` is a keyword of Python, so `q.{name}` cannot be written; "
                "choose another"
            )
        if counts[name] > 1:
            raise ValueError(f"{kind} name `{name}` is used twice; every {kind} needs its own name")
        if name == "t" and kind != "input":
            raise ValueError(f"{kind} name `t` is reserved for time (`motion.t`); choose another")
        if name in ("array", "slots", "keys"):
            raise ValueError(
                f"{kind} name `{name}` is reserved: `q.{name}` already has a meaning; choose another"
            )
