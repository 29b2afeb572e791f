"""Taylor series of a solution of dy/dt = f(t, y), as LLVM IR: recurrences of the coefficients of every operation of the graph of f, written out order by order.

    y_{k+1} = f_k/(k + 1)                                  x_k = x^(k)/k! of any number x along the solution
    (a b)_k = sum_{j=0}^k a_j b_{k-j}
    c = a/b:       c_k = (a_k - sum_{j=1}^k b_j c_{k-j})/b_0
    c = sqrt(a):   c_k = (a_k - sum_{j=1}^{k-1} c_j c_{k-j})/(2 c_0)
    c = a^e:       c_k = sum_{j=1}^k (e j/k - (k - j)/k) a_j c_{k-j}/a_0             (a constant exponent e)
    c = F(a, ..):  c_k = sum_{j=1}^k (j/k) a_j (dF/da)_{k-j} + ..                     with the derivative on the graph, for all other functions

Sums add the newest coefficients last: all others are known long before. Source: A. Jorba and M. Zou, Experimental Mathematics 14 (2005) 99, section 2.
"""

from collections.abc import Mapping, Sequence

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.native.angles import sine_and_cosine
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.math_functions import FUNCTIONS
from jourdain_jax.native.scalar_program import unsupported
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


def products(graph: Graph, outputs: Sequence[int], order: int) -> int:
    """About how many multiplications a series up to this order takes."""
    each = order * (order + 1) // 2
    return sum(each for node in graph.reachable(outputs) if graph.op[node] not in ("const", "input", "add", "sub", "neg"))


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
