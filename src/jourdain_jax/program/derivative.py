"""Derivatives on the graph, by forward mode: nodes for the derivative of nodes along a direction given at some of them."""

import functools
import math
from collections.abc import Callable, Iterable, Mapping

from jourdain_jax.program.graph import Graph, Unsupported


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


def jacobian(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> list[dict[int, int]]:
    """Of each output, its derivatives with respect to the variables (nodes that are not looked into) on which it depends."""
    return directional_derivative(graph, outputs, {n: {n: graph.one} for n in variables})


def directional_derivative(graph: Graph, outputs: Iterable[int], directions: Mapping[int, Mapping[int, int]]) -> list[dict[int, int]]:
    """Of each output, its derivatives along those named directions in which it changes, in one sweep; `directions[k][n]` is dn/ds in direction k.

    Nodes in any direction are not looked into in any other.
    """
    outputs = list(outputs)
    tangents: dict[int, dict[int, int]] = {}
    for k, direction in directions.items():
        for n, rate in direction.items():
            tangents.setdefault(n, {})
            if rate != graph.zero:
                tangents[n][k] = rate
    for node in graph.needed(outputs, ()):
        if node not in tangents:
            of_args = [tangents[a] for a in graph.args[node]]
            moving = dict.fromkeys(k for tangent in of_args for k in tangent)
            found = {k: _derivative(graph, node, [tangent.get(k, graph.zero) for tangent in of_args]) for k in moving}
            tangents[node] = {k: rate for k, rate in found.items() if rate != graph.zero}
    return [tangents[n] for n in outputs]


def columns(graph: Graph, outputs: Iterable[int], variables: Iterable[int]) -> list[list[int]]:
    """Derivatives of all outputs with respect to each variable: the columns of the Jacobian, zeros among them."""
    variables, rows = list(variables), jacobian(graph, outputs, variables)
    return [[row.get(n, graph.zero) for row in rows] for n in variables]


def _derivative(graph: Graph, node: int, dots: list[int]) -> int:
    op, args = graph.op[node], graph.args[node]
    if op == "select":
        return graph.zero if dots[1] == dots[2] == graph.zero else graph.call("select", args[0], dots[1], dots[2])
    if all(d == graph.zero for d in dots):
        return graph.zero
    if op == "array":  # that it moves; the call of it has no derivative here
        return graph.one
    if op == "kept":
        raise Unsupported(graph.value[node].reason)
    if op not in _RULES:
        raise Unsupported(f"the derivative of `{op}`")
    return _RULES[op](graph, node, *args, *dots)


def _quotient(g: Graph, n, a, b, da, db):
    return g.div(g.sub(da, g.mul(n, db)), b)  # (a/b)' = (a' - (a/b) b')/b


def _larger(g: Graph, n, a, b, da, db):
    return _halved_where_equal(g, a, b, g.call("select", g.call("gt", a, b), db, da), da, db)


def _smaller(g: Graph, n, a, b, da, db):
    return _halved_where_equal(g, a, b, g.call("select", g.call("lt", a, b), db, da), da, db)


def _halved_where_equal(g: Graph, a, b, otherwise, da, db):
    """Half of either, as JAX has it: max(x, 0) - max(-x, 0) is smooth at x = 0."""
    return g.call("select", g.call("eq", a, b), otherwise, g.mul(g.const(0.5), g.add(da, db)))


def _real_power(g: Graph, n, a, b, da, db):
    """(a^b)' = b a^(b-1) a' + a^b log(a) b'; the first term is zero where a and b are, the second where a is (a^b log a -> 0 for b > 0)"""
    of_base, of_exponent = g.zero, g.zero
    if da != g.zero:
        of_base = g.mul(g.mul(b, g.call("pow", a, _unless_zero(g, (a, b), g.sub(b, g.one)))), da)
    if db != g.zero:
        of_exponent = g.mul(g.mul(n, g.call("log", _unless_zero(g, (a,), a))), db)
    return g.add(of_base, of_exponent)


def _unless_zero(g: Graph, nodes: tuple[int, ...], value):
    """The value, and 1 where all of the nodes are zero."""
    if any(g.is_const(n) and g.value[n] for n in nodes):
        return value
    vanish = [g.call("eq", n, g.zero) for n in nodes]
    return g.call("select", functools.reduce(lambda a, b: g.call("and", a, b), vanish), value, g.one)


def _remainder(g: Graph, n, a, b, da, db):
    return g.sub(da, g.mul(g.div(g.sub(a, n), b), db))  # a = k b + n with a whole k


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
    "asin": lambda g, n, a, da: g.div(da, g.call("sqrt", g.sub(g.one, g.mul(a, a)))),
    "acos": lambda g, n, a, da: g.neg(g.div(da, g.call("sqrt", g.sub(g.one, g.mul(a, a))))),
    "atan": lambda g, n, a, da: g.div(da, g.add(g.one, g.mul(a, a))),
    "asinh": lambda g, n, a, da: g.div(da, g.call("sqrt", g.add(g.mul(a, a), g.one))),
    "acosh": lambda g, n, a, da: g.div(da, g.mul(g.call("sqrt", g.sub(a, g.one)), g.call("sqrt", g.add(a, g.one)))),
    "atanh": lambda g, n, a, da: g.div(da, g.sub(g.one, g.mul(a, a))),
    "exp2": lambda g, n, a, da: g.mul(g.mul(n, g.const(math.log(2.0))), da),
    "expm1": lambda g, n, a, da: g.mul(g.add(n, g.one), da),
    "log1p": lambda g, n, a, da: g.div(da, g.add(g.one, a)),
    "logistic": lambda g, n, a, da: g.mul(g.mul(n, g.sub(g.one, n)), da),
    "cbrt": lambda g, n, a, da: g.div(da, g.mul(g.const(3.0), g.mul(n, n))),
    "pow": _real_power,
    "rem": _remainder,
    "atan2": _arctangent,
    "abs": lambda g, n, a, da: g.mul(g.call("select", g.call("ge", a, g.zero), g.const(-1.0), g.one), da),  # 1 at zero: so powers of |x| are smooth
    "sign": lambda g, n, a, da: g.zero,
    "max": _larger,
    "min": _smaller,
    **{name: lambda g, n, *rest: g.zero for name in ("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite", "floor", "ceil", "round")},
}
