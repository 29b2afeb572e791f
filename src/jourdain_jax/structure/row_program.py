"""Constraints of a class of scenes as a scalar program, for projections and checks of starts.

    g(t, q),   G = dg/dq;        phi(t, q, u),   A = dphi/du;        M = sum m beta' beta + gamma' I gamma

Unit norms of quaternions count as geometric constraints g.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import Indices
from jourdain_jax.program.derivative import jacobian
from jourdain_jax.program.evaluate import depend_on, part_of
from jourdain_jax.program.graph import Graph, Unsupported
from jourdain_jax.program.interpret import Nodes, as_nodes, interpret
from jourdain_jax.scene.coordinates import parameter_faults
from jourdain_jax.scene.identity import once_per_class, with_usual_parameters
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.plausibility import (
    BY_ROWS,
    CHECKS,
    any_wrong,
    checks_inertia,
    elsewhere,
    without_inertia,
)
from jourdain_jax.structure.probes import LookedAt, looked_at

Matrix = dict[tuple[int, int], int]  # (row, column) -> node, of nonzero entries


@dataclass(frozen=True, eq=False)
class RowProgram:
    """The program as nodes of a graph. Programs are compared by identity, so that they can be static
    arguments of compiled functions.
    """

    graph: Graph
    parameters: tuple[Indices, ...]  # of each leaf of the scene, by entry; -1 for unused ones
    t: int
    q: Indices
    u: Indices
    inputs: Indices
    g: Indices
    G: Matrix
    phi: Indices
    A: Matrix
    M: Matrix | None  # lower triangle; None if too large to be written out
    right: Indices  # truth values: parameters and bodies are valid; the state is finite
    others: (
        Indices  # coordinates of other states, on the geometric constraints, on which `right` also depends
    )

    @property
    def entries(self) -> list[int]:
        """Return the nodes of all entries of parameters that the program uses."""
        return [n for leaf in self.parameters for n in leaf if n >= 0]


@once_per_class
def row_program(scene: Scene) -> RowProgram | None:
    """Return the program of a class of scenes; None if a part of it has no scalar form."""
    scene, _ = with_usual_parameters(scene)
    try:
        nodes = looked_at(scene)
        graph, traced = nodes.graph, nodes.traced
        q, u = traced.q.tolist(), traced.u.tolist()
        A, M = _entries(nodes.rows, u), _mass_matrix(nodes, u)
        right, others = _right(scene, nodes, A, M)
    except Unsupported:
        return None
    parts: dict[str, Any] = {
        "t": traced.t,
        "q": q,
        "u": u,
        "inputs": traced.inputs.tolist(),
        "g": nodes.closures,
        "G": _entries(nodes.of_closures, q),
        "phi": traced.at.phi.tolist(),
        "A": A,
        "M": M,
        "right": right,
        "others": others,
    }
    needed = jax.tree.leaves(parts)
    if graph.calls(needed):
        return None
    own, place = part_of(graph, needed)
    listed: dict[str, Any] = {
        name: tuple(x) if isinstance(x, list) else x
        for name, x in jax.tree.map(lambda n: int(place[n]), parts).items()
    }
    return RowProgram(own, tuple(tuple(place[x.ravel()].tolist()) for x in traced.parameters), **listed)


def _right(scene: Scene, looked: LookedAt, A: Matrix, M: Matrix | None) -> tuple[list[int], list[int]]:
    """Return the nodes of two truth values, for valid parameters and for a finite state, and the coordinates
    of other states on which they depend.

    Parameters are valid if each is finite, has its required sign, causes no fault of `plausibility.CHECKS`
    at the start and at states from `elsewhere`, and leaves no free motion without inertia. The coordinates of
    these states depend on parameters if the geometric constraints do. Faults that do not depend on parameters
    are found when the scene is probed.
    """
    g, traced = looked.graph, looked.traced
    states, count = list(zip(*elsewhere(scene), strict=True)), len(traced.q) if len(traced.at.closure) else 0
    on_rows = [[g.input(f"other_{k}_{i}", True) for i in range(count)] for k in range(len(states))]
    of_parameters = [n for leaf in traced.parameters for n in leaf.ravel().tolist()]
    held = traced.q.tolist() if any(depend_on(g, looked.closures, of_parameters)) else []
    varying = [traced.t, *traced.q.tolist(), *traced.u.tolist()]
    placed = [
        [g.const(t), *(own or map(g.const, q)), *map(g.const, u)]
        for (t, q, u), own in zip(states, on_rows, strict=True)
    ]
    others = [dict(zip(varying, state, strict=True)) for state in placed]

    def at_states(nodes: np.ndarray) -> np.ndarray:
        flat = nodes.ravel().tolist()
        return np.array([flat, *(g.substituted(flat, other) for other in others)]).reshape(-1, *nodes.shape)

    judged = dict.fromkeys(check.of for check in CHECKS if check.label)
    every = {kind: list(map(np.asarray, traced.particulars.numbers[kind].values())) for kind in judged}
    deciding = {kind: [*of_parameters, *(held if kind in BY_ROWS else [])] for kind in judged}
    matters = lambda kind, x: any(depend_on(g, x.ravel().tolist(), deciding[kind]))
    kept = {kind: [x for x in of if matters(kind, x)] for kind, of in every.items()}
    stacked = {kind: np.stack([at_states(x) for x in of], 1) for kind, of in kept.items() if of}
    generic = dict(zip(varying, map(g.const, np.concatenate([np.ravel(x) for x in states[0]])), strict=True))
    free = _inertia_elsewhere(looked, A, M, generic) if M and _may_vanish(scene, looked) else []
    state = np.array([*traced.q.tolist(), *traced.u.tolist()])
    nodes = [state, *traced.parameters, *stacked.values(), *free]
    treedef, count = jax.tree.structure(scene), len(traced.parameters)

    def right(state, *given):
        faults = [*parameter_faults(jax.tree.unflatten(treedef, given[:count])).values()]
        faults += [without_inertia(*given[-2:])] if free else []
        faults += [any_wrong(dict(zip(stacked, given[count:], strict=False)))]
        return ~jnp.any(jnp.stack(faults)), jnp.all(jnp.abs(state) < jnp.inf)

    closed = jax.make_jaxpr(right)(*(jax.ShapeDtypeStruct(x.shape, jnp.result_type(float)) for x in nodes))
    found = [int(as_nodes(g, x)) for x in interpret(g, closed, [Nodes(x) for x in nodes])]
    given = [n for state in on_rows for n in state]
    return found, given if any(depend_on(g, found, given)) else []


def _may_vanish(scene: Scene, looked: LookedAt) -> bool:
    """Return whether a mass or inertia depends on a parameter that may be zero; False for scenes too large
    for the check.
    """
    if not checks_inertia(scene):
        return False
    others = [n for leaf in looked.traced.parameters for n in leaf.ravel().tolist()]
    others = [n for n in others if n not in looked.graph.positive]
    weights = [*looked.traced.at.mass.ravel().tolist(), *looked.traced.at.inertia.ravel().tolist()]
    return any(depend_on(looked.graph, weights, others))


def _inertia_elsewhere(looked: LookedAt, A: Matrix, M: Matrix, state: dict[int, int]) -> list[np.ndarray]:
    """Return the nodes of the mass matrix and of the rows at another state, as arrays."""
    graph, n = looked.graph, len(looked.traced.u)
    found = [np.full((n, n), graph.zero), np.full((len(looked.rows), n), graph.zero)]
    for matrix, entries in zip(found, (M, A), strict=True):
        for (i, k), node in zip(entries, graph.substituted(list(entries.values()), state), strict=True):
            matrix[i, k] = node
    found[0] = np.where(graph.zero != found[0].T, found[0].T, found[0])
    return found


def _entries(rows: list[dict[int, int]], variables: list[int]) -> Matrix:
    place = {n: k for k, n in enumerate(variables)}
    return {(i, place[n]): node for i, row in enumerate(rows) for n, node in row.items()}


def _mass_matrix(nodes: LookedAt, u: list[int]) -> Matrix | None:
    """Return the lower triangle of `M = d^2 T/du^2`, or None if it is too large."""
    # above this number of products of entries of velocities M is too large to be written out
    if sum(len(row) ** 2 for row in nodes.velocities) > 20_000:
        return None
    graph, (kinetic, _) = nodes.graph, nodes.traced.at.energies.tolist()
    momenta = jacobian(graph, [kinetic], u)[0]
    slopes = jacobian(graph, list(momenta.values()), u)
    place = {n: k for k, n in enumerate(u)}
    found = {
        (place[n], place[m]): node
        for n, row in zip(momenta, slopes, strict=True)
        for m, node in row.items()
        if place[m] <= place[n]
    }
    at_rest = graph.substituted(list(found.values()), dict.fromkeys(u, graph.zero))
    return {key: int(node) for key, node in zip(found, at_rest, strict=True) if node != graph.zero}
