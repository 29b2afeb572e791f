"""Derivatives on the graph, by forward mode: nodes for the derivative of nodes along a direction given at some of them."""

from collections.abc import Callable, Iterable

from jourdain_jax.program.graph import Graph
from jourdain_jax.program.interpret import Unsupported


def derivatives(graph: Graph, outputs: Iterable[int], direction: dict[int, int]) -> list[int]:
    """d output/ds for each output, where `direction[n]` is dn/ds; a node in `direction` is not looked into."""
    outputs = list(outputs)
    tangent: dict[int, int] = {}
    for node in graph.reachable(outputs):
        if node in direction:
            tangent[node] = direction[node]
        elif not graph.args[node]:
            tangent[node] = graph.zero
        else:
            tangent[node] = _derivative(graph, node, [tangent[a] for a in graph.args[node]])
    return [tangent[n] for n in outputs]


def _derivative(graph: Graph, node: int, dots: list[int]) -> int:
    op, args = graph.op[node], graph.args[node]
    if op == "select":
        return graph.zero if dots[1] == dots[2] == graph.zero else graph.call("select", args[0], dots[1], dots[2])
    if all(d == graph.zero for d in dots):
        return graph.zero
    if op not in _RULES:
        raise Unsupported(f"the derivative of `{op}`")
    return _RULES[op](graph, node, *args, *dots)


def _quotient(g: Graph, n, a, b, da, db):
    return g.div(g.sub(da, g.mul(n, db)), b)  # (a/b)' = (a' - (a/b) b')/b


def _larger(g: Graph, n, a, b, da, db):
    return g.call("select", g.call("ge", a, b), db, da)


def _smaller(g: Graph, n, a, b, da, db):
    return g.call("select", g.call("le", a, b), db, da)


def _arctangent(g: Graph, n, y, x, dy, dx):
    return g.div(g.sub(g.mul(x, dy), g.mul(y, dx)), g.add(g.mul(x, x), g.mul(y, y)))


_RULES: dict[str, Callable] = {
    "add": lambda g, n, a, b, da, db: g.add(da, db),
    "sub": lambda g, n, a, b, da, db: g.sub(da, db),
    "neg": lambda g, n, a, da: g.neg(da),
    "mul": lambda g, n, a, b, da, db: g.add(g.mul(da, b), g.mul(a, db)),
    "div": _quotient,
    "sin": lambda g, n, a, da: g.mul(g.call("cos", a), da),
    "cos": lambda g, n, a, da: g.neg(g.mul(g.call("sin", a), da)),
    "tan": lambda g, n, a, da: g.mul(g.add(g.one, g.mul(n, n)), da),
    "sqrt": lambda g, n, a, da: g.div(da, g.mul(g.const(2.0), n)),
    "exp": lambda g, n, a, da: g.mul(n, da),
    "log": lambda g, n, a, da: g.div(da, a),
    "tanh": lambda g, n, a, da: g.mul(g.sub(g.one, g.mul(n, n)), da),
    "sinh": lambda g, n, a, da: g.mul(g.call("cosh", a), da),
    "cosh": lambda g, n, a, da: g.mul(g.call("sinh", a), da),
    "atan": lambda g, n, a, da: g.div(da, g.add(g.one, g.mul(a, a))),
    "atan2": _arctangent,
    "abs": lambda g, n, a, da: g.mul(g.call("sign", a), da),
    "sign": lambda g, n, a, da: g.zero,
    "max": _larger,
    "min": _smaller,
    **{name: lambda g, n, *rest: g.zero for name in ("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite")},
}
