"""What is kept of a traced function as it is: a call of JAX in a graph of scalars.

    array   entries put together             kept    the results of a `Call` of arrays
    output  one of these results             entry   one entry of it, a scalar again

The values of an array may have axes of lanes, which come last, as a scalar's do.
"""

import functools
from collections.abc import Callable, Hashable

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal, jaxpr_as_fun

from jourdain_jax.eager.numpy_backend import uncompiled


class Call:
    """A closed jaxpr, and why it is one; calls are equal where they compute the same in the same way."""

    def __init__(self, closed, reasons: tuple[str, ...]):
        self.closed, self.reasons = closed, reasons
        self._described = description(closed)
        self._hash = hash(self._described)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return isinstance(other, Call) and self._described == other._described

    @property
    def reason(self) -> str:
        """In words, without a verb."""
        return " and ".join(self.reasons)

    def results(self, *operands) -> tuple:
        """The results; operands, and so results, may have last axes of lanes."""
        function = jaxpr_as_fun(self.closed)
        avals = [v.aval for v in self.closed.jaxpr.invars]
        real = [x.dtype for x in operands if jnp.issubdtype(x.dtype, jnp.floating)]
        operands = [jnp.asarray(x, a.dtype) for x, a in zip(operands, avals, strict=True)]
        lanes = jnp.broadcast_shapes(*(x.shape[a.ndim :] for x, a in zip(operands, avals, strict=True)))
        axes = tuple(None if x.ndim == a.ndim else -1 for x, a in zip(operands, avals, strict=True))
        operands = [x if axis is None else jnp.broadcast_to(x, (*a.shape, *lanes)) for x, a, axis in zip(operands, avals, axes, strict=True)]
        for _ in lanes:
            function = jax.vmap(function, in_axes=axes, out_axes=-1)
        try:
            found = function(*operands)
        except NotImplementedError as error:
            if not lanes or "vmap" not in str(error):
                raise
            raise NotImplementedError(f"a callback in a load or stop event does not say how it takes a batch: {str(error).splitlines()[0]}") from None
        return tuple(jnp.asarray(x, jnp.result_type(*real)) if real and jnp.issubdtype(x.dtype, jnp.floating) else x for x in found)

    @functools.cached_property
    def name(self) -> str:
        """What tells it from calls of other functions."""
        return repr(self._described)

    @functools.cached_property
    def at_probes(self) -> Callable[..., list[np.ndarray]]:
        """The results on NumPy, operands and results with a leading axis of probes."""
        function = jaxpr_as_fun(self.closed)
        together, alone = uncompiled(jax.vmap(function)), uncompiled(function)

        def results(*operands):
            try:
                return together(*operands)
            except NotImplementedError:  # a callback that takes one at a time
                return [np.stack(x) for x in zip(*(alone(*one) for one in zip(*operands, strict=True)), strict=True)]

        return results


def _array(shape_and_type, *entries):
    shape, dtype = shape_and_type
    lanes = jnp.broadcast_shapes(*map(jnp.shape, entries))
    stacked = jnp.stack([jnp.broadcast_to(x, lanes) for x in entries])
    return (stacked if np.dtype(dtype).kind == "f" else stacked.astype(dtype)).reshape(*shape, *lanes)


def _output(which, results):
    return results[which[0]]


def _entry(index, x):
    number, dimensions = index
    return jax.lax.index_in_dim(x.reshape(-1, *x.shape[dimensions:]), number, keepdims=False)


EMITTED: dict[str, Callable] = {"array": _array, "kept": lambda call, *operands: call.results(*operands), "output": _output, "entry": _entry}


def _array_at_probes(shape_and_type, *entries):
    shape, dtype = shape_and_type
    return np.stack(entries, axis=-1).reshape(-1, *shape).astype(dtype)


AT_PROBES: dict[str, Callable] = {
    "array": _array_at_probes,
    "kept": lambda call, *operands: call.at_probes(*operands),
    "output": _output,
    "entry": lambda index, x: x.reshape(len(x), -1)[:, index[0]],
}


def description(x) -> Hashable:
    """What tells a jaxpr, or a parameter of an operation, from another; two traces of one function have the same, unless they hold new functions."""
    if hasattr(x, "consts") and hasattr(x, "jaxpr"):
        return "closed", description(x.jaxpr), tuple(map(description, x.consts))
    if hasattr(x, "eqns"):
        number = {v: k for k, v in enumerate([*x.constvars, *x.invars])}
        lines: list = [tuple(str(v.aval) for v in number)]
        for equation in x.eqns:
            inputs = tuple(description(v.val) if isinstance(v, Literal) else number[v] for v in equation.invars)
            number |= {v: len(number) + k for k, v in enumerate(equation.outvars)}
            lines.append((equation.primitive, inputs, description(equation.params), tuple(str(v.aval) for v in equation.outvars)))
        return *lines, tuple(description(v.val) if isinstance(v, Literal) else number[v] for v in x.outvars)
    if isinstance(x, dict):
        return tuple((key, description(value)) for key, value in sorted(x.items()))
    if isinstance(x, tuple | list):
        return tuple(map(description, x))
    if isinstance(x, np.ndarray | np.generic | jax.Array | float):
        return str(np.asarray(x).dtype), np.shape(x), np.asarray(x).tobytes()
    try:
        hash(x)
    except TypeError:
        return id(x)
    return x
