"""JAX code of a graph: each scalar is one array over the batch, so nothing is stacked.

Deep programs run in pieces. XLA makes a separate loop for each result and repeats shared parts in each, so it
would compute the shared parts of long chains many times. At the end of each piece, the values for later
pieces are computed together.

Sine and cosine of one argument are computed together. In double precision they use range reduction with pi/2
in three parts and polynomials, with an error of about 2e-16; XLA on CPUs would call libm once per element and
again in every fusion.

Values of one shape are computed in one loop over their elements, and their shared parts once.
XLA on CPUs makes a separate loop for each result of a program and repeats shared parts in each, but it makes
one loop for a reduction over several operands. Therefore each value is padded with a zero, and all are summed
over value and zero in one reduction. JAX treats this as the identity, which is linear and elementwise.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jax.interpreters import ad, batching, mlir

from jourdain_jax.calculus.markers import identity
from jourdain_jax.calculus.scalar_operations import TABLE
from jourdain_jax.program.calls import EMITTED
from jourdain_jax.program.graph import ARRAYS, Graph, NodeList


def fused(values: tuple) -> tuple:
    """Return the given real values unchanged, but computed in one loop. All must have the same
    shape and type.
    """
    return values if len(values) < 2 else tuple(fused_p.bind(*values))


def _reduced_with_zeros(*values):
    beside = [lax.pad(x[None], jnp.zeros((), x.dtype), [(0, 1, 0), *[(0, 0, 0)] * x.ndim]) for x in values]
    zeros = [jnp.zeros((), x.dtype) for x in values]
    return lax.reduce(beside, zeros, lambda a, b: [x + y for x, y in zip(a, b, strict=True)], (0,))


def _jvp(primals, tangents):
    return fused_p.bind(*primals), fused_p.bind(*(ad.instantiate_zeros(t) for t in tangents))


def _transpose(cotangents, *_):
    return [ad.instantiate_zeros(c) for c in cotangents]


def _batched(values, axes):
    # values shared by all samples stay without a batch axis, because a derivative rule must not add one that
    # the values lack
    alike = fused(tuple(x for x, axis in zip(values, axes, strict=True) if axis is None))
    lanes = fused(
        tuple(jnp.moveaxis(x, axis, 0) for x, axis in zip(values, axes, strict=True) if axis is not None)
    )
    found = {None: iter(alike), 0: iter(lanes)}
    new_axes = [None if axis is None else 0 for axis in axes]
    return [next(found[axis]) for axis in new_axes], new_axes


fused_p = identity("fused")
ad.primitive_jvps[fused_p] = _jvp
ad.primitive_transposes[fused_p] = _transpose
batching.primitive_batchers[fused_p] = _batched
mlir.register_lowering(fused_p, mlir.lower_fun(_reduced_with_zeros, multiple_results=True), platform="cpu")


# longest chain of operations in a program without pieces; measured: pieces make chains of links and trailers
# faster from a length of 100 to 250 on, but the bicycle (102) a quarter slower
DEEP = 120  # tuning
PIECE = 128  # tuning: operations


def run(graph: Graph, outputs: Iterable[int], known: Mapping[int, jax.Array]) -> list:
    """Return the values of the outputs as JAX scalars or numbers, from `known` values of other nodes."""
    outputs, values = list(outputs), dict(known)
    needed = graph.needed(outputs, values)
    depth: dict[int, int] = {}  # longest chain of operations that ends in a node
    for node in needed:
        depth[node] = 1 + max((depth.get(a, 0) for a in graph.args[node]), default=0)
    if max(depth.values(), default=0) <= DEEP:
        _run_in_a_row(graph, needed, values)
        return [values[n] for n in outputs]
    values |= {n: graph.value[n] for n in needed if graph.is_const(n)}
    order = _deepest_first(graph, outputs, values, depth)
    parts = [order[k : k + PIECE] for k in range(0, len(order), PIECE)]
    last_use = {a: k for k, part in enumerate(parts) for n in part for a in graph.args[n]} | dict.fromkeys(
        outputs, len(parts)
    )
    for k, part in enumerate(parts):
        _run_in_a_row(graph, part, values)
        values |= _fused_by_shape(
            [n for n in part if last_use.get(n, -1) > k and graph.op[n] not in ARRAYS], values
        )
    return [values[n] for n in outputs]


def _deepest_first(
    graph: Graph, outputs: Sequence[int], known: Iterable[int], depth: Mapping[int, int]
) -> NodeList:
    """Return the needed nodes, each soon after its arguments, with the longest chains first. Sums then grow
    term by term, and few values pass between pieces.
    """
    seen, order = set(known), []

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


def _run_in_a_row(graph: Graph, nodes: NodeList, values: dict[int, jax.Array]) -> None:
    waves: dict = {}
    for node in nodes:
        op, args = graph.operation(node)
        given = [values[a] for a in args]
        if op == "const":
            values[node] = graph.value[node]
        elif op in EMITTED:
            values[node] = EMITTED[op](graph.value[node], *given)
        elif op in ("sin", "cos"):
            if args not in waves:
                waves[args] = sine_and_cosine(*given)
            values[node] = waves[args][op == "cos"]
        else:
            values[node] = FUNCTIONS[op](*given)


def _fused_by_shape(nodes: NodeList, values: Mapping[int, jax.Array]) -> dict[int, jax.Array]:
    """Return values of the nodes, computing nodes of equal shape and type together."""
    alike: dict[tuple, NodeList] = {}
    for n in nodes:
        if jnp.issubdtype(jnp.result_type(values[n]), jnp.floating) and isinstance(values[n], jax.Array):
            alike.setdefault((values[n].shape, values[n].dtype), []).append(n)
    return {
        n: x
        for group in alike.values()
        for n, x in zip(group, fused(tuple(values[n] for n in group)), strict=True)
    }


FUNCTIONS: dict[str, Callable] = {name: operation.in_jax for name, operation in TABLE.items()}

# pi/2 in three parts of 33 bits, and minimax polynomials on [-pi/4, pi/4] (by K. C. Ng, as in FreeBSD's libm)
HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)  # numerics
SINE = (  # numerics
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
COSINE = (  # numerics
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


@jax.custom_jvp
def sine_and_cosine(x):
    """Return (sin x, cos x)."""
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
