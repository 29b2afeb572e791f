"""Analyticity of expressions: an analytic expression that is zero at random states is zero everywhere.

Expressions of +, -, *, /, roots, sines and cosines are analytic; branches and opaque calls are not. Functions
that are constant to round-off over some range do not obey the rule either.
"""

from collections.abc import Callable, Collection, Iterable

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program.graph import Graph

NONANALYTIC = frozenset(name for name, operation in TABLE.items() if operation.kind != "analytic")
CALLS = frozenset({"opaque"})


def passes(graph: Graph, outputs: Iterable[int], kinds: Collection[str]) -> list[bool]:
    """Return, for each output, whether an operation of the given `kinds` occurs in a part that depends on
    time, state or inputs.
    """
    return _with(graph, outputs, lambda n: graph.op[n] in kinds and graph.varies[n])


def decided_by(
    graph: Graph, outputs: Iterable[int], variables: Iterable[int], kinds: Collection[str]
) -> bool:
    """Return whether any operation of the given `kinds` in the outputs depends on one of the variables."""
    outputs, variables = list(outputs), set(variables)
    decisions = [n for n in graph.reachable(outputs) if graph.op[n] in kinds]
    return any(depend_on(graph, decisions, variables))


def depend_on(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> list[bool]:
    """Return whether each output needs one of the variables."""
    variables = set(variables)
    return _with(graph, outputs, lambda n: n in variables)


def _with(graph: Graph, outputs: Iterable[int], wanted: Callable[[int], bool]) -> list[bool]:
    outputs = list(outputs)
    found: dict[int, bool] = {}
    for node in graph.reachable(outputs):
        found[node] = wanted(node) or any(found[a] for a in graph.args[node])
    return [found[n] for n in outputs]
