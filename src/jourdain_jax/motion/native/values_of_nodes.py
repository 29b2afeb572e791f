"""Values of nodes of a graph by machine code, as a function that JAX can differentiate.

    o = f(x),    f'(x) v,    g f'(x),    f''(x) w v,    g f''(x) v         o: values of the nodes, x: of the variables

Each is machine code of its own, made when it is asked for: derivatives are taken on the graph. For programs that are too large these are JAX's derivatives of
the program as XLA runs it.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jourdain_jax.calculus.derivatives import Rules, differentiated_as, filled, is_zero, with_rules
from jourdain_jax.motion.native.called import nodes_called
from jourdain_jax.native.scalar_program import unsupported
from jourdain_jax.program.derivative import cotangents, derivatives, on_its_own
from jourdain_jax.program.emit import run
from jourdain_jax.program.graph import Graph, Unsupported


def values_of_nodes(graph: Graph, nodes: Sequence[int], variables: Sequence[int]) -> Callable[[Array], Array]:
    """Values of nodes, of which zeros cost nothing, as a function of the values of the variables."""
    graph, nodes, variables = on_its_own(graph, nodes, variables)
    by_xla, by_machine_code = _both(graph, nodes, variables)
    there = np.flatnonzero([n != graph.zero for n in nodes])

    @cache
    def derivative(back: bool, order: int) -> Callable[[Array], Array] | None:
        """The derivative as a function of x, v or g, and w in a row; None where it is too large, or no machine code."""
        weights = [graph.input(f"v {i}", True) for i in range(len(there if back else variables))]
        w = [graph.input(f"w {i}", True) for i in range(len(variables))]

        def along(nodes, direction: list[int]) -> list[int]:
            return derivatives(graph, nodes, dict(zip(variables, direction, strict=True)))

        try:
            first = along(nodes, w) if order == 2 else nodes
            found = cotangents(graph, [first[i] for i in there], weights, variables) if back else along(first, weights)
        except Unsupported:
            return None
        # operations of a derivative; machine code of so many takes 1.4 MB of the stack, and 0.3 s to make
        if unsupported(graph, found) or graph.operations(found) > 40_000:
            return None
        return differentiated_as(*_both(graph, found, [*variables, *weights, *(w if order == 2 else ())]))

    def linear(back: bool) -> Callable[[Array, Array], Array]:
        """A function of x and v, or (`back`) g; its derivative along x is machine code where that serves."""

        def taken(v):
            return v[there] if back else v

        @jax.custom_jvp
        def first(x, v):
            if (by_graph := derivative(back, 1)) is not None:
                return by_graph(jnp.concatenate([x, taken(v)]))
            return jax.vjp(by_xla, x)[1](v)[0] if back else jax.jvp(by_xla, (x,), (v,))[1]

        @partial(first.defjvp, symbolic_zeros=True)
        def rule(at, tangents):
            (x, v), (dx, dv) = at, tangents
            found, second = first(x, v), None if is_zero(dx) else derivative(back, 2)
            if not is_zero(dx) and second is None:
                return jax.jvp(first.fun, at, (dx, filled(dv)))
            rates = [] if is_zero(dv) else [first(x, dv)]
            rates += [second(jnp.concatenate([x, taken(v), dx]))] if second else []
            return found, sum(rates[1:], rates[0]) if rates else jnp.zeros_like(found)

        return first

    along, back = linear(False), linear(True)

    def push(arguments, tangents):
        return values(*arguments), along(*arguments, *tangents)

    def pull(perturbed, arguments, found, g):
        return (back(*arguments, g),)

    values = with_rules(by_machine_code, Rules(push, pull))
    return values


def _both(graph: Graph, nodes: Sequence[int], variables: Sequence[int]) -> tuple[Callable, Callable]:
    """Values of nodes as a function of the values of the variables: by XLA, and by machine code.

    Machine code returns the numbers that are not zero: a whole matrix of 32 trailers lay beyond the end of its stack.
    """
    number = {n: k for k, n in enumerate(dict.fromkeys(n for n in nodes if n != graph.zero))}
    which = np.array([number.get(n, len(number)) for n in nodes], int)
    in_order = bool(number) and np.array_equal(which, np.arange(len(number)))
    kernel = nodes_called(graph, list(number), variables, effort=0)

    def placed(found, x):
        return found if in_order else jnp.append(found, jnp.zeros((), x.dtype))[which]

    def by_xla(x):
        found = [jnp.asarray(value, x.dtype) for value in run(graph, list(number), dict(zip(variables, x, strict=True)))]
        return placed(jnp.stack(found) if found else x[:0], x)

    return by_xla, lambda x: placed(kernel(x), x)
