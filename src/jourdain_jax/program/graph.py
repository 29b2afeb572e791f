"""Hash-consed graph of scalar expressions: equal expressions are one node.

The graph simplifies constants, 0 + x, 0 x, 1 x, x - x, squares of square roots, sin(-x) and cos(-x). Signs
move outwards, so that a - (-b) = a + b. Arguments of sums and products are ordered, so that a b and b a
are one node.
"""

import math
import threading
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import reduce

import numpy as np

from jourdain_jax.calculus.scalar_operations import TABLE

MOST_NODES = 500_000  # tuning: limit of one graph, which takes seconds to build
# limit of one expanded matrix product; measured in batches: scalars win at 16 x 16, calls from 24 x 24 on
MOST_MULTIPLICATIONS = 512  # tuning
ARRAYS = {"array", "opaque", "output"}  # operations whose values are not scalars (`calls.py`)
NodeList = list[int]  # node indices
_GROWING = threading.Lock()  # lock, because threads may extend one graph
OPERATIONS = {"add", "sub", "mul", "div", "neg", "sqrt", "sin", "cos"}  # included in operation counts
ARITHMETIC = {"add", "sub", "mul", "div", "neg"}  # methods of `Graph`
_TRUTHS = frozenset(("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite"))


class Unsupported(Exception):
    """Operation that cannot become part of a scalar program; the text gives the reason."""


class Graph:
    """Graph whose nodes are integers. `op[n]` and `args[n]` are the operation and the arguments of node n,
    `value[n]` is the number of a constant, the name of an input, or a call.

    `most_multiplications`: maximum number of multiplications in a matrix product; larger products stay calls.
    `keeps_rules`: whether functions with a custom derivative stay calls.
    """

    def __init__(self, most_multiplications: float = math.inf, keeps_rules: bool = False) -> None:
        self.most_multiplications, self.keeps_rules = most_multiplications, keeps_rules
        self.op: list[str] = []
        self.args: list[tuple[int, ...]] = []
        self.value: list = []
        self.varies: list[bool] = []  # depends on time, state or inputs; otherwise computed once per motion
        self.positive: NodeList = []  # parameters that are declared positive
        self._known: dict = {}
        self.zero, self.one = self.const(0.0), self.const(1.0)

    def like(self, other: "Graph", node: int, args: tuple[int, ...]) -> int:
        """Return the node with arguments `args` and the operation of `node` in another graph."""
        return self._node(other.op[node], args, other.value[node], other.varies[node])

    def _node(self, op: str, args: tuple[int, ...] = (), value=None, varies: bool | None = None) -> int:
        key = (op, args, value)
        if (node := self._known.get(key)) is not None:
            return node
        with _GROWING:
            if (count := len(self.op)) >= MOST_NODES:
                raise Unsupported(f"a computation of more than {MOST_NODES} scalars")
            self.op.append(op)
            self.args.append(args)
            self.value.append(value)
            self.varies.append(any(map(self.varies.__getitem__, args)) if varies is None else varies)
            node = self._known.setdefault(key, count)
            if node != count:  # another thread has added it meanwhile
                for of_nodes in (self.op, self.args, self.value, self.varies):
                    of_nodes.pop()
        return node

    # leaves

    def const(self, value) -> int:
        """Return the node of a constant."""
        value = float(value)
        # a single zero and a single NaN
        return self._node("const", (), 0.0 if value == 0 else math.nan if value != value else value, False)

    def input(self, name: str, varies: bool) -> int:
        """Return the node of an input. If it `varies`, it is time, a coordinate, a speed or an input of the
        scene; otherwise it is a parameter.
        """
        return self._node("input", (), name, varies)

    def is_const(self, node: int) -> bool:
        """Return whether a node is a constant."""
        return self.op[node] == "const"

    def operation(self, node: int) -> tuple[str, tuple[int, ...]]:
        """Return the operation and the arguments of a node."""
        return self.op[node], self.args[node]

    # arithmetic

    def neg(self, a: int) -> int:
        """Return -a."""
        op, args = self.operation(a)
        if op == "const":
            return self.const(-self.value[a])
        if op == "neg":
            return args[0]
        if op == "sub":
            return self._node("sub", (args[1], args[0]))
        return self._node("neg", (a,))

    def add(self, a: int, b: int) -> int:
        """Return a + b."""
        if a == self.zero:
            return b
        if b == self.zero:
            return a
        if self.op[a] == "const" and self.op[b] == "const":
            return self.const(self.value[a] + self.value[b])
        if self.op[b] == "neg":
            return self.sub(a, self.args[b][0])
        if self.op[a] == "neg":
            return self.sub(b, self.args[a][0])
        if self.op[a] == "sub" and self.args[a][1] == b:  # (x - b) + b
            return self.args[a][0]
        if self.op[b] == "sub" and self.args[b][1] == a:
            return self.args[b][0]
        if self.op[a] == "mul" and self.op[b] == "mul":
            common = self._without_wave(a, b)
            if common is not None:
                return common
        return self._node("add", (a, b) if a < b else (b, a))

    def _without_wave(self, a: int, b: int) -> int | None:
        """Return x if `a = sin(w)^2 x` and `b = cos(w)^2 x`, or the reverse; None for other products."""
        factors = self._factors(a), self._factors(b)
        if len(factors[0]) != len(factors[1]):
            return None
        left, right = map(Counter, factors)
        more, less = left - right, right - left
        if len(more) != 1 or len(less) != 1:
            return None
        (s, i), (c, j) = (*more.items(), *less.items())
        if i != 2 or j != 2 or {self.op[s], self.op[c]} != {"sin", "cos"} or self.args[s] != self.args[c]:
            return None
        return self.product((left & right).elements())

    def _factors(self, node: int) -> NodeList:
        """Return the factors of a product."""
        factors, split = [node], True
        # split into at most 8 factors
        while split and len(factors) < 8:
            split = False
            for k, n in enumerate(factors):
                if self.op[n] == "mul":
                    factors[k : k + 1] = self.args[n]
                    split = True
                    break
        return factors

    def sub(self, a: int, b: int) -> int:
        """Return a - b."""
        if b == self.zero:
            return a
        if a == self.zero:
            return self.neg(b)
        if a == b:
            return self.zero
        if self.op[a] == "const" and self.op[b] == "const":
            return self.const(self.value[a] - self.value[b])
        if self.op[b] == "neg":
            return self.add(a, self.args[b][0])
        if self.op[a] == "neg":
            return self.neg(self.add(self.args[a][0], b))
        if self.op[a] == "sub" and self.args[a][0] == b:  # (b - x) - b
            return self.neg(self.args[a][1])
        if self.op[a] == "add" and b in self.args[a]:  # (b + x) - b
            return self.args[a][1 - self.args[a].index(b)]
        if self.op[b] == "sub" and self.args[b][0] == a:  # a - (a - x)
            return self.args[b][1]
        if self.op[b] == "add" and a in self.args[b]:  # a - (a + x)
            return self.neg(self.args[b][1 - self.args[b].index(a)])
        return self._node("sub", (a, b))

    def mul(self, a: int, b: int) -> int:
        """Return a b."""
        if a == self.zero or b == self.zero:
            return self.zero
        if a == self.one:
            return b
        if b == self.one:
            return a
        op_a, op_b = self.op[a], self.op[b]
        if op_a == "const" and op_b == "const":
            return self.const(self.value[a] * self.value[b])
        if op_a == "neg":
            return self.neg(self.mul(self.args[a][0], b))
        if op_b == "neg":
            return self.neg(self.mul(a, self.args[b][0]))
        if op_a == "const" and self.value[a] < 0:
            return self.neg(self.mul(self.const(-self.value[a]), b))
        if op_b == "const" and self.value[b] < 0:
            return self.neg(self.mul(a, self.const(-self.value[b])))
        if a == b and op_a == "sqrt":
            return self.args[a][0]
        if op_a == "const" and op_b == "mul" and self.op[self.args[b][0]] == "const":
            return self.mul(self.const(self.value[a] * self.value[self.args[b][0]]), self.args[b][1])
        if op_b == "const" and op_a == "mul" and self.op[self.args[a][0]] == "const":
            return self.mul(self.const(self.value[b] * self.value[self.args[a][0]]), self.args[a][1])
        if op_b == "const" or (op_a != "const" and a > b):
            a, b = b, a
        return self._node("mul", (a, b))

    def div(self, a: int, b: int) -> int:
        """Return a / b."""
        if self.op[b] == "const" and self.value[b] != 0:
            if self.op[a] == "const":
                return self.const(self.value[a] / self.value[b])
            return self.mul(a, self.const(1 / self.value[b]))
        if a == self.zero:
            return a
        if self.op[a] == "neg":
            return self.neg(self.div(self.args[a][0], b))
        if self.op[b] == "neg":
            return self.neg(self.div(a, self.args[b][0]))
        if self.op[a] == "const" and self.value[a] < 0:
            return self.neg(self.div(self.const(-self.value[a]), b))
        if self.varies[a] and not self.varies[b]:
            return self.mul(a, self.div(self.one, b))  # the reciprocal is computed once per motion
        return self._node("div", (a, b))

    def power(self, a: int, exponent: int) -> int:
        """Return `a^exponent` for an integer exponent, by repeated multiplication."""
        if exponent < 0:
            return self.div(self.one, self.power(a, -exponent))
        result, square = self.one, a
        while exponent:
            if exponent & 1:
                result = self.mul(result, square)
            exponent >>= 1
            square = self.mul(square, square) if exponent else square
        return result

    def call(self, op: str, *args: int) -> int:
        """Return the node of a scalar function, given by name; a constant if all arguments are constants."""
        if op in ARITHMETIC:
            return getattr(self, op)(*args)
        if all(self.op[a] == "const" for a in args):
            with np.errstate(all="ignore"):
                value = TABLE[op].value(*(self.value[a] for a in args))
            if np.isfinite(value):  # other values are left to the program
                return self.const(value)
        a = args[0]
        if op == "sin" and self.op[a] == "neg":
            return self.neg(self.call("sin", self.args[a][0]))
        if op in ("cos", "abs") and self.op[a] == "neg":
            return self.call(op, self.args[a][0])
        if op == "sqrt" and self.op[a] == "mul" and self.args[a][0] == self.args[a][1]:
            return self.call("abs", self.args[a][0])
        if op == "select" and args[1] == args[2]:
            return args[1]
        if op == "eq":  # x == min(x, y), from JAX's derivative of min, is the relation x <= y
            for x, extreme in (args, args[::-1]):
                is_it = {"min": "le", "max": "ge"}.get(self.op[extreme])
                if is_it and x in (of := self.args[extreme]):
                    return self.call(is_it, x, of[of[0] == x])
        return self._node(op, args)

    # arrays and calls

    def array(self, entries: Iterable[int], shape: tuple[int, ...], dtype: str) -> int:
        """Combine scalars into an array, or return the existing array of exactly the same entries."""
        entries = tuple(entries)
        if entries and self.op[entries[0]] == "entry":
            (whole,) = self.args[entries[0]]
            alike = self.value[whole][1:] == (shape, dtype)
            if alike and entries == tuple(self.entries(whole).ravel().tolist()):
                return whole
        return self._node("array", entries, (shape, dtype))

    def opaque(self, call, operands: Iterable[int]) -> int:
        """Return the node of a call whose `operands` are arrays."""
        return self._node("opaque", tuple(operands), call)

    def results(self, call: int, shapes: Mapping[int, tuple[tuple[int, ...], str]]) -> NodeList:
        """Return nodes for results of a call. `shapes`: index of a result -> its shape and type."""
        return [self._node("output", (call,), (k, *shape)) for k, shape in shapes.items()]

    def entries(self, output: int) -> np.ndarray:
        """Return the entries of a result of a call."""
        _, shape, _ = self.value[output]
        return np.array(
            [self._node("entry", (output,), (i, len(shape))) for i in range(math.prod(shape))], np.int64
        ).reshape(shape)

    def entries_of(self, array: int) -> NodeList:
        """Return the entries of an array or of a result of a call."""
        return list(self.args[array]) if self.op[array] == "array" else self.entries(array).ravel().tolist()

    def again(self, node: int, args: Iterable[int], of: "Graph | None" = None) -> int:
        """Apply the operation of a node to other arguments; `of`: graph of the node (default: this one)."""
        graph, args = of or self, tuple(args)
        op, value = graph.op[node], graph.value[node]
        if op == "array":
            return self.array(args, *value)
        return self._node(op, args, value) if op in ARRAYS or op == "entry" else self.call(op, *args)

    def copied(self, nodes: Iterable[int], of: "Graph", known: Mapping[int, int]) -> dict[int, int]:
        """Copy nodes of another graph. Return a dictionary, node -> its copy; `known` has copies that
        exist already.
        """
        nodes, new = list(nodes), dict(known)
        for node in of.needed(nodes, new):
            new[node] = (
                self.const(of.value[node])
                if of.is_const(node)
                else self.again(node, [new[a] for a in of.args[node]], of)
            )
        return new

    def calls(self, nodes: Iterable[int]) -> NodeList:
        """Return the calls that the nodes need."""
        return [n for n in self.reachable(nodes) if self.op[n] == "opaque"]

    def total(self, terms: Iterable[int]) -> int:
        """Return the sum of nodes."""
        return reduce(self.add, terms, self.zero)

    def product(self, factors: Iterable[int]) -> int:
        """Return the product of nodes."""
        return reduce(self.mul, factors, self.one)

    def dot(self, a: Iterable[int], b: Iterable[int]) -> int:
        """Return `sum a_i b_i`."""
        return self.total(self.mul(x, y) for x, y in zip(a, b, strict=True))

    def substituted(self, outputs: Iterable[int], replacement: Mapping[int, int]) -> NodeList:
        """Return the outputs with some nodes replaced by others."""
        outputs = list(outputs)
        if not replacement:
            return outputs
        new: dict[int, int] = {}
        for node in self.reachable(outputs):
            if node in replacement:
                new[node] = replacement[node]
            elif not self.args[node] or all(new[a] == a for a in self.args[node]):
                new[node] = node
            else:
                new[node] = self.again(node, (new[a] for a in self.args[node]))
        return [new[n] for n in outputs]

    # queries

    def reachable(self, outputs: Iterable[int]) -> NodeList:
        """Return all nodes that the outputs need, in order of evaluation."""
        return self.needed(outputs, known=())

    def needed(self, outputs: Iterable[int], known) -> NodeList:
        """Return, in order, the nodes to compute for the outputs when the nodes in `known` are given."""
        args = self.args
        seen = {node for node in outputs if node not in known}
        stack = list(seen)
        while stack:
            for node in args[stack.pop()]:
                if node not in seen and node not in known:
                    seen.add(node)
                    stack.append(node)
        return sorted(seen)  # arguments have smaller indices than the nodes that use them

    def fixed(self, outputs: Iterable[int]) -> tuple[int, ...]:
        """Return the nodes that depend only on parameters and that varying nodes use."""
        outputs = list(outputs)
        found = {
            a for n in self.reachable(outputs) if self.varies[n] or self.is_truth(n) for a in self.args[n]
        } | set(outputs)
        return tuple(sorted(n for n in found if not (self.varies[n] or self.is_const(n) or self.is_truth(n))))

    def is_truth(self, node: int) -> bool:
        """Return whether a node is a boolean."""
        return self.op[node] in _TRUTHS or (self.op[node] == "select" and self.is_truth(self.args[node][1]))

    def with_quotients(self, outputs: Iterable[int]) -> NodeList:
        """Return the outputs with `a (1/b)` as one division if `1/b` is used only once."""
        outputs = list(outputs)
        uses = Counter(a for node in self.reachable(outputs) for a in self.args[node])
        new: dict[int, int] = {}
        for node in self.reachable(outputs):
            args = self.args[node]
            products = (args, args[::-1]) if self.op[node] == "mul" and self.varies[node] else ()
            divided = [(a, self.args[b][1]) for a, b in products if self._divides_once(b, uses, outputs)]
            if divided:
                new[node] = self._node("div", (new[divided[0][0]], new[divided[0][1]]))
            else:
                given = tuple(new[a] for a in args)
                new[node] = self._node(self.op[node], given, self.value[node]) if args else node
        return [new[n] for n in outputs]

    def _divides_once(self, node: int, uses: dict[int, int], outputs: NodeList) -> bool:
        """Return whether a node is a varying reciprocal with one use."""
        reciprocal = self.op[node] == "div" and self.args[node][0] == self.one and self.varies[node]
        return reciprocal and uses[node] == 1 and node not in outputs

    def operations(self, outputs: Iterable[int]) -> int:
        """Return the number of operations on varying quantities."""
        return sum(self.varies[n] and self.op[n] in OPERATIONS for n in self.reachable(outputs))
