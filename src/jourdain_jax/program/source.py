"""Source code of a graph: readable Python, C, or SymPy expressions, with names for values used more than
once.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program.graph import Graph


@dataclass(frozen=True)
class Language:
    """Syntax of expressions and statements."""

    name: str  # field of `Operation` with the source form
    library: str
    assignment: str
    infinity: str

    @property
    def names(self) -> set[str]:
        """Return the names of all functions in this language."""
        return {getattr(operation, self.name) or name for name, operation in TABLE.items()}

    def written(self, op: str, operands: list[str]) -> str:
        """Return the source of an operation on `operands`."""
        form = getattr(TABLE[op], self.name) or self.library + op
        return f"({form.format(*operands)})" if "{" in form else f"{form}({', '.join(operands)})"


PYTHON = Language("python", "math.", "    {name} = {value}", "math.inf")
C = Language("c", "", "    const double {name} = {value};", "INFINITY")


def statements(
    graph: Graph, outputs: Sequence[int], names: Mapping[int, str], language: Language, prefix: str = "s"
) -> tuple[list[str], list[str]]:
    """Return lines that name values used more than once, and the expressions of the outputs. `names`: node ->
    name, for inputs and known nodes.
    """
    nodes = _needed(graph, outputs, names)
    uses = Counter([*outputs, *(a for node in nodes for a in graph.args[node])])
    written: dict[int, tuple[str, int]] = {n: (name, 9) for n, name in names.items()}  # text and precedence
    lines: list[str] = []
    for node in nodes:
        text, binds = _expression(graph, node, written, language)
        # name expressions longer than 110 characters
        if graph.args[node] and (uses[node] > 1 or len(text) > 110) and binds < 9:
            name = f"{prefix}{len(lines)}"
            lines.append(language.assignment.format(name=name, value=text))
            text, binds = name, 9
        written[node] = text, binds
    return lines, [written[n][0] for n in outputs]


def _needed(graph: Graph, outputs: Sequence[int], names: Mapping[int, str] | dict) -> list[int]:
    """Return the nodes to write, in order. Raises ValueError if a JAX call is among them."""
    nodes = graph.needed(outputs, names)
    reasons = dict.fromkeys(graph.value[n].reason for n in nodes if graph.op[n] == "opaque")
    if reasons:
        raise ValueError(
            f"calls of JAX ({'; '.join(reasons)}) cannot be written as source; rewrite the load or event "
            "that contains them in scalar operations, or print the scene without it"
        )
    return nodes


def _expression(graph: Graph, node: int, written, language: Language) -> tuple[str, int]:
    op, args = graph.operation(node)
    if op == "const":
        value = graph.value[node]
        infinity = language.infinity if value > 0 else f"-{language.infinity}"
        return repr(value) if abs(value) < float("inf") else infinity, 9 if value >= 0 else 1
    if op == "input":
        return str(graph.value[node]), 9
    if op == "neg":
        return "-" + _inside(written[args[0]], 3), 1
    if infix := TABLE[op].infix:
        sign, level = infix
        left, right = written[args[0]], written[args[1]]
        return f"{_inside(left, level)} {sign} {_inside(right, level + (op != 'add'))}", level
    return language.written(op, [written[a][0] for a in args]), 9


def _inside(part: tuple[str, int], level: int) -> str:
    text, binds = part
    return text if binds >= level else f"({text})"


def sympy_expressions(graph: Graph, outputs: Sequence[int], names: Mapping[int, str]) -> list:
    """Return the outputs as SymPy expressions; requires SymPy."""
    import sympy

    values: dict = {n: sympy.Symbol(name) for n, name in names.items()}
    for node in _needed(graph, outputs, values):
        op = graph.op[node]
        if op == "const":
            value = graph.value[node]
            exact = abs(value) < 1e6
            values[node] = sympy.nsimplify(value, rational=True) if exact else sympy.Float(value)
        else:
            function = TABLE[op].sympy
            args = [values[a] for a in graph.args[node]]
            values[node] = function(sympy, *args) if function else getattr(sympy, op)(*args)
    return [values[n] for n in outputs]
