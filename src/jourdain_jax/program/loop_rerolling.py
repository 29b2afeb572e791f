"""Loop re-rolling: repeated blocks of a program become loops, whose iterations apply the same operations to values of the iteration before or from outside.

    k-th operation of iteration r:   n[r, k] = op[k](arguments)
    each argument, alike in all iterations, is    Here(k')      n[r, k'] of the same iteration
                                                  Before(k')    n[r - 1, k'] of the iteration before; at r = 0 what is given
                                                  Given         one value per iteration, known when the loop begins

Chains of bodies give such blocks, if operations are put in an order that follows the chain. The order decides; nothing has to be said by the scene.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program.graph import ARRAYS, Graph

LONGEST = 400  # operations of one iteration
LEAST = 48  # operations that one loop must save
WORTHWHILE = 1000  # operations that all loops of a program must save: with fewer, a row compiles in seconds and runs up to a fifth faster
_ALONE = {*ARRAYS, "entry", *(name for name, operation in TABLE.items() if not operation.is_number)}  # loops carry numbers
_COMMUTATIVE = {name for name, operation in TABLE.items() if operation.commutes}


@dataclass(frozen=True)
class Here:
    """An operation of the same iteration."""

    place: int


@dataclass(frozen=True)
class Before:
    """An operation of the iteration before."""

    place: int
    first: int  # the node that stands for it in the first iteration


@dataclass(frozen=True)
class Given:
    """One node per iteration, all known when the loop begins."""

    nodes: tuple[int, ...]


Argument: TypeAlias = Here | Before | Given


@dataclass(frozen=True)
class Loop:
    """Iterations of the same operations."""

    ops: tuple[str, ...]
    arguments: tuple[tuple[Argument, ...], ...]
    nodes: np.ndarray  # (iterations, operations)


def deepest_first(graph: Graph, outputs: Sequence[int], known: Iterable[int]) -> list[int]:
    """What must be computed, each node soon after its arguments, of which the one at the end of the longest chain of operations comes first.

    So chains are followed from their beginning, sums grow term by term, and little is carried along.
    """
    seen = set(known)
    depth: dict[int, int] = {}
    for node in graph.needed(outputs, seen):
        depth[node] = 1 + max((depth.get(a, 0) for a in graph.args[node]), default=0)
    order = []

    def arguments(node):
        return iter(sorted(graph.args[node], key=lambda a: -depth.get(a, 0)))

    for output in outputs:
        waiting = [] if output in seen else [(output, arguments(output))]
        seen.add(output)
        while waiting:
            arg = next((a for a in waiting[-1][1] if a not in seen), None)
            if arg is None:
                order.append(waiting.pop()[0])
            else:
                seen.add(arg)
                waiting.append((arg, arguments(arg)))
    return order


def with_loops(graph: Graph, order: Sequence[int]) -> list[list[int] | Loop]:
    """The nodes of `order`, with repeats gathered into loops and what lies between loops in lists; one list where loops would save little."""
    names = {name: k for k, name in enumerate(sorted({graph.op[n] for n in order}))}
    kinds = np.array([names[graph.op[n]] for n in order], int)
    alone = np.array([graph.op[n] in _ALONE for n in order], bool)
    kinds[alone] = -1 - np.arange(np.count_nonzero(alone))
    parts: list[list[int] | Loop] = []
    for begin, length, iterations in _periods(kinds, 0, len(order)):
        for part in _parts(graph, order, begin, length, iterations):
            if parts and isinstance(part, list) and isinstance(parts[-1], list):
                parts[-1].extend(part)
            else:
                parts.append(part)
    saved = sum(part.nodes.size - len(part.ops) for part in parts if isinstance(part, Loop))
    return parts if saved >= WORTHWHILE else [list(order)]


def _periods(kinds: np.ndarray, begin: int, end: int) -> Iterator[tuple[int, int, int]]:
    """(begin, length of an iteration, iterations) of stretches in which the kinds repeat, and (begin, length, 1) of what lies between."""
    most, found = LEAST - 1, None
    for length in range(1, min(LONGEST, (end - begin) // 3) + 1):
        same = kinds[begin : end - length] == kinds[begin + length : end]
        breaks = np.flatnonzero(~same)
        starts, ends = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(same)]])
        longest = int(np.argmax(ends - starts))
        iterations = 1 + int(ends[longest] - starts[longest]) // length
        if iterations >= 3 and (iterations - 1) * length > most:
            most, found = (iterations - 1) * length, (begin + int(starts[longest]), length, iterations)
    if found is None:
        if end > begin:
            yield begin, end - begin, 1
        return
    yield from _periods(kinds, begin, found[0])
    yield found
    yield from _periods(kinds, found[0] + found[1] * found[2], end)


def _parts(graph: Graph, order: Sequence[int], begin: int, length: int, iterations: int) -> Iterator[list[int] | Loop]:
    """The longest loop whose iterations take their arguments from the same places, and what comes before and after it."""
    nodes = np.array(order[begin : begin + length * iterations]).reshape(iterations, length)
    if iterations == 1:
        yield nodes[0].tolist()
        return
    arguments = _aligned(graph, nodes)
    origins = _origins(nodes, arguments)
    first, last = _longest(origins, length)
    if (last - first - 1) * length < LEAST:
        yield nodes.ravel().tolist()
        return
    if first > 0:
        yield nodes[:first].ravel().tolist()
    yield _loop(graph, nodes[first:last], arguments[first:last], origins[last - 1])
    if last < iterations:
        yield nodes[last:].ravel().tolist()


def _aligned(graph: Graph, nodes: np.ndarray) -> list[list[tuple[int, ...]]]:
    """Arguments of every node, those of sums and products in the order of their counterparts in the iteration before."""
    place = {n: divmod(k, nodes.shape[1]) for k, n in enumerate(nodes.ravel().tolist())}
    found: list[list[tuple[int, ...]]] = []

    def likeness(r, a, b):
        """How much argument a in iteration r is like argument b in the iteration before."""
        if a == b:
            return 3
        if a in place and b in place:
            (at, k), (before, j) = place[a], place[b]
            return 4 if k == j and at - r == before - (r - 1) else 0
        return 1 if (a in place) == (b in place) and graph.op[a] == graph.op[b] else 0

    for r, row in enumerate(nodes.tolist()):
        here = []
        for k, node in enumerate(row):
            args = graph.args[node]
            if r and len(args) == 2 and graph.op[node] in _COMMUTATIVE:
                before = found[-1][k]
                straight, crossed = (sum(likeness(r, a, b) for a, b in zip(x, before, strict=True)) for x in (args, args[::-1]))
                args = args[::-1] if crossed > straight else args
            here.append(args)
        found.append(here)
    return found


def _origins(nodes: np.ndarray, arguments) -> np.ndarray:
    """Where the arguments of each iteration are found: k in the same iteration, length + k in the one before, -1 before the loop, -2 elsewhere in it."""
    iterations, length = nodes.shape
    place = {n: divmod(k, length) for k, n in enumerate(nodes.ravel().tolist())}

    def origin(r, a):
        if a not in place:
            return -1
        back = r - place[a][0]
        return place[a][1] + back * length if back < 2 else -2

    return np.array([[origin(r, a) for args in arguments[r] for a in args] for r in range(iterations)])


def _longest(origins: np.ndarray, length: int) -> tuple[int, int]:
    """The longest stretch of iterations with the same origins; its first iteration may be given what the others take from the one before."""
    best, begin = (0, 0), 0
    for r in range(1, len(origins) + 1):
        if r == len(origins) or np.any(origins[r] != origins[begin]) or np.any(origins[r] == -2):
            first = begin - 1 if begin and _may_begin(origins[begin - 1], origins[begin], length) else begin
            if np.all(origins[begin] != -2) and r - first > best[1] - best[0]:
                best = first, r
            begin = r
    return best


def _may_begin(first: np.ndarray, origin: np.ndarray, length: int) -> bool:
    inside = (origin >= 0) & (origin < length)
    return bool(np.all(np.where(inside, first == origin, (first < 0) | (first >= length))))


def _loop(graph: Graph, nodes: np.ndarray, arguments, origin: np.ndarray) -> Loop:
    length = nodes.shape[1]
    origins = iter(origin.tolist())
    found = []
    for k in range(length):
        slots: list[Argument] = []
        for j in range(len(arguments[0][k])):
            where = next(origins)
            given = tuple(args[k][j] for args in arguments)
            slots.append(Given(given) if where < 0 else Here(where) if where < length else Before(where - length, given[0]))
        found.append(tuple(slots))
    return Loop(tuple(graph.op[n] for n in nodes[0].tolist()), tuple(found), nodes)


def sources(loop: Loop) -> set[int]:
    """Nodes from outside that a loop needs."""
    slots = [slot for slots in loop.arguments for slot in slots]
    return {n for s in slots if isinstance(s, Given) for n in s.nodes} | {s.first for s in slots if isinstance(s, Before)}
