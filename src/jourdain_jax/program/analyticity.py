"""What no probe need show: an expression of +, -, *, /, roots and waves that is zero at random states is zero everywhere; one with a branch, a function
that is flat somewhere, or a call, may begin later or elsewhere.
"""

from collections.abc import Callable, Iterable

from jourdain_jax.program.graph import BRANCHES, Graph

FLAT_SOMEWHERE = {"exp", "exp2", "expm1", "log1p", "sinh", "cosh", "tanh", "logistic"}
HIDING = {*BRANCHES, *FLAT_SOMEWHERE, "select", "is_finite", "kept"}


def is_nonanalytic(graph: Graph, outputs: Iterable[int]) -> list[bool]:
    """Of each output, whether it is made of something that may begin where no probe lies, in the course of time, state or inputs."""
    return _with(graph, outputs, lambda n: graph.op[n] in HIDING and graph.varies[n])


def decided_by(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> bool:
    """Whether anything of that kind on the way to the outputs is decided by one of the variables."""
    outputs, variables = list(outputs), set(variables)
    hiding = [n for n in graph.reachable(outputs) if graph.op[n] in HIDING]
    return any(depend_on(graph, hiding, variables))


def depend_on(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> list[bool]:
    """Of each output, whether it needs one of the variables."""
    variables = set(variables)
    return _with(graph, outputs, lambda n: n in variables)


def _with(graph: Graph, outputs: Iterable[int], wanted: Callable[[int], bool]) -> list[bool]:
    outputs = list(outputs)
    found: dict[int, bool] = {}
    for node in graph.reachable(outputs):
        found[node] = wanted(node) or any(found[a] for a in graph.args[node])
    return [found[n] for n in outputs]
