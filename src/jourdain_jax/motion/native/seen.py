"""Numbers beside the steps of a motion, as machine code: those that depend on parameters alone, and all speeds, pivots and energies at saved states.

Each is a function of JAX on one state or scene; under `vmap` all lanes go to one call, for which rows of the numbers that are needed are put together. Speeds
of few operations are XLA's (`lowering/lowered.py`).
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.build.row_program import RowProgram
from jourdain_jax.calculus.markers import entries_of
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.motion.native.called import called, nodes_called
from jourdain_jax.motion.native.values_of_nodes import values_of_nodes
from jourdain_jax.native.ffi import write_rows
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.math_functions import FUNCTIONS
from jourdain_jax.native.scalar_program import as_real, unsupported, written
from jourdain_jax.program.graph import Graph
from jourdain_jax.scene.scene import Scene

_TRUTHS = frozenset(("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite"))


class Beside(NamedTuple):
    """Machine code of what stands beside the steps of a program."""

    needed: tuple[tuple[int, ...], ...]  # nodes of those entries of the scene's parameters on which something that is fixed depends, -1 for others
    fixed: Callable[[Array], Array]  # of those entries and of what is usual
    usual: Callable[[Array], Array] | None  # of those entries; JAX does not differentiate it
    at_states: "AtStates | None"  # None where XLA is quicker


class AtStates(NamedTuple):
    """Functions of what is fixed, of time, coordinates, privileged speeds and inputs."""

    speeds: Callable[..., Array]  # all of them
    numbers: Callable[..., Array]  # pivots, then energies, which JAX does not differentiate


@lru_cache(maxsize=64)
def beside(program: Lowered) -> Beside | None:
    """All this; None where it cannot be machine code."""
    graph, nodes = program.graph, [*program.z, *program.pivots, *program.energies, *program.fixed, *program.usual.values()]
    truths = any(_is_truth(graph, n) for n in program.fixed)  # which XLA hands on as such
    # 60_000 operations
    if truths or graph.operations(nodes) > 60_000 or unsupported(graph, nodes):
        return None
    used = set(graph.reachable([*program.fixed, *program.usual.values()]))
    needed = tuple(tuple(n if n in used else -1 for n in np.ravel(leaf).tolist()) for leaf in program.traced.parameters)
    given = [n for leaf in needed for n in leaf if n >= 0]
    usual = called(partial(_write_usual, program, given), lambda *_: ((len(program.usual),),), effort=1) if program.usual else None
    return Beside(needed, values_of_nodes(graph, program.fixed, [*given, *program.usual]), usual, _at_states(program))


def _at_states(program: Lowered) -> AtStates | None:
    # Operations from which on speeds, pivots and energies are machine code. Measured, ms by XLA and here: one motion of 8 trailers (228 operations) 0.69 and
    # 0.54, of 16 (436) 2.6 and 1.8, derivatives of which compile in 13 and 6 s; 256 bicycles (460) 25 and 15, their gradient 85 and 72; 1,024 chains of
    # 4 trailers (124) 44 and 39, their gradient 111 and 108; gradients of 256 rattlebacks (70) 29 and 42.
    if program.graph.operations(program.z) < 100:
        return None
    every = [*(int(program.traced.u[k]) for k in program.independent), *program.z]
    speeds = [every[i] for i in np.argsort([*program.independent, *program.dependent])]
    numbers = _at_state(program, [*program.pivots, *program.energies], nodes_called)
    return AtStates(_at_state(program, speeds, values_of_nodes), lambda *state: numbers(*jax.lax.stop_gradient(state)))


def _at_state(program: Lowered, nodes: Sequence[int], function: Callable) -> Callable[..., Array]:
    """Machine code of nodes, which is given those numbers alone that it needs of what is fixed."""
    used = set(program.graph.reachable(nodes))
    which = [k for k, n in enumerate(program.fixed) if n in used]
    run = function(program.graph, nodes, [*(program.fixed[k] for k in which), *program.variables[len(program.fixed) :]])

    def values(fixed, t, q, y, inputs) -> Float[Array, "nodes"]:
        known = jnp.stack([*(fixed[k] for k in which), t])
        return run(jnp.concatenate([jnp.asarray(x, real_type()) for x in (known, q, y, inputs)]))

    return values


def _is_truth(graph: Graph, node: int) -> bool:
    return graph.op[node] in _TRUTHS or (graph.op[node] == "select" and _is_truth(graph, graph.args[node][1]))


def entries(scene: Scene, nodes: Sequence[Sequence[int]]) -> list[Array]:
    """Those entries of a scene's parameters that have a node; `nodes`: of each leaf, entry by entry, -1 for none."""
    found = []
    for leaf, of_leaf in zip(jax.tree.leaves(scene), nodes, strict=True):
        needed = np.flatnonzero(np.ravel(np.asarray(of_leaf, int)) >= 0)
        if needed.size:
            flat = jnp.reshape(jnp.asarray(leaf, real_type()), (-1,))
            found.append(flat if needed.size == flat.shape[0] else flat[needed])
    return found


def fixed_values(program: Lowered, scene: Scene) -> tuple[Float[Array, ""], ...]:
    """As `Lowered.fixed_values`."""
    own = beside(program)
    parameters = [] if own is None else entries(scene, own.needed)
    if own is None or not program.fixed or not parameters:  # nothing to hand over, or nothing asked for
        return program.fixed_values(scene)
    x = jnp.concatenate(parameters)
    usual = [] if own.usual is None else own.usual(jax.lax.stop_gradient(x))
    return entries_of(own.fixed(jnp.concatenate([x, *usual])))


def speeds_and_pivot(program: Lowered, fixed, t, q, y, inputs) -> tuple[Float[Array, "speeds"], Float[Array, ""]]:
    """As `Lowered.speeds_and_pivot`."""
    if (own := beside(program)) is None or own.at_states is None:
        return program.speeds_and_pivot(fixed, t, tuple(q), tuple(y), inputs)
    pivots = own.at_states.numbers(fixed, t, q, y, inputs)[:-2]
    return own.at_states.speeds(fixed, t, q, y, inputs), program.smallest_pivot(fixed, pivots)


def energies(program: Lowered, fixed, t, q, y, inputs) -> Float[Array, "2"]:
    """As `Lowered.energy_values`."""
    if (own := beside(program)) is None or own.at_states is None:
        return program.energy_values(fixed, t, tuple(q), tuple(y), inputs)
    return own.at_states.numbers(fixed, t, q, y, inputs)[-2:]


def is_right(program: RowProgram, scene: Scene, t, q) -> Bool[Array, ""]:
    """Whether parameters are right, and the masses and inertias that they make; as `parameter_faults` and `body_faults`."""
    parts = [*entries(scene, program.parameters), jnp.asarray(t)[None], q]
    run = nodes_called(program.graph, [program.right], [*(n for leaf in program.parameters for n in leaf if n >= 0), program.t, *program.q])
    return run(jax.lax.stop_gradient(jnp.concatenate([jnp.asarray(x, real_type()) for x in parts])))[0] > 0


def _write_usual(program: Lowered, given: Sequence[int], w: Writer) -> None:
    """`row(state, found)`: as `Lowered.usual_values`, of the magnitudes at the probed states."""
    nodes, states = list(program.usual.values()), list(program.states)
    probes = len(next(iter(program.states.values()), (None,)))
    table = w.constants("probed", (x[p] for p in range(probes) for x in program.states.values())) if states else Value(w, "ptr", "null")
    log, exp = FUNCTIONS["log"], FUNCTIONS["exp"]
    with w.procedure("row", "state found") as (state, found):
        totals = w.room(2 * len(nodes))  # of logarithms, and of how many these are
        for k in range(2 * len(nodes)):
            w.store(0.0, totals, k)
        known = {n: w.load(state, k) for k, n in enumerate(given)}
        with w.counted(0, probes) as p:
            at = {n: w.spread(w.load(table, p * len(states) + k, "double")) for k, n in enumerate(states)}
            for k, value in enumerate(written(w, program.graph, nodes, known | at)):
                size = w.magnitude(as_real(w, value))
                counts = (size > 0.0) & (size < math.inf)
                more = log(w, w.where(counts, size, w.number(1.0))), w.where(counts, 1.0, 0.0)
                for place, x in zip((2 * k, 2 * k + 1), more, strict=True):
                    w.store(w.load(totals, place) + x, totals, place)
        for k in range(len(nodes)):
            count = w.larger(w.load(totals, 2 * k + 1), w.number(1.0))
            w.store(exp(w, w.load(totals, 2 * k) / count), found, k)
    write_rows(w, len(given), len(nodes))
