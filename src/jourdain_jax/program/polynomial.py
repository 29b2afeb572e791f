"""Normal forms: a node as a polynomial in atoms, modulo `sin^2 + cos^2 = 1` and `sqrt(x)^2 = x`, and back to
a short expression.

Atoms are inputs and all nodes other than sums, differences and products: sines, cosines, square roots,
reciprocals. Expansion cancels equal terms. Reconstruction groups terms by their varying part, whose
coefficient (a polynomial in parameters) is computed once per motion. The result is then factored greedily
(multivariate Horner scheme).
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from operator import and_

from jourdain_jax.program.evaluate import more_operations
from jourdain_jax.program.graph import ARRAYS, Graph, NodeList

Monomial = tuple[int, ...]  # atoms in order, repeated by their power
Polynomial = dict[Monomial, float]


class TooLarge(Exception):
    """Raised if the expansion has more terms than allowed."""


class NormalForms:
    """Normal forms of the nodes of one graph. Squares of cosines replace squares of sines; the reverse took
    fewer operations in no model.

    - `most_terms`: maximum number of terms of a normal form; 0: nodes stay unchanged.
    - `sign`: function from a node to its sign: 1, -1, or 0 if unknown. With a known sign |x| becomes x or -x,
      and `guards` records that node.
    - `squares`: atom -> polynomial equal to its square, for one entry of each unit quaternion.
    """

    def __init__(
        self,
        graph: Graph,
        most_terms: int,
        sign: Callable[[int], int] = lambda node: 0,
        squares: Mapping[int, Polynomial] | None = None,
    ):
        self.graph, self.most_terms, self._sign = graph, most_terms, sign
        self.guards: set[int] = set()  # nodes that must stay positive
        self._expanded: dict[int, Polynomial | None] = {graph.zero: {}}
        self._squares: dict[int, Polynomial] = dict(squares or {})
        self._simplified: dict[int, int] = {}
        self._reductions: dict[Monomial, tuple[tuple[Monomial, float], ...]] = {}
        self._reciprocals: dict[int, int | None] = {}  # x of an atom 1/x, None for others

    def simplified(self, node: int) -> int:
        """Return the normal form of a node if it takes no more operations, otherwise the node itself."""
        if node not in self._simplified:
            self._simplified[node] = self._smaller(node)
        return self._simplified[node]

    def all_simplified(self, nodes: Iterable[int]) -> NodeList:
        """Return `simplified` of every node."""
        return [self.simplified(n) for n in nodes]

    def _smaller(self, node: int) -> int:
        if not self.most_terms or self.graph.op[node] in ("const", "input"):
            return node
        try:
            form = self.rebuilt(self.expanded(node))
        except TooLarge:
            return node
        return form if more_operations(self.graph, form, node) <= 0 else node

    # expansion

    def expanded(self, node: int) -> Polynomial:
        """Return the polynomial of a node."""
        if node not in self._expanded:
            for part in self.graph.needed([node], self._expanded):  # arguments first, to avoid deep recursion
                try:
                    self._expanded[part] = self._expand(part)
                except TooLarge:
                    self._expanded[part] = None
        found = self._expanded[node]
        if found is None:
            raise TooLarge
        return found

    def _expand(self, node: int) -> Polynomial:
        graph = self.graph
        op, args = graph.operation(node)
        if op == "const":
            return {(): graph.value[node]}
        if op == "input":
            return {(node,): 1.0}
        if op in ARRAYS or op == "entry":
            same = not graph.varies[node]
            return {(node if same else graph.again(node, [self._rebuilt_or(a) for a in args]),): 1.0}
        parts = [p for p in (self._expanded[a] for a in args) if p is not None]
        if len(parts) < len(args):
            raise TooLarge
        if op == "add":
            return _sum(parts[0], parts[1], 1.0)
        if op == "sub":
            return _sum(parts[0], parts[1], -1.0)
        if op == "neg":
            return {m: -c for m, c in parts[0].items()}
        if op == "mul":
            return self.product(parts[0], parts[1])
        if op == "div":
            return self.product(parts[0], self._reciprocal(parts[1]))
        if op == "sqrt":
            return self._root(parts[0])
        if op == "abs":
            return self._absolute(parts[0])
        atom = graph.call(op, *(self.rebuilt(p) for p in parts))
        return self._atom(atom) if graph.op[atom] == op else self.expanded(atom)

    def _rebuilt_or(self, node: int) -> int:
        """Return a node rebuilt from its normal form, or the node itself if it has none."""
        found = self._expanded[node]
        return node if found is None else self.rebuilt(found)

    def _root(self, p: Polynomial) -> Polynomial:
        """Return `sqrt p`, with `|x|` extracted from `x^2 y`, and `|sin x|` from `y (1 - cos(x)^2)`."""
        rooted = self._rooted(p)
        if rooted is None:
            atom = self.graph.call("sqrt", self.rebuilt(p))
            return self._atom(atom) if self.graph.op[atom] == "sqrt" else self.expanded(atom)
        outside, inside = rooted
        return self._times(self._root(inside) if inside != {(): 1.0} else inside, self._magnitude, outside)

    def _times(
        self, p: Polynomial, function: Callable[[int], Polynomial], atoms: Iterable[int]
    ) -> Polynomial:
        """Return p f(x) f(y) ... for some atoms."""
        for atom in atoms:
            p = self.product(p, function(atom))
        return p

    def _rooted(self, p: Polynomial) -> tuple[NodeList, Polynomial] | None:
        """Return the atoms that can be taken out of the root of p, and the remaining radicand; None if
        there are none.
        """
        if len(p) == 1:
            ((monomial, c),) = p.items()
            counts = Counter(monomial)
            outside, inside = (
                [atom for atom, k in counts.items() for _ in range(share(k))]
                for share in (lambda k: k // 2, lambda k: k % 2)
            )
            return (outside, {tuple(inside): c}) if outside else None
        if len(p) == 2:
            (small, c), (large, d) = sorted(p.items(), key=lambda item: len(item[0]))
            extra = Counter(large) - Counter(small)
            one_square = len(large) == len(small) + 2 and [*extra.values()] == [2]
            if c == -d and one_square and self.graph.op[min(extra)] == "cos":
                return [self.graph.call("sin", self.graph.args[min(extra)][0])], {small: c}
        return None

    def _absolute(self, p: Polynomial) -> Polynomial:
        """Return |p|; for a product, factor by factor."""
        if len(p) != 1:
            return self._kept_absolute(self.rebuilt(p))
        ((monomial, c),) = p.items()
        return self._times({(): abs(c)}, self._kept_absolute, monomial)

    def _kept_absolute(self, node: int) -> Polynomial:
        value = self.graph.call("abs", node)
        return self._atom(value) if self.graph.op[value] == "abs" else self.expanded(value)

    def _magnitude(self, node: int) -> Polynomial:
        """Return |x| of a factor extracted from a root. Sines and cosines, as in lengths of contacts, get the
        sign that they have at the probes, and `guards` records the node.
        """
        sign = self._sign(node) if self.graph.op[node] in ("sin", "cos") and self.graph.varies[node] else 0
        if sign == 0:
            return self._kept_absolute(node)
        self.guards.add(node if sign > 0 else self.graph.neg(node))
        return self.expanded(node if sign > 0 else self.graph.neg(node))

    def _reciprocal(self, p: Polynomial) -> Polynomial:
        if len(p) == 1:
            ((monomial, c),) = p.items()
            return self._times({(): 1 / c}, self._inverse_atom, monomial)
        return {(self.graph.div(self.graph.one, self.rebuilt(p)),): 1.0}

    def _inverse_atom(self, atom: int) -> Polynomial:
        x = self._reciprocal_of(atom)
        return {(self.graph.div(self.graph.one, atom),): 1.0} if x is None else self.expanded(x)

    def _atom(self, atom: int) -> Polynomial:
        graph, op = self.graph, self.graph.op[atom]
        if atom not in self._squares and op in ("sin", "sqrt", "abs"):
            if op == "sin":
                other = graph.call("cos", graph.args[atom][0])
                self._squares[atom] = {(): 1.0, (other, other): -1.0}
            else:
                x = self.expanded(graph.args[atom][0])
                self._squares[atom] = x if op == "sqrt" else self.product(x, x)
        return {(atom,): 1.0}

    def product(self, p: Polynomial, q: Polynomial) -> Polynomial:
        """Return p q, with squares replaced."""
        if len(p) * len(q) > 8 * self.most_terms:
            raise TooLarge
        result: Polynomial = {}
        reductions = self._reductions
        for m, a in p.items():
            for n, b in q.items():
                monomial = tuple(sorted(m + n)) if m and n else m or n
                c, found = a * b, reductions.get(monomial)
                for k, factor in self._reduced(monomial) if found is None else found:
                    if k in result:
                        _put(result, k, c * factor)
                    else:
                        result[k] = c * factor
        if len(result) > self.most_terms:
            raise TooLarge
        return result

    def _reduced(self, monomial: Monomial) -> tuple[tuple[Monomial, float], ...]:
        """Return the terms of a monomial, with squares replaced and pairs x, 1/x cancelled. Caching is valid,
        because the square of an atom is known before its first use.
        """
        found = self._reductions.get(monomial)
        if found is None:
            rest = self._cancelled(monomial)
            at = self._first_square(rest)
            if at is None:
                found = ((rest, 1.0),)
            else:
                terms: Polynomial = {}
                square, rest = rest[at], rest[:at] + rest[at + 2 :]
                for n, c in self._squares[square].items():
                    for k, factor in self._reduced(tuple(sorted(rest + n))):
                        _put(terms, k, c * factor)
                found = tuple(terms.items())
            self._reductions[monomial] = found
        return found

    def _first_square(self, monomial: Monomial) -> int | None:
        """Return the index of a squared atom whose square is another polynomial."""
        before = None
        for at, atom in enumerate(monomial):
            if atom == before and atom in self._squares:
                return at - 1
            before = atom
        return None

    def _cancelled(self, monomial: Monomial) -> Monomial:
        """Return the monomial without pairs x, 1/x."""
        for atom in monomial:
            x = self._reciprocal_of(atom)
            if x is not None and x in monomial:
                return self._cancelled(_without(_without(monomial, atom), x))
        return monomial

    def _reciprocal_of(self, atom: int) -> int | None:
        """Return x for an atom 1/x, None for others."""
        graph = self.graph
        if atom not in self._reciprocals:
            self._reciprocals[atom] = (
                graph.args[atom][1] if graph.op[atom] == "div" and graph.args[atom][0] == graph.one else None
            )
        return self._reciprocals[atom]

    # reconstruction

    def rebuilt(self, p: Polynomial, divisor: int | None = None) -> int:
        """Return a node with few operations for the polynomial p, divided by the node `divisor`, a function
        of parameters.
        """
        graph = self.graph
        terms = []
        for varying, coefficient in self._gathered(p).items():
            positive = next(iter(sorted(coefficient.items())))[1] > 0
            node = self._coefficient(coefficient if positive else {m: -c for m, c in coefficient.items()})
            node = node if divisor is None else graph.div(node, divisor)
            factors = varying if node == graph.one else tuple(sorted((*varying, node)))
            terms.append((factors, positive))
        return self._horner(terms)

    def _gathered(self, p: Polynomial) -> dict[Monomial, Polynomial]:
        """Return the coefficient of each varying monomial, a polynomial in parameters."""
        gathered: dict[Monomial, Polynomial] = {}
        for monomial, c in p.items():
            varying = tuple(x for x in monomial if self.graph.varies[x])
            gathered.setdefault(varying, {})[tuple(x for x in monomial if not self.graph.varies[x])] = c
        return gathered

    def quotient(self, p: Polynomial, q: Polynomial) -> int:
        """Return a node for p/q, with common factors of all terms of q cancelled term by term."""
        graph = self.graph
        if not p:
            return graph.zero
        common = reduce(and_, map(Counter, q))
        scale = next(iter(q.values()))
        p = self._times({m: c / scale for m, c in p.items()}, self._inverse_atom, common.elements())
        divisor = self.rebuilt({tuple((Counter(m) - common).elements()): c / scale for m, c in q.items()})
        if graph.varies[divisor]:
            return graph.div(self.rebuilt(p), divisor)
        return self.rebuilt(p, None if divisor == graph.one else divisor)

    def cramer(self, M: list[NodeList], f: NodeList) -> NodeList:
        """Return `M^-1 f` in normal form by Cramer's rule, for up to three unknowns."""
        A, b = [[self.expanded(x) for x in row] for row in M], [self.expanded(x) for x in f]
        determinant = self._determinant(A)
        replaced = [
            [[b[i] if j == k else A[i][j] for j in range(len(b))] for i in range(len(b))]
            for k in range(len(b))
        ]
        return [self.quotient(self._determinant(R), determinant) for R in replaced]

    def _determinant(self, A: list[list[Polynomial]]) -> Polynomial:
        if len(A) == 1:
            return A[0][0]
        total: Polynomial = {}
        for k, first in enumerate(A[0]):
            if first:
                minor = self._determinant([[*row[:k], *row[k + 1 :]] for row in A[1:]])
                total = _sum(total, self.product(first, minor), 1.0 if k % 2 == 0 else -1.0)
        if len(total) > self.most_terms:
            raise TooLarge
        return total

    def _coefficient(self, p: Polynomial) -> int:
        """Return a node for a polynomial in parameters, without minimising its operations."""
        return self.graph.total(
            self.graph.mul(self.graph.const(c), self.graph.product(monomial))
            for monomial, c in sorted(p.items())
        )

    def _horner(self, terms: list[tuple[Monomial, bool]]) -> int:
        graph = self.graph
        counts = Counter(factor for factors, _ in terms for factor in set(factors))
        factor, count = max(
            counts.items(), key=lambda item: (item[1], graph.varies[item[0]], item[0]), default=(graph.one, 0)
        )
        if count < 2:
            # parameters first
            products = (
                (graph.product(sorted(factors, key=graph.varies.__getitem__)), positive)
                for factors, positive in sorted(terms)
            )
            return graph.total(product if positive else graph.neg(product) for product, positive in products)
        inside = [(_without(f, factor), s) for f, s in terms if factor in f]
        outside = [(f, s) for f, s in terms if factor not in f]
        return graph.add(graph.mul(factor, self._horner(inside)), self._horner(outside))


def _without(factors: Monomial, factor: int) -> Monomial:
    at = factors.index(factor)
    return factors[:at] + factors[at + 1 :]


def _put(p: Polynomial, monomial: Monomial, c: float) -> None:
    new = p.get(monomial, 0.0) + c
    if abs(new) <= 1e-13 * abs(c):  # cancelled up to the round-off of the constants in the scene
        p.pop(monomial, None)
    else:
        p[monomial] = new


def _sum(p: Polynomial, q: Polynomial, sign: float) -> Polynomial:
    result = dict(p)
    for monomial, c in q.items():
        _put(result, monomial, sign * c)
    return result
