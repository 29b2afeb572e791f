"""Parts of a graph that some nodes need: extraction, and comparison of their sizes."""

import heapq
from collections.abc import Iterable

import numpy as np

from jourdain_jax.program.graph import OPERATIONS, Graph


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
