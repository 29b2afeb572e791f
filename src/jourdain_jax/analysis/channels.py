"""Channels that are functions of a `Motion`: every fit traces them anew, and two are equal that compute the same.

A function is traced where it is handed over. What it closes over becomes arguments, what is left, the operations, is compared by value: a new lambda that
does the same in every run is one channel, batched and compiled once; a function whose globals have changed is another one.
"""

from collections.abc import Callable
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr
from jaxtyping import Array

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.program.calls import Call
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.names_read import is_function, now_read_by
from jourdain_jax.scene.scene import Scene

MOST = 256  # functions whose trace is kept


class Channel(eqx.Module):
    """A function of a motion as it was when it was given."""

    operations: Call = eqx.field(static=True)  # on what it closes over and the numbers of a motion
    held: tuple[Array, ...]  # what it closes over
    shape: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, motion: Motion) -> Array:
        """The value of the channel at one instant."""
        return self.operations.results(*self.held, *jax.tree.leaves(motion))[0]


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
    jaxpr = closed.jaxpr
    operations = ClosedJaxpr(jaxpr.replace(constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars]), [])
    return Channel(Call(operations, ("a channel",)), tuple(jnp.asarray(x) for x in closed.consts), shape.shape)


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
