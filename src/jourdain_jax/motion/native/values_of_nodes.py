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
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from jourdain_jax.calculus.differentiated_as import Rules, differentiated_as, with_rules
from jourdain_jax.lowering.jacobian import on_its_own
from jourdain_jax.motion.native.called import nodes_called
from jourdain_jax.native.scalar_program import unsupported
from jourdain_jax.program.derivative import cotangents, derivatives
from jourdain_jax.program.emit import run
from jourdain_jax.program.graph import Graph, Unsupported


def values_of_nodes(graph: Graph, places: dict[int, int], size: int, variables: Sequence[int]) -> Callable[[Array], Array]:
    """Values of nodes, at their places among so many numbers that are zero otherwise, as a function of the values of the variables."""
    program = Derivatives(graph, places, size, variables)

    def push(arguments, tangents):
        return values(*arguments), program.along(*arguments, *tangents)

    def pull(perturbed, arguments, found, g):
        return (program.back(*arguments, g),)

    values = with_rules(program.values, Rules(push, pull))
    return values


class Derivatives:
    """Machine code of derivatives of values of nodes, as of `values_of_nodes`."""

    along: Callable[[Array, Array], Array]  # f'(x) v as a function of x and v
    back: Callable[[Array, Array], Array]  # g f'(x) as a function of x and g

    def __init__(self, graph: Graph, places: dict[int, int], size: int, variables: Sequence[int]) -> None:
        places = dict(sorted(places.items()))
        self.graph, nodes, self.variables = on_its_own(graph, list(places.values()), variables)
        self.places, self.size = dict(zip(places, nodes, strict=True)), size
        self._by_xla, self.values = _by_xla_and_machine_code(self.graph, self.places, size, self.variables)
        self._function = cache(self._made)
        self.along, self.back = self._linear(back=False), self._linear(back=True)

    def _linear(self, back: bool) -> Callable[[Array, Array], Array]:
        """A function of x and v, or (`back`) g; its derivative along x is machine code where that serves."""

        def taken(v):
            return v[np.array(list(self.places), int)] if back else v

        def first(x, v):
            if (function := self._function(back, 1)) is not None:
                return function(jnp.concatenate([x, taken(v)]))
            return jax.vjp(self._by_xla, x)[1](v)[0] if back else jax.jvp(self._by_xla, (x,), (v,))[1]

        linear = jax.custom_jvp(first)

        @partial(linear.defjvp, symbolic_zeros=True)
        def rule(at, tangents):
            found, (dx, dv) = linear(*at), tangents
            moves, turns = (not isinstance(d, SymbolicZero) for d in tangents)
            second = self._function(back, 2) if moves else None
            if moves and second is None:
                return jax.jvp(first, at, (dx, dv if turns else jnp.zeros_like(at[1])))
            rates = [linear(at[0], dv)] if turns else []
            rates += [second(jnp.concatenate([at[0], taken(at[1]), dx]))] if second else []
            return found, sum(rates[1:], rates[0]) if rates else jnp.zeros_like(found)

        return linear

    def _made(self, back: bool, order: int) -> Callable[[Array], Array] | None:
        """The derivative as a function of x, v or g, and w in a row; None where it is too large, or no machine code."""
        graph, variables, size = self.graph, self.variables, len(self.places if back else self.variables)
        weights, w = ([graph.input(f"{name} {i}", True) for i in range(count)] for name, count in (("v", size), ("w", len(variables))))

        def along(nodes, direction: list[int]) -> list[int]:
            return derivatives(graph, nodes, dict(zip(variables, direction, strict=True)))

        try:
            nodes = along(self.places.values(), w) if order == 2 else list(self.places.values())
            if back:
                found = dict(enumerate(cotangents(graph, nodes, weights, variables)))
            else:
                found = dict(zip(self.places, along(nodes, weights), strict=True))
        except Unsupported:
            return None
        found = {place: node for place, node in found.items() if node != graph.zero}
        # operations of a derivative; machine code of so many takes 1.4 MB of the stack, and 0.3 s to make
        if unsupported(graph, found.values()) or graph.operations(found.values()) > 40_000:
            return None
        given = [*variables, *weights, *(w if order == 2 else ())]
        return differentiated_as(*_by_xla_and_machine_code(graph, found, len(variables) if back else self.size, given))


def _by_xla_and_machine_code(graph: Graph, places: dict[int, int], size: int, variables: Sequence[int]) -> tuple[Callable, Callable]:
    """Values of nodes at their places, as a function of the values of the variables: by XLA, and by machine code.

    Machine code returns the numbers that are not zero: a whole matrix of 32 trailers lay beyond the end of its stack.
    """
    nodes = list(dict.fromkeys(places.values()))
    number = {n: k for k, n in enumerate(nodes)}
    which = np.full(size, len(nodes))
    which[list(places)] = [number[n] for n in places.values()]
    in_order = bool(nodes) and np.array_equal(which, np.arange(len(nodes)))
    kernel = nodes_called(graph, nodes, variables, effort=0)

    def placed(found, x):
        return jnp.concatenate(found) if in_order else jnp.concatenate([*found, jnp.zeros(1, x.dtype)])[which]

    def by_xla(x):
        return placed([jnp.asarray(value, x.dtype)[None] for value in run(graph, nodes, dict(zip(variables, x, strict=True)))], x)

    return by_xla, lambda x: placed([kernel(x)], x)
