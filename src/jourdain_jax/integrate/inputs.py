"""Inputs of a scene as functions of time: constants, callables, or linearly interpolated samples.

Steps end at the knots of samples (`input_knots.py`). Functions of time become programs, which consist of
operations, plain numbers and captured values.

A function of time is traced in each call that receives it. Captured values (arrays, traced numbers) and plain
numbers in sums, products, quotients and comparisons become arguments of a program and have derivatives. The
remaining operations identify the program. A new function with the same operations but other numbers therefore
needs no compilation; a function whose globals have changed is a new program.
"""

from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, Primitive, Var, jaxpr_as_fun
from jaxtyping import Array, Float, PyTree

from jourdain_jax.calculus.compilation import compiled
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
from jourdain_jax.program.calls import description
from jourdain_jax.program.eager import uncompiled_lanes
from jourdain_jax.program.evaluate import depend_on
from jourdain_jax.scene.arguments import ChangingInputs
from jourdain_jax.scene.coordinates import check_names
from jourdain_jax.scene.outside_names import now_read_by
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.spline import checked_samples
from jourdain_jax.structure.probes import looked_at
from jourdain_jax.structure.smoothness import SPEEDS_WOULD_JUMP
from jourdain_jax.structure.structure import structure_of

_TAKE_NUMBERS = ("add", "sub", "mul", "div", "lt", "le", "gt", "ge")  # differentiable in nonzero numbers


class TimeProgram:
    """Operations of a function of time, without its numbers. Programs are equal if their operations are."""

    def __init__(self, closed: ClosedJaxpr, real):
        taken: list[tuple[Var, Literal]] = []

        def lifted(atoms):
            return [
                lift(x) if isinstance(x, Literal) and x.aval.shape == () and x.aval.dtype == real else x
                for x in atoms
            ]

        def lift(number: Literal) -> Var:
            taken.append((Var(number.aval), number))
            return taken[-1][0]

        jaxpr = closed.jaxpr
        equations = [
            e.replace(invars=lifted(e.invars)) if e.primitive.name in _TAKE_NUMBERS else e for e in jaxpr.eqns
        ]
        outputs = lifted(jaxpr.outvars)
        arguments = [*(v for v, _ in taken), *jaxpr.constvars, *jaxpr.invars]
        self.numbers = np.array([number.val for _, number in taken], real)  # not part of comparisons
        self.closed = ClosedJaxpr(
            jaxpr.replace(constvars=[], invars=arguments, eqns=equations, outvars=outputs), []
        )
        self._key = description(self.closed)
        self._hash = hash(self._key)

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of the arguments other than time: plain numbers, then captured values."""
        return [x.shape for x in self.closed.in_avals[:-1]]

    def __call__(self, numbers, held, t):
        """Return the value at time t. `numbers`: the plain numbers; `held`: the captured values."""
        given = zip((*numbers, *held, t), self.closed.in_avals, strict=True)
        return jaxpr_as_fun(self.closed)(*(jnp.asarray(x, like.dtype) for x, like in given))[0]

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (isinstance(other, TimeProgram) and self._key == other._key)

    def does_the_same_as(self, other: "TimeProgram") -> bool:
        """Return whether both programs have the same operations, ignoring custom derivative rules."""
        return self._key == other._key or _without_rules(self._key) == _without_rules(other._key)


def _without_rules(described):
    """Return a description of operations without custom derivative rules."""
    if not isinstance(described, tuple):
        return described
    if (
        len(described) == 4
        and isinstance(described[0], Primitive)
        and described[0].name.startswith("custom_")
    ):
        primitive, inputs, parameters, outputs = described
        kept = tuple(
            (name, _without_rules(value))
            for name, value in parameters
            if isinstance(value, tuple | str | int | None)
        )
        return primitive, inputs, kept, outputs
    return tuple(map(_without_rules, described))


class FunctionOfTime(eqx.Module):
    """Input as a function of time: its operations, plain numbers, and captured arrays."""

    program: TimeProgram = eqx.field(static=True)
    numbers: Float[Array, "*lanes numbers"]
    held: tuple

    def __call__(self, t):
        """Return the value at time t."""
        return self.program(self.numbers, self.held, t)


def traced(function: Callable, real) -> tuple[FunctionOfTime | None, object]:
    """Return a `FunctionOfTime` (None unless its value is one number), and the shape of its value.

    A function is traced if it is new, or if a value that it reads has changed (`scene/identity.py`).
    """
    try:
        kept = _trace(function)
    except TypeError:  # not hashable
        kept = _Trace()
    now = (now_read_by(function), real) if kept.again else (None,)
    if now[0] is not None and kept.now == now:
        return kept.found
    closed, shape = jax.make_jaxpr(lambda t: function(t), return_shape=True)(jax.ShapeDtypeStruct((), real))
    found = None
    if getattr(shape, "shape", None) == ():
        program = TimeProgram(closed, real)
        if kept.program is None or not kept.program.does_the_same_as(program):
            kept.program = program
        found = FunctionOfTime(
            kept.program, jnp.asarray(program.numbers), tuple(jnp.asarray(x) for x in closed.consts)
        )
    if kept.again and found is not None and not is_traced(found):
        kept.now, kept.found = now, (found, shape)
    kept.again = True
    return found, shape


class _Trace:
    """Last trace of a function, and the values that it read then."""

    def __init__(self) -> None:
        self.again = False
        self.now: Hashable = None
        self.found: tuple[FunctionOfTime | None, object] = (None, None)
        self.program: TimeProgram | None = None


@lru_cache(maxsize=64)
def _trace(function: Callable) -> _Trace:
    return _Trace()


def for_programs(f: Callable, options: Callable | None = None) -> Callable[[Hashable], Callable]:
    """Return a function that compiles `f` for given input programs. The 16 most recently used are kept."""
    return lru_cache(maxsize=16)(lambda programs: compiled(f, options))


class Sampled(eqx.Module):
    """Input with `values` at given times `ts` (s, increasing): linear between them, constant before the first
    and after the last.

    Steps end at the sample times, so that no feature is missed, however short. Samples on a straight line
    between others are skipped; the tolerance is a tenth of `rtol` (at most 1e-5) of the range of values. A
    rough signal costs one step per sample. Other functions of time are evaluated only at the times of steps.
    """

    ts: Float[Array, "samples"] = eqx.field(converter=as_real)  # s, increasing
    values: Float[Array, "samples"] = eqx.field(converter=as_real)

    def __init__(self, ts: Any, values: Any):
        self.ts, self.values = in_default_precision(checked_samples("Sampled", ts, values, 1, "input"))

    def __call__(self, t):
        """Return the value at time t."""
        return jnp.interp(t, self.ts, self.values)


def samples_in(tree: PyTree) -> list[Sampled]:
    """Return all `Sampled` in a tree."""
    found = jax.tree.leaves(tree, is_leaf=lambda x: isinstance(x, Sampled))
    return [x for x in found if isinstance(x, Sampled)]


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
    direction: Float[Array, ""] | None = None  # 1, or -1 if time runs backward

    def __call__(self, t):
        """Return the index of the value at time t; at a transition, that of the new value."""
        if self.ts is None or self.values is None:
            return self.value
        known = stopped((self.ts, t * self.direction))
        passed = jnp.searchsorted(*known, side="right")
        return jnp.where(passed > 0, self.values[passed - 1], self.value)


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


_ZERO = Constant(np.zeros(()))  # shared, because making a module takes some 20 us


def _as_channel(f: Callable, where: str) -> Callable:
    """Return a function of time as an input channel. Raises ValueError if `f` does not return one number."""
    advice = "pass a function of one time that returns one number, such as `lambda t: jnp.sin(t)`"
    try:
        channel, found = traced(f, real_type())
    except (TypeError, AttributeError) as error:
        raise ValueError(
            f"{where} cannot be called with a time ({str(error).splitlines()[0]}); {advice}. A controller "
            "that reads the state is a load: compute its force from `motion.q` and `motion.u` in `loads`"
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
    given = given or {}
    check_names(given, scene.inputs.entries, f"`{type(scene).__name__}` has no input `{{}}`")
    channels: list[Callable] = []
    modes = dict(scene.modes.pairs)
    for name in scene.inputs.entries:
        value = given.get(name, 0.0)
        advice = "pass a number, a function of time, or `jj.Sampled(ts, values)`"
        where = f"input `{name}` of `{type(scene).__name__}`"
        if name in modes:
            channels.append(Mode(np.asarray(scene.modes.number(name, value, "`inputs`"), real_type())))
        elif name not in given:
            channels.append(_ZERO)
        elif isinstance(value, Sampled):  # checked on construction
            channels.append(value)
        elif callable(value):
            channels.append(_as_channel(value, where))
        else:
            channels.append(Constant(checked_unless_traced(value, where, (), advice=advice)))
    return Inputs(tuple(channels))


def check_inputs_in_rows(scene: Scene, inputs: Inputs, t0, t1) -> None:
    """Raise ValueError if velocity constraints depend on a mode, or on an input that jumps in the span."""
    known = structure_of(scene).rows_of_inputs and not is_traced(scene, inputs, t0, t1)
    traced, modes = looked_at(scene).traced, dict(scene.modes.pairs)
    each = zip(scene.inputs.entries, traced.inputs.tolist(), inputs.channels, strict=True)
    for name, node, channel in each:
        changes = known and not isinstance(channel, Constant | Sampled)
        if not (name in modes or changes) or not any(depend_on(traced.graph, traced.at.phi.tolist(), [node])):
            continue
        if name in modes:
            raise ValueError(
                f"constraints of `{type(scene).__name__}` depend on mode `{name}`; only "
                "loads, potentials and events may depend on modes"
            )
        with jax.ensure_compile_time_eval():  # all values are concrete, even inside `jit`
            values, ts = uncompiled_lanes(channel), np.linspace(float(t0), float(t1), 257)[:, None]
            for _, _, behind in jumps(
                lambda t, values=values: np.asarray(values(t[:, 0]), float)[:, None], ts[:-1], ts[1:]
            ):
                raise ValueError(
                    f"input `{name}` of `{type(scene).__name__}` jumps at t = {behind[0]:.6g} s, but velocity"
                    f" constraints depend on it: {SPEEDS_WOULD_JUMP}"
                )
