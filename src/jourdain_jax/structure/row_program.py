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
    entries: Indices  # of all entries of parameters that the program uses
    t: int
    q: Indices
    u: Indices
    inputs: Indices
    g: Indices
    G: Matrix
    phi: Indices
    A: Matrix
    M: Matrix | None  # lower triangle; None if too large to be written out
    right: Indices  # truth values: valid parameters and bodies; possible moments of inertia; a finite state
    others: (
        Indices  # coordinates of other states, on the geometric constraints, on which `right` also depends
    )


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
    parameters = tuple(tuple(place[x.ravel()].tolist()) for x in traced.parameters)
    entries = tuple(n for leaf in parameters for n in leaf if n >= 0)
    return RowProgram(own, parameters, entries, **listed)


def _right(scene: Scene, looked: LookedAt, A: Matrix, M: Matrix | None) -> tuple[list[int], list[int]]:
    """Return the nodes of three truth values, for valid parameters, possible moments of inertia and a finite
    state, and the coordinates of other states on which they depend.

    Parameters are valid if each is finite, has its required sign, causes no other fault of
    `plausibility.CHECKS` at the start and at states from `elsewhere`, and leaves no free motion without
    inertia. The coordinates of these states depend on parameters if the geometric constraints do.
    """
    g, traced = looked.graph, looked.traced
    states, count = list(zip(*elsewhere(scene), strict=True)), len(traced.q) if len(traced.at.closure) else 0
    on_rows = [[g.input(f"other_{k}_{i}", True) for i in range(count)] for k in range(len(states))]
    of_parameters = [n for leaf in traced.parameters for n in leaf.ravel().tolist()]
    held = traced.q.tolist() if any(depend_on(g, looked.closures, of_parameters)) else []
    varying = [traced.t, *traced.q.tolist(), *traced.u.tolist()]
    fixed = [dict(zip(varying, map(g.const, np.hstack(state)), strict=True)) for state in states]
    others = [
        at | dict(zip(traced.q.tolist(), own, strict=False)) for at, own in zip(fixed, on_rows, strict=True)
    ]

    def at_states(kind: str, nodes: np.ndarray) -> np.ndarray | None:
        """Return the numbers at the start and elsewhere. Numbers that do not depend on parameters are
        constants at random states; None if random states violate the geometric constraints.
        """
        flat = nodes.ravel().tolist()
        decided = any(depend_on(g, flat, [*of_parameters, *(held if kind in BY_ROWS else [])]))
        if not decided and count and any(depend_on(g, flat, traced.q.tolist())):
            return None
        places = [{}, *others] if decided else [fixed[0], *fixed]
        return np.array([g.substituted(flat, at) for at in places]).reshape(-1, *nodes.shape)

    stacked: dict[str, np.ndarray] = {}
    for kind in dict.fromkeys(check.of for check in CHECKS if check.label):
        numbers = traced.particulars.numbers[kind].values()
        found = [x for one in numbers if (x := at_states(kind, np.asarray(one))) is not None]
        stacked |= {kind: np.stack(found, 1)} if found else {}
    free = _inertia_elsewhere(looked, A, M, fixed[0]) if M and _may_vanish(scene, looked) else []
    state = np.array([*traced.q.tolist(), *traced.u.tolist()])
    nodes = [state, *traced.parameters, *stacked.values(), *free]
    treedef, count = jax.tree.structure(scene), len(traced.parameters)

    def right(state, *given):
        faults = [*parameter_faults(jax.tree.unflatten(treedef, given[:count])).values()]
        faults += [without_inertia(*given[-2:])] if free else []
        numbers = dict(zip(stacked, given[count:], strict=False))
        faults += [any_wrong(numbers, moments=False)]
        possible = ~any_wrong(numbers, moments=True)
        return ~jnp.any(jnp.stack(faults)), possible, jnp.all(jnp.abs(state) < jnp.inf)

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
