"""Steps by Taylor series: the coefficients of a state along its motion, how far they reach, and the state at any time within reach.

    y(t + s) = sum_{k=0}^p y_k s^k,        h = safety min((1/N_{p-1})^{1/(p-1)}, (1/N_p)^{1/p}),   N_k = rms(y_k/(atol + rtol |y_0|))

so that neither of the last two terms of a step is larger than what is allowed. The coefficients of y' = f(y) are written out order by order:

    y_{k+1} = f_k/(k + 1)                                  x_k = x^(k)/k! of any number x along the solution
    (a b)_k = sum_{j=0}^k a_j b_{k-j}
    c = a/b:       c_k = (a_k - sum_{j=1}^k b_j c_{k-j})/b_0
    c = sqrt(a):   c_k = (a_k - sum_{j=1}^{k-1} c_j c_{k-j})/(2 c_0)
    c = a^e:       c_k = sum_{j=1}^k (e j/k - (k - j)/k) a_j c_{k-j}/a_0             (a constant exponent e)
    c = F(a, ..):  c_k = sum_{j=1}^k (j/k) a_j (dF/da)_{k-j} + ..                     with the derivative on the graph, for all other functions

Sums add the newest coefficients last: all others are known long before. Source: A. Jorba and M. Zou, Experimental Mathematics 14 (2005) 99, sections 2 and 3.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.motion.native.functions import known_values, outputs_of
from jourdain_jax.motion.native.layout import Form, Lanes
from jourdain_jax.native.angles import sine_and_cosine
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.math_functions import FUNCTIONS, exponential, logarithm
from jourdain_jax.native.scalar_program import as_real, unsupported, written
from jourdain_jax.program.graph import Graph

_OWN = ("add", "sub", "neg", "mul", "div", "sqrt", "pow")  # that need no derivative on the graph
Coefficients = list[Value | None]  # None: zero


def reason_against(graph: Graph, outputs: Sequence[int]) -> str:
    """Why a series of the outputs cannot be written, in words; empty where it can."""
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
    """Coefficients of all numbers of a graph along the solution with these rates.

    **Arguments:** `known`, the values of what does not vary and of the time; `states` and `rates`, the nodes of the state's numbers (None: one that no rate
    depends on) and of their rates; `start`, values of the state; `order`, of the last coefficient of the state; `clock`, the node of the time.
    """

    def __init__(self, w: Writer, graph: Graph, known: Mapping[int, Value], states: Sequence[int | None], rates, start, order: int, clock: int) -> None:
        self.w, self.graph, self.order = w, graph, order
        self.of: dict[int, Coefficients] = {node: [value] for node, value in known.items()}
        self.of[clock] = [known[clock], w.number(1.0)]
        self.state: list[Coefficients] = [[value] for value in start]
        self.of |= {node: series for node, series in zip(states, self.state, strict=True) if node is not None}
        self._rates = {node: rate for node, rate in zip(states, rates, strict=True) if node is not None}
        self._partial: dict[tuple[int, int], int] = {}  # of a function and the number of an argument: the derivative's node
        self._scaled: dict[tuple[int, int], Value | None] = {}
        self._inverse: dict[int, Value] = {}
        self._waves: dict[int, tuple[Value, Value]] = {}
        given = set(self.of)
        needed = self._with_derivatives(graph.needed(rates, given), given)
        for node in needed:
            self.of[node] = []
        for k in range(order):
            for node in needed:
                self.of[node].append(self._coefficient(node, k))
            for series, rate in zip(self.state, rates, strict=True):
                found = self.at(rate, k)
                series.append(found if found is None or k == 0 else found * (1.0 / (k + 1)))

    def at(self, node: int, k: int) -> Value | None:
        """The coefficient of a node; those beyond the last one known of what is given are zero."""
        series = self.of[node]
        return series[k] if k < len(series) else None

    def _with_derivatives(self, nodes: Sequence[int], given: set[int]) -> list[int]:
        """The nodes in order, with those of the derivatives that their recurrences ask for."""
        graph, found, left = self.graph, set(nodes), list(nodes)
        while left:
            node = left.pop()
            op, args = graph.op[node], graph.args[node]
            if op in (*_OWN, "const"):
                continue
            for i in range(len(args)):
                along = [graph.one if i == j else graph.zero for j in range(len(args))]
                derivative = self._partial[node, i] = TABLE[op].derivative(graph, node, *args, *along)
                new = [n for n in graph.needed([derivative], given) if n not in found]
                found |= set(new)
                left += new
        return sorted(found)

    def _coefficient(self, node: int, k: int) -> Value | None:
        graph, w, op, args = self.graph, self.w, self.graph.op[node], self.graph.args[node]
        if op == "const":
            return w.number(graph.value[node]) if k == 0 else None
        if op in ("add", "sub"):
            return _sum(self.at(args[0], k), self.at(args[1], k), op)
        if op == "neg":
            a = self.at(args[0], k)
            return None if a is None else -a
        if k == 0:
            return self._value(node)
        if op == "mul":
            return self._product(args[0], args[1], k, range(k + 1))
        if op == "div":
            rest = _sum(self.at(args[0], k), self._product(args[1], node, k, range(1, k + 1)), "sub")
            return None if rest is None else rest * self._reciprocal(args[1])
        if op == "sqrt":
            rest = _sum(self.at(args[0], k), self._product(node, node, k, range(1, k)), "sub")
            return None if rest is None else rest * 0.5 * self._reciprocal(node)
        if op == "pow":
            e = graph.value[args[1]]
            total = self._convolved([(self.at(args[0], j), self.at(node, k - j), (e * j - (k - j)) / k) for j in range(k, 0, -1)])
            return None if total is None else total * self._reciprocal(args[0])
        total = None
        for i, a in enumerate(args):
            derivative = self._partial[node, i]
            terms = [(self._times_order(a, j), self.at(derivative, k - j), 1.0) for j in _newest_last(range(1, k + 1), k)]
            total = _sum(total, self._convolved(terms), "add")
        return None if total is None else total * (1.0 / k)

    def _value(self, node: int) -> Value:
        op, args = self.graph.op[node], self.graph.args[node]
        values = [self.of[a][0] or self.w.number(0.0) for a in args]
        if op in ("sin", "cos"):
            if args[0] not in self._waves:
                self._waves[args[0]] = sine_and_cosine(self.w, values[0])
            return self._waves[args[0]][op == "cos"]
        if op == "div":
            return values[0] * self._reciprocal(args[1])
        return FUNCTIONS[op](self.w, *values)

    def _reciprocal(self, node: int) -> Value:
        if node not in self._inverse:
            self._inverse[node] = 1.0 / (self.of[node][0] or self.w.number(0.0))
        return self._inverse[node]

    def _times_order(self, node: int, j: int) -> Value | None:
        """j a_j"""
        if node in self._rates and j > 1:
            return self.at(self._rates[node], j - 1)
        if (node, j) not in self._scaled:
            a = self.at(node, j)
            self._scaled[node, j] = a if a is None or j == 1 else a * float(j)
        return self._scaled[node, j]

    def _product(self, a: int, b: int, k: int, js: range) -> Value | None:
        """sum_j a_j b_{k-j}"""
        if a != b:
            return self._convolved([(self.at(a, j), self.at(b, k - j), 1.0) for j in _newest_last(js, k)])
        halves = self._convolved([(self.at(a, j), self.at(a, k - j), 1.0) for j in _newest_last([j for j in js if 2 * j > k], k)])
        middle = self.at(a, k // 2) if k % 2 == 0 and k // 2 in js else None
        if middle is None:
            return None if halves is None else halves + halves
        return middle * middle if halves is None else self.w.fma(middle, middle, halves + halves)

    def _convolved(self, terms: Sequence[tuple[Value | None, Value | None, float]]) -> Value | None:
        total = None
        for a, b, weight in terms:
            if a is None or b is None or weight == 0.0:
                continue
            a = a if weight == 1.0 else a * weight
            total = a * b if total is None else self.w.fma(a, b, total)
        return total


def _newest_last(js: Sequence[int], k: int) -> list[int]:
    """The numbers j in the order in which both factors of a_j b_{k-j} are known."""
    return sorted(js, key=lambda j: max(j, k - j))


def _sum(a: Value | None, b: Value | None, op: str) -> Value | None:
    if b is None:
        return a
    if a is None:
        return b if op == "add" else -b
    return a + b if op == "add" else a - b


@dataclass(frozen=True)
class TaylorSteps:
    """Taylor series up to this order, in place of a tableau."""

    order: int

    @property
    def needed(self) -> int:
        """Rows of a state that a step keeps: the coefficients, and the slope at its end."""
        return self.order + 2

    @property
    def at_the_end(self) -> int:
        """The place of the slope at the end, counted from that at the start."""
        return self.order


class Monitored(NamedTuple):
    """What must not change its sign."""

    holds: Value  # whether all guards are positive
    values: list[Value]  # as `Form.monitored`, pivots relative to their usual sizes


def jet(w: Writer, form: Form, p: Lanes, t: Value, order: int) -> tuple[list[Coefficients], Monitored]:
    """The Taylor series of every number that is integrated, tangents too, at the time t, and what is monitored there."""
    y, rates = p.pointer, form.rates
    own = outputs_of(form, [*rates, *_monitored(form)], len(rates))
    known = dict(zip(own.variables, known_values(w, form, y, t, y).values(), strict=True))
    _, clock, states, _ = form.split(own.variables)
    given = {n: x for n, x in known.items() if n not in states} | dict(zip(own.known, p.every("dknown"), strict=True))
    given |= dict(zip(own.times, p.every("dt"), strict=True)) if own.times else {}

    def with_work(nodes: list[int], other: int | None) -> list:
        return [*nodes, *[other] * (form.y - len(nodes))]

    moved = [n for part in (states, *own.states) for n in with_work(part, None)]
    nodes = [n for part in (own.values[: len(rates)], *own.tangents) for n in with_work(part, own.graph.zero)]
    start = [w.load(y, i) for i in range(form.integrated)]
    found = Series(w, own.graph, given, moved, nodes, start, order, clock)
    values = {n: w.number(0.0) if x[0] is None else x[0] for n, x in found.of.items()}
    return found.state, _evaluated(w, form, own.graph, own.values[len(rates) :], values, known)


def products(form: Form, order: int) -> int:
    """About how many multiplications a step takes, tangents and all."""
    own = outputs_of(form, form.rates, form.y)
    nodes = own.graph.reachable([*own.values, *(n for part in own.tangents for n in part)])
    return order * (order + 1) // 2 * sum(own.graph.op[n] not in ("const", "input", "add", "sub", "neg") for n in nodes)


def _monitored(form: Form) -> list[int]:
    return [*form.program.guards, *form.monitored]


def monitored_at(w: Writer, form: Form, p: Lanes, t: Value, y: Value) -> Monitored:
    """What is monitored, at a state in memory."""
    known = known_values(w, form, p.pointer, t, y)
    return _evaluated(w, form, form.program.graph, _monitored(form), known, known)


def _evaluated(w: Writer, form: Form, graph, nodes: Sequence[int], values: Mapping[int, Value], known: Mapping[int, Value]) -> Monitored:
    found, of_variables = [as_real(w, x) for x in written(w, graph, nodes, values)], list(known.values())
    count, holds = len(form.program.guards), w.literal(-1, w.truth)
    for guard in found[:count]:
        holds = holds & (guard > 0.0)
    sizes = [of_variables[form.program.variables.index(n)] for n in form.program.sizes[: form.pivots]]
    pivots = [x / size for x, size in zip(found[count:], sizes, strict=False)]
    return Monitored(holds, [*pivots, *found[count + len(pivots) :]])


def radius(w: Writer, form: Form, p: Lanes, rows: Sequence[Coefficients]) -> Value:
    """How long a step may be; zero where a coefficient is no number."""
    rtol, atol, count = p["rtol"], p["atol"], form.q_and_v
    inverse = [1.0 / w.fma(rtol, w.magnitude(w.load(p.pointer, i)), atol) for i in range(count)]
    order, least = len(rows[0]) - 1, w.number(math.inf)  # of log h
    for k in (order - 1, order):
        square = w.number(0.0)  # of N_k, times `count`
        for x, share in zip(rows, inverse, strict=False):
            if x[k] is not None:
                relative = x[k] * share
                square = w.fma(relative, relative, square)
        least = w.smaller(least, (-0.5 / k) * logarithm(w, square * (1.0 / count)))
    reach = w.where(least < math.inf, exponential(w, least), least)
    return 0.9 * w.where(w.is_nan(reach), 0.0, reach)


def at_time(w: Writer, series: Coefficients, s: Value) -> Value:
    """sum_k x_k s^k"""
    total = w.number(0.0) if series[-1] is None else series[-1]
    for x in reversed(series[:-1]):
        total = total * s if x is None else w.fma(total, s, x)
    return total


def slope(series: Coefficients) -> Coefficients:
    """Coefficients of the derivative."""
    return [x if x is None or k == 0 else x * float(k + 1) for k, x in enumerate(series[1:])]
