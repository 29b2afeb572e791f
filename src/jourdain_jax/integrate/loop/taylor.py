"""Steps by Taylor series: coefficients of the state along its motion, the permitted length of a step, and the
state at any time within a step.

    y(t + s) = sum_{k=0}^p y_k s^k
    h = safety min((1/N_{p-1})^{1/(p-1)}, (1/N_p)^{1/p}),   N_k = rms(y_k/(atol + rtol |y_0|))

so that neither of the last two terms of the series exceeds the tolerance. The coefficients of y' = f(y) are
computed order by order, without loops:

    y_{k+1} = f_k/(k + 1)                                  x_k = x^(k)/k! of any number x along the solution
    (a b)_k = sum_{j=0}^k a_j b_{k-j}
    c = a/b:       c_k = (a_k - sum_{j=1}^k b_j c_{k-j})/b_0
    c = sqrt(a):   c_k = (a_k - sum_{j=1}^{k-1} c_j c_{k-j})/(2 c_0)
    c = a^e:       c_k = sum_{j=1}^k (e j/k - (k - j)/k) a_j c_{k-j}/a_0             (a constant exponent e)
    c = F(a, ..):  c_k = sum_{j=1}^k (j/k) a_j (dF/da)_{k-j} + ..                     (dF/da: by the graph)

Sums add the newest coefficients last, because all others are known much earlier. Source: A. Jorba and M. Zou,
Experimental Mathematics 14 (2005) 99, sections 2 and 3.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations
from typing import NamedTuple

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.integrate.loop.form import Form
from jourdain_jax.integrate.loop.lanes import Lanes, MachineWriter, stated
from jourdain_jax.integrate.loop.rate_functions import known_values, outputs_of
from jourdain_jax.kernels.ir import Value
from jourdain_jax.kernels.math_functions import exponential, logarithm
from jourdain_jax.kernels.scalar_program import as_real, unsupported, written
from jourdain_jax.program.derivative import on_its_own
from jourdain_jax.program.graph import Graph

_OWN = ("add", "sub", "neg", "mul", "div", "sqrt", "pow")  # operations that need no derivative on the graph
Coefficients = list[Value]


def reason_against(graph: Graph, outputs: Sequence[int]) -> str:
    """Return why there is no Taylor series of the outputs; empty if there is one."""
    for node in graph.reachable(outputs):
        op = graph.op[node]
        if op in ("const", "input"):
            continue
        if op not in TABLE or TABLE[op].kind in ("branch", "choice"):
            return f"`{op}` has no Taylor series"
        if op == "pow" and not graph.is_const(graph.args[node][1]):
            return "an exponent varies"
    return unsupported(graph, outputs)


class Series:
    """Taylor coefficients of the nodes of a graph along a solution, as nodes of the same graph.

    **Arguments:** `known`: nodes that are constant along the solution; `states` and `rates`: nodes of the
    state and of its rates; `order`: index of the last coefficient of the state; `clock`: node of time.
    """

    def __init__(
        self,
        graph: Graph,
        known: Iterable[int],
        states: Sequence[int],
        rates: Sequence[int],
        order: int,
        clock: int,
    ) -> None:
        self.graph = graph
        self.of = {n: [n] for n in (*known, *states)} | {clock: [clock, graph.one]}
        self.state = [self.of[n] for n in states]
        self._partial: dict[tuple[int, int], int] = {}  # node of a derivative, by function and argument index
        needed = self._with_derivatives(graph.needed(rates, self.of), set(self.of))
        self.of |= {node: [] for node in needed}
        for k in range(order):
            for node in needed:
                self.of[node].append(self._coefficient(node, k))
            for series, rate in zip(self.state, rates, strict=True):
                series.append(graph.div(self._at(rate, k), graph.const(k + 1)))

    def _at(self, node: int, k: int) -> int:
        """Return coefficient k of a node. Inputs have zero coefficients beyond those given."""
        return self.of[node][k] if k < len(self.of[node]) else self.graph.zero

    def _with_derivatives(self, nodes: Sequence[int], given: set[int]) -> list[int]:
        """Return the nodes and the derivatives that their recurrences need, in order of evaluation."""
        graph, found, left = self.graph, set(nodes), list(nodes)
        while left:
            node = left.pop()
            op, args = graph.operation(node)
            if op in (*_OWN, "const"):
                continue
            for i in range(len(args)):
                along = [graph.one if i == j else graph.zero for j in range(len(args))]
                derivative = self._partial[node, i] = TABLE[op].derivative(graph, node, *args, *along)
                new = [n for n in graph.needed([derivative], given) if n not in found]
                found |= set(new)
                left += new
        return sorted(found)

    def _coefficient(self, node: int, k: int) -> int:
        graph, op, args = self.graph, self.graph.op[node], self.graph.args[node]
        if k == 0 and op != "div":
            return node
        if op == "const":
            return graph.zero
        if op in ("add", "sub", "neg"):
            return graph.again(node, [self._at(a, k) for a in args])
        if op == "mul":
            return self._product(args[0], args[1], k, range(k + 1))
        if op == "div":
            rest = graph.sub(self._at(args[0], k), self._product(args[1], node, k, range(1, k + 1)))
            return graph.mul(rest, graph.div(graph.one, args[1]))
        if op == "sqrt":
            rest = graph.sub(self._at(args[0], k), self._product(node, node, k, range(1, k)))
            return graph.mul(rest, graph.div(graph.const(0.5), node))
        if op == "pow":
            e = graph.value[args[1]]
            terms = (
                graph.mul(graph.const((e * j - (k - j)) / k), self._term(args[0], node, j, k))
                for j in range(k, 0, -1)
            )
            return graph.mul(graph.total(terms), graph.div(graph.one, args[0]))
        found = [
            graph.mul(graph.mul(graph.const(j), self._at(a, j)), self._at(self._partial[node, i], k - j))
            for i, a in enumerate(args)
            for j in _newest_last(range(1, k + 1), k)
        ]
        return graph.div(graph.total(found), graph.const(k))

    def _product(self, a: int, b: int, k: int, js: range) -> int:
        """Return sum_j a_j b_{k-j}."""
        graph, ordered = self.graph, _newest_last(js, k)
        half = graph.total(self._term(a, a, j, k) for j in ordered if a == b and 2 * j > k)
        rest = graph.total(self._term(a, b, j, k) for j in ordered if a != b or 2 * j == k)
        return graph.add(rest, graph.add(half, half))

    def _term(self, a: int, b: int, j: int, k: int) -> int:
        return self.graph.mul(self._at(a, j), self._at(b, k - j))


def _newest_last(js: Sequence[int], k: int) -> list[int]:
    """Sort the indices j by the time at which both factors of a_j b_{k-j} are known."""
    return sorted(js, key=lambda j: max(j, k - j))


# a sum of products: for each product its varying factors, sorted, and its constant coefficient
Terms = list[tuple[tuple[int, ...], int]]


def with_few_products(graph: Graph, outputs: Sequence[int], moving: Iterable[int]) -> list[int]:
    """Return nodes with the same values, to round-off, and fewer products of varying factors, because each
    coefficient of a product costs a sum. `moving`: varying inputs.

    Sums and products are expanded into terms. Then the sharing that saves the most products is applied
    repeatedly: `x y` is computed once if several terms contain it, and `x y + x z` becomes `x (y + z)`. For
    example, the accelerations of a disc, with s, c = sin, cos of its lean, take 12 products at first, and 7
    with p = v w/c and q = c u:

           v (2 s w/c - 5/3 c u),   s (g + c u^2) + 6/5 c u w,   -2 v w/c
        -> 2 s p - 5/3 v q,         g s + q (s u + 6/5 w),       -2 p
    """
    one, nodes = graph.one, graph.reachable(outputs)
    signs = {"add": (one, one), "sub": (one, graph.const(-1.0)), "neg": (graph.const(-1.0),)}
    uses = Counter(a for n in nodes for a in graph.args[n])
    whole = {*outputs, *(a for n in nodes if graph.op[n] not in (*signs, "mul") for a in graph.args[n])}
    forms: dict[int, Terms] = {n: [((n,), one)] for n in moving}
    sums: dict[int, Terms] = {}  # sums that are factors or outputs; new sums have negative keys

    def named(n: int) -> Terms:
        sums[n] = forms[n]
        return [((n,), one)]

    for n in nodes:
        op, args = graph.operation(n)
        if forms.keys().isdisjoint(args):
            continue
        if op == "div":
            inverse = graph.div(one, args[1])
            forms |= {inverse: [((inverse,), one)]} if args[1] in forms else {}
            op, args = "mul", (args[0], inverse)
        parts = [forms.get(a) or [((), a)] for a in args]
        if op == "mul" and min(map(len, parts)) > 1 and len(parts[0]) * len(parts[1]) > 8:
            parts[0] = named(args[0])
        if op == "mul":
            forms[n] = [(tuple(sorted(f + g)), graph.mul(c, d)) for f, c in parts[0] for g, d in parts[1]]
        elif op in signs:
            forms[n] = [
                (f, graph.mul(c, sign)) for sign, part in zip(signs[op], parts, strict=True) for f, c in part
            ]
        else:
            forms[n] = [((n,), one)]
            continue
        if n in whole or uses[n] > 1 < len(forms[n]):
            own = named(n)
            forms[n] = own if len(forms[n]) > 1 else forms[n]

    while True:
        shared = Counter(pair for terms in sums.values() for f, _ in terms for pair in {*combinations(f, 2)})
        shared.update((n, x, n) for n, terms in sums.items() for f, _ in terms if len(f) > 1 for x in {*f})
        found, count = max(
            shared.items(), key=lambda item: (item[1], -len(item[0]), item[0]), default=((), 0)
        )
        if count < 2:
            break
        name, (a, b) = -len(sums) - 1, found[:2]
        if len(found) == 2:
            for n, terms in sums.items():
                sums[n] = [
                    ((name, *_without(f, a, b)) if found in combinations(f, 2) else f, c) for f, c in terms
                ]
            sums[name] = [(found, one)]
        else:
            inside = [term for term in sums[a] if b in term[0] and len(term[0]) > 1]
            sums[a] = [((name, b), one), *(term for term in sums[a] if term not in inside)]
            sums[name] = [(_without(f, b), c) for f, c in inside]

    new: dict[int, int] = {}

    def inverts(x: int) -> bool:
        return x > 0 and graph.op[x] == "div"

    def times(a: int, x: int) -> int:
        return graph.div(a, node(graph.args[x][1])) if inverts(x) else graph.mul(a, node(x))

    def node(n: int) -> int:
        if n not in new and n in sums:
            new[n] = graph.total(graph.mul(c, reduce(times, sorted(f, key=inverts), one)) for f, c in sums[n])
        elif n not in new:
            new[n] = graph.again(n, map(node, graph.args[n])) if n in forms and graph.args[n] else n
        return new[n]

    for n in nodes:  # in order of dependence, to avoid deep recursion
        node(n)
    return list(map(node, outputs))


def _without(factors: tuple[int, ...], *some: int) -> tuple[int, ...]:
    return tuple(sorted((Counter(factors) - Counter(some)).elements()))


@dataclass(frozen=True)
class TaylorSteps:
    """Taylor series of this order, used in place of a tableau."""

    order: int

    @property
    def needed(self) -> int:
        """Return the number of state vectors that a step stores: coefficients, and the rates at its end."""
        return self.order + 2

    @property
    def at_the_end(self) -> int:
        """Return the index of the rates at the end, relative to that of the rates at the start."""
        return self.order


class Monitored(NamedTuple):
    """Quantities that must not change sign."""

    holds: Value  # whether all guards are positive
    values: list[Value]  # as `Form.monitored`


def jet(w: MachineWriter, form: Form, p: Lanes, t: Value, order: int) -> tuple[list[Coefficients], Monitored]:
    """Return the Taylor series of the state, including tangents, at the time t, and the monitored quantities
    there.
    """
    y, rates = p.pointer, form.rates
    own = outputs_of(form, [*rates, *_monitored(form)], len(rates))
    known = dict(zip(own.variables, known_values(w, form, y, t, y).values(), strict=True))
    _, clock, states, _ = form.split(own.variables)
    given = {n: x for n, x in known.items() if n not in states} | dict(
        zip(own.known, stated(w, p, "dknown"), strict=True)
    )
    given |= dict(zip(own.times, p.every("dt"), strict=True)) if own.times else {}
    nodes = [n for part in (own.values[: len(rates)], *own.tangents, own.values[len(rates) :]) for n in part]
    # on a new graph, because node indices determine the order of evaluation
    graph, nodes, inputs = on_its_own(
        own.graph, nodes, [*given, *states, *(n for part in own.states for n in part)]
    )
    clock, fixed, varying = inputs[[*given].index(clock)], inputs[: len(given)], iter(inputs[len(given) :])
    moved = [
        next(varying) if i % form.y < form.q_and_v else graph.input(f"work {i}", True)
        for i in range(form.integrated)
    ]
    values = dict(zip(fixed, given.values(), strict=True)) | {n: w.load(y, i) for i, n in enumerate(moved)}
    series = Series(
        graph, fixed, moved, with_few_products(graph, nodes[: form.integrated], [*moved, clock]), order, clock
    ).state
    found = iter(
        written(
            w, graph, [*(n for row in series for n in row), *nodes[form.integrated :]], values, by_llvm=True
        )
    )
    return [[next(found) for _ in row] for row in series], _judged(w, form, list(found))


def products(form: Form, order: int) -> int:
    """Return the approximate number of multiplications per step, including tangents."""
    own = outputs_of(form, form.rates, form.y)
    nodes = own.graph.reachable([*own.values, *(n for part in own.tangents for n in part)])
    return (
        order
        * (order + 1)
        // 2
        * sum(own.graph.op[n] not in ("const", "input", "add", "sub", "neg") for n in nodes)
    )


def _monitored(form: Form) -> list[int]:
    return [*form.program.guards, *form.monitored]


def monitored_at(w: MachineWriter, form: Form, p: Lanes, t: Value, y: Value) -> Monitored:
    """Return the monitored quantities at a state in memory."""
    known = known_values(w, form, p.pointer, t, y)
    return _judged(w, form, written(w, form.program.graph, _monitored(form), known))


def _judged(w: MachineWriter, form: Form, values: Sequence[Value]) -> Monitored:
    found = [as_real(w, x) for x in values]
    count, holds = len(form.program.guards), w.literal(-1, w.truth)
    for guard in found[:count]:
        holds = holds & (guard > 0.0)
    return Monitored(holds, found[count:])


def radius(w: MachineWriter, form: Form, p: Lanes, rows: Sequence[Coefficients]) -> Value:
    """Return the permitted length of a step; zero if a coefficient is NaN."""
    rtol, atol, count = p["rtol"], p["atol"], form.q_and_v
    inverse = [1.0 / w.fma(rtol, w.magnitude(w.load(p.pointer, i)), atol) for i in range(count)]
    order, least = len(rows[0]) - 1, w.number(math.inf)  # of log h
    for k in (order - 1, order):
        square = w.number(0.0)  # of N_k, times `count`
        for x, share in zip(rows, inverse, strict=False):
            relative = x[k] * share
            square = w.fma(relative, relative, square)
        least = w.smaller(least, (-0.5 / k) * logarithm(w, square * (1.0 / count)))
    reach = w.where(least < math.inf, exponential(w, least), least)
    return 0.9 * w.where(w.is_nan(reach), 0.0, reach)


def at_time(w: MachineWriter, series: Coefficients, s: Value) -> Value:
    """Return `sum_k x_k s^k`."""
    total = series[-1]
    for x in reversed(series[:-1]):
        total = w.fma(total, s, x)
    return total


def slope(series: Coefficients) -> Coefficients:
    """Return the coefficients of the derivative."""
    return [x * float(k) for k, x in enumerate(series) if k]
