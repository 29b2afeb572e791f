"""A graph as JAX code: one array per scalar, so that a batch is a structure of arrays and nothing is stacked.

Deep programs run in pieces: XLA gives each result a loop of its own, computes in it whatever it needs, and so computes what long chains share many
times over. A piece ends where values that later pieces need are computed together.
Sines and cosines of one argument are computed together, in double precision by range reduction with pi/2 in three parts and polynomials
(error about 2e-16; XLA on a CPU would call libm once per element, and again in every fusion).
"""

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

import jax
import jax.numpy as jnp
from jax import lax

from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program.calls import EMITTED
from jourdain_jax.program.fused import fused
from jourdain_jax.program.graph import ARRAYS, Graph
from jourdain_jax.program.loop_rerolling import Before, Given, Here, Loop, deepest_first, sources, with_loops

DEEP = 120  # operations one after the other; measured: chains of links and trailers gain from 100 to 250 on, the bicycle (102) loses a quarter
PIECE = 128  # operations


def run(graph: Graph, outputs: Iterable[int], known: Mapping[int, jax.Array]) -> list:
    """Values of the outputs as JAX scalars (or numbers), given those of inputs and of nodes computed before."""
    outputs = list(outputs)
    values = Values(known)
    needed = graph.needed(outputs, values)
    if _depth(graph, needed) <= DEEP:
        _run_in_a_row(graph, needed, values)
        return [values[n] for n in outputs]
    values |= {n: graph.value[n] for n in needed if graph.is_const(n)}
    parts = list(_pieces(with_loops(graph, deepest_first(graph, outputs, values))))
    last_use = {a: k for k, part in enumerate(parts) for a in _arguments(graph, part)} | dict.fromkeys(outputs, len(parts))
    for k, part in enumerate(parts):
        if isinstance(part, Loop):
            run_loop(part, values, {n for n in part.nodes.ravel().tolist() if last_use.get(n, -1) > k}, _operation)
        else:
            _run_in_a_row(graph, part, values)
            values |= _fused_by_shape([n for n in part if last_use.get(n, -1) > k and graph.op[n] not in ARRAYS], values)
    return [values[n] for n in outputs]


def _pieces(parts: Iterable[list[int] | Loop]) -> Iterator[list[int] | Loop]:
    for part in parts:
        yield from [part] if isinstance(part, Loop) else (part[k : k + PIECE] for k in range(0, len(part), PIECE))


def _arguments(graph: Graph, part: list[int] | Loop) -> Iterable[int]:
    return sources(part) if isinstance(part, Loop) else (a for node in part for a in graph.args[node])


def _run_in_a_row(graph: Graph, nodes: list[int], values: dict[int, jax.Array]) -> None:
    waves: dict = {}
    for node in nodes:
        op, args = graph.op[node], graph.args[node]
        if op == "const":
            values[node] = graph.value[node]
        elif op in EMITTED:
            values[node] = EMITTED[op](graph.value[node], *(values[a] for a in args))
        else:
            values[node] = _operation(op, args, [values[a] for a in args], waves)


def _operation(op: str, key: Hashable, args: list, waves: dict) -> jax.Array:
    """One operation; `waves` keeps sines and cosines by the `key` of their argument."""
    if op not in ("sin", "cos"):
        return FUNCTIONS[op](*args)
    if key not in waves:
        waves[key] = sine_and_cosine(args[0])
    return waves[key][op == "cos"]


def _depth(graph: Graph, nodes: list[int]) -> int:
    """The longest chain of operations."""
    depth: dict[int, int] = {}
    for node in nodes:
        depth[node] = 1 + max((depth.get(a, 0) for a in graph.args[node]), default=0)
    return max(depth.values(), default=0)


def _fused_by_shape(nodes: list[int], values: Mapping[int, jax.Array]) -> dict[int, jax.Array]:
    """The values of the nodes, those of one shape and type computed together."""
    alike: dict[tuple, list[int]] = {}
    for n in nodes:
        if jnp.issubdtype(jnp.result_type(values[n]), jnp.floating) and isinstance(values[n], jax.Array):
            alike.setdefault((values[n].shape, values[n].dtype), []).append(n)
    return {n: x for group in alike.values() for n, x in zip(group, fused(tuple(values[n] for n in group)), strict=True)}


FUNCTIONS: dict[str, Callable] = {name: operation.in_jax for name, operation in TABLE.items()}

# pi/2 in three parts of 33 bits, and minimax polynomials on [-pi/4, pi/4] (K. C. Ng's, as in FreeBSD's libm)
HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
SINE = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
COSINE = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


@jax.custom_jvp
def sine_and_cosine(x):
    """(sin x, cos x)"""
    x = jnp.asarray(x)
    if x.dtype != jnp.float64:
        return jnp.sin(x), jnp.cos(x)
    turns = lax.round(x * (2 / jnp.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r = x
    for part in HALF_PI:
        r = r - turns * part
    square = r * r
    sine = r + r * (square * _polynomial(SINE, square))
    cosine = 1.0 + square * (square * _polynomial(COSINE, square) - 0.5)
    quadrant = turns - 4.0 * jnp.floor(0.25 * turns)
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    s, c = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return jnp.where(quadrant >= 2.0, -s, s), jnp.where((quadrant == 1.0) | (quadrant == 2.0), -c, c)


@sine_and_cosine.defjvp
def _sine_and_cosine_jvp(primals, tangents):
    s, c = sine_and_cosine(*primals)
    (dx,) = tangents
    return (s, c), (c * dx, -s * dx)


def _polynomial(coefficients, x):
    total = jnp.full_like(x, coefficients[0])
    for c in coefficients[1:]:
        total = total * x + c
    return total


UNROLLED = 2  # iterations that follow one another without a jump; measured: one is slower, four compile to more functions


class Values(dict):
    """Values of nodes; those of a loop are kept in one array per operation, and taken out when they are asked for."""

    def __init__(self, known) -> None:
        super().__init__(known)
        self._in_arrays: dict[int, tuple[jax.Array, int]] = {}

    def __missing__(self, node: int) -> jax.Array:
        array, k = self._in_arrays[node]
        self[node] = value = array[k]
        return value

    def keep(self, nodes: Sequence[int], array: jax.Array) -> None:
        """The values of the nodes, along the first axis of an array."""
        self._in_arrays |= {node: (array, k) for k, node in enumerate(nodes)}

    def stacked(self, nodes: Sequence[int], shape: tuple[int, ...], real) -> jax.Array:
        """The values of the nodes along a new first axis: part of an array that is kept, where they follow one another in it."""
        places = [self._in_arrays[n] for n in nodes if n in self._in_arrays]
        steps = {b[1] - a[1] for a, b in pairwise(places)}
        if len(places) == len(nodes) and steps in ({1}, {-1}) and all(array is places[0][0] for array, _ in places):
            low, high = sorted((places[0][1], places[-1][1]))
            part = jnp.broadcast_to(jnp.moveaxis(places[0][0][low : high + 1], 0, -1), (*shape, len(nodes)))
            return jnp.moveaxis(part, -1, 0)[:: steps.pop()].astype(real)
        return jnp.stack([jnp.broadcast_to(jnp.asarray(self[n], real), shape) for n in nodes])


def run_loop(loop: Loop, values: Values, wanted: set[int], operation: Callable) -> None:
    """Add the wanted nodes of a loop to the values; `operation(op, key, arguments, waves)` computes one of them."""
    outside = sources(loop)
    shape = jnp.broadcast_shapes(*(jnp.shape(values[n]) for n in outside))
    real = jnp.result_type(*([values[n] for n in outside if isinstance(values[n], jax.Array)] or [float]))
    slots = {slot: None for slots in loop.arguments for slot in slots}
    carried = [s for s in slots if isinstance(s, Before)]
    stacked = [s for s in slots if isinstance(s, Given) and len(set(s.nodes)) > 1]
    fixed = {s: values[s.nodes[0]] for s in slots if isinstance(s, Given) and len(set(s.nodes)) == 1}
    kept = [k for k, nodes in enumerate(loop.nodes.T.tolist()) if not wanted.isdisjoint(nodes)]

    def body(carry, given):
        at = fixed | dict(zip(carried, carry, strict=True)) | dict(zip(stacked, given, strict=True))
        waves = {}
        for k, (op, arguments) in enumerate(zip(loop.ops, loop.arguments, strict=True)):
            at[Here(k)] = operation(op, arguments, [at[a] for a in arguments], waves)
        places = list(dict.fromkeys([*(s.place for s in carried), *kept]))
        found = fused(tuple(jnp.broadcast_to(jnp.asarray(at[Here(k)], real), shape) for k in places))
        here = dict(zip(places, found, strict=True))
        return tuple(here[s.place] for s in carried), tuple(here[k] for k in kept)

    first = tuple(jnp.broadcast_to(jnp.asarray(values[s.first], real), shape) for s in carried)
    given = tuple(values.stacked(s.nodes, shape, real) for s in stacked)
    _, found = lax.scan(body, first, given, length=len(loop.nodes), unroll=UNROLLED)
    for k, array in zip(kept, found, strict=True):
        values.keep(loop.nodes[:, k].tolist(), array)
