"""The part of a graph needed by some nodes, as a separate graph."""

from collections.abc import Iterable

import numpy as np

from jourdain_jax.program.graph import Graph


def part_of(graph: Graph, needed: Iterable[int]) -> tuple[Graph, np.ndarray]:
    """Return a new graph with only the needed nodes and, for every node of `graph`, its index there (-1 if
    not needed). A program then keeps no failed attempts in memory.
    """
    kept = [n for n in graph.reachable(needed) if n > graph.one]  # in the old order, so that no sum is turned round
    found, place = Graph(graph.most_multiplications, graph.keeps_rules), np.full(len(graph.op), -1, np.int64)
    place[[graph.zero, graph.one]] = found.zero, found.one
    for n in kept:
        place[n] = found.like(graph, n, tuple(place[list(graph.args[n])].tolist()))
    return found, place
