"""Inputs of a scene as functions of time: constants, callables by name, or samples with linear interpolation in between."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import as_real
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene


class Sampled(eqx.Module):
    """An input as `values` at given times `ts` (s, increasing), linear in between, constant beyond the ends."""

    ts: Float[Array, "samples"] = eqx.field(converter=as_real)  # s, increasing
    values: Float[Array, "samples"] = eqx.field(converter=as_real)

    def __call__(self, t):
        """Value at time t."""
        return jnp.interp(t, self.ts, self.values)


class Constant(eqx.Module):
    """One value at all times."""

    value: Float[Array, ""]

    def __call__(self, t):
        """The value."""
        return self.value


class Inputs(eqx.Module):
    """All inputs of a scene, in order; `inputs(t)` is their vector."""

    channels: tuple[Callable, ...]

    def __call__(self, t) -> Float[Array, "inputs"]:
        """The vector of inputs at time t."""
        return jnp.stack([jnp.asarray(channel(t), jnp.result_type(float)) for channel in self.channels]) if self.channels else jnp.zeros(0)


def as_inputs(scene: Scene, given) -> Inputs:
    """Inputs from a dictionary of name -> number, function of time or `Sampled`; what is not named is zero."""
    if isinstance(given, Inputs):
        return given
    given = {} if given is None else dict(given)
    for name in given:
        if name not in scene.inputs.entries:
            raise ValueError(f"`{type(scene).__name__}` has no input `{name}`; {nearest(name, scene.inputs.entries)}")
    channels = []
    for name in scene.inputs.entries:
        value = given.get(name, 0.0)
        channels.append(value if callable(value) else Constant(jnp.asarray(value, jnp.result_type(float))))
    return Inputs(tuple(channels))
