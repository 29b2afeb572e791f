"""Reductions of arrays of nodes over axes (sums, products, extremes), and matrix products."""

from collections.abc import Sequence

import numpy as np

from jourdain_jax.program.graph import Graph, Unsupported
from jourdain_jax.program.numpy_backend import as_matrices

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
