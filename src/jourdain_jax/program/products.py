"""Equal numbers by fewer products and quotients of what varies: a Taylor series of order p takes p (p + 1)/2 multiplications for each of these.

Sums and products are taken apart into terms c x y .. with coefficients c that do not vary. Then, one after the other, whatever saves most products is shared:

    x y                     where several terms hold it
    x y + x z = x (y + z)   in one sum

Accelerations of a disc with s, c = sin, cos of its lean take 12, and after that 7, with p = v w/c and q = c u:

    v (2 s w/c - 5/3 c u),  s (g + c u^2) + 6/5 c u w,  -2 v w/c      ->      2 s p - 5/3 v q,  g s + q (s u + 6/5 w),  -2 p
"""

from collections import Counter
from collections.abc import Sequence
from graphlib import TopologicalSorter
from itertools import combinations, count

from jourdain_jax.program.graph import Graph

MOST_TERMS = 8  # of what a product of sums is multiplied out to
Term = tuple[int, list[int]]  # a node that does not vary, and the factors that do, in order
Form = dict[tuple[int, ...], int]  # a sum: factors -> their coefficient


def with_few_products(graph: Graph, outputs: Sequence[int]) -> list[int]:
    """Nodes for the same numbers, up to round-off."""
    varying = [n for n in graph.reachable(outputs) if graph.varies[n]]
    sums = _Sums(graph, varying, list(dict.fromkeys(n for n in outputs if graph.varies[n])))
    while sums.shares_more():
        pass
    new = sums.nodes()
    return min(list(outputs), [new.get(n, n) for n in outputs], key=lambda nodes: _products(graph, nodes))


def _products(graph: Graph, nodes: list[int]) -> int:
    """Products, quotients and functions of what varies."""
    free = ("input", "add", "sub", "neg")
    varying = [n for n in graph.reachable(nodes) if graph.varies[n] and graph.op[n] not in free]
    return sum(graph.op[n] != "mul" or all(graph.varies[a] for a in graph.args[n]) for n in varying)


class _Sums:
    """What varies as sums of products of factors: nodes that are none, or are used more than once, and new ones, which have negative numbers."""

    def __init__(self, graph: Graph, varying: list[int], outputs: list[int]) -> None:
        self.graph = graph
        self.terms: dict[int, list[Term]] = {}
        self.inverse: dict[int, int] = {}  # factor -> what it is the reciprocal of
        self._reciprocals: dict[int, int] = {}
        self._new = count(-1, -1)
        uses = Counter([*(a for n in varying for a in graph.args[n]), *outputs])
        forms: dict[int, Form] = {}
        for n in varying:
            forms[n] = form = self._form(n, forms)
            if uses[n] > 1 and len(form) > 1:
                forms[n] = {(self._named(n, form),): graph.one}
        for n in outputs:
            self._named(n, forms[n])

    def _form(self, node: int, forms: dict[int, Form]) -> Form:
        graph, op, args = self.graph, self.graph.op[node], self.graph.args[node]
        given: list[Form] = [forms[a] if graph.varies[a] else {(): a} for a in args]
        if op in ("add", "sub"):
            return self._collected([*given[0].items(), *((m, graph.neg(c) if op == "sub" else c) for m, c in given[1].items())])
        if op == "neg":
            return {m: graph.neg(c) for m, c in given[0].items()}
        if op == "mul":
            if len(given[0]) * len(given[1]) > MOST_TERMS:
                given[0] = {(self._named(args[0], given[0]),): graph.one}
            return self._collected([(tuple(sorted(m + n)), graph.mul(a, b)) for m, a in given[0].items() for n, b in given[1].items()])
        if op == "div":
            divisor = self._named(args[1], given[1])
            if divisor not in self._reciprocals:
                self._reciprocals[divisor] = next(self._new)
                self.inverse[self._reciprocals[divisor]] = divisor
            return {tuple(sorted((*m, self._reciprocals[divisor]))): c for m, c in given[0].items()}
        for a, form in zip(args, given, strict=True):
            if graph.varies[a]:
                self._named(a, form)
        return {(node,): graph.one}

    def _collected(self, terms: list[tuple[tuple[int, ...], int]]) -> Form:
        form: Form = {}
        for factors, c in terms:
            form[factors] = self.graph.add(form.get(factors, self.graph.zero), c)
        return {factors: c for factors, c in form.items() if c != self.graph.zero}

    def _named(self, node: int, form: Form) -> int:
        """A factor that is equal to the node."""
        if form == {(node,): self.graph.one}:
            return node
        self.terms.setdefault(node, [(c, list(factors)) for factors, c in form.items()])
        return next((factors[0] for factors, c in form.items() if len(form) == 1 and len(factors) == 1 and c == self.graph.one), node)

    def shares_more(self) -> bool:
        """Shares what saves most products; whether there was any."""
        pairs: Counter[tuple[int, int]] = Counter()
        factors: Counter[tuple[int, int]] = Counter()  # of products in one sum
        for name, terms in self.terms.items():
            for _, product in terms:
                pairs.update(set(combinations(product, 2)))
                if len(product) > 1:
                    factors.update({(name, x) for x in product})
        every = [(n, True, pair) for pair, n in pairs.items()] + [(n, False, x) for x, n in factors.items()]
        saved, is_pair, found = max(every, default=(0, True, (0, 0)))
        if saved < 2:
            return False
        new = next(self._new)
        if is_pair:
            for terms in self.terms.values():
                for _, product in terms:
                    if found in set(combinations(product, 2)):
                        product.remove(found[0])
                        product.remove(found[1])
                        product.insert(0, new)  # the lowest of all
            self.terms[new] = [(self.graph.one, list(found))]
        else:
            name, factor = found
            inside = [term for term in self.terms[name] if len(term[1]) > 1 and factor in term[1]]
            self.terms[name] = [term for term in self.terms[name] if term not in inside] + [(self.graph.one, [new, factor])]
            self.terms[new] = inside
            for _, product in inside:
                product.remove(factor)
        return True

    def nodes(self) -> dict[int, int]:
        """Nodes for all that has a name, and for all factors."""
        graph, new = self.graph, dict[int, int]()
        made_of: dict[int, set[int]] = {}
        left = list(self.terms)
        while left:
            name = left.pop()
            if name in self.terms:
                made_of[name] = {self.inverse.get(x, x) for _, product in self.terms[name] for x in product}
            else:
                made_of[name] = {a for a in graph.args[name] if graph.varies[a]}
            left += [x for x in made_of[name] if x not in made_of]
        for name in TopologicalSorter(made_of).static_order():
            if name in self.terms:
                new[name] = graph.total(graph.mul(c, self._product(product, new)) for c, product in self.terms[name])
            else:
                new[name] = graph.again(name, (new.get(a, a) for a in graph.args[name])) if graph.args[name] else name
        return new

    def _product(self, factors: list[int], new: dict[int, int]) -> int:
        graph, product = self.graph, self.graph.one
        for x in factors:
            product = product if x in self.inverse else graph.mul(product, new[x])
        for x in factors:
            product = graph.div(product, new[self.inverse[x]]) if x in self.inverse else product
        return product
