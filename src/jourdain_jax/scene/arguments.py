"""What is handed to a public function besides the scene's description: the scene itself, vectors of q and u, inputs. Checked by name.

Kinds and shapes are known while a function is traced: no compiled program contains these checks.
"""

from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.guards import DifferentiationModeError
from jourdain_jax.calculus.reals import at_once, checked_real, checked_unless_traced, described, is_traced, real_type
from jourdain_jax.scene.coordinates import Names
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene

F = TypeVar("F", bound=Callable)


class BuiltFor:
    """A scene with its choices (`motion/model.py: Model`); functions that call `as_scene` take it in place of the scene."""

    scene: Scene
    formulation: Any
    backend: str
    reference: Any

    def __getattr__(self, name: str):
        raise AttributeError(f"`{type(self).__name__}` has no `{name}`; where a scene is asked for, pass its `.scene`")


def as_scene(scene) -> Scene:
    """The scene itself; a ValueError where it is none, or the class and not one of its instances."""
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, BuiltFor):
        return scene.scene
    if isinstance(scene, type) and issubclass(scene, Scene):
        raise ValueError(f"`scene` is the class `{scene.__name__}`, expected a scene of it; write `{scene.__name__}()`, with parameters in the parentheses")
    raise ValueError(f"`scene` is {described(scene)}, expected a scene: an instance of a subclass of `jj.Scene`")


def of_known_numbers(function: F) -> F:
    """The function of a scene, or of a motion, and more, run on numbers also inside `jit`, `vmap` and derivatives.

    A DifferentiationModeError that names it where one is traced.
    """

    @wraps(function)
    def called(known, *args, **kwargs):
        known = known.scene if isinstance(known, BuiltFor) else known
        if is_traced(known, args, kwargs):
            raise DifferentiationModeError(
                f"`{function.__name__}` was called inside jit, vmap or a derivative, with numbers that are not known there; call it outside of them"
            )
        with at_once():
            return function(known, *args, **kwargs)

    return called  # type: ignore[return-value]


def as_time(t) -> Float[Array, ""]:
    """A time in s, as a number of the default floating-point type."""
    return checked_real(t, "`t`", (), advice="give one time in s; use `jax.vmap` for many").astype(real_type())


def one_time(t, name: str = "t"):
    """A time on NumPy, unless it is traced; None stays. A ValueError that names it where it is no number."""
    return None if t is None else checked_unless_traced(t, f"`{name}`", (), advice="give one time in s; use `jax.vmap` for many")


def as_coordinates(scene: Scene, q) -> Float[Array, "coordinates"]:
    """q as a vector of the scene's coordinates."""
    return _as_vector(scene, "q", q, as_scene(scene).coordinate_names)


def as_speeds(scene: Scene, u, what: str = "u") -> Float[Array, "speeds"]:
    """u (or another vector over the speeds, named by `what`) as a vector of the scene's speeds."""
    return _as_vector(scene, what, u, as_scene(scene).speed_names)


def _as_vector(scene: Scene, what: str, x, names: Names) -> Array:
    if isinstance(x, jax.Array) and x.shape == (len(names),) and x.dtype == real_type() and not x.weak_type:
        return x  # as it should be, in a twentieth of the time of what follows
    listed = ", ".join(names.entries)
    if isinstance(x, Mapping):
        raise ValueError(f"`{what}` of `{type(scene).__name__}` is a dictionary, expected a vector of {listed}; `jj.start(scene, **values)` makes one by name")
    advice = f"one number for each of {listed}; use `jax.vmap` or `rollout` for many states"
    return checked_real(x, f"`{what}` of `{type(scene).__name__}`", (len(names),), advice=advice).astype(real_type())


class ChangingInputs(eqx.Module):
    """Inputs near one time: where rows depend on them, accelerations depend on their rates."""

    t: Float[Array, ""]  # s
    values: Float[Array, "inputs"]
    rates: Float[Array, "inputs"]  # per s

    def __call__(self, t) -> Float[Array, "inputs"]:
        """The values near that time."""
        return self.values + self.rates * (t - self.t)


def as_input_vector(scene: Scene, inputs, dtype=None) -> Float[Array, "inputs"]:
    """Values of the scene's inputs at one instant: from a vector, a dictionary (what is not named is zero), or None for all zero."""
    names = scene.inputs.entries
    if inputs is None:
        return jnp.zeros(len(names), dtype)
    if not isinstance(inputs, Mapping):
        listed = ", ".join(names) or "none: the scene has no inputs"
        return checked_real(inputs, f"`inputs` of `{type(scene).__name__}`", (len(names),), advice=f"one number for each of {listed}")
    for name in inputs:
        if name not in names:
            raise ValueError(f"`{type(scene).__name__}` has no input `{name}`; {nearest(name, names)}")
    advice = "a function of time is for `simulate`; here give its value at this instant"
    values = [checked_real(inputs.get(name, 0.0), f"input `{name}` of `{type(scene).__name__}`", (), advice=advice) for name in names]
    return jnp.stack(values) if values else jnp.zeros(0, dtype)
