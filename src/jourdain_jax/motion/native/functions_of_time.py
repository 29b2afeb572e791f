"""Inputs that are functions of time, as part of the scalar program: time and their numbers take the place of their values.

u_i = f_i(t, c_i),   y' = F(t, y, u) = F(t, y, f(t, c))         c_i: the numbers in f_i and those that it closes over
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from typing import Any

import jax.numpy as jnp
import numpy as np

from jourdain_jax.build.trace import Variables
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.lowering.relations import jumps, switches
from jourdain_jax.motion.inputs import FunctionOfTime, TimeProgram
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import ARRAYS, Graph, Unsupported
from jourdain_jax.program.interpret import Nodes, as_nodes, interpret

# Parts of a program that are nodes; `power` is another one.
_NODES = (
    *("qdot", "ydot", "pivots", "sizes", "directions", "squares", "guards", "events"),
    *("projected_q", "projected_u", "relations", "event_relations", "jumps"),
)
MOST_NUMBERS = 200  # in a function of time; of a long table each is a row of a lane, and `jj.Sampled` looks up in it


@lru_cache(maxsize=64)
def with_functions(program: Lowered, functions: tuple[TimeProgram | None, ...]) -> Lowered | str:
    """The program with these functions in the place of inputs, or why there is none, in words; their numbers come last among what is `fixed`."""
    numbers = sum(math.prod(shape) for function in functions if function is not None for shape in function.shapes)
    if numbers > MOST_NUMBERS:
        return f"inputs are functions of time with {numbers} numbers, more than {MOST_NUMBERS}"
    if any(program.graph.op[n] in ARRAYS for n in program.fixed):
        return "the scene keeps parts as calls, and an input is a function of time"
    graph = Graph(keeps_rules=True)
    new = {n: graph.input(str(k), True) for k, n in enumerate(program.variables)}
    t, known = new[program.traced.t], []
    try:
        for node, function in zip(program.traced.inputs.tolist(), functions, strict=True):
            if function is not None:
                given = [[graph.input(f"{node} {k} {i}", True) for i in range(math.prod(shape))] for k, shape in enumerate(function.shapes)]
                known += [n for part in given for n in part]
                arguments = [Nodes(np.reshape(part, shape)) for part, shape in zip(given, function.shapes, strict=True)]
                new[node] = int(as_nodes(graph, interpret(graph, function.closed, [*arguments, Nodes(t)])[0]))
    except (Unsupported, ValueError) as error:
        return f"an input is a function of time without scalar form ({error})"
    nodes = {name: getattr(program, name) for name in _NODES}
    of_functions = [new[n] for n in program.traced.inputs.tolist() if n in new]
    by_functions = switches(graph, of_functions)
    jumping = jumps(graph, by_functions, of_functions, _random(graph, [*by_functions, *of_functions]))
    new = graph.copied([program.power, *(n for part in nodes.values() for n in part)], program.graph, new)
    on_it: dict[str, Any] = {name: tuple(new[n] for n in part) for name, part in nodes.items()}
    on_it["relations"] = tuple(dict.fromkeys([*on_it["relations"], *by_functions]))
    on_it["jumps"] += tuple(jumping)
    stays = [i for i, function in enumerate(functions) if function is None]
    u = [new.get(n, t) for n in program.traced.u.tolist()]  # dependent speeds are no variables
    q, inputs = (np.array([new[n] for n in part.tolist()], np.int64) for part in (program.traced.q, program.traced.inputs[stays]))
    return replace(
        program,
        traced=Variables(graph, t, q, np.array(u, np.int64), inputs, []),
        inputs=tuple(program.inputs[i] for i in stays),
        fixed=(*(new[n] for n in program.fixed), *known),
        power=new[program.power],
        **on_it,
        z=(),  # what is seen of a motion is evaluated with the values of inputs
        energies=(),
        usual={},
        states={},
    )


def _random(graph: Graph, nodes: Iterable[int]) -> Probes:
    """Return random times and numbers for functions."""
    generator = np.random.default_rng(11)
    # states at which it is seen whether functions jump
    return Probes(graph, {str(graph.value[n]): generator.uniform(-1.0, 3.0, 64) for n in graph.reachable(nodes) if graph.op[n] == "input"})


def numbers_of(channel: FunctionOfTime) -> list:
    """Each number of a function of time; of a tree of flags or of tangents in its place, what stands for each (None: nothing does)."""
    return [x for part, shape in zip((channel.numbers, *channel.held), _shapes(channel), strict=True) for x in _each(part, shape)]


def parts_from(channel: FunctionOfTime, numbers: Iterator) -> list:
    """`channel.numbers`, and all that is `channel.held`, from the next of what stands for each number; None where nothing does."""
    found = [(list(islice(numbers, math.prod(shape))), shape) for shape in _shapes(channel)]
    return [None if any(x is None for x in each) else jnp.stack(each).reshape(shape) if each else jnp.zeros(shape) for each, shape in found]


def _shapes(channel: FunctionOfTime) -> list[tuple[int, ...]]:
    shapes = channel.program.shapes
    count = len(shapes) - len(channel.held)
    return [(count,), *shapes[count:]]


def _each(part, shape: tuple[int, ...]) -> list:
    return list(jnp.reshape(part, -1)) if hasattr(part, "shape") else [part] * math.prod(shape)
