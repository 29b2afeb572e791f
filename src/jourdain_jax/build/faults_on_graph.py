"""Whether the parameters of a scene are right, and the bodies they make, as a node of its graph: as `parameter_faults` and `body_faults` say it."""

from dataclasses import fields
from itertools import combinations

import jax

from jourdain_jax.build.plausibility import TOLERANCE
from jourdain_jax.build.trace import TracedScene
from jourdain_jax.program.graph import Graph
from jourdain_jax.scene.scene import Scene


def right_on_graph(scene: Scene, traced: TracedScene) -> int:
    """The node of a truth value: every parameter is finite and has its sign, no mass and no principal moment of inertia is below zero."""
    graph, at = traced.graph, traced.at
    faults, leaves = [], iter(traced.parameters)
    for field in fields(scene):
        about = field.metadata
        of_field = [] if about.get("static", False) else [next(leaves) for _ in jax.tree.leaves(getattr(scene, field.name))]
        for x in (x for leaf in of_field for x in leaf.ravel().tolist() if about.get("parameter")):
            faults.append(graph.call("not", graph.call("is_finite", x)))
            if about["positive"] or about["non_negative"]:
                faults.append(graph.call("le" if about["positive"] else "lt", x, graph.zero))
    for mass, inertia in zip(at.mass.tolist(), at.inertia.tolist(), strict=True):
        faults += [graph.call("lt", x, graph.zero) for x in (mass, *_minors(graph, inertia))]
    found = graph.one
    for fault in faults:
        found = graph.call("and", found, graph.call("not", fault))
    return found


def _minors(graph: Graph, inertia: list[list[int]]) -> list[int]:
    """Principal minors of a symmetric matrix, relative to its largest entry, with a little added to the diagonal."""
    size = graph.zero
    for x in (x for row in inertia for x in row):
        size = graph.call("max", size, graph.call("abs", x))
    size = graph.call("select", graph.call("gt", size, graph.zero), graph.one, size)
    little = graph.const(TOLERANCE)
    I = [[graph.add(graph.div(x, size), little if i == k else graph.zero) for k, x in enumerate(row)] for i, row in enumerate(inertia)]

    def minor(i: int, j: int, k: int, m: int) -> int:
        return graph.sub(graph.mul(I[i][k], I[j][m]), graph.mul(I[i][m], I[j][k]))

    whole = graph.total(graph.mul(I[0][i], minor(1, 2, (i + 1) % 3, (i + 2) % 3)) for i in range(3))
    return [*(I[i][i] for i in range(3)), *(minor(i, j, i, j) for i, j in combinations(range(3), 2)), whole]
