"""Convert relations of a scalar program, such as `a < b` or `|x|`, to modes and events. The mode s of a
relation is the side of it on which the state is.

    x = a - b of a < b, max(a, b), ...; x of |x|, sign(x)     s = 1, -1: x counts as positive, negative
    c = s x falls through zero:  s <- -s                      s = 0: x rests at zero; its current sign counts

    n of floor(a) = n, ceil(a) = n + 1, ...                   s = 2 n + 1; s = 0 before the start
    c = (a - n) (n + 1 - a) falls through zero:  n <- n +- 1

The branch does not change within a step: the event search ends the step where x vanishes, and derivatives
change there as at any event (`integrate/loop/transitions.py`). Modelica treats relations in the same way. If
a branch is undefined beyond x = 0, as with `sqrt`, its relation has the event but not the mode.

Relations of the traced scene also show kinks and jumps of loads and masses, without a lowered program. Kinks
inside a JAX call (`jnp.interp`, a callback) are not detected.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from jourdain_jax.lowering.lowered_equations import NODES, Lowered
from jourdain_jax.lowering.relations import AGREE, COMPARED, WHOLE, branches, counted, jumps, switches, where
from jourdain_jax.program.evaluate import Probes, depend_on
from jourdain_jax.program.graph import Graph, NodeList, Unsupported
from jourdain_jax.scene.identity import with_reference_parameters
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.probes import looked_at
from jourdain_jax.structure.structure import structure_whatever_its_faults
from jourdain_jax.structure.trace import TracedScene, Variables, named_values, owned


@lru_cache(maxsize=64)
def with_sides(program: Lowered, has_events: bool, modes: tuple[int, ...]) -> Lowered:
    """Return the program with a mode and an event for each relation, after the scene's modes and events.

    `modes`: indices of the inputs that are modes.
    """
    old, graph, numbers = program.graph, Graph(keeps_rules=True), program.watched(has_events)
    given = {n: graph.input(str(k), True) for k, n in enumerate(program.variables)}
    sides = [graph.input(f"side {k}", True) for k in range(len(numbers))]
    relations: dict[int, tuple[int, int, int]] = {}
    decided = switches(old, [*program.qdot, *program.ydot, *(program.events if has_events else ())])
    first = {
        number: [pair for pair in nodes if old.op[pair[0]] in WHOLE][:1] for number, nodes in decided.items()
    }
    wholes = [bool(first.get(number)) for number in numbers]
    for number, side in zip(numbers, sides, strict=True):
        if number in program.sided:
            relations |= {n: (number, side, turned) for n, turned in decided[number]}
    new = given
    for n in sorted(relations):  # in order of dependence
        number, side, turned = relations[n]
        new = graph.copied([number, *old.args[n]], old, new)
        args = [new[a] for a in old.args[n]]
        new[n] = _by_side(graph, old.op[n], args, turned, side, new[number], bool(first[number]))
    nodes = {name: getattr(program, name) for name in NODES}
    new = graph.copied([program.power, *numbers, *(n for part in nodes.values() for n in part)], old, new)
    copied: dict[str, Any] = {name: tuple(new[n] for n in part) for name, part in nodes.items()}
    copied |= dict.fromkeys(("relations", "event_relations"), ())
    x = [
        _counted(graph, old, first[n][0], new) if whole else new[n]
        for n, whole in zip(numbers, wholes, strict=True)
    ]
    inputs = np.array([*(new[n] for n in program.traced.inputs.tolist()), *sides], np.int64)
    parts = program.traced.q, program.traced.u
    # nodes of dependent speeds do not exist on the new graph
    q, u = (np.array([new.get(n, 0) for n in part.tolist()], np.int64) for part in parts)
    now = [*q.tolist(), *(int(u[k]) for k in program.independent), *(int(inputs[i]) for i in modes)]
    events, stops = (copied["events"], program.stops) if has_events else ((), ())
    each = len(copied["resets"]) // max(len(events), 1)
    resets: list[int] = []

    def add(after: dict[int, int], rise: int) -> None:
        """Add a reset: the state and the modes `after` an event, the new sides, and the gain of stored
        energy.
        """
        for k in sorted(range(len(x)), key=numbers.__getitem__):  # in order of dependence
            (moved,) = graph.substituted([x[k]], after)
            if moved != x[k] and sides[k] not in after:
                anew = _odd(graph, graph.call("floor", moved)) if wholes[k] else graph.call("sign", moved)
                after[sides[k]] = where(graph, graph.call("eq", moved, x[k]), sides[k], anew)
        resets.extend([*(after.get(n, n) for n in (*now, *sides)), rise])

    for i in range(len(events)):
        *after, rise = copied["resets"][i * each : (i + 1) * each] or (*now, graph.zero)
        add(dict(zip(now, after, strict=True)), rise)
    falls = []
    for side, number, whole in zip(sides, x, wholes, strict=True):
        at_rest = graph.call("eq", side, graph.zero)
        if whole:
            n = _whole(graph, side)
            above, left = graph.sub(number, n), graph.sub(graph.add(n, graph.one), number)
            up = graph.call("lt", left, above)
            add({side: graph.add(side, where(graph, up, graph.const(2.0), graph.const(-2.0)))}, graph.zero)
            falls.append(where(graph, at_rest, number, graph.mul(above, left)))
        else:
            add({side: where(graph, at_rest, graph.call("sign", number), graph.neg(side))}, graph.zero)
            falls.append(where(graph, graph.call("lt", side, graph.zero), graph.neg(number), number))
    copied |= {"events": (*events, *falls), "resets": tuple(resets), "z": ()}
    return replace(
        program,
        traced=Variables(graph, new[program.traced.t], q, u, inputs, []),
        inputs=(*program.inputs, *(f"side {k}" for k in range(len(sides)))),
        fixed=tuple(new[n] for n in program.fixed),
        power=new[program.power],
        stops=(*stops, *[False] * len(sides)),
        sides=tuple(wholes),
        **copied,
    )


def _counted(graph: Graph, old: Graph, first: tuple[int, int], new: dict[int, int]) -> int:
    """Return the number whose integer part decides a relation. `first`: the relation, and 1, or -1 if the
    negative number decides it.
    """
    node, turned = first
    found = counted(graph, old.op[node], [new[a] for a in old.args[node]])
    return found if turned > 0 else graph.neg(found)


def _whole(graph: Graph, side: int) -> int:
    """Return the integer n that belongs to the side 2 n + 1."""
    return graph.mul(graph.const(0.5), graph.sub(side, graph.one))


def _odd(graph: Graph, n: int) -> int:
    """Return the side 2 n + 1 that belongs to the integer n."""
    return graph.add(graph.mul(graph.const(2.0), n), graph.one)


def _by_side(graph: Graph, op: str, args: NodeList, turned: int, side: int, number: int, whole: bool) -> int:
    """Return the value of a relation on this `side` of its number. `turned`: 1, or -1 if the negative number
    decides.
    """
    at_rest = graph.call("eq", side, graph.zero)
    if op in WHOLE:
        n = _whole(graph, side)
        plain = graph.call("floor", counted(graph, op, args))
        n = where(graph, at_rest, plain, n if turned > 0 else graph.neg(graph.add(n, graph.one)))
        if op == "ceil":
            return graph.add(n, graph.one)
        if op == "rem":  # towards zero
            towards = where(graph, graph.call("lt", n, graph.zero), graph.add(n, graph.one), n)
            return graph.sub(args[0], graph.mul(args[1], towards))
        return n
    sign = graph.call("cos", graph.mul(graph.const(np.pi), _whole(graph, side))) if whole else side
    sign = where(graph, at_rest, number, sign)
    sign = sign if turned > 0 else graph.neg(sign)
    if op in COMPARED:
        return graph.call(op, sign, graph.zero)
    if op == "sign":
        return graph.call("sign", sign)
    low, high = {
        "abs": (graph.neg(args[0]), args[0]),
        "max": (args[-1], args[0]),
        "min": (args[0], args[-1]),
    }[op]
    return where(graph, graph.call("lt", sign, graph.zero), low, high)


def loads_have_relations(scene: Scene) -> bool:
    """Return whether relations decide between branches of loads or masses."""
    traced = looked_at(scene).traced
    return bool(switches(traced.graph, _loads(scene, traced)))


def may_jump(scene: Scene, scene_varies: bool, inputs_vary: bool) -> bool:
    """Return whether loads, masses or constraints jump at a place or time that varies. It depends on the
    state, or on parameters or inputs if they vary. Derivatives are correct at jumps at other times.
    """
    scene = with_reference_parameters(scene)
    traced = looked_at(scene).traced
    graph, outputs = traced.graph, [*_loads(scene, traced), *traced.at.phi.tolist(), *traced.at.qdot.tolist()]
    moving = [*traced.q.tolist(), *traced.u.tolist()]
    moving += traced.inputs[: len(scene.inputs) - len(scene.modes.names)].tolist() if inputs_vary else []
    moving += [n for leaf in traced.parameters for n in leaf.ravel().tolist()] if scene_varies else []
    numbers = [n for n in switches(graph, outputs) if depend_on(graph, [n], moving)[0]]
    return bool(numbers) and bool(jumps(graph, numbers, outputs, _probes(scene, traced)))


def bent_load(scene: Scene, t, q, u, inputs) -> str:
    """Return the name of a load or mass that has no derivative at this state; empty if all have one."""
    try:
        traced = looked_at(scene).traced
    except Unsupported:
        return ""
    graph, named = traced.graph, _loads(scene, traced)
    loads, numbers = list(named), switches(graph, named)
    if not numbers:
        return ""
    at = np.concatenate([np.ravel(x).astype(float) for x in (q, u, inputs)])
    # 1e-6 away from the state, relative for entries larger than one
    step = np.diag(1e-6 * np.maximum(1.0, np.abs(at)))
    q, u, inputs = np.split(
        np.concatenate([at + step, at - step]), np.cumsum([np.size(q), np.size(u)]), axis=1
    )
    beside = Probes(graph, named_values(scene, t, q, u, inputs))
    size, bent = np.nanmax(np.abs(_probes(scene, traced)(loads)), axis=1), np.zeros(len(loads), bool)
    for number, nodes in numbers.items():
        if not beside.sign(number):
            above, below = branches(graph, nodes, loads)
            bent |= np.any(np.abs(beside(above) - beside(below)) > AGREE * size[:, None], axis=1)
    return named[loads[int(np.argmax(bent))]] if np.any(bent) else ""


def _probes(scene: Scene, traced: TracedScene) -> Probes:
    """Return probes at the states used to determine the scene's structure, with random speeds and inputs."""
    known, generator = structure_whatever_its_faults(scene), np.random.default_rng(7)
    u, inputs = (
        generator.normal(size=(len(known.times), len(names)))
        for names in (scene.speed_names.entries, scene.inputs)
    )
    return Probes(traced.graph, named_values(scene, known.times, known.coordinates, u, inputs))


def _loads(scene: Scene, traced: TracedScene) -> dict[int, str]:
    """Return the names of loads and masses, by node."""
    names = "force", "torque", "mass", "inertia", "direct"
    return owned(scene, **{name: getattr(traced.at, name) for name in names})
