"""The scene: its fields are physical parameters, its methods describe bodies, loads and constraints in plain
JAX.

Velocities, partial velocities, the mass matrix and the constraint Jacobian follow by automatic
differentiation.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Entries,
    PerCoordinate,
    Scalar,
    Speeds,
    array_module,
    checked_unless_traced,
    described,
    has_unit,
    known_numbers,
    real_type,
)
from jourdain_jax.scene.bodies import Body, Visual
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.coordinates import (
    Coordinates,
    Labels,
    Named,
    Names,
    check_parameters,
    nearest,
    parameters_of,
)
from jourdain_jax.scene.description import check_description, checked_arguments
from jourdain_jax.scene.loads import HeldRow, Load
from jourdain_jax.scene.modes import (
    NONE_SWITCHES,
    Declared,
    Event,
    Modes,
    Switching,
    has_friction,
    switching_of,
)
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.outside_names import NamesRead, is_function, names_read
from jourdain_jax.scene.printing import scene_html, scene_text


class Scene(eqx.Module):
    """Base class of all scenes. Subclass it and define `coordinates`, `bodies`, and whatever else the
    scene needs.

    Class attributes (or properties, where they depend on a static field such as a number of bodies)

    - `coordinates`: names, from `jj.coordinates(...)` (required).
    - `speeds`: names of user-defined quasi-velocities, from `jj.speeds(...)`; then also define
      `coordinate_rates`.
    - `inputs`: names of inputs, from `jj.inputs(...)`; `motion.inputs.name` in the methods.
    - `modes`: modes and their values, from `jj.modes(...)`: inputs that events switch; `motion.modes.name` in
      the methods.
    - `privileged`: names of the independent speeds; chosen by the engine if not given.
    - `domain`: coordinate or speed name -> (low, high), the range of states sampled for probing and tests;
      default (-3.2, 3.2) for coordinates, (-1, 1) for speeds.
    - `conventions`: one text on axes, signs and frames.
    - `example`: coordinate or speed name -> value, a typical start; `example_span`: its duration in s.

    As everywhere in JAX, methods are traced once, and values from outside the fields of the scene become
    constants. A method may itself read global names and variables of an enclosing function. If these hold
    numbers, texts, functions or tuples of them, the next call notices a change. If they hold arrays, lists,
    dictionaries or objects with state, the scene raises an error; make them parameters or static fields. The
    next call also notices a changed method, for example after `%autoreload`. Call `jj.clear_caches()` after
    changing anything else: values that helper functions read, attributes of modules and classes, or files.
    """

    coordinates: ClassVar[Coordinates]
    speeds: ClassVar[Names | None] = None
    inputs: ClassVar[Names] = Names(())
    modes: ClassVar[Modes] = Modes()
    privileged: ClassVar[Labels | None] = None
    domain: ClassVar[dict[str, tuple[float, float]]] = {}
    conventions: ClassVar[str] = "SI units, radians; right-handed inertial frame, z up."
    example: ClassVar[dict[str, float]] = {}
    example_span: ClassVar[float] = 5.0
    _may_switch: ClassVar[bool] = False  # whether the methods mention friction
    _read: NamesRead = eqx.field(init=False, repr=False)  # a change of these values makes a different scene
    switching: Switching = eqx.field(init=False, repr=False, static=True)  # contacts with friction

    def __init_subclass__(cls, **options):
        """Check the names that the methods read. Raises ValueError if a name refers to an
        object with state.
        """
        super().__init_subclass__(**options)
        if isinstance(cls.inputs, Names) and isinstance(cls.modes, Modes):
            modes = dict(cls.modes.pairs)
            cls.inputs = Names((*(name for name in cls.inputs.entries if name not in modes), *modes))
        cls._may_switch = has_friction(cls)
        if cls._may_switch:
            for name in ("coordinates", "inputs", "modes"):
                stated = inspect.getattr_static(cls, name)
                setattr(cls, name, stated if isinstance(stated, Declared) else Declared(name, stated))
        _names_read(cls)

    def __new__(cls, *args, **kwargs):
        """Check that the arguments are parameters of the scene, before any field is set."""
        checked_arguments(cls, kwargs)
        scene = super().__new__(cls)
        object.__setattr__(scene, "_read", _names_read(cls))  # `hold_leaves` adds the functions in fields
        object.__setattr__(scene, "switching", NONE_SWITCHES)
        return scene

    def __check_init__(self):
        if not isinstance(getattr(self, "coordinates", None), Coordinates):
            raise ValueError(
                f"scene `{type(self).__name__}` has no `coordinates`; state them as a class "
                "attribute: coordinates = jj.coordinates('x y ...')"
            )
        check_description(self, Scene)
        hold_leaves(self)
        check_parameters(self)
        if self._may_switch:
            object.__setattr__(self, "switching", switching_of(self))

    def bodies(self, t: Scalar, q: Named) -> Mapping[str, Body]:
        """Return the poses of all bodies by name, at time t (s) and coordinates q (`q.name`), in the inertial
        frame. Required.
        """
        raise NotImplementedError(f"scene `{type(self).__name__}` has no bodies; define `bodies(self, t, q)`")

    def coordinate_rates(self, t: Scalar, q: Named, u: Named) -> PerCoordinate:
        """Return `qdot = N(q,t) u + nu(q,t)`, affine in u. Default: each speed is the rate of its coordinate,
        or the body angular velocity of a quaternion.
        """
        return self.coordinates.default_rates(q.array, u.array)

    def loads(self, motion: Motion) -> tuple[Load, ...]:
        """Return the impressed forces at a `motion` (t, q, u, inputs, velocities)."""
        return ()

    def potential(self, pose: Pose) -> Scalar | None:
        """Return the potential energy (J) at a `pose`, in addition to the loads' potentials; None if there is
        none.
        """
        return None

    def gauge(self, pose: Pose) -> Scalar | None:
        """Return a function S (J s) of a `pose`, or None. Its rate is subtracted from the Lagrangian:
        `L = T - V - dS/dt`.

        S does not change the exact motion, but it changes the error of integrators with a discrete
        Lagrangian. Use it to measure this effect.
        """
        return None

    def prescribed(self, t: Scalar) -> Mapping[str, Scalar]:
        """Return prescribed coordinates at time t (s), name -> value. Each is a constraint, whose multiplier
        is the force of the actuator.
        """
        return {}

    def geometric_constraints(self, pose: Pose) -> Mapping[str, Array]:
        """Return geometric constraints g(q, t) = 0 at a `pose`, name -> scalar or vector; eq. (5)."""
        return {}

    def velocity_constraints(self, motion: Motion) -> Mapping[str, Array | HeldRow]:
        """Return velocity constraints phi(q, u, t) = 0 at a `motion`, name -> scalar or vector: linear,
        affine or nonlinear in u; (6)-(9).
        """
        return {}

    def contacts(self, pose: Pose) -> Mapping[str, Contact]:
        """Return the rolling contacts at a `pose`, by name. Each adds its no-slip constraints, and with
        `height="row"` its height constraint.
        """
        return {}

    def events(self, motion: Motion) -> Mapping[str, Scalar | Event]:
        """Return named events at a `motion`: values that are positive while the motion may continue. The
        motion stops where a value falls through zero; beyond that the value may be NaN. A value that starts
        at zero and rises is not an event. Return a `jj.Event` instead of a value to let the motion continue.

        If several events occur in one step, the first counts. A value may also fall through zero and rise
        again within one step. Such a dip is found if a relation in the value (`<`, `where`, `abs`, ...)
        changes. Default solvers also find it if the cubic through values and rates at the ends of the step
        becomes negative; other adaptive solvers, if the dense output is negative at one of three times.
        Otherwise a smooth dip of an event's value that is shorter than the longest step may be missed, and so
        may a condition such as `jnp.linalg.norm(x) < r` that holds only briefly. Use values that fall only
        once, or a smaller `max_step`.
        """
        return {}

    def invariants(self, motion: Motion) -> Mapping[str, Scalar]:
        """Return conserved quantities of a `motion` besides energy, by name, for checks and summaries."""
        return {}

    def visuals(self, pose: Pose) -> Mapping[str, Visual | Sequence[Visual]]:
        """Return shapes of bodies at a `pose`, by name, for pictures only. Shapes under the name `""` are
        fixed in the inertial frame. See `jj.Visual`.

        A body that is not listed is drawn from its `outline`, its contacts, or its inertia.
        """
        return {}

    @property
    def coordinate_names(self) -> Names:
        """Names of the coordinates q."""
        return self.coordinates.names

    @property
    def speed_names(self) -> Names:
        """Names of the speeds u."""
        return self.coordinates.default_speeds if self.speeds is None else self.speeds

    def __repr__(self) -> str:
        return scene_text(self)

    def _repr_html_(self) -> str:
        """Return HTML for notebooks: class, parameters with values and units, names of the variables."""
        return scene_html(self)

    def replace(self, **changes: Any) -> Self:
        """Return a copy of this scene with changed parameters. `changes`: name -> value in the
        parameter's unit.

        Raises ValueError for an inadmissible value or an unknown name; for the latter it suggests the
        nearest valid one.
        """
        names = [name for name, _, _ in parameters_of(self)]
        for name in changes:
            if name not in self.__dataclass_fields__:
                raise ValueError(
                    f"scene `{type(self).__name__}` has no parameter `{name}`; {nearest(name, names)}"
                )
        return replace(self, **changes)

    def named(self, **values: Any) -> tuple[PerCoordinate, Speeds, Labels]:
        """Return q and u with the named `values`, and the given names. Other entries have their reference
        value: zero, or the identity for quaternions.

        A quaternion or its angular velocity may be given as a whole, by its own name. If some parts of a
        quaternion are given, the others are zero. Raises ValueError for an unknown name, a wrong shape, or
        parts of a quaternion whose squares do not sum to one.
        """
        q, u, given = vectors_named(self, values)
        return jnp.asarray(q), jnp.asarray(u), given


def state_names(scene: Scene) -> Labels:
    """Return the names of all coordinates and speeds, in order."""
    return scene.coordinate_names.entries + scene.speed_names.entries


def vectors_named(
    scene: Scene, values: Mapping
) -> tuple[Float[Entries, "coordinates"], Float[Entries, "speeds"], Labels]:
    """Return the result of `Scene.named`, as NumPy arrays if all numbers are known."""
    q, u, given = entries_named(scene, values)
    return _vector(q), _vector(u), given


def entries_named(scene: Scene, values: Mapping) -> tuple[list, list, Labels]:
    """Return the result of `Scene.named`, with the entries of q and u as lists."""
    coordinates, speeds = scene.coordinate_names, scene.speed_names
    q, u = scene.coordinates.reference().tolist(), [0.0] * len(speeds)
    given: list[str] = []
    for name, value in values.items():
        hits = _put(coordinates, q, name, value) + _put(speeds, u, name, value)
        if not hits:
            raise ValueError(
                f"scene `{type(scene).__name__}` has no coordinate or speed `{name}`; "
                f"{nearest(name, state_names(scene))}"
            )
        given += hits
    for first, _ in scene.coordinates.quaternions:
        given += _completed(coordinates.entries[first : first + 4], q, first, given)
    return q, u, tuple(given)


def _completed(parts: Labels, q: list, first: int, given: list[str]) -> list[str]:
    """Set the omitted parts of a partly given quaternion to zero, and return their names."""
    named = [name for name in parts if name in given]
    if len(named) in (0, 4):
        return []
    q[first : first + 4] = [
        value if name in named else 0.0 for name, value in zip(parts, q[first : first + 4], strict=True)
    ]
    square = sum(value * value for value in q[first : first + 4])
    if np.any(abs(known_numbers(square) - 1) > 1e-4):  # users round the parts to a few digits
        group, told = parts[0].removesuffix("_w"), ", ".join(f"`{name}`" for name in named)
        raise ValueError(
            f"only {told} of the quaternion `{group}` is given, and the squares sum to {float(square):.4g}, "
            f"not 1; give all four parts, {group}=(w, x, y, z), or parts whose squares sum to 1"
        )
    return [name for name in parts if name not in named]


def _put(names: Names, entries: list, name: str, value) -> list[str]:
    """Store a value, or a vector of values, under `name`; return the names of its entries."""
    groups = [rest for group, *rest in names.groups if group == name]
    if not groups and name not in names.entries:
        return []
    if type(value) is not float:
        checked_unless_traced(value, f"`{name}`", advice="give its value")
    shape = () if type(value) is float else np.shape(value)
    if not groups:
        if shape != ():
            raise ValueError(
                f"`{name}` was given an array of shape {shape}, expected one number; use `jax.vmap` or "
                "`rollout` for many values"
            )
        entries[names.entries.index(name)] = value
        return [name]
    ((first, length),) = groups
    if shape != (length,):
        raise ValueError(f"`{name}` was given an array of shape {shape}, expected ({length},)")
    entries[first : first + length] = [value[i] for i in range(length)]
    return list(names.entries[first : first + length])


def _vector(entries: list) -> Float[Entries, "entries"]:
    if array_module(entries) is jnp:
        return jnp.stack([jnp.asarray(value, real_type()) for value in entries])
    # convert once, on NumPy: nothing to compile
    return np.array([value if type(value) is float else np.asarray(value) for value in entries], real_type())


def _names_read(kind: type[Scene], *functions: Callable) -> NamesRead:
    """Return the names read by the functions and by the methods of the scene's class and its bases
    below `Scene`.
    """
    return names_read(*(owner for owner in kind.__mro__ if owner not in Scene.__mro__), *functions)


class HeldFunction(eqx.Module):
    """A function that JAX treats as part of the structure of the scene, like a static field."""

    function: Callable[..., Any] = eqx.field(static=True)
    read: NamesRead

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self.read = names_read(*filter(is_function, (function,)))

    def __call__(self, *args, **kwargs):
        """Return the function's result."""
        return self.function(*args, **kwargs)


def hold_leaves(scene) -> None:
    """Make functions in the fields of a new scene static, at any depth, and convert floats to arrays.

    Raises ValueError for texts, which only a static field can hold.
    """

    def held(leaf):
        return HeldFunction(leaf) if callable(leaf) else jnp.asarray(leaf) if type(leaf) is float else leaf

    static = tuple(
        value
        for field in fields(scene)
        if field.metadata.get("static") and is_function(value := getattr(scene, field.name))
    )
    object.__setattr__(scene, "_read", _names_read(type(scene), *static))
    for field in fields(scene):
        if field.metadata.get("static") or field.metadata.get("parameter"):
            continue
        value = getattr(scene, field.name)
        leaves = jax.tree.leaves(value)
        text = next((leaf for leaf in leaves if isinstance(leaf, str) or has_unit(leaf)), None)
        if text is not None:
            raise ValueError(
                f"field `{field.name}` of `{type(scene).__name__}` holds {described(text)}, expected "
                f"numbers; give the number, or for a text write `{field.name}: str = eqx.field(static=True, "
                f"default={text!r})`"
            )
        if any(callable(leaf) or type(leaf) is float for leaf in leaves):
            object.__setattr__(scene, field.name, jax.tree.map(held, value))
