"""Names of generalized coordinates `q` and generalized speeds `u`, the default speeds of coordinates, and the
physical parameters of a scene.

A plain coordinate `x` has the speed `x_rate = xdot`. A quaternion `attitude` has the three body components of
the angular velocity as speeds, `attitude_omega_x`, `..._y`, `..._z`, with
`d attitude/dt = 1/2 attitude (0, omega)`.

Names select entries of flat arrays; the message about an unknown name lists the valid and the nearest names.
Parameters are differentiable leaves, checked where their values are known.
"""

import difflib
import keyword
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import MISSING, dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Flag,
    PerCoordinate,
    Speeds,
    all_finite,
    as_real,
    check_kind,
    described,
    has_unit,
    known_numbers,
    real_type,
)
from jourdain_jax.calculus.rotations import quaternion_rate

Labels = tuple[str, ...]
Sentences = tuple[str, ...]  # messages to the user


class UnknownNameError(KeyError):
    """Raised for a name that does not exist; unlike KeyError, it prints its message without quotes."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return the end of an error message: the nearest valid name, if any is near, and all valid names."""
    valid = list(valid)
    match = difflib.get_close_matches(str(name), valid, n=1, cutoff=0.5)
    names = ", ".join(f"`{v}`" for v in valid) or "none"
    return f"did you mean `{match[0]}`? Valid names: {names}." if match else f"valid names: {names}."


def check_name(name: str, valid: Iterable[str], what: str, error: type[Exception] = ValueError) -> None:
    """Raise an error with the text `what` and the nearest valid name, unless the name is valid."""
    if name not in valid:
        raise error(f"{what}; {nearest(name, valid)}")


def check_names(
    names: Iterable[str], valid: Iterable[str], what: str, error: type[Exception] = ValueError
) -> None:
    """Check several names. `{}` in the text `what` is replaced by the invalid name."""
    for name in names:
        check_name(name, valid, what.replace("{}", str(name)), error)


def as_names(names: "str | Iterable[str]") -> Labels:
    """Return names as a tuple. In a text, names are separated by spaces, as in `jj.coordinates`."""
    if not isinstance(names, str | Iterable):
        raise ValueError(f"`{names}` was given, expected names, in one text or in several")
    return tuple(names.split() if isinstance(names, str) else names)


def as_labels(labels: "str | Iterable[str]") -> Labels:
    """Return names of another tool as a tuple. A text is one name, since such names may contain blanks."""
    return (labels,) if isinstance(labels, str) else as_names(labels)


class Named(eqx.Module):
    """A flat array with access by name to entries and groups of entries: `q.yaw`, `q["yaw"]`, `q.array`."""

    array: Float[Array, "*shape"]
    # name, first entry, length (0 for a scalar)
    slots: tuple[tuple[str, int, int], ...] = eqx.field(static=True)

    def __getitem__(self, name: str):
        for slot, first, length in self.slots:
            if slot == name:
                return self.array[..., first] if length == 0 else self.array[..., first : first + length]
        if not isinstance(name, str):
            raise TypeError(
                f"`{name}` was given, but entries are accessed by name; write `q.yaw` or `q['yaw']`, or "
                "`q.array[0]` for the first entry"
            )
        raise UnknownNameError(f"no entry `{name}`; {nearest(name, [slot for slot, _, _ in self.slots])}")

    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __contains__(self, name: str) -> bool:
        return name in self.keys()

    def keys(self) -> Labels:
        """Return the names, in order."""
        return tuple(slot for slot, _, _ in self.slots)


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

    def default_rates(self, q: PerCoordinate, u: Speeds) -> PerCoordinate:
        """Return `qdot` from the default speeds: `xdot = x_rate`,
        `d quaternion/dt = 1/2 quaternion (0, omega)`.
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


def _as_leaf(value):
    """Return a number or an array as a floating-point array. Any other value stays unchanged, and
    `check_parameters` rejects it with the field's name.
    """
    try:
        return as_real(value)
    except (TypeError, ValueError):
        return value


def parameter(
    default: Any = ..., *, unit: str = "", positive: bool = False, non_negative: bool = False, about: str = ""
) -> Any:
    """Declare a field of a scene as a physical parameter. It is converted to a floating-point array and is
    differentiable.

    - `default`: a number or an array; without it the parameter must be given. `unit` and `about` describe it.
    - `positive`, `non_negative`: required sign. A scene with a known value of another sign, or with numbers
      that are not finite, raises ValueError.
    """
    whole = np.ndim(default) == 0
    options = {"default": default} if whole else {"default_factory": lambda: default}
    metadata = {"parameter": True, "unit": unit, "about": about}
    metadata |= {"positive": positive, "non_negative": non_negative}
    return eqx.field(converter=_as_leaf, metadata=metadata, **({} if default is ... else options))


def parameters_of(scene) -> Iterator[tuple[str, Array, dict]]:
    """Yield name, value and metadata (unit, ...) of every parameter of a scene."""
    for name, field in scene.__dataclass_fields__.items():
        if field.metadata.get("parameter"):
            yield name, getattr(scene, name), dict(field.metadata)


def parameter_faults(scene) -> dict[str, Flag]:
    """Return for each parameter whether it is not finite or has the wrong sign. This works under jit and
    vmap, unlike `check_parameters`.
    """
    faults = {}
    for name, value, metadata in parameters_of(scene):
        right = jnp.isfinite(value)
        if metadata["positive"] or metadata["non_negative"]:
            right = right & (value > 0 if metadata["positive"] else value >= 0)
        faults[name] = ~jnp.all(right)
    return faults


def check_parameters(scene) -> None:
    """Raise ValueError for a parameter that is not finite or has the wrong sign. Traced values are not
    checked.
    """
    for name, value, metadata in parameters_of(scene):
        where = f"parameter `{name}` of `{type(scene).__name__}`"
        if has_unit(value) or not hasattr(value, "dtype"):
            raise ValueError(
                f"{where} is {described(value)}, expected a number{_in(metadata)} or an array of numbers"
            )
        if not jnp.issubdtype(value.dtype, jnp.floating):
            raise ValueError(
                f"{where} is of type {value.dtype}, expected real numbers{_in(metadata)}; check "
                "where it was computed"
            )
        numbers = known_numbers(value)
        if not all_finite(numbers):
            raise ValueError(f"{where} is {numbers}, expected finite numbers; check where it was computed")
        if metadata["positive"] and not np.all(numbers > 0):
            raise ValueError(
                f"{where} is {numbers}, expected a positive number{_in(metadata)}; give a value above zero"
            )
        if metadata["non_negative"] and not np.all(numbers >= 0):
            raise ValueError(
                f"{where} is {numbers}, expected a number >= 0{_in(metadata)}; give a value "
                "that is not negative"
            )


def stacked_parameters(scene) -> str:
    """Return an error message about parameters with one axis more than their defaults, as in a batch of
    scenes; empty if there are none.
    """
    shapes = {name: np.shape(value) for name, value, _ in parameters_of(scene)}
    usual = {name: np.shape(value) for name, value in _defaults(type(scene))}
    many = [
        f"`{name}` has the shape {shape}"
        for name, shape in shapes.items()
        if name in usual and shape[1:] == usual[name] != shape
    ]
    if not many:
        return ""
    return (
        f"`{type(scene).__name__}` cannot be evaluated: its {', '.join(many)}, one axis more than the "
        "default; for many scenes use `jax.vmap`, or `rollout` with `parameters={name: values}`"
    )


def _defaults(kind) -> Iterator[tuple[str, object]]:
    for name, field in kind.__dataclass_fields__.items():
        if field.metadata.get("parameter"):
            if field.default is not MISSING:
                yield name, field.default
            elif field.default_factory is not MISSING:
                yield name, field.default_factory()


def _in(metadata: dict) -> str:
    return f" in {metadata['unit']}" if metadata["unit"] else ""
