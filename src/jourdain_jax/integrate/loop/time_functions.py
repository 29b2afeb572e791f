"""Functions of time on the scalar graph: substitute them for inputs of a program, and detect their jumps."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from jourdain_jax.integrate.inputs import TimeProgram
from jourdain_jax.lowering.lowered_equations import NODES, Lowered
from jourdain_jax.lowering.relations import jumps, sided, switches
from jourdain_jax.program.evaluate import Probes, depend_on
from jourdain_jax.program.graph import ARRAYS, Graph, Unsupported
from jourdain_jax.program.interpret import Nodes, as_nodes, interpret
from jourdain_jax.structure.trace import Variables

# limit for all functions of time; each number is a row of a lane, so long tables should use `jj.Sampled`
MOST_NUMBERS = 200  # tuning


@lru_cache(maxsize=64)
def with_functions(program: Lowered, functions: tuple[TimeProgram | None, ...]) -> Lowered | str:
    """Return the program with these functions substituted for inputs, or why that is not possible. Their
    numbers are appended to the `fixed` values of the program.
    """
    numbers = sum(
        math.prod(shape) for function in functions if function is not None for shape in function.shapes
    )
    if numbers > MOST_NUMBERS:
        return f"inputs are functions of time with {numbers} numbers, more than {MOST_NUMBERS}"
    if any(program.graph.op[n] in ARRAYS for n in program.fixed):
        return "parts of the scene are JAX calls, and an input is a function of time"
    graph = Graph(keeps_rules=True)
    new = {n: graph.input(str(k), True) for k, n in enumerate(program.variables)}
    t, known = new[program.traced.t], []
    try:
        for node, function in zip(program.traced.inputs.tolist(), functions, strict=True):
            if function is not None:
                own, new[node] = _on_graph(graph, function, t, f"{node}")
                known += own
    except (Unsupported, ValueError) as error:
        return f"an input is a function of time without scalar form ({error})"
    nodes = {name: getattr(program, name) for name in NODES}
    of_functions = [new[n] for n in program.traced.inputs.tolist() if n in new]
    by_functions = switches(graph, of_functions)
    probes = _random(graph, [*by_functions, *of_functions])
    go_on = sided(graph, by_functions, of_functions, probes)
    new = graph.copied([program.power, *(n for part in nodes.values() for n in part)], program.graph, new)
    on_it: dict[str, Any] = {name: tuple(new[n] for n in part) for name, part in nodes.items()}
    on_it["relations"] = tuple(dict.fromkeys([*on_it["relations"], *by_functions]))
    on_it["sided"] += go_on
    stays = [i for i, function in enumerate(functions) if function is None]
    u = [new.get(n, t) for n in program.traced.u.tolist()]  # dependent speeds are not variables
    q, inputs = (
        np.array([new[n] for n in part.tolist()], np.int64)
        for part in (program.traced.q, program.traced.inputs[stays])
    )
    return replace(
        program,
        traced=Variables(graph, t, q, np.array(u, np.int64), inputs, []),
        inputs=tuple(program.inputs[i] for i in stays),
        fixed=(*(new[n] for n in program.fixed), *known),
        power=new[program.power],
        **on_it,
        z=(),  # dependent speeds of saved states are computed by the original program
    )


def _random(graph: Graph, nodes: Iterable[int]) -> Probes:
    """Return random times and numbers, at which jumps of functions are detected."""
    generator = np.random.default_rng(11)
    return Probes(
        graph,
        {
            str(graph.value[n]): generator.uniform(-1.0, 3.0, 64)
            for n in graph.reachable(nodes)
            if graph.op[n] == "input"
        },
    )


def _on_graph(graph: Graph, function: TimeProgram, t: int, name: str) -> tuple[list[int], int]:
    """Return the nodes of a function's numbers, and the node of its value at time t."""
    given = [
        [graph.input(f"{name} {k} {i}", True) for i in range(math.prod(shape))]
        for k, shape in enumerate(function.shapes)
    ]
    arguments = [Nodes(np.reshape(part, shape)) for part, shape in zip(given, function.shapes, strict=True)]
    value = interpret(graph, function.closed, [*arguments, Nodes(t)])[0]
    return [n for part in given for n in part], int(as_nodes(graph, value))


def function_may_jump(function: TimeProgram, varies: Sequence[bool] | None = None) -> bool:
    """Return whether a function of time jumps. `varies`: flags of its numbers; then only jumps count whose
    times depend on a flagged number.
    """
    graph = Graph(keeps_rules=True)
    try:
        numbers, value = _on_graph(graph, function, graph.input("t", True), "")
    except (Unsupported, ValueError):
        return False
    places = list(switches(graph, [value]))
    found = jumps(graph, places, [value], _random(graph, [*places, value])) if places else ()
    moving = [n for n, moves in zip(numbers, varies, strict=True) if moves] if varies is not None else None
    return bool(found) and (moving is None or any(depend_on(graph, found, moving)))
