"""Rows and mass matrix of a scene by machine code, as functions that JAX can differentiate: a derivative has two calls in it, in place of the scene itself.

    g(t, q),   G = dg/dq;        phi(t, q, u),   A = dphi/du;        M(t, q)
    d o_i = sum_j J_ij d x_j     o: any of these numbers, x: parameters, time, coordinates, speeds, inputs;   J: derived on the graph

The tangents of d o are derived on the graph too; derivatives of an order above the second are those of the program as XLA runs it.
"""

from collections.abc import Callable, Sequence
from functools import cache, lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jourdain_jax.build.row_program import RowProgram
from jourdain_jax.calculus.differentiated_as import Rules, differentiated_as
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.equations.projection import BY_AUTODIFF, RowFunctions
from jourdain_jax.lowering.jacobian import on_its_own
from jourdain_jax.motion.native import onto_rows
from jourdain_jax.motion.native.called import nodes_called
from jourdain_jax.motion.native.seen import entries
from jourdain_jax.native.scalar_program import unsupported
from jourdain_jax.program.derivative import cotangents, directional_derivative, jacobian
from jourdain_jax.program.emit import run
from jourdain_jax.program.graph import Graph, Unsupported
from jourdain_jax.scene.scene import Scene

MOST_KEPT = 64
LARGEST_PROGRAM = 20_000  # operations of values and derivatives; machine code of so many takes 0.7 MB of the stack, and 0.15 s to make


@lru_cache(maxsize=MOST_KEPT)
def row_functions(program: RowProgram) -> RowFunctions:
    """g and G, phi and A, and M, by the program; of what is no machine code, by autodiff."""
    nodes = [*program.g, *program.G.values(), *program.phi, *program.A.values(), *(program.M or {}).values()]
    if unsupported(program.graph, nodes) or program.graph.operations(nodes) > onto_rows.LARGEST_PROGRAM:
        return BY_AUTODIFF
    rows, speeds = len(program.phi), len(program.u)
    closures, coordinates = len(program.g), len(program.q)
    parameters = [n for leaf in program.parameters for n in leaf if n >= 0]
    at = [*parameters, program.t, *program.q]
    of_closures = _function(program.graph, _places(program.g, program.G, coordinates), closures * (1 + coordinates), at)
    of_rows = _function(program.graph, _places(program.phi, program.A, speeds), rows * (1 + speeds), [*at, *program.u, *program.inputs])
    M = {key: node for (i, k), node in (program.M or {}).items() for key in ((i, k), (k, i))}
    of_masses = _function(program.graph, _places((), M, speeds), speeds**2, at)

    def parameters_of(scene: Scene):
        found = entries(scene, program.parameters)
        return jnp.concatenate(found) if found else jnp.zeros(0, real_type())

    def in_a_row(given, t, *vectors):
        first = parameters_of(given) if isinstance(given, Scene) else given
        return jnp.concatenate([jnp.asarray(x, real_type()) for x in (first, jnp.asarray(t)[None], *vectors)])

    def closures_at(given, t, q):
        found = of_closures(in_a_row(given, t, q))
        return found[:closures], found[closures:].reshape(closures, coordinates)

    def rows_at(given, t, q, u, inputs):
        found = of_rows(in_a_row(given, t, q, u, inputs))
        return found[:rows], found[rows:].reshape(rows, speeds)

    def masses_at(given, t, q):
        return of_masses(in_a_row(given, t, q)).reshape(speeds, speeds)

    return RowFunctions(closures_at, rows_at, masses_at if program.M is not None else BY_AUTODIFF.masses, parameters_of)


def _places(vector: Sequence[int], matrix: dict[tuple[int, int], int], columns: int) -> dict[int, int]:
    """Where the nodes of a vector, and of a matrix after it, are among all numbers; those that have none are zero."""
    return dict(enumerate(vector)) | {len(vector) + i * columns + k: node for (i, k), node in matrix.items()}


def _function(graph: Graph, places: dict[int, int], size: int, variables: Sequence[int]) -> Callable[[Array], Array]:
    """Values of nodes, at their places among so many numbers that are zero otherwise, as a function of the values of the variables."""
    graph, nodes, variables = on_its_own(graph, list(places.values()), variables)
    places = dict(zip(places, nodes, strict=True))
    slopes = cache(lambda: _slopes(graph, places, variables))  # derived when the first derivative is asked for
    curved = cache(lambda: _second(graph, places, size, variables, back=False))  # and when the second is
    bent = cache(lambda: _second(graph, places, size, variables, back=True))

    def by_slopes(x, dx):
        J, rows = slopes()
        return jnp.zeros(size, dx.dtype).at[rows].set(J(x) @ dx, unique_indices=True, indices_are_sorted=True)

    def by_slopes_back(x, g):
        J, rows = slopes()
        return J(x).T @ g[rows]

    along, back = _with_second(by_slopes, curved), _with_second(by_slopes_back, bent)

    def serve(order: int, *_) -> bool:
        return order <= 2 and slopes() is not None

    def push(arguments, tangents):
        return values(*arguments), along(*arguments, *tangents)

    def pull(perturbed, arguments, found, g):
        return (back(*arguments, g),)

    by_xla, quick = _by_xla_and_machine_code(graph, places, size, variables)
    values = differentiated_as(by_xla, quick, "both", Rules(serve, push, pull), by_xla)
    return values


def _with_second(f: Callable, second: Callable) -> Callable:
    """`f(x, v)`, which is linear in v; its derivative along x is `second()` of x, v and the direction, where that is machine code."""
    linear = jax.custom_jvp(f)

    @linear.defjvp
    def rule(at, tangents):
        if second() is None:
            return jax.jvp(f, at, tangents)
        return linear(*at), linear(at[0], tangents[1]) + second()(jnp.concatenate([*at, tangents[0]]))

    return linear


def _second(graph: Graph, places: dict[int, int], size: int, variables: Sequence[int], back: bool) -> Callable[[Array], Array] | None:
    """f''(x)(w, v) as a function of x, w and v in a row, or (`back`) g f''(x)(., v) of x, g and v; None where it is too large, or no machine code."""
    first, last = ([graph.input(f"{name} {i}", True) for i in range(count)] for name, count in (("w", size if back else len(variables)), ("v", len(variables))))

    def along(nodes, direction: list[int]) -> list[int]:
        return [rate.get(0, graph.zero) for rate in directional_derivative(graph, nodes, {0: dict(zip(variables, direction, strict=True))})]

    rates = along(places.values(), last)
    if back:
        found = dict(enumerate(cotangents(graph, rates, [first[place] for place in places], variables)))
    else:
        found = dict(zip(places, along(rates, first), strict=True))
    found = {place: node for place, node in found.items() if node != graph.zero}
    if unsupported(graph, found.values()) or graph.operations(found.values()) > LARGEST_PROGRAM:
        return None
    return _by_xla_and_machine_code(graph, found, len(variables) if back else size, [*variables, *first, *last])[1]


def _slopes(graph: Graph, places: dict[int, int], variables: Sequence[int]) -> tuple[Callable[[Array], Array], np.ndarray] | None:
    """Those rows of J that are not zero, as a function of the variables, and their places; None where it is too large, or no machine code."""
    try:
        slopes = dict(zip(places, jacobian(graph, places.values(), variables), strict=True))
    except Unsupported:
        return None
    rows = sorted(place for place, row in slopes.items() if row)
    entries = {i * len(variables) + j: slopes[place][n] for i, place in enumerate(rows) for j, n in enumerate(variables) if n in slopes[place]}
    found = list(entries.values())
    if unsupported(graph, found) or graph.operations([*places.values(), *found]) > LARGEST_PROGRAM:
        return None
    values = differentiated_as(*_by_xla_and_machine_code(graph, entries, len(rows) * len(variables), variables), "forward")
    return lambda x: values(x).reshape(len(rows), len(variables)), np.array(rows, int)


def _by_xla_and_machine_code(graph: Graph, places: dict[int, int], size: int, variables: Sequence[int]) -> tuple[Callable, Callable]:
    """Values of nodes at their places, as a function of the values of the variables: by XLA, and by machine code.

    Machine code returns the numbers that are not zero: a whole matrix of 32 trailers lay beyond the end of its stack.
    """
    nodes = list(dict.fromkeys(places.values()))
    number = {n: k for k, n in enumerate(nodes)}
    which = np.full(size, len(nodes))
    which[list(places)] = [number[n] for n in places.values()]
    kernel = nodes_called(graph, nodes, variables, effort=0)

    def placed(found, x):
        return jnp.concatenate([*found, jnp.zeros(1, x.dtype)])[which]

    def by_xla(x):
        return placed((jnp.asarray(value, x.dtype)[None] for value in run(graph, nodes, dict(zip(variables, x, strict=True)))), x)

    return by_xla, lambda x: placed([kernel(x)], x)
