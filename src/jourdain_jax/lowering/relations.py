"""Relations that decide between branches of rates and stop events, as numbers whose signs decide: they become
sides (`sides.py`).

    a < b, max(a, b), ...    a - b          sign(x), |x|    x          floor(x)    sin(pi x)          round(x)    cos(pi x)

A relation counts where a rate, or its slope, is another one on either side of where that number vanishes, or where a stop event may have a dip there;
with it count the relations that its number is made of. Where its branches agree, as those of a guard do, it does not. Both branches are evaluated on
either side of such places, which are found between the states that are probed; a relation that vanishes between none of these counts.

A rate jumps where such a number vanishes if it changes as much over a way that is much shorter, and bends there if it does not.
"""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from jourdain_jax.calculus.reals import Indices
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph, NodeList

MOST_WATCHED = 32  # of a scene
COMPARED = {"lt": (False, True), "le": (False, True), "gt": (True, False), "ge": (True, False)}  # the truth where a > b, and where a < b
ASIDE, AGREE = 1e-5, 1e-7  # of the way between two probes; of the size of a rate
WHOLE = {"floor": "sin", "ceil": "sin", "round": "cos", "rem": "sin"}


def switches(graph: Graph, nodes: Iterable[int]) -> dict[int, list[tuple[int, int]]]:
    """Return for each number whose sign decides relations these relations. Each has a factor: 1, or -1 if its
    own number is the negative of the key.
    """
    found: dict[int, list[tuple[int, int]]] = {}
    for n in graph.reachable(list(nodes)):
        if graph.varies[n] and (own := _own(graph, n)) is not None and graph.varies[own]:
            number, turned = (graph.args[own][0], -1) if graph.op[own] == "neg" else (own, 1)
            if _is_never_negative(graph, number, {}):  # as in a guard, `where(x x + y y > 0, ...)`
                continue
            if graph.op[number] == "sub" and graph.args[number][0] > graph.args[number][1]:
                number, turned = graph.neg(number), -turned
            found.setdefault(number, []).append((n, turned))
    return found


def _own(graph: Graph, node: int) -> int | None:
    op, args = graph.operation(node)
    if op in COMPARED or op in ("max", "min"):
        return graph.sub(*args)
    if op in ("abs", "sign"):
        return args[0]
    if op not in WHOLE:
        return None
    return graph.call(WHOLE[op], graph.mul(graph.const(np.pi), graph.div(*args) if op == "rem" else args[0]))


def _is_never_negative(graph: Graph, node: int, known: dict[int, bool]) -> bool:
    if node not in known:
        op, args = graph.operation(node)
        squared = op in ("sqrt", "abs", "exp", "cosh") or (op == "mul" and args[0] == args[1]) or (op == "const" and graph.value[node] >= 0)
        known[node] = squared or (op in ("add", "mul", "div") and all(_is_never_negative(graph, a, known) for a in args))
    return known[node]


def _branch(graph: Graph, node: int, above: bool) -> int:
    """Return the value of a relation where its own number is positive (`above`) or negative."""
    op, args = graph.operation(node)
    if op in COMPARED:
        return graph.const(COMPARED[op][0 if above else 1])
    if op == "sign":
        return graph.const(1.0 if above else -1.0)
    if op in WHOLE:  # one step apart
        return node if above else graph.add(node, args[-1] if op == "rem" else graph.one)
    return args[0] if above == (op in ("abs", "max")) else graph.neg(args[0]) if op == "abs" else args[1]


def branches(graph: Graph, nodes: list[tuple[int, int]], outputs: Iterable[int]) -> tuple[NodeList, NodeList]:
    """Return the outputs for a positive number, and for a negative number, of these relations (of
    `switches`).
    """
    outputs = list(outputs)
    above, below = (graph.substituted(outputs, {n: _branch(graph, n, side == turned) for n, turned in nodes}) for side in (1, -1))
    return above, below


def relations(graph: Graph, rates: Sequence[int], events: Sequence[int], probes: Probes, modes: Sequence[int]) -> tuple[Indices, Indices]:
    """Return the numbers whose signs are monitored, in two parts: those of the rates, and those that occur in
    stop events only.

    Numbers that depend on `modes` are omitted, since modes have their own events.
    """
    found: list[NodeList] = []
    for outputs, counts in ((rates, _differ), (events, _may_dip)):
        of_outputs = {n: nodes for n, nodes in switches(graph, outputs).items() if not set(modes) & set(graph.reachable([n]))}
        kept = [n for n, nodes in of_outputs.items() if any(graph.op[k] in WHOLE for k, _ in nodes) or _counts(graph, n, nodes, outputs, counts, probes)]
        needed = set(graph.reachable(kept))
        found.append([n for n in of_outputs if n in kept or any(k in needed for k, _ in of_outputs[n])])
    return tuple(found[0]), tuple(n for n in found[1] if n not in found[0])


def _counts(graph: Graph, number: int, nodes: list[tuple[int, int]], outputs: Sequence[int], counts, probes: Probes) -> bool:
    """Return whether the branches of relations differ near a zero of their number."""
    if (beside := _beside(number, probes)) is None:
        return True
    above, below = branches(graph, nodes, outputs)
    least = AGREE * np.nanmax(np.abs(probes(outputs)), axis=1, initial=0.0)[:, None]
    return any(counts(here(outputs), here(above), here(below), least) for here in beside(ASIDE))


def _differ(values, above, below, least) -> bool:
    return not np.all(np.abs(above - below) <= least)


def _may_dip(values, above, below, least) -> bool:
    """Return whether a value may fall and rise again at a relation. It may if, on one side of the relation,
    the value is not the smaller of its two branches.
    """
    return not np.all(values <= np.minimum(above, below) + least)


def sided(graph: Graph, numbers: Iterable[int], outputs: Sequence[int], probes: Probes) -> Indices:
    """Return the numbers whose branches may be continued beyond their zeros, since both branches are finite
    where the outputs are.
    """
    decided, finite = switches(graph, outputs), np.isfinite(probes(outputs))

    def go_on(number: int) -> bool:
        nodes = decided.get(number, [])
        return all(np.all(np.isfinite(probes(of)) | ~finite) for of in branches(graph, nodes, outputs))

    return tuple(n for n in numbers if go_on(n))


def jumps(graph: Graph, numbers: Iterable[int], outputs: Sequence[int], probes: Probes) -> Indices:
    """Return the numbers at whose zeros, between probes, an output jumps."""
    least = AGREE * np.nanmax(np.abs(probes(outputs)), axis=1, initial=0.0)[:, None]

    def jumps_at(number: int) -> bool:
        if (beside := _beside(number, probes)) is None:
            return False
        closer, wide = (np.abs(behind(outputs) - before(outputs)) for before, behind in map(beside, (1e-9, ASIDE)))
        return bool(np.any((closer > least) & (closer > 0.5 * wide)))

    return tuple(n for n in numbers if jumps_at(n))


def _beside(number: int, probes: Probes) -> Callable[[float], tuple[Probes, Probes]] | None:
    """Return a function that returns states at a given distance on either side of zeros of a number; None if
    the number has no zero between probes.
    """
    values = probes([number])[0]
    positive, negative = np.flatnonzero(values > 0), np.flatnonzero(values < 0)
    count = min(len(positive), len(negative), 6)  # places
    if not count:
        return None
    a, b = ({name: np.broadcast_to(x, probes.count)[k[:count]] for name, x in probes.inputs.items()} for k in (positive, negative))

    def at(share) -> Probes:
        return probes.with_inputs({name: a[name] + share * (b[name] - a[name]) for name in a})

    low, high = np.zeros(count), np.ones(count)
    for _ in range(40):
        middle = 0.5 * (low + high)
        above = at(middle)([number])[0] > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return lambda aside: (at(low - aside), at(high + aside))
