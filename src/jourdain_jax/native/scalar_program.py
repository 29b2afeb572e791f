"""A graph of scalars as LLVM IR: one vector per node, one lane per motion.

A product that only one sum or difference uses is fused with it. Truth values are vectors of bits; where one meets a number it counts as 0 or 1.
"""

from collections.abc import Iterable, Mapping
from typing import Any

from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.math_functions import FUNCTIONS, sine_and_cosine
from jourdain_jax.program.graph import ARRAYS, Graph

_TRUTHS = {"and": "and", "or": "or"}


def unsupported(graph: Graph, nodes: Iterable[int]) -> str:
    """Why the nodes cannot be written as machine code; empty where they can."""
    known = {*FUNCTIONS, *_TRUTHS, *ARRAYS, "not", "select", "sin", "cos", "const", "input"}
    for node in graph.reachable(nodes):
        if graph.op[node] in ARRAYS or graph.op[node] == "entry":
            return "a part of it is kept as a call of JAX"
        if graph.op[node] not in known:
            return f"`{graph.op[node]}` is none of its operations"
    return ""


def written(w: Writer, graph: Graph, outputs: Iterable[int], known: Mapping[int, Value]) -> list[Value]:
    """Values of the outputs, given those of inputs and of nodes computed before."""
    outputs = list(outputs)
    needed = graph.needed(outputs, known)
    fusible = _used_once_in_a_sum(graph, needed, outputs)
    values: dict[int, Value] = dict(known)
    waves: dict[int, tuple[Value, Value]] = {}
    for node in needed:
        op, args = graph.op[node], graph.args[node]
        if op == "const":
            values[node] = w.number(graph.value[node])
        elif op in ("sin", "cos"):
            if args[0] not in waves:
                waves[args[0]] = sine_and_cosine(w, as_real(w, values[args[0]]))
            values[node] = waves[args[0]][op == "cos"]
        elif op in ("add", "sub") and any(a in fusible for a in args):
            values[node] = _fused(w, graph, op, args, fusible, values)
        elif node not in fusible:
            values[node] = _operation(w, op, [values[a] for a in args])
    return [values[n] for n in outputs]


def as_real(w: Writer, a: Value) -> Value:
    """A truth value as 0 or 1."""
    return w.converted("uitofp", a, w.real) if a.type == w.truth else a


def as_truth(w: Writer, a: Value) -> Value:
    """Whether a number is not zero."""
    return a if a.type == w.truth else a.differs(0.0)


def _operation(w: Writer, op: str, args: list[Value]) -> Value:
    if op in _TRUTHS:
        return w.bitwise(_TRUTHS[op], as_truth(w, args[0]), as_truth(w, args[1]))
    if op == "not":
        return ~as_truth(w, args[0])
    if op == "select":
        condition, a, b = args
        if a.type != b.type:
            a, b = as_real(w, a), as_real(w, b)
        return w.where(as_truth(w, condition), b, a)
    return FUNCTIONS[op](w, *(as_real(w, a) for a in args))


def _used_once_in_a_sum(graph: Graph, nodes: Iterable[int], outputs: list[int]) -> set[int]:
    """Products that one sum or difference uses, and nothing else."""
    users: dict[int, list[Any]] = {n: [""] for n in outputs}
    products = set()
    for node in nodes:
        if graph.op[node] == "mul":
            products.add(node)
        for a in graph.args[node]:
            users.setdefault(a, []).append(graph.op[node])
    return {n for n in products if users.get(n) in (["add"], ["sub"])}


def _fused(w: Writer, graph: Graph, op: str, args: tuple[int, ...], fusible: set[int], values: Mapping[int, Value]) -> Value:
    """x y + b, b - x y or x y - b, where only the first product of two is fused."""
    which = 0 if args[0] in fusible else 1
    x, y = (as_real(w, values[a]) for a in graph.args[args[which]])
    other = args[1 - which]
    b = FUNCTIONS["mul"](w, *(as_real(w, values[a]) for a in graph.args[other])) if other in fusible else as_real(w, values[other])
    if op == "sub":
        x, b = (x, -b) if which == 0 else (-x, b)
    return w.fma(x, y, b)
