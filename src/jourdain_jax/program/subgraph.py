"""Extraction of the part of a graph that some nodes need."""

from collections.abc import Iterable

import numpy as np

from jourdain_jax.program.graph import Graph


def part_of(graph: Graph, needed: Iterable[int]) -> tuple[Graph, np.ndarray]:
    """Return a new graph with only the needed nodes, and the new index of every node of `graph` (-1 if not
    needed). It frees the memory of unused expressions.
    """
    # in the old order, which keeps the order of terms in sums
    kept = [n for n in graph.reachable(needed) if n > graph.one]
    found, place = Graph(graph.most_multiplications, graph.keeps_rules), np.full(len(graph.op), -1, np.int64)
    place[[graph.zero, graph.one]] = found.zero, found.one
    for n in kept:
        place[n] = found.like(graph, n, tuple(place[list(graph.args[n])].tolist()))
    return found, place
