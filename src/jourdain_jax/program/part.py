"""The part of a graph that some nodes need, as rows from which it is put together again."""

from collections.abc import Iterable

import numpy as np

from jourdain_jax.program.graph import Graph


def part(graph: Graph, needed: Iterable[int]) -> tuple[list[tuple], np.ndarray]:
    """Rows for `Graph.of_rows`, and for every node of the graph its number there; -1 for those that are not needed. No call of JAX may be among them."""
    kept = [graph.zero, graph.one, *(n for n in graph.reachable(needed) if n > graph.one)]  # in the old order, so that no sum is turned round
    place = np.full(len(graph.op), -1, np.int64)
    place[kept] = np.arange(len(kept))
    return [(graph.op[n], [int(place[a]) for a in graph.args[n]], graph.value[n], graph.varies[n]) for n in kept], place
