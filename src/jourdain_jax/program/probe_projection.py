"""Projection of probes on a graph: inputs move by Gauss-Newton until the constraints vanish."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jourdain_jax.calculus.roots import nearest_root
from jourdain_jax.calculus.sparse_slopes import Pattern
from jourdain_jax.program.derivative import jacobian
from jourdain_jax.program.graph import Graph


class Projected(NamedTuple):
    """Probes projected onto constraints, or as close as the iteration came."""

    probes: Any  # of the given type: `Probes` or `IdentityProbes`
    moved: list[str]  # names of the inputs on which the constraints depend
    pattern: Pattern  # sparsity pattern of the constraint Jacobian with respect to these
    slopes: list[int]  # nodes of its entries


def onto_rows(probes, rows: Sequence[int], inputs: Mapping[str, int], **limits) -> Projected:
    """Return the probes with `inputs` (names -> nodes) moved to the nearest point where all rows are zero.
    `limits`: limits of the steps, as in `nearest_root`.
    """
    graph = probes.graph
    needed = set(graph.reachable(rows))
    moved = {name: n for name, n in inputs.items() if n in needed}
    pattern, slopes = _slopes_by_entries(graph, rows, list(moved.values()))
    given = (
        np.stack([np.broadcast_to(probes.inputs[name], probes.count) for name in moved], axis=1)
        if moved
        else np.zeros((probes.count, 0))
    )

    def at(x, which):
        every = given.copy()
        every[which] = x
        return probes.with_inputs(dict(zip(moved, every.T, strict=True)))

    def look(x, which):
        here = at(x, which)
        return np.asarray(here(rows)).T[which], np.asarray(here(slopes)).T[which]

    x = nearest_root(look, pattern.shortest, given, **limits)[0] if moved else given
    return Projected(at(x, slice(None)), list(moved), pattern, slopes)


def _slopes_by_entries(
    graph: Graph, rows: Sequence[int], variables: Sequence[int]
) -> tuple[Pattern, list[int]]:
    """Return the structurally nonzero derivatives of rows with respect to variables: their pattern and their
    nodes.
    """
    place = {n: k for k, n in enumerate(variables)}
    entries = [
        (i, place[n], slope)
        for i, row in enumerate(jacobian(graph, rows, variables))
        for n, slope in row.items()
        if slope != graph.zero
    ]
    pattern = Pattern.of([(i, k) for i, k, _ in entries], (len(rows), len(place)))
    return pattern, [slope for *_, slope in entries]
