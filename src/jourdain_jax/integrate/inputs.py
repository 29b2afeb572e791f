"""Inputs of a scene as functions of time: constants, callables by name, or linearly interpolated samples.

A function of time is traced in every call that receives it. Captured values (arrays, traced numbers) and
plain numbers in sums, products, quotients and comparisons become arguments of a program and have derivatives.
The remaining operations are compared by value. A new function with the same operations but other numbers
compiles nothing; a function whose globals changed is a new program.

A step evaluates an input only a few times and could miss a short feature at any tolerance. `Sampled`
inputs are piecewise linear with knots at their sample times. Steps end at knots, so every step has a smooth
input. Knots may be skipped where the remaining polygon deviates from them by at most

    max(0.1 min(rtol, 1e-4) (max v - min v), round-off)

Knots are chosen greedily: lines from one to the next must pass all knots in between within that distance.

Both steps at a knot evaluate the input there. Each takes derivatives with respect to time and knot times from
the line on its own side (`SeenFromWithin`), so step ends need not move with the knots.
"""

from collections.abc import Callable, Hashable, Mapping
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, Primitive, Var, jaxpr_as_fun
from jaxtyping import Array, Bool, Float, PyTree

from jourdain_jax.calculus.compilation import compiled
from jourdain_jax.calculus.jumps import jumps
from jourdain_jax.calculus.reals import (
    PerLane,
    as_real,
    checked_unless_traced,
    described,
    in_default_precision,
    is_traced,
    largest,
    real_type,
)
from jourdain_jax.program.analyticity import depend_on
from jourdain_jax.program.calls import description
from jourdain_jax.program.eager import uncompiled_lanes
from jourdain_jax.scene.arguments import ChangingInputs
from jourdain_jax.scene.names import check_names
from jourdain_jax.scene.outside_names import now_read_by
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.spline import checked_samples
from jourdain_jax.structure.probes import looked_at
from jourdain_jax.structure.smoothness import SPEEDS_WOULD_JUMP
from jourdain_jax.structure.structure import structure_of

_TAKE_NUMBERS = ("add", "sub", "mul", "div", "lt", "le", "gt", "ge")  # differentiable in a nonzero number


class TimeProgram:
    """Operations of a function of time without its numbers; equal if the operations are equal."""

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
        """Return the shapes of the arguments before the time: plain numbers and captured values."""
        return [x.shape for x in self.closed.in_avals[:-1]]

    def __call__(self, numbers, held, t):
        """Return the value at time t; `numbers`: the plain numbers; `held`: the captured values."""
        given = zip((*numbers, *held, t), self.closed.in_avals, strict=True)
        return jaxpr_as_fun(self.closed)(*(jnp.asarray(x, like.dtype) for x, like in given))[0]

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (isinstance(other, TimeProgram) and self._key == other._key)

    def does_the_same_as(self, other: "TimeProgram") -> bool:
        """Return whether both are traces of one known function, ignoring derivative rules."""
        return self._key == other._key or _without_rules(self._key) == _without_rules(other._key)


def _without_rules(described):
    """Return a description without custom derivative rules."""
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
    """Input as a function of time: its operations, their plain numbers, and captured arrays."""

    program: TimeProgram = eqx.field(static=True)
    numbers: Float[Array, "*lanes numbers"]
    held: tuple

    def __call__(self, t):
        """Return the value at time t."""
        return self.program(self.numbers, self.held, t)


def traced(function: Callable, real) -> tuple[FunctionOfTime | None, object]:
    """Return a function of time with its captured values, or None unless its value is a number; and its
    shape.

    A function is traced again if it is new, or if a value that it reads has changed (`scene/identity.py`).
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
    """Last trace of a function, and the values it then read."""

    def __init__(self) -> None:
        self.again = False
        self.now: Hashable = None
        self.found: tuple[FunctionOfTime | None, object] = (None, None)
        self.program: TimeProgram | None = None


@lru_cache(maxsize=64)
def _trace(function: Callable) -> _Trace:
    return _Trace()


def for_programs(f: Callable, options: Callable | None = None) -> Callable[[Hashable], Callable]:
    """Compile `f` for a set of input programs; the least recently used is dropped."""
    return lru_cache(maxsize=16)(lambda programs: compiled(f, options))


class Sampled(eqx.Module):
    """Input with `values` at given times `ts` (s, increasing), linear between, constant beyond.

    Steps end at its knots, so no feature is missed, however short. Knots on a straight line between others
    are skipped, to within a tenth of `rtol` (at most 1e-5) of the range of values. A rough signal costs a
    step per sample. Other functions of time are evaluated only at the times of steps.
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
    """Mode: the number of its value at the start, and after each transition."""

    value: Float[Array | np.ndarray, ""]
    ts: Float[Array, "transitions"] | None = None  # s, times `direction`; infinite after the last one
    values: Float[Array, "transitions"] | None = None
    direction: Float[Array, ""] | None = None  # 1, or -1 if time runs backwards

    def __call__(self, t):
        """Return the number at time t; at a transition, the one after it."""
        if self.ts is None or self.values is None:
            return self.value
        passed = jnp.searchsorted(*jax.lax.stop_gradient((self.ts, t * self.direction)), side="right")
        return jnp.concatenate([jnp.asarray(self.value)[None], self.values])[passed]


class Inputs(eqx.Module):
    """All inputs of a scene, in order; `inputs(t)` is their vector."""

    channels: tuple[Callable, ...]

    def __call__(self, t) -> Float[Array, "inputs"]:
        """Return the vector of inputs at time t."""
        return (
            jnp.stack([jnp.asarray(channel(t), real_type()) for channel in self.channels])
            if self.channels
            else jnp.zeros(0)
        )

    @property
    def constant(self) -> bool:
        """Return whether all inputs are constant."""
        return all(isinstance(channel, Constant) for channel in self.channels)

    @property
    def programs(self) -> tuple:
        """Return the programs of the inputs that are functions of time."""
        return tuple(channel.program for channel in self.channels if isinstance(channel, FunctionOfTime))

    def near(self, t) -> ChangingInputs:
        """Return values and rates at time t. Raises ValueError for functions without derivatives."""
        t = jnp.asarray(t, real_type())
        try:
            values, rates = jax.jvp(self, (t,), (jnp.ones_like(t),))
        except (ValueError, TypeError, NotImplementedError) as error:
            said = str(error).splitlines()[0]
            raise ValueError(
                "constraints depend on inputs and need their rates, but one cannot be differentiated "
                f"({said}); pass it as `jj.Sampled`"
            ) from None
        return ChangingInputs(t, values, rates)


def in_phases(
    inputs: Inputs,
    ts: Float[Array, "transitions"],
    modes: Float[Array | np.ndarray, "modes transitions"],
    direction,
) -> Inputs:
    """Return inputs whose modes change at each transition; missing transitions are at infinity."""
    if not len(modes):
        return inputs
    ts = jnp.where(jnp.isfinite(ts), ts * direction, jnp.inf)
    values = iter(jax.lax.stop_gradient(modes))
    phases = lambda channel: Mode(jnp.asarray(channel.value), ts, next(values), direction)
    return Inputs(
        tuple(phases(channel) if isinstance(channel, Mode) else channel for channel in inputs.channels)
    )


def inputs_at(inputs: Inputs, t) -> Float[Array | np.ndarray, "inputs"]:
    """Return the vector of inputs at time t, in NumPy or compiled if all values are concrete."""
    if inputs.channels and is_traced(inputs, t):
        return inputs(t)
    if inputs.constant:
        return np.array([np.asarray(value) for value in jax.tree.leaves(inputs)], real_type())
    return _compiled_inputs(inputs.programs)(inputs, np.asarray(t, real_type()))


_compiled_inputs = for_programs(lambda inputs, t: inputs(t))


_NOTHING = object()
_ZERO = Constant(np.zeros(()))  # made once, because a module takes some 20 us


def _as_channel(f: Callable, where: str) -> Callable:
    """Return a function of time as an input channel; ValueError unless `f` maps a time to one number."""
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
    """Return inputs from name -> number, function of time or `Sampled`; omitted ones are zero."""
    if isinstance(given, Inputs):
        if len(given.channels) != len(scene.inputs):
            raise ValueError(
                f"`inputs` has {len(given.channels)} channels, but `{type(scene).__name__}` has "
                f"{len(scene.inputs)} inputs; pass them by name"
            )
        return given
    if given is not None and not isinstance(given, Mapping):
        raise ValueError(
            f"`inputs` is {described(given)}, expected a dictionary: name -> number, function of time, or"
            " `jj.Sampled`"
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
    """Raise ValueError for an input of velocity constraints that jumps between t0 and t1."""
    traced = looked_at(scene).traced
    for name, node in zip(scene.inputs.entries, traced.inputs.tolist(), strict=True):
        if name in dict(scene.modes.pairs) and any(depend_on(traced.graph, traced.at.phi.tolist(), [node])):
            raise ValueError(
                f"constraints of `{type(scene).__name__}` depend on mode `{name}`; only "
                "loads and potentials may switch"
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


def knots_between(holders: PyTree, rtol, t0, t1, ts: Float[Array, "times"]) -> Float[Array, "knots"] | None:
    """Return the knots (times since `t0`) at which steps must end, of all samples in `holders`, in the order
    of the motion, without the times `ts`, then at least one infinite time. None without samples."""
    samples = [
        x
        for x in jax.tree.leaves(holders, is_leaf=lambda x: isinstance(x, Sampled))
        if isinstance(x, Sampled) and len(x.ts) > 1
    ]
    if not samples:
        return None
    t1, ts = jax.lax.stop_gradient((t1, ts))
    direction, span = jax.lax.stop_gradient((jnp.sign(t1 - t0), jnp.abs(t1 - t0)))
    # tolerance of the polygon relative to the range of values; times nearer than 1e-12 of the span coincide
    share, near = 0.1 * jnp.minimum(rtol, 1e-4), 1e-12 * span
    # the choice of knots has no derivative, but their times do
    since = jnp.concatenate([jnp.where(bends(x, share), (x.ts - t0) * direction, jnp.inf) for x in samples])
    ends = jnp.sort(
        jnp.concatenate(
            [(ts - jax.lax.stop_gradient(t0)) * direction, jnp.stack([jnp.zeros_like(span), span])]
        )
    )
    number = jax.lax.stop_gradient(since)
    after = jnp.clip(jnp.searchsorted(ends, number), 1, len(ends) - 1)
    is_end = jnp.minimum(jnp.abs(number - ends[after - 1]), jnp.abs(ends[after] - number)) <= near
    since = jnp.sort(jnp.where(is_end | (number < 0) | (number > span), jnp.inf, since))
    number = jax.lax.stop_gradient(since)
    repeated = jnp.concatenate([jnp.zeros(1, bool), number[1:] - number[:-1] <= near])
    return direction * jnp.append(jnp.sort(jnp.where(repeated, jnp.inf, since)), jnp.inf)


def bends(sampled: Sampled, share) -> Bool[Array, "samples"]:
    """Return the knots at which steps must end, for lines that differ by at most `share` of the range."""
    t, v, share = jax.lax.stop_gradient((sampled.ts, sampled.values, share))
    allowed = jnp.maximum(share * (jnp.max(v) - jnp.min(v)), 16 * jnp.finfo(v.dtype).eps * largest(v))

    def next_knot(carry, here):
        t_a, v_a, t_b, v_b, low, high = carry  # anchor, last knot, range of slopes that pass all knots since
        t_k, v_k = here
        slope = (v_k - v_a) / (t_k - t_a)
        straight = (slope >= low) & (slope <= high)
        t_a, v_a = jnp.where(straight, t_a, t_b), jnp.where(straight, v_a, v_b)
        least, most = (v_k - allowed - v_a) / (t_k - t_a), (v_k + allowed - v_a) / (t_k - t_a)
        low, high = (
            jnp.where(straight, jnp.maximum(low, least), least),
            jnp.where(straight, jnp.minimum(high, most), most),
        )
        return (t_a, v_a, t_k, v_k, low, high), ~straight

    start = (t[0], v[0], t[0], v[0], jnp.asarray(-jnp.inf, v.dtype), jnp.asarray(jnp.inf, v.dtype))
    _, bent = jax.lax.scan(next_knot, start, (t[1:], v[1:]))
    # `bent` at a knot marks the one before as a step end
    return jnp.concatenate([(v[1] != v[0])[None], bent[1:], (v[-1] != v[-2])[None]])


class SeenFromWithin(eqx.Module):
    """Sampled input within one step: at a knot it continues the line of this step."""

    sampled: Sampled
    middle: PerLane  # middle of the step, s; infinite if there is none

    def __call__(self, t):
        """Return the value at time t, f_k + (t - t_k)/(t_{k+1} - t_k) (f_{k+1} - f_k)."""
        ts, values = self.sampled.ts, self.sampled.values
        at, middle, knots = jax.lax.stop_gradient((t, self.middle, ts))
        # shift t towards the middle of the step, by 2.0**-10 of the distance, to select the side of a knot
        at = jnp.where(jnp.isfinite(middle), at + (2.0**-10) * (middle - at), at)
        k = jnp.clip(jnp.searchsorted(knots, at, side="right") - 1, 0, max(len(ts) - 2, 0))
        after = jnp.minimum(k + 1, len(ts) - 1)
        on_line = values[k] + (t - ts[k]) / jnp.where(after > k, ts[after] - ts[k], 1.0) * (
            values[after] - values[k]
        )
        return jnp.where(at < knots[0], values[0], jnp.where(at > knots[-1], values[-1], on_line))


def seen_from_within(inputs: Inputs, middle: PerLane) -> Inputs:
    """Return `inputs` with samples continued within the step around this time (s; infinite: no step)."""

    def within(channel):
        sampled = channel.sampled if isinstance(channel, SeenFromWithin) else channel
        return (
            SeenFromWithin(sampled, jax.lax.stop_gradient(middle))
            if isinstance(sampled, Sampled)
            else channel
        )

    return Inputs(tuple(within(channel) for channel in inputs.channels))
