"""A program with its own rule of differentiation: tangents by its Jacobian, derived on the graph.

    d o_i = sum_j J_ij d x_j          J_ij: nodes that share subexpressions with the program and with one another

The entries are computed once, with the values, however many tangents there are; and reverse mode has to keep no more than them. Programs whose
Jacobian is large, and those with an operation that has no rule on the graph, are differentiated by JAX.
"""

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp

from jourdain_jax.calculus.differentiated_as import is_zero
from jourdain_jax.program.derivative import jacobian
from jourdain_jax.program.emit import run
from jourdain_jax.program.fused import fused
from jourdain_jax.program.graph import ARRAYS, Graph, Unsupported


def differentiable(graph: Graph, outputs: Sequence[int], variables: Sequence[int], like: int, monitored: Sequence[int] = ()) -> Callable[..., tuple]:
    """A function of the values of `variables` (all that the outputs depend on) that returns those of `outputs`, as arrays of one shape, in the precision
    of the variable with number `like`; after them the values of the nodes `monitored`, which have no derivatives.
    """
    scalars = [i for i, n in enumerate(variables) if graph.op[n] not in ARRAYS]
    count = len(outputs)
    graph, nodes, variables = on_its_own(graph, [*outputs, *monitored], variables)
    outputs, monitored = nodes[:count], nodes[count:]
    entries = _entries(graph, outputs, variables)

    def values_of(nodes, values) -> tuple:
        shape, real = jnp.broadcast_shapes(*(jnp.shape(values[i]) for i in scalars)), jnp.result_type(values[like])
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
        found = fused(found) if found[0].ndim == 0 else found  # measured: a quarter less time for one motion, a quarter more in batches
        J = dict(zip(varying, found[count + len(monitored) :], strict=True))
        # d o_i = sum_j J_ij d x_j
        along = [jnp.zeros_like(x) for x in found[: count + len(monitored)]]
        for i, j, node in used:
            along[i] = along[i] + jnp.asarray(J.get(node, graph.value[node]) * tangents[j], along[i].dtype)
        return found[: len(along)], tuple(along)

    return own


def on_its_own(graph: Graph, outputs: Sequence[int], variables: Sequence[int]) -> tuple[Graph, list[int], list[int]]:
    """The outputs on a new graph whose inputs are the variables: no simplification can look behind these."""
    own = Graph()
    inputs = [own.input(str(k), True) for k in range(len(variables))]
    new = own.copied(outputs, graph, dict(zip(variables, inputs, strict=True)))
    return own, [new[n] for n in outputs], inputs


def _entries(graph: Graph, outputs: Sequence[int], variables: Sequence[int]) -> list[tuple[int, int, int]] | None:
    """Row, column and node of the entries that are not zero by structure; None where JAX does better."""
    operations = graph.operations(outputs)
    if graph.calls(outputs):
        return None
    # 100_000 operations times variables: beyond, deriving takes longer than it can save
    if operations * len(variables) > 100_000:
        return None
    try:
        rows = jacobian(graph, outputs, variables)
    except Unsupported:
        return None
    entries = [(i, j, rows[i][n]) for j, n in enumerate(variables) for i in range(len(rows)) if n in rows[i]]
    # 8 operations of values and Jacobian over those of the values
    return entries if graph.operations([*outputs, *(node for *_, node in entries)]) <= 8 * max(operations, 10) else None
