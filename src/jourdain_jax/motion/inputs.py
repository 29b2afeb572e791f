"""Inputs of a scene as functions of time: constants, callables by name, or samples with linear interpolation in between."""

from collections.abc import Callable, Mapping
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import as_real, checked_real, checked_unless_traced, described, is_traced, real_type
from jourdain_jax.motion.input_programs import FunctionOfTime, for_programs, traced
from jourdain_jax.scene.arguments import ChangingInputs
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene


class Sampled(eqx.Module):
    """An input as `values` at given times `ts` (s, increasing), linear in between, constant beyond the ends.

    Steps end at its knots, so that no feature is passed over, however short: a blow of 1 ms in a motion of 10 s is felt at any tolerance. Knots at which the
    values are on a straight line, to within a tenth of `rtol` (at most 1e-5) of their range, do not count. Samples of something rough cost a step each.
    Functions of time are seen at the times of steps only, also those that interpolate themselves.
    """

    ts: Float[Array, "samples"] = eqx.field(converter=as_real)  # s, increasing
    values: Float[Array, "samples"] = eqx.field(converter=as_real)

    def __init__(self, ts, values):
        self.ts = checked_real(ts, "`ts` of `Sampled`", advice="give times in s").astype(real_type())
        self.values = checked_real(values, "`values` of `Sampled`", advice="give one number per time").astype(real_type())
        if self.ts.ndim != 1 or self.ts.shape[0] == 0 or self.values.shape != self.ts.shape:
            raise ValueError(
                f"`Sampled` was given times of shape {self.ts.shape} and values of shape {self.values.shape}, expected two vectors of one length; "
                "give one value per time, and one `Sampled` per input"
            )
        if not is_traced(self.ts) and not (np.all(np.isfinite(self.ts)) and np.all(np.diff(np.asarray(self.ts)) > 0)):
            raise ValueError("the times of `Sampled` must be finite and increase from one to the next; sort the samples by time and merge repeated ones")
        if not is_traced(self.values) and not np.all(np.isfinite(self.values)):
            first = int(np.argmin(np.isfinite(self.values)))
            raise ValueError(f"value {first} of `Sampled` is {float(self.values[first])}, expected finite numbers; leave samples out that were not measured")

    def __call__(self, t):
        """Value at time t."""
        return jnp.interp(t, self.ts, self.values)


class Constant(eqx.Module):
    """One value at all times."""

    value: Float[Array | np.ndarray, ""]

    def __call__(self, t):
        """The value."""
        return self.value


class Inputs(eqx.Module):
    """All inputs of a scene, in order; `inputs(t)` is their vector."""

    channels: tuple[Callable, ...]

    def __call__(self, t) -> Float[Array, "inputs"]:
        """The vector of inputs at time t."""
        return jnp.stack([jnp.asarray(channel(t), real_type()) for channel in self.channels]) if self.channels else jnp.zeros(0)

    @property
    def constant(self) -> bool:
        """Whether all are numbers."""
        return all(isinstance(channel, Constant) for channel in self.channels)

    @property
    def programs(self) -> tuple:
        """What is done with time, of the channels that are functions."""
        return tuple(channel.program for channel in self.channels if isinstance(channel, FunctionOfTime))

    def near(self, t) -> ChangingInputs:
        """Values and rates at time t; a ValueError for functions that JAX cannot differentiate."""
        t = jnp.asarray(t, real_type())
        try:
            values, rates = jax.jvp(self, (t,), (jnp.ones_like(t),))
        except (ValueError, TypeError, NotImplementedError) as error:
            said = str(error).splitlines()[0]
            raise ValueError(
                f"rows depend on inputs, whose rates the accelerations need, but one of them cannot be differentiated ({said}); give it as `jj.Sampled`"
            ) from None
        return ChangingInputs(t, values, rates)


def inputs_at(inputs: Inputs, t) -> Float[Array | np.ndarray, "inputs"]:
    """The vector of inputs at time t; on NumPy or compiled where all is known, instead of one operation after another."""
    if not inputs.channels or (inputs.constant and not is_traced(inputs)):
        return np.array([np.asarray(value) for value in jax.tree.leaves(inputs)], real_type())
    return inputs(t) if is_traced(inputs, t) else _compiled_inputs(inputs.programs)(inputs, np.asarray(t, real_type()))


_compiled_inputs = for_programs(lambda inputs, t: inputs(t))


_NOTHING = object()
_ZERO = Constant(np.zeros(()))  # made once: a module takes some 20 us


@lru_cache(maxsize=64)
def _at_rest(count: int) -> Inputs:
    """So many inputs that are zero."""
    return Inputs((_ZERO,) * count)


def _as_channel(f: Callable, where: str) -> Callable:
    """A function of time as a channel, or a ValueError unless `f` of one time is one number; nothing is computed."""
    advice = "give a function of one time that returns one number, such as `lambda t: jnp.sin(t)`"
    try:
        channel, found = traced(f, real_type())
    except TypeError as error:
        raise ValueError(f"{where} cannot be called with a time ({str(error).splitlines()[0]}); {advice}") from None
    if not (hasattr(found, "shape") and hasattr(found, "dtype")):
        raise ValueError(f"{where} returned {described(found)}, expected one number; {advice}")
    if found.shape != ():
        raise ValueError(f"{where} returned an array of shape {found.shape}, expected one number; {advice}")
    if jnp.issubdtype(found.dtype, jnp.complexfloating):
        raise ValueError(f"{where} returned a number of type {found.dtype}, expected a real number; {advice}")
    leaves = jax.tree.leaves(f)
    plain = len(leaves) == 1 and leaves[0] is f  # a module may hold arrays to be differentiated, and is kept as it is
    return channel if plain and channel is not None else f


def as_inputs(scene: Scene, given) -> Inputs:
    """Inputs from a dictionary of name -> number, function of time or `Sampled`; what is not named is zero."""
    if isinstance(given, Inputs):
        if len(given.channels) != len(scene.inputs):
            raise ValueError(f"`inputs` has {len(given.channels)} channels, but `{type(scene).__name__}` has {len(scene.inputs)} inputs; give them by name")
        return given
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(f"`inputs` is {described(given)}, expected a dictionary: name -> number, function of time, or `jj.Sampled`")
    if not given:
        return _at_rest(len(scene.inputs))
    for name in given:
        if name not in scene.inputs.entries:
            raise ValueError(f"`{type(scene).__name__}` has no input `{name}`; {nearest(name, scene.inputs.entries)}")
    channels: list[Callable] = []
    for name in scene.inputs.entries:
        value = given.get(name, _NOTHING)
        advice = "give a number, a function of time, or `jj.Sampled(ts, values)`"
        where = f"input `{name}` of `{type(scene).__name__}`"
        if isinstance(value, Sampled):  # its own numbers are checked where it is made
            channels.append(value)
        elif callable(value):
            channels.append(_as_channel(value, where))
        else:
            channels.append(_ZERO if value is _NOTHING else Constant(checked_unless_traced(value, where, (), advice=advice)))
    return Inputs(tuple(channels))
