"""Arithmetic operations of a function of scalars, after common subexpressions are shared.

+, -, *, /, sqrt, sin, cos, a change of sign and any other elementwise operation count one each; an integer power counts as its multiplications
(by squaring) and, if negative, one division. What depends on parameters and constants alone, and what no output needs, does not count.
The arguments of + and * are put in one order first; nothing else is simplified.
"""

from collections import Counter
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal

_FREE = {"convert_element_type", "copy", "copy_p", "broadcast_in_dim", "reshape", "squeeze", "stop_gradient"}  # of scalars: no arithmetic
_COMMUTATIVE = {"add", "add_any", "mul", "max", "min"}


class _Program:
    """A graph of scalar operations in which equal expressions are one node."""

    def __init__(self):
        self.nodes: dict[tuple, int] = {}
        self.states: set[int] = set()  # nodes that depend on the time or the state

    def leaf(self, key: tuple, state: bool = False) -> int:
        node = self.nodes.setdefault(key, len(self.nodes))
        if state:
            self.states.add(node)
        return node

    def apply(self, operation: str, arguments: Sequence[int], details: str = "") -> int:
        arguments = tuple(sorted(arguments) if operation in _COMMUTATIVE else arguments)
        return self.leaf((operation, details, *arguments), any(a in self.states for a in arguments))

    def power(self, base: int, exponent: int) -> int:
        """`base ** exponent` by squaring."""
        if exponent < 0:
            return self.apply("div", (self.leaf(("constant", 1.0)), self.power(base, -exponent)))
        result, square = None, base
        while exponent:
            if exponent % 2:
                result = square if result is None else self.apply("mul", (result, square))
            exponent //= 2
            if exponent:
                square = self.apply("mul", (square, square))
        return self.leaf(("constant", 1.0)) if result is None else result

    def run(self, closed: ClosedJaxpr, inputs: Sequence[int]) -> list[int]:
        """Nodes of the outputs of a jaxpr whose inputs are the nodes given."""
        known = dict(zip(closed.jaxpr.invars, inputs, strict=True))
        known |= {v: self.leaf(("constant", float(c))) for v, c in zip(closed.jaxpr.constvars, closed.consts, strict=True)}

        def node(atom) -> int:
            return self.leaf(("constant", float(atom.val))) if isinstance(atom, Literal) else known[atom]

        for equation in closed.jaxpr.eqns:
            arguments = [node(a) for a in equation.invars]
            known |= dict(zip(equation.outvars, self._equation(equation, arguments), strict=True))
        return [node(a) for a in closed.jaxpr.outvars]

    def _equation(self, equation, arguments: list[int]) -> list[int]:
        name, details = equation.primitive.name, equation.params
        inner = details.get("jaxpr", details.get("call_jaxpr"))
        if inner is not None:
            return self.run(inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), arguments)
        if any(v.aval.shape for v in equation.outvars):
            raise ValueError(f"`{name}` gives an array, expected scalars only; write the function with one scalar per state and parameter")
        if name in _FREE:
            return arguments[:1]
        if name == "integer_pow":
            return [self.power(arguments[0], details["y"])]
        if name == "square":
            return [self.power(arguments[0], 2)]
        return [self.apply(name, arguments, str(sorted(details.items(), key=str)))]

    def needed(self, outputs: Sequence[int]) -> Counter[str]:
        """How often each operation is needed for the outputs, among those that depend on the state."""
        keys, waiting, seen = list(self.nodes), list(outputs), set()
        counted: Counter[str] = Counter()
        while waiting:
            node = waiting.pop()
            if node in seen or node not in self.states:
                continue
            seen.add(node)
            operation, _, *arguments = keys[node]
            if operation != "state":
                counted[operation] += 1
                waiting.extend(arguments)
        return counted


def count_operations(function: Callable, parameters: dict[str, float], coordinates: int, speeds: int) -> Counter[str]:
    """Operations of `function(parameters, t, q, v)` by name; their number is `.total()`.

    **Arguments:** `parameters`, scalars by name; `coordinates` and `speeds`, the lengths of the tuples `q` and `v`, whose entries are scalars.
    **Raises:** `ValueError` where an array is computed.
    """
    scalar, value = jnp.zeros(()), {name: jnp.asarray(number, float) for name, number in parameters.items()}
    closed = jax.make_jaxpr(function)(value, scalar, (scalar,) * coordinates, (scalar,) * speeds)
    program = _Program()
    inputs = [program.leaf(("parameter", i)) for i in range(len(value))]
    inputs += [program.leaf(("state", i), state=True) for i in range(1 + coordinates + speeds)]
    return program.needed(program.run(closed, inputs))
