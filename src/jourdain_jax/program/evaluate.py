"""Evaluation of nodes on NumPy arrays, at all probes at once, without compilation.

The module also extracts the parts of a graph that some nodes need, and compares their sizes.

It also finds which expressions are analytic: an analytic expression that is zero at random states is zero
everywhere.

Expressions of +, -, *, /, roots, sines and cosines are analytic; branches and opaque calls are not. Functions
that are constant to round-off over some range do not obey the rule either.
"""

import heapq
from collections.abc import Callable, Collection, Iterable, Mapping

import numpy as np

from jourdain_jax.calculus.scalar_operations import TABLE, VALUES
from jourdain_jax.program.calls import AT_PROBES
from jourdain_jax.program.graph import ARRAYS, OPERATIONS, Graph


class Probes:
    """Values of the nodes of a graph at sample inputs (probes); computed values are cached."""

    def __init__(
        self,
        graph: Graph,
        inputs: Mapping[str, np.ndarray],
        functions: Mapping[str, Callable] = VALUES,
        arrays: Mapping[str, Callable] = AT_PROBES,
        constant: Callable = float,
    ):
        self.graph, self.inputs = graph, dict(inputs)
        self._functions, self._of_arrays, self._constant = functions, arrays, constant
        self.count = max((np.size(x) for x in self.inputs.values()), default=1)
        self._row: dict[int, int] = {}  # row of the table, by node
        self._table = np.empty((256, self.count))
        # arrays and results of calls, with a leading axis of probes
        self._arrays: dict[int, np.ndarray | list[np.ndarray]] = {}

    def __call__(self, nodes: Iterable[int]) -> np.ndarray:
        """Return values, shape (nodes, probes)."""
        nodes = list(nodes)
        self._compute(nodes)
        return self._table[np.array([self._row[n] for n in nodes], int)]

    def with_inputs(self, changes: Mapping[str, np.ndarray]) -> "Probes":
        """Return probes with some inputs changed."""
        return Probes(
            self.graph, self.inputs | dict(changes), self._functions, self._of_arrays, self._constant
        )

    def sign(self, node: int) -> int:
        """Return 1 or -1 if the node has this sign at every probe, otherwise 0."""
        value = self([node])[0]
        signs = set(np.sign(value[np.isfinite(value)]).tolist())
        return int(signs.pop()) if len(signs) == 1 else 0

    def in_the_middle(self, node: int) -> int:
        """Return the node as a function of parameters only: other inputs get their values at the probe where
        the node has its median magnitude. If no probe has a nonzero value, return 1.
        """
        graph, size = self.graph, np.abs(self([node])[0])
        known = np.flatnonzero(np.isfinite(size) & (size > 0))
        if not known.size:
            return graph.one
        k = known[np.argsort(size[known])[known.size // 2]]
        varying = [n for n in graph.reachable([node]) if graph.op[n] == "input" and graph.varies[n]]
        value = lambda n: float(np.broadcast_to(self.inputs[str(graph.value[n])], self.count)[k])
        return graph.substituted([node], {n: graph.const(value(n)) for n in varying})[0]

    def _compute(self, nodes) -> None:
        graph, row = self.graph, self._row
        wanted = graph.needed(nodes, row)
        if len(row) + len(wanted) > len(self._table):
            longer = np.empty((2 * (len(row) + len(wanted)), self.count))
            longer[: len(row)] = self._table[: len(row)]
            self._table = longer
        table, functions, place = self._table, self._functions, len(row) - 1
        with np.errstate(all="ignore"):
            for node in wanted:
                op = graph.op[node]
                place += 1
                if op in functions:
                    table[place] = functions[op](*[table[row[a]] for a in graph.args[node]])
                elif op in ARRAYS:
                    args = [
                        self._arrays[a] if graph.op[a] in ARRAYS else table[row[a]] for a in graph.args[node]
                    ]
                    self._arrays[node] = self._of_arrays[op](graph.value[node], *args)
                elif op == "entry":
                    table[place] = self._of_arrays[op](graph.value[node], self._arrays[graph.args[node][0]])
                elif op == "const":
                    table[place] = self._constant(graph.value[node])
                else:  # an input
                    table[place] = self.inputs[graph.value[node]]
                row[node] = place


def part_of(graph: Graph, needed: Iterable[int]) -> tuple[Graph, np.ndarray]:
    """Return a new graph with only the needed nodes, and the new index of every node of `graph` (-1 if not
    needed). This frees the memory of the other nodes.
    """
    # in the old order, which keeps the order of terms in sums
    kept = [n for n in graph.reachable(needed) if n > graph.one]
    found, place = Graph(graph.most_multiplications, graph.keeps_rules), np.full(len(graph.op), -1, np.int64)
    place[[graph.zero, graph.one]] = found.zero, found.one
    for n in kept:
        place[n] = found.like(graph, n, tuple(place[list(graph.args[n])].tolist()))
    return found, place


def more_operations(graph: Graph, a: int, b: int) -> int:
    """Return the number of operations of node a minus that of node b. Shared operations cancel."""
    if a == b:
        return 0
    needed_by, newest_first = {a: 1, b: 2}, [-max(a, b), -min(a, b)]
    unshared, more = 2, 0
    while unshared:  # pending nodes that only one of the two needs
        node = -heapq.heappop(newest_first)
        who = needed_by[node]
        if who != 3:
            unshared -= 1
            if graph.varies[node] and graph.op[node] in OPERATIONS:
                more += 1 if who == 1 else -1
        for arg in graph.args[node]:
            before = needed_by.get(arg, 0)
            if not before:
                heapq.heappush(newest_first, -arg)
            needed_by[arg] = before | who
            unshared += (needed_by[arg] != 3) - (before in (1, 2))
    return more


NONANALYTIC = frozenset(name for name, operation in TABLE.items() if operation.kind != "analytic")
CALLS = frozenset({"opaque"})


def passes(graph: Graph, outputs: Iterable[int], kinds: Collection[str]) -> list[bool]:
    """Return, for each output, whether an operation of the given `kinds` occurs in a part that depends on
    time, state or inputs.
    """
    return _with(graph, outputs, lambda n: graph.op[n] in kinds and graph.varies[n])


def decided_by(
    graph: Graph, outputs: Iterable[int], variables: Iterable[int], kinds: Collection[str]
) -> bool:
    """Return whether any operation of the given `kinds` in the outputs depends on one of the variables."""
    outputs, variables = list(outputs), set(variables)
    decisions = [n for n in graph.reachable(outputs) if graph.op[n] in kinds]
    return any(depend_on(graph, decisions, variables))


def depend_on(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> list[bool]:
    """Return whether each output needs one of the variables."""
    variables = set(variables)
    return _with(graph, outputs, lambda n: n in variables)


def _with(graph: Graph, outputs: Iterable[int], wanted: Callable[[int], bool]) -> list[bool]:
    outputs = list(outputs)
    found: dict[int, bool] = {}
    for node in graph.reachable(outputs):
        found[node] = wanted(node) or any(found[a] for a in graph.args[node])
    return [found[n] for n in outputs]
