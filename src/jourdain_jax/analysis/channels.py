"""Channels that are functions of a `Motion`: every fit traces them anew, and two are equal that compute the same.

A function is traced where it is handed over. What it closes over becomes arguments, what is left, the operations, is compared by value: a new lambda that
does the same in every run is one channel, batched and compiled once; a function whose globals have changed is another one.
"""

from collections.abc import Callable
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.program.calls import description
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.names_read import is_function, now_read_by
from jourdain_jax.scene.scene import Scene

MOST = 256  # functions whose trace is kept


class Operations:
    """What a function does with the numbers of a motion and with those it closes over; equal to any other that does the same."""

    def __init__(self, closed: ClosedJaxpr):
        jaxpr = closed.jaxpr
        self._closed = ClosedJaxpr(jaxpr.replace(constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars]), [])
        self._key = description(self._closed)
        self._hash = hash(self._key)

    def __call__(self, held, numbers):
        """The value of the channel."""
        return jaxpr_as_fun(self._closed)(*held, *numbers)[0]

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (isinstance(other, Operations) and self._key == other._key)


class Channel(eqx.Module):
    """A function of a motion as it was when it was given."""

    operations: Operations = eqx.field(static=True)
    held: tuple[Array, ...]  # what it closes over
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, motion: Motion) -> Array:
        """The value of the channel at one instant."""
        return self.operations(self.held, jax.tree.leaves(motion))


def channel(function: Callable, scene: Scene) -> Channel:
    """A function of a motion of this scene as a channel; it is traced again where it is new, or what it reads has changed."""
    now = now_read_by(function) if is_function(function) else None
    if now is None:
        return _traced(function, scene)
    kept, key = _kept(function), (now, _kind(scene))
    if kept.get("key") == key:
        return kept["channel"]
    found = _traced(function, scene)
    if not is_traced(found.held):
        kept["key"], kept["channel"] = key, found
    return found


@lru_cache(maxsize=MOST)
def _kept(function: Callable) -> dict:
    return {}


def _traced(function: Callable, scene: Scene) -> Channel:
    try:
        closed, shape = jax.make_jaxpr(lambda motion: function(motion), return_shape=True)(motion_shape(scene))
    except TypeError as error:
        advice = "write it with `jax.numpy`, without `if` of numbers of the motion, and return one array of numbers"
        raise ValueError(f"a function of `sensors` cannot be called with a motion ({str(error).splitlines()[0]}); {advice}") from error
    if not hasattr(shape, "shape"):
        raise ValueError(f"a function of `sensors` returned {type(shape).__name__}, expected an array of numbers; return one array")
    return Channel(_one_of_equals(Operations(closed)), tuple(jnp.asarray(x) for x in closed.consts), shape.shape)


@lru_cache(maxsize=MOST)
def _one_of_equals(operations: Operations) -> Operations:
    return operations


def motion_shape(scene: Scene) -> Motion:
    """A motion of this scene with shapes in place of numbers."""
    return _motion_shape(*_kind(scene))


def _kind(scene: Scene):
    leaves, treedef = jax.tree.flatten(scene)
    return treedef, tuple((x.shape, x.dtype) for x in leaves)


@lru_cache(maxsize=64)
def _motion_shape(treedef, shapes) -> Motion:
    scene = jax.tree.unflatten(treedef, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes])
    q, u = (jax.ShapeDtypeStruct((len(names.entries),), jnp.result_type(float)) for names in (scene.coordinate_names, scene.speed_names))
    return jax.eval_shape(lambda scene, q, u: motion_at(scene, 0.0, q, u), scene, q, u)
