"""Find the relations that decide between branches of rates and events. Each relation is decided by the sign
of a number (`sides.py`):

    relation    a < b, max(a, b), ...     sign(x), |x|     floor(x), ceil(x)     round(x)
    number      a - b                     x                sin(pi x)             sin(pi (x + 1/2))

A relation is monitored if a rate or its slope differs between the two sides of the zero of its number, if an
event may have a dip there, or if its number has no zero between probes. Relations on which a monitored number
depends are monitored, too. Relations with equal branches, as in guards, are not monitored.

Both branches are evaluated on both sides of zeros between probes, for all combinations of decisions of
unrelated relations: the branches of `(x > a) & (y > b)`, for example, agree where y < b.

A rate jumps at a zero if its change does not shrink with the distance between the two sides. Otherwise it has
a kink.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from jourdain_jax.calculus.reals import Indices
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph, NodeList

MOST_WATCHED = 32  # tuning: maximum number of monitored relations of a scene
# values of comparisons if a > b, and if a < b
COMPARED = {"lt": (False, True), "le": (False, True), "gt": (True, False), "ge": (True, False)}
EQUAL = {"eq": (False, False), "ne": (True, True)}  # not monitored, unless the number also decides others
COMPARED |= EQUAL
# distance from a zero, relative to the distance of two probes; tolerance, relative to the size of a rate
ASIDE, AGREE = 1e-5, 1e-7  # numerics
# numerics: maximum number of decisions of other relations at each zero; if there are more, random ones
DECISIONS = 512
Decided = dict[int, list[tuple[int, int]]]  # result of `switches`
WHOLE = ("floor", "ceil", "round", "rem")


def switches(graph: Graph, nodes: Iterable[int]) -> Decided:
    """Return relations by the number whose sign decides them. Each relation has a factor: 1, or -1 if the
    negative number decides it.
    """
    found: Decided = {}
    for n in graph.reachable(list(nodes)):
        if graph.varies[n] and (own := _own(graph, n)) is not None and graph.varies[own]:
            number, turned = (graph.args[own][0], -1) if graph.op[own] == "neg" else (own, 1)
            if _is_never_negative(graph, number, {}):  # as in a guard, `where(x x + y y > 0, ...)`
                continue
            if graph.op[number] == "sub" and graph.args[number][0] > graph.args[number][1]:
                number, turned = graph.neg(number), -turned
            found.setdefault(number, []).append((n, turned))
    alone = [number for number, nodes in found.items() if all(graph.op[n] in EQUAL for n, _ in nodes)]
    return {number: nodes for number, nodes in found.items() if number not in alone}


def _own(graph: Graph, node: int) -> int | None:
    op, args = graph.op[node], graph.args[node]
    if op in WHOLE:
        return graph.call("sin", graph.mul(graph.const(np.pi), counted(graph, op, args)))
    if op in ("abs", "sign"):
        own = args[0]
    elif op in COMPARED or op in ("max", "min"):
        own = graph.sub(*args)
    else:
        return None
    if graph.op[own] == "rem":  # rem(a, b) has the sign of a
        own = graph.args[own][0]
    return None if any(map(graph.is_truth, args)) else own


def counted(graph: Graph, op: str, args: Sequence[int]) -> int:
    """Return the number whose integer part decides: a/b for rem(a, b), a + 1/2 for round(a), a otherwise."""
    if op == "rem":
        return graph.div(*args)
    return graph.add(args[0], graph.const(0.5)) if op == "round" else args[0]


def _is_never_negative(graph: Graph, node: int, known: dict[int, bool]) -> bool:
    if node not in known:
        op, args = graph.operation(node)
        squared = op == "mul" and args[0] == args[1]
        constant = op == "const" and graph.value[node] >= 0
        known[node] = op in ("sqrt", "abs", "exp", "cosh") or squared or constant
        if op in ("add", "mul", "div") and not known[node]:
            known[node] = all(_is_never_negative(graph, a, known) for a in args)
    return known[node]


def _branch(graph: Graph, node: int, above: bool) -> int:
    """Return the value of a relation where its number is positive (`above`) or negative."""
    op, args = graph.operation(node)
    if op in COMPARED:
        return graph.const(COMPARED[op][0 if above else 1])
    if op == "sign":
        return graph.const(1.0 if above else -1.0)
    if op in WHOLE:  # one step apart
        return node if above else graph.add(node, args[-1] if op == "rem" else graph.one)
    return args[0] if above == (op in ("abs", "max")) else graph.neg(args[0]) if op == "abs" else args[1]


def where(graph: Graph, condition: int, there: int, otherwise: int) -> int:
    """Return a node with the value `there` if the condition is true, and `otherwise` if not."""
    return graph.call("select", condition, otherwise, there)


def branches(graph: Graph, nodes: list[tuple[int, int]], outputs: Iterable[int]) -> tuple[NodeList, NodeList]:
    """Return the outputs above and below the zero of the number that decides the relations `nodes`."""
    outputs = list(outputs)
    above, below = (
        graph.substituted(outputs, {n: _branch(graph, n, side == turned) for n, turned in nodes})
        for side in (1, -1)
    )
    return above, below


def relations(
    graph: Graph, rates: Sequence[int], events: Sequence[int], probes: Probes, modes: Sequence[int]
) -> tuple[Indices, Indices]:
    """Return the nodes whose signs are monitored: those that decide relations in the rates, and further ones
    that decide relations in events.

    Nodes that depend on `modes` are omitted, because modes have their own events.
    """
    found: list[NodeList] = []
    for outputs, excess in ((rates, _difference), (events, _dip)):
        decided = switches(graph, outputs)
        of_outputs = {n: nodes for n, nodes in decided.items() if not set(modes) & set(graph.reachable([n]))}

        def counts(number: int, decided: Decided = decided, outputs=outputs, excess=excess) -> bool:
            whole = any(graph.op[k] in WHOLE for k, _ in decided[number])
            return whole or _counts(graph, number, decided, outputs, excess, probes)

        kept = list(filter(counts, of_outputs))
        needed = set(graph.reachable(kept))
        found.append([n for n in of_outputs if n in kept or any(k in needed for k, _ in of_outputs[n])])
    return tuple(found[0]), tuple(n for n in found[1] if n not in found[0])


def _counts(graph: Graph, number: int, decided: Decided, outputs: Sequence[int], excess, probes) -> bool:
    """Return whether a number must be monitored: the branches of its relations differ near a zero, or it has
    no zero.
    """
    least = AGREE * np.nanmax(np.abs(probes(outputs)), axis=1, initial=0.0)[:, None]
    for beside, here in _beside(graph, number, decided, outputs, probes):
        above, below = branches(graph, decided[number], here)
        for at in beside(ASIDE):
            more = excess(at(here), at(above), at(below))
            if np.any(more > least) or (here is outputs and np.any(np.isnan(more))):
                return True
    values = probes([number])[0]
    return not (np.any(values > 0) and np.any(values < 0))


def _difference(values, above, below):
    return np.abs(above - below)


def _dip(values, above, below):
    """Return the excess of a value over the lower of its two branches. If there is an excess, the value may
    dip.
    """
    return values - np.minimum(above, below)


def sided(graph: Graph, numbers: Iterable[int], outputs: Sequence[int], probes: Probes) -> Indices:
    """Return the numbers whose branches are both defined beyond their zeros: both are finite wherever the
    outputs are.
    """
    decided, finite = switches(graph, outputs), np.isfinite(probes(outputs))

    def go_on(number: int) -> bool:
        nodes = decided.get(number, [])
        return all(np.all(np.isfinite(probes(of)) | ~finite) for of in branches(graph, nodes, outputs))

    return tuple(n for n in numbers if go_on(n))


def jumps(graph: Graph, numbers: Iterable[int], outputs: Sequence[int], probes: Probes) -> Indices:
    """Return the numbers at whose zeros between probes an output jumps."""
    outputs, decided = list(outputs), switches(graph, outputs)
    least = AGREE * np.nanmax(np.abs(probes(outputs)), axis=1, initial=0.0)[:, None]

    def jumps_at(number: int) -> bool:
        for beside, here in _beside(graph, number, decided, outputs, probes):
            pairs = map(beside, (1e-9, ASIDE))
            closer, wide = (np.abs(behind(here) - before(here)) for before, behind in pairs)
            if np.any((closer > least) & (closer > 0.5 * wide)):
                return True
        return False

    return tuple(n for n in numbers if jumps_at(n))


def _beside(graph: Graph, number: int, decided: Decided, outputs: Sequence[int], probes: Probes) -> Iterator:
    """Yield a pair: a function from a distance to probes on the two sides of zeros of a number, and the
    outputs. Then yield such a pair for all decisions of unrelated relations. Yield nothing if there is no
    zero between probes.

    A relation is unrelated if neither number depends on the other, and its number varies between the zeros.
    """
    values = probes([number])[0]
    positive, negative = np.flatnonzero(values > 0), np.flatnonzero(values < 0)
    count = min(len(positive), len(negative), 6)  # number of zeros
    if not count:
        return
    a, b = (
        {name: np.broadcast_to(x, probes.count)[k[:count]] for name, x in probes.inputs.items()}
        for k in (positive, negative)
    )

    def at(share) -> dict[str, np.ndarray]:
        return {name: a[name] + share * (b[name] - a[name]) for name in a}

    low, high = np.zeros(count), np.ones(count)
    for _ in range(40):
        middle = 0.5 * (low + high)
        above = probes.with_inputs(at(middle))([number])[0] > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    sides = [lambda aside: at(low - aside), lambda aside: at(high + aside)]
    yield lambda aside: [probes.with_inputs(side(aside)) for side in sides], outputs
    own, nodes = set(graph.reachable([number])), {n for n, _ in decided.get(number, ())}
    zeros = probes.with_inputs(at(middle))

    def apart(other: int) -> bool:
        made_of, decides = graph.reachable([other]), (n for n, _ in decided[other])
        apart_of_graph = other != number and nodes.isdisjoint(made_of) and own.isdisjoint(decides)
        return apart_of_graph and (count == 1 or np.ptp(zeros([other])) > ASIDE * np.ptp(probes([other])))

    free = {k: graph.input(f"decision {k}", True) for k in decided if apart(k)}
    if not free:
        return
    replaced = {}
    for k, decision in free.items():
        is_below = graph.call("lt", decision, graph.zero)
        for n, turned in decided[k]:
            if graph.op[n] not in EQUAL:
                there, otherwise = (_branch(graph, n, above) for above in (turned < 0, turned > 0))
                replaced[n] = where(graph, is_below, there, otherwise)
    if 2 ** len(free) <= DECISIONS:
        chosen = 1.0 - 2.0 * (np.arange(2 ** len(free))[:, None] >> np.arange(len(free)) & 1)
    else:
        chosen = np.random.default_rng(0).choice([-1.0, 1.0], (DECISIONS, len(free)))
    decisions = {f"decision {k}": np.repeat(x, count) for k, x in zip(free, chosen.T, strict=True)}

    def decided_freely(aside):
        tiled = ({name: np.tile(x, len(chosen)) for name, x in side(aside).items()} for side in sides)
        return [probes.with_inputs(inputs | decisions) for inputs in tiled]

    yield decided_freely, graph.substituted(outputs, replaced)
