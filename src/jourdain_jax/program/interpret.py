"""Interpreter of a jaxpr over scalars. Every array is an array of nodes of a `Graph`; primitives act on its
entries.

Integers and booleans that do not depend on inputs (indices, shapes, masks) stay NumPy arrays. A primitive
without a rule raises `Unsupported`; `calls.py` then keeps its surroundings as a call.

Sums, products and extremes over axes, and matrix products, are written out as nodes.
"""

import os
import re
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.jaxprs import called, evaluated
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program.entry_places import gathered, scattered, targets
from jourdain_jax.program.graph import ARITHMETIC, Graph, Unsupported
from jourdain_jax.program.numpy_backend import applied, as_matrices

_OPERATIONS = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
}
_OF_NOTHING = {"add": 0.0, "mul": 1.0, "max": -np.inf, "min": np.inf, "and": 1.0, "or": 0.0}
REDUCTIONS = frozenset(_OPERATIONS)


def reduced(graph: Graph, ids: np.ndarray, axes: Sequence[int], name: str) -> np.ndarray:
    """Return the result of one of JAX's `REDUCTIONS` on an array of nodes."""
    op = _OPERATIONS[name]
    kept = [a for a in range(ids.ndim) if a not in axes]
    rows = np.transpose(ids, (*kept, *axes)).reshape(
        *(ids.shape[a] for a in kept), int(np.prod([ids.shape[a] for a in axes]))
    )
    result = np.empty(rows.shape[:-1], np.int64)
    for place in np.ndindex(result.shape):
        result[place] = _of_all(graph, op, rows[place].tolist())
    return result


def _of_all(graph: Graph, op: str, entries: list[int]) -> int:
    if not entries:
        return graph.const(_OF_NOTHING[op])
    total = entries[0]
    for entry in entries[1:]:
        total = graph.call(op, total, entry)
    return _mean_of_those_equal(graph, entries, total) if op in ("max", "min") and len(entries) > 2 else total


def _mean_of_those_equal(graph: Graph, entries: list[int], extreme: int) -> int:
    """Rewrite the extreme of more than two numbers as the mean of the numbers that equal it. Its derivative
    is then the mean of their derivatives, as in JAX.
    """
    reached = [graph.call("eq", entry, extreme) for entry in entries]
    total = graph.total(
        graph.call("select", reaches, graph.zero, entry)
        for reaches, entry in zip(reached, entries, strict=True)
    )
    return graph.div(
        total, graph.total(graph.call("select", reaches, graph.zero, graph.one) for reaches in reached)
    )


def product(graph: Graph, equation, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the result of JAX's `dot_general` on two arrays of nodes."""
    left, right = (m.reshape(int(np.prod(m.shape[:-2])), *m.shape[-2:]) for m in as_matrices(equation, x, y))
    right = np.swapaxes(right, 1, 2)
    _check_size(graph, left, right)
    result = [
        [[graph.dot(row, column) for column in rights] for row in lefts]
        for lefts, rights in zip(left.tolist(), right.tolist(), strict=True)
    ]
    return np.array(result, dtype=np.int64).reshape(equation.outvars[0].aval.shape)


def _check_size(graph: Graph, left: np.ndarray, right: np.ndarray) -> None:
    """Raise `Unsupported` for a product with more multiplications (other than by 0, 1 and -1) than the graph
    allows.
    """
    if left.size * right.shape[1] <= graph.most_multiplications:
        return
    trivial = {graph.zero, graph.one, graph.const(-1.0)}
    rows, columns = (
        np.sum([[[n not in trivial for n in row] for row in matrix] for matrix in x.tolist()], axis=1)
        for x in (left, right)
    )
    count = int(np.sum(rows * columns))
    if count > graph.most_multiplications:
        raise Unsupported(f"a matrix product with {count} multiplications")


_LINEAR = re.compile(r"relu6? at .*[/\\]jax[/\\]")  # piecewise linear, with the derivative of each piece
_HOME = f"{Path(__file__).parent.parent}{os.sep}"  # folder of this package


class Nodes:
    """Array of nodes."""

    __slots__ = ("ids",)

    def __init__(self, ids):
        self.ids = np.asarray(ids, dtype=np.int64)


Value: TypeAlias = Nodes | np.ndarray


def interpret(graph: Graph, closed, arguments: list[Value]) -> list[Value]:
    """Return the outputs of a closed jaxpr at the given arguments."""
    return evaluated(
        closed,
        arguments,
        lambda equation, inputs: apply(graph, equation, inputs),
        lambda x, aval: np.asarray(x),
    )


def effects_of(jaxpr) -> str:
    """Describe the first operation with side effects, such as printing; empty if there is none."""
    for equation in jaxpr.eqns:
        if equation.effects:
            inner = called(equation.primitive.name, equation.params)
            return (
                f"the operation `{equation.primitive.name}`, which has effects,"
                if inner is None
                else effects_of(inner.jaxpr)
            )
    return ""


def as_nodes(graph: Graph, value: Value) -> np.ndarray:
    """Return the nodes of a value; numbers become constants."""
    if isinstance(value, Nodes):
        return value.ids
    # limit on the scalars of one array
    if value.size > 200_000:
        raise Unsupported(f"an array of {value.size} numbers")
    return np.array([graph.const(x) for x in np.ravel(value)], dtype=np.int64).reshape(np.shape(value))


def apply(graph: Graph, equation, inputs) -> list[Value]:
    """Return the results of one equation."""
    name = equation.primitive.name
    refuse(equation)
    symbolic = Nodes in map(type, inputs)
    if graph.keeps_rules and symbolic and (rule := own_rule(name, equation.params)):
        raise Unsupported(rule)
    inner = called(name, equation.params)
    if inner is not None:
        return interpret(graph, inner, inputs)
    if name == "cond" and not isinstance(inputs[0], Nodes):
        return interpret(graph, equation.params["branches"][int(inputs[0])], inputs[1:])
    if name == "cond":
        found = [interpret(graph, branch, inputs[1:]) for branch in equation.params["branches"]]
        choose = partial(_elementwise, graph, partial(_select, graph))
        return [Nodes(choose([inputs[0], *cases])) for cases in zip(*found, strict=True)]
    if not equation.outvars:
        raise Unsupported(f"the operation `{name}`")
    out = equation.outvars[0].aval
    if name == "convert_element_type" and symbolic:
        return [_converted(graph, as_nodes(graph, inputs[0]), equation.invars[0].aval.dtype, out.dtype)]
    if symbolic and name in _MOVES:
        return [Nodes(ids) for ids in _moved(graph, name, equation, inputs)]
    if not symbolic:
        return applied(
            equation, [np.asarray(x, v.aval.dtype) for x, v in zip(inputs, equation.invars, strict=True)]
        )
    if out.dtype.kind in "iu" and name in _NOT_OF_INTEGERS:
        raise Unsupported("an integer that depends on the state")
    if _is_rounded(out.dtype):
        raise Unsupported(f"the operation `{name}` in {out.dtype}")
    if name in REDUCTIONS:
        return [Nodes(reduced(graph, as_nodes(graph, inputs[0]), equation.params["axes"], name))]
    if name == "dot_general":
        return [Nodes(product(graph, equation, *(as_nodes(graph, x) for x in inputs)))]
    if name == "argmax" and equation.invars[0].aval.dtype == bool:
        first, (axis,) = partial(_first_true, graph), equation.params["axes"]
        return [Nodes(np.apply_along_axis(first, axis, as_nodes(graph, inputs[0])))]
    if name in _ELEMENTWISE:
        return [Nodes(_elementwise(graph, _ELEMENTWISE[name](graph, equation.params), inputs))]
    raise Unsupported(f"the operation `{name}`")


def _elementwise(graph: Graph, result: Callable, inputs: Sequence[Value]) -> np.ndarray:
    arrays = [as_nodes(graph, x) for x in inputs]
    if any(a.shape != arrays[0].shape for a in arrays):
        arrays = np.broadcast_arrays(*arrays)
    found = list(map(result, *(a.ravel().tolist() for a in arrays)))
    return np.array(found, dtype=np.int64).reshape(arrays[0].shape)


def refuse(equation) -> None:
    """Raise ValueError if a scene cannot contain this equation."""
    for v in (*equation.invars, *equation.outvars):
        kind = v.aval.dtype
        if not isinstance(kind, np.dtype) and jnp.issubdtype(kind, jax.dtypes.prng_key):
            raise ValueError(
                f"a method of the scene draws random numbers (`{equation.primitive.name}`); draw "
                "them outside and pass them as parameters or inputs"
            )


def own_rule(name: str, params) -> str:
    """Return the name of a primitive's function if it has a custom derivative that the graph cannot
    reproduce, otherwise an empty text.

    Functions of this package do not count: their custom derivatives equal those of their operations.
    Functions of JAX do: `softplus` and `sinc` have branches, and derivatives of branches are wrong
    where these meet.
    """
    if name == "stop_gradient":
        return "`stop_gradient`, which sets its derivative to zero,"
    function = called(name, params)
    if function is None or not name.startswith("custom_"):
        return ""
    info = getattr(function.jaxpr.debug_info, "func_src_info", None) or "a function"
    known = _HOME in info or _LINEAR.match(info)
    return "" if known else f"`{info.split(' at ')[0]}`, which has a custom derivative,"


# Primitives that move entries.


def _moved(graph: Graph, name: str, equation, inputs: list[Value]) -> list[np.ndarray]:
    """Return the nodes that a primitive moves as if they were numbers; numbers among its operands
    become constants.
    """
    entries = _MOVES[name](len(inputs))
    if any(isinstance(x, Nodes) for i, x in enumerate(inputs) if i not in entries):
        raise Unsupported("an index that depends on the state")
    given = [as_nodes(graph, x) if i in entries else x for i, x in enumerate(inputs)]
    return [_OF_NODES[name](graph, given, equation.params)] if name in _OF_NODES else applied(equation, given)


def _gather(graph, inputs, params):
    if (found := gathered(params, *inputs)) is None:
        raise Unsupported("an index out of bounds")
    return found


def _scatter(graph, inputs, params):
    if (found := scattered(params, *inputs)) is None:
        raise Unsupported("entries changed by a function")
    return found


def _scatter_add(graph, inputs, params):
    flat, (where, update) = inputs[0].flatten(), targets(params, *inputs)
    if len(set(where.tolist())) != inputs[2].size:
        raise Unsupported("the operation `scatter-add` with repeated places")
    flat[where] = [graph.add(*pair) for pair in zip(flat[where].tolist(), update.tolist(), strict=True)]
    return flat.reshape(inputs[0].shape)


# Operands that hold entries; the others are indices.
_MOVES: dict[str, Callable[[int], Collection[int]]] = {
    **dict.fromkeys(
        (
            "broadcast_in_dim",
            "reshape",
            "squeeze",
            "expand_dims",
            "transpose",
            "rev",
            "slice",
            "dynamic_slice",
            "split",
        ),
        lambda n: (0,),
    ),
    **dict.fromkeys(("gather", "copy", "copy_p", "stop_gradient", "unstack"), lambda n: (0,)),
    **dict.fromkeys(("concatenate", "stack", "optimization_barrier"), range),
    **dict.fromkeys(("pad", "dynamic_update_slice"), lambda n: (0, 1)),
    **dict.fromkeys(("scatter", "scatter-add"), lambda n: (0, 2)),
}
# For all other primitives, `program/numpy_backend.py` moves the node indices as if they were numbers.
_OF_NODES: dict[str, Callable] = {
    "gather": _gather,
    "scatter": _scatter,
    "scatter-add": _scatter_add,
    **dict.fromkeys(("copy", "copy_p", "stop_gradient"), lambda graph, inputs, params: inputs[0]),
}


def _is_rounded(dtype: np.dtype) -> bool:
    """Return whether a type has lower precision than the program."""
    return dtype != np.float64 and _kind(dtype) == "f" and dtype.itemsize < real_type().itemsize


def _kind(dtype: np.dtype) -> str:
    """Return NumPy's kind of a type; bfloat16 and similar types are floats."""
    return dtype.kind if dtype.kind != "V" else "f" if jnp.issubdtype(dtype, jnp.floating) else "V"


def _converted(graph: Graph, ids: np.ndarray, old: np.dtype, new: np.dtype) -> Nodes:
    """Convert nodes to another type: booleans become 1 or 0, and nonzero numbers are true."""
    kinds = _kind(old), _kind(new)
    if kinds == ("f", "f") and jnp.finfo(new).eps > jnp.finfo(old).eps and _is_rounded(new):
        raise Unsupported(f"a number in {new}")
    if kinds[0] == kinds[1] or kinds == ("i", "f"):
        return Nodes(ids)
    if kinds[1] not in ("f", "b") and kinds[0] != "b":
        raise Unsupported("an integer that depends on the state")
    nodes = ids.ravel().tolist()
    if old.kind == "b":
        found = [graph.call("select", n, graph.zero, graph.one) for n in nodes]
    else:
        found = [graph.call("ne", n, graph.zero) for n in nodes]
    return Nodes(np.array(found, np.int64).reshape(ids.shape))


# Primitives on entries.


def _call(op: str) -> Callable:
    return lambda graph, params: getattr(graph, op) if op in ARITHMETIC else partial(graph.call, op)


def _select(graph: Graph, which, *cases):
    if graph.is_const(which):
        return cases[int(graph.value[which])]
    if len(cases) == 2:
        truth = which if graph.is_truth(which) else graph.call("ne", which, graph.zero)
        return graph.call("select", truth, *cases)
    found = cases[0]
    for k, case in enumerate(cases[1:], 1):
        found = graph.call("select", graph.call("eq", which, graph.const(float(k))), found, case)
    return found


def _first_true(graph: Graph, truths: np.ndarray) -> int:
    """Return the index of the first true node, or 0 if none is true."""
    found = graph.zero
    for k in reversed(range(len(truths))):
        found = graph.call("select", int(truths[k]), found, graph.const(float(k)))
    return found


def _power(graph: Graph, x: int, y: int) -> int:
    whole = graph.is_const(y) and graph.value[y].is_integer()
    return graph.power(x, int(graph.value[y])) if whole else graph.call("pow", x, y)


def _round(graph: Graph, params) -> Callable[[int], int]:
    if params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        raise Unsupported("rounding half away from zero")
    return partial(graph.call, "round")


# function of the graph and of the primitive's `params` -> function of entries
_ELEMENTWISE: dict[str, Callable[[Graph, dict], Callable]] = {
    **{name: _call(name) for name in TABLE},
    "pow": lambda graph, params: partial(_power, graph),
    "round": _round,
    "add_any": _call("add"),
    "square": lambda graph, params: lambda x: graph.mul(x, x),
    "rsqrt": lambda graph, params: lambda x: graph.div(graph.one, graph.call("sqrt", x)),
    "integer_pow": lambda graph, params: lambda x: graph.power(x, params["y"]),
    "select_n": lambda graph, params: partial(_select, graph),
    "xor": _call("ne"),
}

# bitwise, or rounded for integers
_NOT_OF_INTEGERS = {"div", "and", "or", "xor", "not", "reduce_and", "reduce_or"}
