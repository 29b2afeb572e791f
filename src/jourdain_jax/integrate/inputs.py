"""Inputs of a scene as functions of time: constants, callables, or linearly interpolated samples.

Functions become programs (`time_programs.py`); steps end at the knots of samples (`input_knots.py`).
"""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.jumps import jumps
from jourdain_jax.calculus.markers import stopped
from jourdain_jax.calculus.reals import (
    as_real,
    checked_unless_traced,
    described,
    in_default_precision,
    is_traced,
    real_type,
)
from jourdain_jax.integrate.time_programs import FunctionOfTime, for_programs, traced
from jourdain_jax.program.analyticity import depend_on
from jourdain_jax.program.eager import uncompiled_lanes
from jourdain_jax.scene.arguments import ChangingInputs
from jourdain_jax.scene.names import check_names
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.spline import checked_samples
from jourdain_jax.structure.probes import looked_at
from jourdain_jax.structure.smoothness import SPEEDS_WOULD_JUMP
from jourdain_jax.structure.structure import structure_of


class Sampled(eqx.Module):
    """Input with `values` at given times `ts` (s, increasing): linear between them, constant before the first
    and after the last.

    Steps end at the sample times, so that no feature is missed, however short. Samples on a straight line
    between others are skipped; the tolerance is a tenth of `rtol` (at most 1e-5) of the range of values. A
    rough signal costs one step per sample. Other functions of time are evaluated only at the times of steps.
    """

    ts: Float[Array, "samples"] = eqx.field(converter=as_real)  # s, increasing
    values: Float[Array, "samples"] = eqx.field(converter=as_real)

    def __init__(self, ts, values):
        self.ts, self.values = in_default_precision(checked_samples("Sampled", ts, values, 1, "input"))

    def __call__(self, t):
        """Return the value at time t."""
        return jnp.interp(t, self.ts, self.values)


class Constant(eqx.Module):
    """Input with one value at all times."""

    value: Float[Array | np.ndarray, "*lanes"]

    def __call__(self, t):
        """Return the value."""
        return self.value


class Mode(eqx.Module):
    """Mode as an input: the index of its value at the start and after each transition."""

    value: Float[Array | np.ndarray, ""]
    ts: Float[Array, "transitions"] | None = None  # s, times `direction`; infinite after the last one
    values: Float[Array, "transitions"] | None = None
    direction: Float[Array, ""] | None = None  # 1, or -1 if time runs backwards

    def __call__(self, t):
        """Return the index of the value at time t; at a transition, that of the new value."""
        if self.ts is None or self.values is None:
            return self.value
        known = stopped((self.ts, t * self.direction))
        passed = jnp.searchsorted(*known, side="right", method="compare_all")
        return jnp.concatenate([jnp.asarray(self.value)[None], self.values])[passed]


class Inputs(eqx.Module):
    """All inputs of a scene, in order. `inputs(t)` returns their values as a vector."""

    channels: tuple[Callable, ...]

    def __call__(self, t) -> Float[Array | np.ndarray, "inputs"]:
        """Return the vector of inputs at time t."""
        if self.channels:
            return jnp.stack([jnp.asarray(channel(t), real_type()) for channel in self.channels])
        return np.zeros(0, real_type())

    @property
    def constant(self) -> bool:
        """Return whether all inputs are constant."""
        return all(isinstance(channel, Constant) for channel in self.channels)

    @property
    def programs(self) -> tuple:
        """Return the programs of the inputs that are functions of time."""
        return tuple(channel.program for channel in self.channels if isinstance(channel, FunctionOfTime))

    def near(self, t) -> ChangingInputs:
        """Return values and rates at time t. Raises ValueError if an input cannot be differentiated."""
        t = jnp.asarray(t, real_type())
        try:
            values, rates = jax.jvp(self, (t,), (jnp.ones_like(t),))
        except (ValueError, TypeError, NotImplementedError) as error:
            said = str(error).splitlines()[0]
            raise ValueError(
                "constraints depend on inputs and need their rates, but an input cannot be differentiated "
                f"({said}); pass that input as `jj.Sampled`"
            ) from None
        return ChangingInputs(t, values, rates)


def in_phases(
    inputs: Inputs,
    ts: Float[Array, "transitions"],
    modes: Float[Array | np.ndarray, "modes transitions"],
    direction,
) -> Inputs:
    """Return inputs whose modes change at the transitions `ts`; unused entries of `ts` are infinite."""
    if not len(modes):
        return inputs
    ts = jnp.where(jnp.isfinite(ts), ts * direction, jnp.inf)
    values = iter(jax.lax.stop_gradient(modes))
    phases = lambda channel: Mode(jnp.asarray(channel.value), ts, next(values), direction)
    return Inputs(
        tuple(phases(channel) if isinstance(channel, Mode) else channel for channel in inputs.channels)
    )


def inputs_at(inputs: Inputs, t) -> Float[Array | np.ndarray, "inputs"]:
    """Return the vector of inputs at time t. Concrete values are computed by NumPy or a compiled function."""
    if inputs.channels and is_traced(inputs, t):
        return inputs(t)
    if inputs.constant:
        return np.array([np.asarray(value) for value in jax.tree.leaves(inputs)], real_type())
    return _compiled_inputs(inputs.programs)(inputs, np.asarray(t, real_type()))


_compiled_inputs = for_programs(lambda inputs, t: inputs(t))


_NOTHING = object()
_ZERO = Constant(np.zeros(()))  # shared, because making a module takes some 20 us


def _as_channel(f: Callable, where: str) -> Callable:
    """Return a function of time as an input channel. Raises ValueError if `f` does not return one number."""
    advice = "pass a function of one time that returns one number, such as `lambda t: jnp.sin(t)`"
    try:
        channel, found = traced(f, real_type())
    except TypeError as error:
        raise ValueError(
            f"{where} cannot be called with a time ({str(error).splitlines()[0]}); {advice}"
        ) from None
    if not (hasattr(found, "shape") and hasattr(found, "dtype")):
        raise ValueError(f"{where} returned {described(found)}, expected one number; {advice}")
    if found.shape != ():
        raise ValueError(f"{where} returned an array of shape {found.shape}, expected one number; {advice}")
    if jnp.issubdtype(found.dtype, jnp.complexfloating):
        raise ValueError(f"{where} returned a number of type {found.dtype}, expected a real number; {advice}")
    leaves = jax.tree.leaves(f)
    plain = len(leaves) == 1 and leaves[0] is f  # keep a module, whose arrays may be differentiated
    return channel if plain and channel is not None else f


def as_inputs(scene: Scene, given) -> Inputs:
    """Return the inputs of a scene from a dictionary by name: numbers, functions of time or `Sampled`.
    Omitted inputs are zero.
    """
    if isinstance(given, Inputs):
        if len(given.channels) != len(scene.inputs):
            raise ValueError(
                f"`inputs` has {len(given.channels)} channels, but `{type(scene).__name__}` has "
                f"{len(scene.inputs)} inputs; pass them by name"
            )
        return given
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(
            f"`inputs` is {described(given)}, expected a dictionary of numbers, functions of time, or"
            " `jj.Sampled` by name"
        )
    if not given and not scene.modes.pairs:
        return Inputs((_ZERO,) * len(scene.inputs))
    given = given or {}
    check_names(given, scene.inputs.entries, f"`{type(scene).__name__}` has no input `{{}}`")
    channels: list[Callable] = []
    modes = dict(scene.modes.pairs)
    for name in scene.inputs.entries:
        value = given.get(name, _NOTHING)
        advice = "pass a number, a function of time, or `jj.Sampled(ts, values)`"
        where = f"input `{name}` of `{type(scene).__name__}`"
        if name in modes:
            channels.append(
                Mode(
                    np.asarray(
                        scene.modes.number(name, 0.0 if value is _NOTHING else value, "`inputs`"), real_type()
                    )
                )
            )
        elif isinstance(value, Sampled):  # checked on construction
            channels.append(value)
        elif callable(value):
            channels.append(_as_channel(value, where))
        else:
            channels.append(
                _ZERO
                if value is _NOTHING
                else Constant(checked_unless_traced(value, where, (), advice=advice))
            )
    return Inputs(tuple(channels))


def check_inputs_in_rows(scene: Scene, inputs: Inputs, t0, t1) -> None:
    """Raise ValueError if velocity constraints depend on a mode, or on an input that jumps in the span."""
    traced = looked_at(scene).traced
    for name, node in zip(scene.inputs.entries, traced.inputs.tolist(), strict=True):
        if name in dict(scene.modes.pairs) and any(depend_on(traced.graph, traced.at.phi.tolist(), [node])):
            raise ValueError(
                f"constraints of `{type(scene).__name__}` depend on mode `{name}`; only "
                "loads and potentials may depend on modes"
            )
    if not structure_of(scene).rows_of_inputs or is_traced(scene, inputs, t0, t1):
        return
    for name, node, channel in zip(
        scene.inputs.entries, traced.inputs.tolist(), inputs.channels, strict=True
    ):
        if isinstance(channel, Constant | Sampled) or not any(
            depend_on(traced.graph, traced.at.phi.tolist(), [node])
        ):
            continue
        with jax.ensure_compile_time_eval():  # all values are concrete, also inside a `jit`
            values, ts = uncompiled_lanes(channel), np.linspace(float(t0), float(t1), 257)[:, None]
            for _, _, behind in jumps(
                lambda t, values=values: np.asarray(values(t[:, 0]), float)[:, None], ts[:-1], ts[1:]
            ):
                raise ValueError(
                    f"input `{name}` of `{type(scene).__name__}` jumps at t = {behind[0]:.6g} s, but velocity"
                    f" constraints depend on it: {SPEEDS_WOULD_JUMP}"
                )
