"""Numbers beside the steps of a motion, as machine code: those that depend on parameters alone, and derivatives of all speeds at saved states.

Each is a function of JAX on one state or scene; under `vmap` all lanes go to one call. Speeds and energies at saved states are XLA's (`lowering/lowered.py`):
machine code, for which rows of numbers are put together, takes longer there.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.build.row_program import RowProgram
from jourdain_jax.calculus.differentiated_as import Rules, with_rules
from jourdain_jax.calculus.entries import entries_of
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.motion.native.called import called, nodes_called
from jourdain_jax.motion.native.values_of_nodes import Derivatives, values_of_nodes
from jourdain_jax.native.ir import Value, Writer
from jourdain_jax.native.math_functions import FUNCTIONS
from jourdain_jax.native.scalar_program import as_real, unsupported, written
from jourdain_jax.native.threads import write_rows
from jourdain_jax.program.graph import Graph
from jourdain_jax.scene.scene import Scene

MOST_KERNELS = 64  # whose names are kept; machine code lives as long as the process
_TRUTHS = frozenset(("lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "is_finite"))


@lru_cache(maxsize=MOST_KERNELS)
def is_supported(program: Lowered) -> bool:
    """Whether all this can be machine code."""
    graph, nodes = program.graph, [*program.z, *program.fixed, *program.usual.values()]
    truths = any(_is_truth(graph, n) for n in program.fixed)  # which XLA hands on as such
    # 60_000 operations
    return not truths and graph.operations(nodes) <= 60_000 and not unsupported(graph, nodes)


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
    parameters = entries(scene, _needed(program))
    if not program.fixed or not parameters:  # nothing to hand over, or nothing asked for
        return program.fixed_values(scene)
    x = jnp.concatenate(parameters)
    usual = [_usual(program)(jax.lax.stop_gradient(x))] if program.usual else []
    return entries_of(_of_parameters(program)(jnp.concatenate([x, *usual])))


@lru_cache(maxsize=MOST_KERNELS)
def _of_parameters(program: Lowered) -> Callable[[Array], Array]:
    """What is fixed, as a function of those parameters that are needed and of what is usual."""
    return values_of_nodes(program.graph, dict(enumerate(program.fixed)), len(program.fixed), [*_places_of(program), *program.usual])


@lru_cache(maxsize=MOST_KERNELS)
def _usual(program: Lowered) -> Callable[[Array], Array]:
    """What is usual at the states that were probed, as a function of those parameters that are needed; JAX does not differentiate it."""
    kernel = called(partial(_write_usual, program), lambda *_: ((len(program.usual),),), effort=1)
    return lambda x: kernel(x)[0]


def speeds_and_pivot(program: Lowered, fixed, t, q, y, inputs) -> tuple[Float[Array, "speeds"], Float[Array, ""]]:
    """As `Lowered.speeds_and_pivot`; where speeds take many operations, derivatives are machine code."""

    def by_xla(fixed, t, q, y, inputs):
        return program.speeds_and_pivot(entries_of(fixed), t, tuple(q), tuple(y), inputs)

    def push(arguments, tangents):
        along = [jnp.zeros_like(x) if dx is None else dx for x, dx in zip(arguments, tangents, strict=True)]
        found = derivatives.along(_in_a_row(*arguments), _in_a_row(*along))
        return values(*arguments), (found[:-1], found[-1])

    def pull(perturbed, arguments, found, g):
        x = _in_a_row(*arguments)
        found = derivatives.back(x, jnp.concatenate([g[0], jnp.zeros_like(x, shape=(1,))]))
        parts = jnp.split(found, np.cumsum([jnp.size(x) for x in arguments])[:-1])
        return tuple(jnp.reshape(part, jnp.shape(x)) for x, part in zip(arguments, parts, strict=True))

    given = jnp.stack(fixed) if fixed else jnp.zeros(0, real_type()), jnp.asarray(t, real_type()), q, y, inputs
    # Operations from which on derivatives are machine code. Measured, gradients of batches over all saved states,
    # by XLA and here: 5 operations, 28 and 42 ms; 66, 98 and 69; 228, 405 and 108. One motion of 16 trailers
    # compiles in 16 to 19 s and 4.5 s.
    if program.graph.operations(program.z) < 60:
        return by_xla(*given)
    derivatives = _derivatives_of_speeds(program)
    values = with_rules(by_xla, Rules(push, pull))
    return values(*given)


@lru_cache(maxsize=MOST_KERNELS)
def _derivatives_of_speeds(program: Lowered) -> Derivatives:
    """Those of all speeds; the pivot after them is a number to differentiation."""
    every = [*(int(program.traced.u[k]) for k in program.independent), *program.z]
    speeds = dict(zip([*program.independent, *program.dependent], every, strict=True))
    return Derivatives(program.graph, speeds, len(every) + 1, program.variables)


def is_right(program: RowProgram, scene: Scene, t, q) -> Bool[Array, ""]:
    """Whether parameters are right, and the masses and inertias that they make; as `parameter_faults` and `body_faults`."""
    parts = [*entries(scene, program.parameters), jnp.asarray(t)[None], q]
    return _kernel_of_right(program)(jax.lax.stop_gradient(jnp.concatenate([jnp.asarray(x, real_type()) for x in parts])))[0] > 0


@lru_cache(maxsize=MOST_KERNELS)
def _kernel_of_right(program: RowProgram):
    given = [*(n for leaf in program.parameters for n in leaf if n >= 0), program.t, *program.q]
    return nodes_called(program.graph, [program.right], given)


def _in_a_row(fixed, t, q, y, inputs) -> Float[Array, "given"]:
    return jnp.concatenate([jnp.asarray(x, real_type()) for x in (fixed, jnp.asarray(t)[None], q, y, inputs)])


def _needed(program: Lowered) -> tuple[tuple[int, ...], ...]:
    """The entries of the scene's parameters on which something that is fixed depends."""
    needed = set(program.graph.reachable([*program.fixed, *program.usual.values()]))
    return tuple(tuple(n if n in needed else -1 for n in np.ravel(leaf).tolist()) for leaf in program.traced.parameters)


def _places_of(program: Lowered) -> list[int]:
    """Nodes of the parameters that are needed."""
    return [n for leaf in _needed(program) for n in leaf if n >= 0]


def _write_usual(program: Lowered, w: Writer) -> None:
    """`row(state, found)`: as `Lowered.usual_values`, of the magnitudes at the probed states."""
    given, nodes, states = _places_of(program), list(program.usual.values()), list(program.states)
    probes = len(next(iter(program.states.values()), (None,)))
    table = w.constants("probed", (x[p] for p in range(probes) for x in program.states.values())) if states else Value(w, "ptr", "null")
    log, exp = FUNCTIONS["log"], FUNCTIONS["exp"]
    with w.function("row", "void", {"state": "ptr", "found": "ptr"}, attributes="noinline") as (state, found):
        totals = w.room(w.real, 2 * len(nodes))  # of logarithms, and of how many these are
        for k in range(2 * len(nodes)):
            w.store(w.number(0.0), totals, k)
        known = {n: w.load(w.real, state, k) for k, n in enumerate(given)}
        with w.counted(0, probes) as p:
            at = {n: w.spread(w.load("double", table, p * len(states) + k)) for k, n in enumerate(states)}
            for k, value in enumerate(written(w, program.graph, nodes, known | at)):
                size = w.magnitude(as_real(w, value))
                counts = (size > 0.0) & (size < math.inf)
                more = log(w, w.where(counts, size, w.number(1.0))), w.where(counts, 1.0, w.number(0.0))
                for place, x in zip((2 * k, 2 * k + 1), more, strict=True):
                    w.store(w.load(w.real, totals, place) + x, totals, place)
        for k in range(len(nodes)):
            count = w.larger(w.load(w.real, totals, 2 * k + 1), w.number(1.0))
            w.store(exp(w, w.load(w.real, totals, 2 * k) / count), found, k)
        w.give()
    write_rows(w, len(given), len(nodes))
