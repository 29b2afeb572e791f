"""Relations of a scalar program as modes and events: a number s holds the side of a relation.

    x = a - b of a < b, max(a, b), ...; x of |x|, sign(x)     s = 1, -1: x counts as positive, negative
    c = s x falls through zero:  s <- -s                      s = 0: x rests at zero, and counts as it is

Within a step no branch changes: the search for events ends the step where x vanishes, and the derivative
jumps
there as at any event (`motion/native/transitions.py`). Relations in Modelica are events, too.
If a branch ends where x vanishes, as `sqrt` does, its relation has the event only. floor(a), whose x is
sin(pi a), is the nearest even or odd number, by the sign of s.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from jourdain_jax.build.trace import Variables
from jourdain_jax.lowering.lowered import NODES, Lowered
from jourdain_jax.lowering.relations import COMPARED, WHOLE, switches
from jourdain_jax.program.graph import Graph


@lru_cache(maxsize=64)
def with_sides(program: Lowered, has_events: bool, modes: tuple[int, ...]) -> Lowered:
    """Return the program with an additional mode and event for each relation, after those of the scene.

    `modes`: which of its inputs are modes.
    """
    old, graph, numbers = program.graph, Graph(keeps_rules=True), program.watched(has_events)
    given = {n: graph.input(str(k), True) for k, n in enumerate(program.variables)}
    sides = [graph.input(f"side {k}", True) for k in range(len(numbers))]
    signs: dict[int, int] = {}
    relations: dict[int, tuple[int, int, int]] = {}
    decided = switches(old, [*program.qdot, *program.ydot, *(program.events if has_events else ())])
    for number, side in zip(numbers, sides, strict=True):
        if number in program.sided:
            relations |= {n: (number, side, turned) for n, turned in decided[number]}
    new = given
    for n in sorted(relations):  # each after those that it is made of
        number, side, turned = relations[n]
        new = graph.copied([number, *old.args[n]], old, new)
        if number not in signs:
            signs[number] = _where(graph, graph.call("eq", side, graph.zero), new[number], side)
        sign = signs[number] if turned > 0 else graph.neg(signs[number])
        new[n] = _by_sign(graph, old.op[n], [new[a] for a in old.args[n]], side, sign)
    nodes = {name: getattr(program, name) for name in NODES}
    new = graph.copied([program.power, *numbers, *(n for part in nodes.values() for n in part)], old, new)
    copied: dict[str, Any] = {name: tuple(new[n] for n in part) for name, part in nodes.items()}
    copied |= dict.fromkeys(("relations", "event_relations", "jumps"), ())
    x = [new[n] for n in numbers]
    inputs = np.array([*(new[n] for n in program.traced.inputs.tolist()), *sides], np.int64)
    parts = program.traced.q, program.traced.u
    q, u = (np.array([new.get(n, 0) for n in part.tolist()], np.int64) for part in parts)  # dependent speeds: none
    now = [*q.tolist(), *(int(u[k]) for k in program.independent), *(int(inputs[i]) for i in modes)]
    events, stops = (copied["events"], program.stops) if has_events else ((), ())
    each = len(copied["resets"]) // max(len(events), 1)
    resets: list[int] = []

    def add(after: dict[int, int], rise: int) -> None:
        """Add a reset: the state and the modes `after` an event, the sides (from the numbers at the new
        state), and the gain in energy.
        """
        for k in sorted(range(len(x)), key=numbers.__getitem__):  # each after those that it is made of
            (moved,) = graph.substituted([x[k]], after)
            if moved != x[k] and sides[k] not in after:
                after[sides[k]] = graph.call("sign", moved)
        resets.extend([*(after.get(n, n) for n in (*now, *sides)), rise])

    for i in range(len(events)):
        *after, rise = copied["resets"][i * each : (i + 1) * each] or (*now, graph.zero)
        add(dict(zip(now, after, strict=True)), rise)
    for side, number in zip(sides, x, strict=True):
        rests = graph.call("eq", side, graph.zero)
        add({side: _where(graph, rests, graph.call("sign", number), graph.neg(side))}, graph.zero)
    below = [graph.call("lt", side, graph.zero) for side in sides]
    falls = [_where(graph, is_below, graph.neg(n), n) for is_below, n in zip(below, x, strict=True)]
    return replace(
        program,
        traced=Variables(graph, new[program.traced.t], q, u, inputs, []),
        inputs=(*program.inputs, *(f"side {k}" for k in range(len(sides)))),
        fixed=tuple(new[n] for n in program.fixed),
        power=new[program.power],
        **copied | {"events": (*events, *falls), "resets": tuple(resets), "stops": (*stops, *[False] * len(sides)), "z": ()},
        sides=len(sides),
    )


def _where(graph: Graph, condition: int, there: int, otherwise: int) -> int:
    return graph.call("select", condition, otherwise, there)


def _by_sign(graph: Graph, op: str, args: Sequence[int], side: int, sign: int) -> int:
    """Return the value of a relation for this `sign` of its own number. If the relation is a whole number,
    return it for this `side`.
    """
    if op in COMPARED:
        return graph.call(op, sign, graph.zero)
    if op == "sign":
        return graph.call("sign", sign)
    if op in WHOLE:
        return _whole(graph, op, args, side)
    low, high = {
        "abs": (graph.neg(args[0]), args[0]),
        "max": (args[-1], args[0]),
        "min": (args[0], args[-1]),
    }[op]
    return _where(graph, graph.call("lt", sign, graph.zero), low, high)


def _whole(graph: Graph, op: str, args: Sequence[int], side: int) -> int:
    """Return floor(a), ceil(a), round(a) or rem(a, b) on a given side, where the whole number below a, a/b or
    a + 1/2 is even or odd.

    `side`: 1 for an even number, -1 for an odd one.
    """
    a = graph.div(*args) if op == "rem" else args[0]
    odd = _where(graph, graph.call("lt", side, graph.zero), graph.one, graph.zero)
    middle = graph.sub(a, odd if op == "round" else graph.add(odd, graph.const(0.5)))
    n = graph.add(graph.mul(graph.const(2.0), graph.call("round", graph.mul(graph.const(0.5), middle))), odd)
    plain = graph.call("round" if op == "round" else "floor", a)
    n = _where(graph, graph.call("eq", side, graph.zero), plain, n)
    if op == "ceil":
        return graph.add(n, graph.one)
    if op == "rem":  # towards zero
        towards = _where(graph, graph.call("lt", n, graph.zero), graph.add(n, graph.one), n)
        return graph.sub(args[0], graph.mul(args[1], towards))
    return n
