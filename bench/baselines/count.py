"""Arithmetic operations of a function of scalars, after common subexpressions are shared.

+, -, *, /, sqrt, sin, cos and a change of sign count one each. What depends on parameters and constants
alone, and what no output needs, does not count. The arguments of + and * are put in one order first; nothing
else is simplified.
"""

from collections import Counter
from dataclasses import dataclass
from types import SimpleNamespace


def _operator(name, swapped=False):
    def apply(*arguments):
        found = [
            x if isinstance(x, Scalar) else Scalar("number", (x,))
            for x in (reversed(arguments) if swapped else arguments)
        ]
        return Scalar(name, tuple(sorted(found, key=repr) if name in ("add", "mul") else found))

    return apply


@dataclass(frozen=True)
class Scalar:
    """An expression; equal ones are equal."""

    operation: str
    arguments: tuple

    __add__ = __radd__ = _operator("add")
    __mul__ = __rmul__ = _operator("mul")
    __sub__, __rsub__ = _operator("sub"), _operator("sub", True)
    __truediv__, __rtruediv__ = _operator("div"), _operator("div", True)
    __neg__ = _operator("neg")

    def needed(self) -> frozenset["Scalar"]:
        """This and all below it that depend on the time or the state, these themselves excepted where they
        are free of both.
        """
        below = frozenset().union(*(x.needed() for x in self.arguments if isinstance(x, Scalar)))
        return below | {self} if below or self.operation == "state" else below


FUNCTIONS = SimpleNamespace(
    **{name: _operator(name) for name in ("sin", "cos", "sqrt")},
    zeros_like=lambda x: Scalar("number", (0.0,)),
)


def count_operations(function, parameters, coordinates, speeds) -> Counter[str]:
    """Operations of `function(parameters, t, q, v, xp)` by name; their number is `.total()`."""
    states = [Scalar("state", (i,)) for i in range(1 + coordinates + speeds)]
    known = {name: Scalar("parameter", (name,)) for name in parameters}
    outputs = function(
        known, states[0], tuple(states[1 : 1 + coordinates]), tuple(states[1 + coordinates :]), xp=FUNCTIONS
    )
    needed = frozenset().union(*(x.needed() for part in outputs for x in part))
    return Counter(x.operation for x in needed if x.operation != "state")
