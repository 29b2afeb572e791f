"""Derivatives on the graph: directional derivatives, cotangents, Jacobians, and JAX programs that use them as
derivative rules.

A JAX program with outputs o_i of variables x_j gets its own derivative rule from the Jacobian on the graph:

    d o_i = sum_j J_ij d x_j          J_ij: nodes that share subexpressions with the program and each other

The entries J_ij are computed once, with the values, for any number of tangents, and reverse mode stores only
them. JAX differentiates the other programs: those with a large Jacobian, or with an operation without a rule
on the graph.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.derivatives import is_zero
from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program.emit import fused, run
from jourdain_jax.program.graph import ARRAYS, Graph, NodeList, Unsupported


def derivatives(graph: Graph, outputs: Iterable[int], direction: dict[int, int]) -> NodeList:
    """Return d output/ds for each output; `direction`: dn/ds for each node n that moves with s. Nodes in
    `direction` count as independent.
    """
    return [rates.get(0, graph.zero) for rates in directional_derivative(graph, outputs, {0: direction})]


def jacobian(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> list[dict[int, int]]:
    """Return the derivatives of each output with respect to the variables on which it depends. Variables
    count as independent nodes.
    """
    return directional_derivative(graph, outputs, {n: {n: graph.one} for n in variables})


def directional_derivative(
    graph: Graph, outputs: Iterable[int], directions: Mapping[int, Mapping[int, int]]
) -> list[dict[int, int]]:
    """Return, for each output, its derivative along each direction in which it changes, in one sweep.

    `directions`: k -> dn/ds of each node n in direction k. A node of one direction counts as independent in
    all directions.
    """
    outputs = list(outputs)
    tangents: dict[int, dict[int, int]] = {}
    for k, direction in directions.items():
        for n, rate in direction.items():
            tangents.setdefault(n, {})
            if rate != graph.zero:
                tangents[n][k] = rate
    for node in graph.needed(outputs, ()):
        if node not in tangents:
            of_args = [tangents[a] for a in graph.args[node]]
            moving = dict.fromkeys(k for tangent in of_args for k in tangent)
            found = {
                k: _derivative(graph, node, [tangent.get(k, graph.zero) for tangent in of_args])
                for k in moving
            }
            tangents[node] = {k: rate for k, rate in found.items() if rate != graph.zero}
    return [tangents[n] for n in outputs]


def cotangents(
    graph: Graph, outputs: Iterable[int], weights: Iterable[int], variables: Iterable[int]
) -> NodeList:
    """Return sum_i w_i d output_i/d variable for each variable (an independent node), in one reverse sweep.

    A branch that is not taken contributes zero, even if its derivative is NaN.
    """
    variables = list(variables)
    total: dict[int, int] = {}
    for output, weight in zip(outputs, weights, strict=True):
        total[output] = graph.add(total.get(output, graph.zero), weight)
    needed = graph.needed(list(total), variables)
    leads_to = set(variables)
    for node in needed:
        if any(a in leads_to for a in graph.args[node]):
            leads_to.add(node)
    branches = [a for node in needed if graph.op[node] in ("select", "max", "min") for a in graph.args[node]]
    in_branch = set(graph.needed(branches, variables))
    for node in reversed(needed):
        weight = total.get(node, graph.zero)
        if weight == graph.zero or node not in leads_to:
            continue
        op, args = graph.operation(node)
        for i, a in enumerate(args):
            if a in leads_to:
                part = _part(graph, node, i, weight)
                if node in in_branch and op not in ("add", "sub", "neg", "select"):
                    part = graph.call("select", graph.call("eq", weight, graph.zero), part, graph.zero)
                total[a] = graph.add(total.get(a, graph.zero), part)
    return [total.get(n, graph.zero) for n in variables]


def _part(graph: Graph, node: int, i: int, weight: int) -> int:
    """Return the contribution of a node's weight to its argument i."""
    op, args = graph.operation(node)
    if op == "mul":
        return graph.mul(weight, args[1 - i])
    if op == "div":
        share = graph.div(weight, args[1])
        return graph.neg(graph.mul(share, node)) if i else share
    if op == "select":
        cases = (weight, graph.zero) if i == 1 else (graph.zero, weight)
        return graph.call("select", args[0], *cases) if i else graph.zero
    slope = _derivative(graph, node, [graph.one if k == i else graph.zero for k in range(len(args))])
    return graph.mul(weight, slope)


def columns(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> list[NodeList]:
    """Return the Jacobian by columns, one per variable, including zeros."""
    variables, rows = list(variables), jacobian(graph, outputs, variables)
    return [[row.get(n, graph.zero) for row in rows] for n in variables]


def matrix(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> list[NodeList]:
    """Return the Jacobian by rows, including zeros."""
    variables = list(variables)
    return [[row.get(n, graph.zero) for n in variables] for row in jacobian(graph, outputs, variables)]


def _derivative(graph: Graph, node: int, dots: list):
    """Return the rate of a node from the rates of its arguments; for arrays and calls, a tuple of rates."""
    op, args = graph.operation(node)
    if all(d == graph.zero for d in dots):
        return graph.zero
    if op in TABLE:
        rule = TABLE[op].derivative
        return graph.zero if rule is None else rule(graph, node, *args, *dots)
    if op == "opaque":
        return _of_call(graph, node, dots)
    value = graph.value[node]
    if op == "array":
        return tuple(dots) if np.issubdtype(value[1], np.floating) else graph.zero
    return dots[0][value[0]]  # a result or an entry


def _of_call(graph: Graph, node: int, dots: list) -> tuple:
    """Return the rates `d y_i = sum_j J_ij d x_j` of a call with results y_i of operands x_j. Another call
    computes the columns of J for the operands that vary.
    """
    operands, call = graph.args[node], graph.value[node]
    entries = [graph.entries_of(a) for a in operands]
    numbers = [np.issubdtype(graph.value[a][-1], np.floating) for a in operands]
    rates = [
        [graph.zero] * len(xs) if dot == graph.zero else dot for xs, dot in zip(entries, dots, strict=True)
    ]
    moves = tuple(
        tuple(number and (graph.varies[x] or dx != graph.zero) for x, dx in zip(xs, dxs, strict=True))
        for xs, dxs, number in zip(entries, rates, numbers, strict=True)
    )
    moving = [dx for pair in zip(rates, moves, strict=True) for dx, does in zip(*pair, strict=True) if does]
    found: list = []
    slopes = graph.opaque(call.slopes(moves), operands)
    for k, aval in enumerate(call.closed.out_avals):
        if not np.issubdtype(aval.dtype, np.floating):
            found.append(graph.zero)
            continue
        (J,) = graph.results(slopes, {k: ((len(moving), *aval.shape), str(aval.dtype))})
        columns = graph.entries(J).reshape(len(moving), -1)
        found.append(tuple(graph.dot(column.tolist(), moving) for column in columns.T))
    return tuple(found)


def differentiable(
    graph: Graph, outputs: Sequence[int], variables: Sequence[int], like: int, monitored: Sequence[int] = ()
) -> Callable[..., tuple]:
    """Return a JAX function of the values of `variables`, which must determine all outputs. It returns the
    `outputs` and then the nodes `monitored`, which get no derivatives, in the shape and precision of
    variable `like`.
    """
    scalars = [i for i, n in enumerate(variables) if graph.op[n] not in ARRAYS]
    count = len(outputs)
    graph, nodes, variables = on_its_own(graph, [*outputs, *monitored], variables)
    outputs, monitored = nodes[:count], nodes[count:]
    entries = _entries(graph, outputs, variables)

    def values_of(nodes, values) -> tuple:
        shape, real = (
            jnp.broadcast_shapes(*(jnp.shape(values[i]) for i in scalars)),
            jnp.result_type(values[like]),
        )
        found = run(graph, nodes, dict(zip(variables, values, strict=True)))
        return tuple(jnp.broadcast_to(jnp.asarray(x, real), shape) for x in found)

    def program(*values):
        found = values_of([*outputs, *monitored], values)
        return *found[:count], *map(jax.lax.stop_gradient, found[count:])

    if entries is None:
        return program
    own = jax.custom_jvp(program)

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(values, tangents):
        moving = [not is_zero(v) for v in tangents]
        used = [(i, j, node) for i, j, node in entries if moving[j]]
        varying = list(dict.fromkeys(node for *_, node in used if not graph.is_const(node)))
        found = values_of([*outputs, *monitored, *varying], values)
        # measured: a quarter less time for one motion, a quarter more in batches
        found = fused(found) if found[0].ndim == 0 else found
        J = dict(zip(varying, found[count + len(monitored) :], strict=True))
        # d o_i = sum_j J_ij d x_j
        along = [jnp.zeros_like(x) for x in found[: count + len(monitored)]]
        for i, j, node in used:
            along[i] = along[i] + jnp.asarray(J.get(node, graph.value[node]) * tangents[j], along[i].dtype)
        return found[: len(along)], tuple(along)

    return own


def on_its_own(
    graph: Graph, outputs: Sequence[int], variables: Sequence[int]
) -> tuple[Graph, NodeList, NodeList]:
    """Return the outputs on a new graph with the variables as inputs, so that no simplification uses their
    definitions.
    """
    own = Graph()
    inputs = [own.input(str(k), True) for k in range(len(variables))]
    new = own.copied(outputs, graph, dict(zip(variables, inputs, strict=True)))
    return own, [new[n] for n in outputs], inputs


def _entries(
    graph: Graph, outputs: Sequence[int], variables: Sequence[int]
) -> list[tuple[int, int, int]] | None:
    """Return row, column and node of each structurally nonzero entry; None if differentiation by
    JAX is cheaper.
    """
    operations = graph.operations(outputs)
    if graph.calls(outputs):
        return None
    # above 100_000 operations times variables, building the Jacobian takes longer than it saves
    if operations * len(variables) > 100_000:
        return None
    try:
        rows = jacobian(graph, outputs, variables)
    except Unsupported:
        return None
    entries = [(i, j, rows[i][n]) for j, n in enumerate(variables) for i in range(len(rows)) if n in rows[i]]
    # values and Jacobian may take at most 8 times the operations of the values
    with_entries = graph.operations([*outputs, *(node for *_, node in entries)])
    return entries if with_entries <= 8 * max(operations, 10) else None
