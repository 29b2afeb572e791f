"""LLVM IR of a graph of scalars: one vector per node, one lane per motion.

A product used by only one sum or difference is fused with it. Booleans are vectors of bits; in arithmetic
they count as 0 or 1.

Registers of long functions are allocated here. When a register is needed, the value with the furthest next
use goes to memory (L. A. Belady, IBM Systems Journal 5 (1966) 78). The cotangents of a bicycle's rates then
take 54 kB of code instead of 73 kB; code beyond the first-level instruction cache (32 kB) runs more slowly.
"""

import heapq
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Any

from jourdain_jax.kernels import host
from jourdain_jax.kernels.angles import sine_and_cosine
from jourdain_jax.kernels.ir import Value, Writer
from jourdain_jax.kernels.math_functions import FUNCTIONS
from jourdain_jax.program.graph import ARRAYS, Graph


@dataclass
class Turn:
    """Values to load before a value is computed, and values to store afterwards, with their memory slots."""

    loaded: list[int]
    stored: list[tuple[int, int]] = field(default_factory=list)


def turns(
    uses: Sequence[tuple[int, Iterable[int]]], there: Collection[int], registers: int
) -> tuple[list[Turn], int]:
    """Return the loads and stores (a `Turn`) for each computed value, and the number of memory slots.

    `uses`: the values in order, each with its operands; `there`: values that are already in memory. A slot is
    reused once its value is no longer needed.
    """
    made_of = [tuple(dict.fromkeys(values)) for _, values in uses]
    coming: dict[int, list[int]] = {}
    for i in reversed(range(len(uses))):
        for value in made_of[i]:
            coming.setdefault(value, []).append(i)
    held: dict[int, int] = {}  # value in a register -> its next use
    places: dict[int, int] = {}
    free: list[int] = []
    found, count = [], 0
    for i, (new, _) in enumerate(uses):
        turn = Turn([value for value in made_of[i] if value not in held])
        found.append(turn)
        for value in made_of[i]:
            coming[value].pop()
            if coming[value]:
                held[value] = coming[value][-1]
            else:
                held.pop(value, None)
                if value in places:
                    heapq.heappush(free, places.pop(value))
        if coming.get(new):
            held[new] = coming[new][-1]
        while len(held) > registers:
            value = max(held, key=held.__getitem__)
            del held[value]
            if value not in places and value not in there:
                if not free:
                    free.append(count)
                    count += 1
                places[value] = heapq.heappop(free)
                turn.stored.append((value, places[value]))
    return found, count


# Number of operations above which registers are allocated here instead of by LLVM. Measured: limits from 100
# to 500 make no difference; rates of a bicycle (2,115) take 10 % less time than by LLVM, their cotangents 25
# %.
LONG = 200  # tuning
# tuning: rows on either side of a pointer that a one-byte displacement reaches, with wide registers
REACH = 128

_TRUTHS = {"and": "and", "or": "or"}


def unsupported(graph: Graph, nodes: Iterable[int]) -> str:
    """Return why the nodes cannot be compiled to machine code; empty if they can."""
    known = {*FUNCTIONS, *_TRUTHS, *ARRAYS, "sin", "cos", "not", "select", "const", "input"}
    for node in graph.reachable(nodes):
        if graph.op[node] in ARRAYS or graph.op[node] == "entry":
            return "a part of it is kept as a JAX call"
        if graph.op[node] not in known:
            return f"the operation `{graph.op[node]}` is not supported"
    return ""


def written(
    w: Writer, graph: Graph, outputs: Iterable[int], known: Mapping[int, Value], by_llvm: bool = False
) -> list[Value]:
    """Return the values of the outputs, given inputs and known nodes. `by_llvm`: LLVM allocates the
    registers.
    """
    return [
        value for _, value in sorted(written_in_turn(w, graph, outputs, known, by_llvm), key=itemgetter(0))
    ]


def written_in_turn(
    w: Writer, graph: Graph, outputs: Iterable[int], known: Mapping[int, Value], by_llvm: bool = False
) -> Iterator[tuple[int, Value]]:
    """Yield index and value of each output as soon as it is computed. Known values stay in memory."""
    numbers: dict[int, list[int]] = {}
    for number, node in enumerate(outputs):
        numbers.setdefault(node, []).append(number)
    needed = graph.needed(numbers, known)
    values: dict[int, Value] = dict(known) | {
        n: w.number(graph.value[n]) for n in needed if graph.op[n] == "const"
    }
    yield from ((number, values[node]) for node in numbers if node in values for number in numbers[node])
    fusible = _used_once_in_a_sum(graph, needed, numbers)
    steps = [(n, _made_of(graph, n, fusible)) for n in needed if n not in values and n not in fusible]
    at_hand = _AtHand(w, values, [] if by_llvm else steps)
    waves: dict[int, tuple[Value, Value]] = {}
    for i, (node, _) in enumerate(steps):
        at_hand.before(i)
        op, args = graph.operation(node)
        if op in ("sin", "cos"):
            if args[0] not in waves:
                waves[args[0]] = sine_and_cosine(w, as_real(w, values[args[0]]))
            values[node] = waves[args[0]][op == "cos"]
        elif op in ("add", "sub") and any(a in fusible for a in args):
            values[node] = _fused(w, graph, op, args, fusible, values)
        else:
            values[node] = _operation(w, op, [values[a] for a in args])
        at_hand.after(i)
        yield from ((number, values[node]) for number in numbers.get(node, ()))


class _AtHand:
    """Moves values of a long function to memory, and back before their next use, as planned by `turns`."""

    def __init__(self, w: Writer, values: dict[int, Value], steps: list[tuple[int, list[int]]]) -> None:
        self.w, self.values, self.places = w, values, dict(values)
        self.turns: list[Turn] = []
        if len(steps) > LONG and not w.device:
            self.turns, rows = turns(steps, values, host.registers())
            self.rooms = w.opaque(w.room(max(rows, 1)), range(REACH, rows + REACH, 2 * REACH))

    def before(self, i: int) -> None:
        """Reload the operands of value i."""
        for node in self.turns[i].loaded if self.turns else ():
            self.values[node] = self.w.again(self.places[node])

    def after(self, i: int) -> None:
        """Store values whose registers are reused."""
        for node, row in self.turns[i].stored if self.turns else ():
            if self.values[node].type == self.w.real:
                which = row // (2 * REACH)
                self.places[node] = self.w.store(
                    self.values[node], self.rooms[which], row - (2 * which + 1) * REACH
                )
            else:
                self.places[node] = self.values[node]


def as_real(w: Writer, a: Value) -> Value:
    """Return a boolean as 0 or 1."""
    return w.converted("uitofp", a, w.real) if a.type == w.truth else a


def as_truth(w: Writer, a: Value) -> Value:
    """Return whether a number is not zero."""
    return a if a.type == w.truth else a.differs(0.0)


def _operation(w: Writer, op: str, args: list[Value]) -> Value:
    if op in _TRUTHS:
        return w.binary(_TRUTHS[op], as_truth(w, args[0]), as_truth(w, args[1]))
    if op == "not":
        return ~as_truth(w, args[0])
    if op == "select":
        condition, a, b = args
        if a.type != b.type:
            a, b = as_real(w, a), as_real(w, b)
        return w.where(as_truth(w, condition), b, a)
    return FUNCTIONS[op](w, *(as_real(w, a) for a in args))


def _made_of(graph: Graph, node: int, fusible: set[int]) -> list[int]:
    """Return operands of a node after fusing multiply-adds, without constants."""
    return [
        b
        for a in graph.args[node]
        for b in (graph.args[a] if a in fusible else (a,))
        if graph.op[b] != "const"
    ]


def _used_once_in_a_sum(graph: Graph, nodes: Iterable[int], outputs: Iterable[int]) -> set[int]:
    """Return the products whose only use is one sum or difference."""
    users: dict[int, list[Any]] = {n: [""] for n in outputs}
    products = set()
    for node in nodes:
        if graph.op[node] == "mul":
            products.add(node)
        for a in graph.args[node]:
            users.setdefault(a, []).append(graph.op[node])
    return {n for n in products if users.get(n) in (["add"], ["sub"])}


def _fused(
    w: Writer, graph: Graph, op: str, args: tuple[int, ...], fusible: set[int], values: Mapping[int, Value]
) -> Value:
    """Return x y + b, b - x y or x y - b as a fused multiply-add. Of two products, the first is fused."""
    which = 0 if args[0] in fusible else 1
    x, y = (as_real(w, values[a]) for a in graph.args[args[which]])
    other = args[1 - which]
    b = (
        FUNCTIONS["mul"](w, *(as_real(w, values[a]) for a in graph.args[other]))
        if other in fusible
        else as_real(w, values[other])
    )
    if op == "sub":
        x, b = (x, -b) if which == 0 else (-x, b)
    return w.fma(x, y, b)
