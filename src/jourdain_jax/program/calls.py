"""JAX calls in a graph of scalars: the parts of a traced function that have no scalar form.

    array   scalars combined into an array    opaque  the results of a `Call` of arrays
    output  one of these results              entry   one of its entries, again a scalar

Values may have batch axes, which come last.
"""

import functools
from collections.abc import Callable, Hashable

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal, jaxpr_as_fun

from jourdain_jax.calculus.jaxprs import loops
from jourdain_jax.calculus.reals import is_array
from jourdain_jax.program.eager import uncompiled_lanes
from jourdain_jax.program.graph import Unsupported


class Call:
    """A closed jaxpr that is kept as a call, and the reasons for it. Calls with the same
    operations are equal.
    """

    def __init__(self, closed, reasons: tuple[str, ...]):
        self.closed, self.reasons = closed, reasons
        self._described = description(closed)
        # distinguishes calls of different functions
        self._hash, self.name = hash(self._described), repr(self._described)
        # on NumPy, operands and results with a leading axis of probes
        self.at_probes = uncompiled_lanes(jaxpr_as_fun(closed))

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return isinstance(other, Call) and self._described == other._described

    @property
    def reason(self) -> str:
        """Return the reason for the call, as a noun phrase."""
        return " and ".join(self.reasons)

    @property
    def loop(self) -> str:
        """Return the name of the first loop in the call, or an empty string."""
        return next(loops(self.closed.jaxpr), "")

    @functools.cache  # noqa: B019  (calls are few, and live as long as their graph)
    def slopes(self, moves: tuple[tuple[bool, ...], ...]) -> "Call":
        """Return a call that computes the derivatives of each result. Their first axis runs over the entries
        of the operands that move. Raises `Unsupported` if JAX has no forward derivative.
        """
        function, avals = jaxpr_as_fun(self.closed), [v.aval for v in self.closed.jaxpr.invars]
        places = [(k, i) for k, of_operand in enumerate(moves) for i, does in enumerate(of_operand) if does]

        def columns(*operands):
            def along(k, i):
                directions = [
                    np.zeros(x.shape, x.dtype if np.issubdtype(x.dtype, np.floating) else jax.dtypes.float0)
                    for x in avals
                ]
                directions[k].flat[i] = 1
                return jax.jvp(function, operands, tuple(directions))[1]

            found = zip(*(along(k, i) for k, i in places), strict=True)
            return [
                jnp.stack(dx) if np.issubdtype(a.dtype, np.floating) else jnp.zeros(0)
                for dx, a in zip(found, self.closed.out_avals, strict=True)
            ]

        try:
            closed = jax.make_jaxpr(columns)(*(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals))
        except (TypeError, ValueError, NotImplementedError):
            raise Unsupported(f"the derivative of {self.reason}") from None
        return Call(closed, self.reasons)

    def results(self, *operands) -> tuple:
        """Return the results of the call; operands and results may have trailing batch axes."""
        function = jaxpr_as_fun(self.closed)
        avals = [v.aval for v in self.closed.jaxpr.invars]
        real = [x.dtype for x in operands if jnp.issubdtype(x.dtype, jnp.floating)]
        operands = [jnp.asarray(x, a.dtype) for x, a in zip(operands, avals, strict=True)]
        lanes = jnp.broadcast_shapes(*(x.shape[a.ndim :] for x, a in zip(operands, avals, strict=True)))
        axes = tuple(None if x.ndim == a.ndim else -1 for x, a in zip(operands, avals, strict=True))
        operands = [
            x if axis is None else jnp.broadcast_to(x, (*a.shape, *lanes))
            for x, a, axis in zip(operands, avals, axes, strict=True)
        ]
        for _ in lanes:
            function = jax.vmap(function, in_axes=axes, out_axes=-1)
        try:
            found = function(*operands)
        except NotImplementedError as error:
            if not lanes or "vmap" not in str(error):
                raise
            raise NotImplementedError(
                f"a callback in a load or stop event does not support batches: {str(error).splitlines()[0]}"
            ) from None
        return tuple(
            jnp.asarray(x, jnp.result_type(*real)) if real and jnp.issubdtype(x.dtype, jnp.floating) else x
            for x in found
        )


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


EMITTED: dict[str, Callable] = {
    "array": _array,
    "opaque": lambda call, *operands: call.results(*operands),
    "output": _output,
    "entry": _entry,
}


AT_PROBES: dict[str, Callable] = {
    "array": lambda about, *entries: np.stack(entries, axis=-1).reshape(-1, *about[0]).astype(about[1]),
    "opaque": lambda call, *operands: call.at_probes(*operands),
    "output": _output,
    "entry": lambda index, x: x.reshape(len(x), -1)[:, index[0]],
}


_SEVERAL = tuple, list  # defined once, because writing a union creates a new type each time


def description(x) -> Hashable:
    """Return a hashable key of a jaxpr or of a primitive's parameter. Two traces of a function have equal
    keys, unless it creates other functions.
    """
    if isinstance(x, _SEVERAL):
        return tuple(map(description, x))
    if isinstance(x, dict):
        return tuple((key, description(value)) for key, value in sorted(x.items()))
    if hasattr(x, "consts"):  # from JAX 0.12 on, every jaxpr has them
        return "closed", _of_jaxpr(x.jaxpr), tuple(map(description, x.consts))
    if hasattr(x, "eqns"):
        return _of_jaxpr(x)
    if (is_array(x) and not np.asarray(x).dtype.hasobject) or isinstance(x, float):
        return str(np.asarray(x).dtype), np.shape(x), np.asarray(x).tobytes()
    try:
        hash(x)
    except TypeError:
        return id(x)
    return x


def _of_jaxpr(x) -> Hashable:
    number = {v: k for k, v in enumerate([*x.constvars, *x.invars])}
    atom = lambda v: description(np.asarray(v.val, v.aval.dtype)) if isinstance(v, Literal) else number[v]
    lines: list = [tuple(v.aval for v in number)]
    for equation in x.eqns:
        inputs = tuple(map(atom, equation.invars))
        number |= {v: len(number) + k for k, v in enumerate(equation.outvars)}
        lines.append(
            (
                equation.primitive,
                inputs,
                description(equation.params),
                tuple(v.aval for v in equation.outvars),
            )
        )
    return *lines, tuple(map(atom, x.outvars))
