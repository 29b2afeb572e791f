"""Rows and mass matrix of a scene by machine code, as functions that JAX can differentiate: a derivative has two calls in it, in place of the scene itself.

    g(t, q),   G = dg/dq;        phi(t, q, u),   A = dphi/du;        M(t, q)
    d o_i = sum_j J_ij d x_j     o: any of these numbers, x: parameters, time, coordinates, speeds, inputs;   J: derived on the graph

Derivatives of higher order are those of the program as XLA runs it.
"""

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.build.row_program import RowProgram
from jourdain_jax.calculus.differentiated_as import Rules, differentiated_as
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.equations.projection import BY_AUTODIFF, RowFunctions
from jourdain_jax.lowering.jacobian import on_its_own
from jourdain_jax.motion.native.called import nodes_called
from jourdain_jax.motion.native.onto_rows import MOST_ENTRIES
from jourdain_jax.motion.native.seen import entries
from jourdain_jax.native.scalar_program import unsupported
from jourdain_jax.program.derivative import jacobian
from jourdain_jax.program.emit import run
from jourdain_jax.program.graph import Graph, Unsupported
from jourdain_jax.scene.scene import Scene

MOST_KEPT = 64
LARGEST_PROGRAM = 20_000  # operations of values and derivatives


@lru_cache(maxsize=MOST_KEPT)
def row_functions(program: RowProgram) -> RowFunctions:
    """g and G, phi and A, and M, by the program; of large scenes by autodiff, since machine code has a Jacobian on the stack."""
    closures, rows, coordinates, speeds = map(len, (program.g, program.phi, program.q, program.u))
    known = sum(n >= 0 for leaf in program.parameters for n in leaf) + 1 + coordinates

    def closures_at(scene: Scene, t, q):
        found = _of_program(program, "closures")(_given(program, scene, t, q))
        return found[:closures], found[closures:].reshape(closures, coordinates)

    def rows_at(scene: Scene, t, q, u, inputs):
        found = _of_program(program, "rows")(_given(program, scene, t, q, u, inputs))
        return found[:rows], found[rows:].reshape(rows, speeds)

    def masses_at(scene: Scene, t, q):
        return _of_program(program, "masses")(_given(program, scene, t, q)).reshape(speeds, speeds)

    return RowFunctions(
        closures_at if closures * (1 + coordinates) * known <= MOST_ENTRIES else BY_AUTODIFF.closures,
        rows_at if rows * (1 + speeds) * (known + speeds + len(program.inputs)) <= MOST_ENTRIES else BY_AUTODIFF.rows,
        masses_at if program.M is not None and speeds**2 * known <= MOST_ENTRIES else BY_AUTODIFF.masses,
    )


def _given(program: RowProgram, scene: Scene, t, *vectors) -> Float[Array, "given"]:
    parts = *entries(scene, program.parameters), jnp.asarray(t)[None], *vectors
    return jnp.concatenate([jnp.asarray(x, real_type()) for x in parts])


@lru_cache(maxsize=MOST_KEPT)
def _of_program(program: RowProgram, what: Literal["closures", "rows", "masses"]) -> Callable[[Array], Array]:
    """A vector and a matrix after it, or a matrix, of what is `_given`."""
    at = [*(n for leaf in program.parameters for n in leaf if n >= 0), program.t, *program.q]
    if what == "closures":
        columns = len(program.q)
        return _function(program.graph, _places(program.g, program.G, columns), len(program.g) * (1 + columns), at)
    columns = len(program.u)
    if what == "rows":
        return _function(program.graph, _places(program.phi, program.A, columns), len(program.phi) * (1 + columns), [*at, *program.u, *program.inputs])
    M = {key: node for (i, k), node in (program.M or {}).items() for key in ((i, k), (k, i))}
    return _function(program.graph, _places((), M, columns), columns**2, at)


def _places(vector: Sequence[int], matrix: dict[tuple[int, int], int], columns: int) -> dict[int, int]:
    """Where the nodes of a vector, and of a matrix after it, are among all numbers; those that have none are zero."""
    return dict(enumerate(vector)) | {len(vector) + i * columns + k: node for (i, k), node in matrix.items()}


def _function(graph: Graph, places: dict[int, int], size: int, variables: Sequence[int]) -> Callable[[Array], Array]:
    """Values of nodes, at their places among so many numbers, as a function of the values of the variables."""
    graph, nodes, variables = on_its_own(graph, list(places.values()), variables)
    places = dict(zip(places, nodes, strict=True))
    slopes = cache(lambda: _slopes(graph, places, size, variables))  # derived when the first derivative is asked for
    by_xla, by_machine_code = _by_xla(graph, places, size, variables), nodes_called(graph, places, size, variables, effort=0)

    def push(arguments, along):
        (x,), (dx,) = arguments, along
        return values(x), slopes()(x) @ dx

    values = differentiated_as(by_xla, by_machine_code, "forward", Rules(lambda *_: slopes() is not None, push))
    return values


def _slopes(graph: Graph, places: dict[int, int], size: int, variables: Sequence[int]) -> Callable[[Array], Array] | None:
    """J as a function of the variables; None where it is too large, or no machine code."""
    count, nodes = len(variables), list(places.values())
    try:
        rows = jacobian(graph, nodes, variables)
    except Unsupported:
        return None
    entries = {i * count + j: row[n] for i, row in zip(places, rows, strict=True) for j, n in enumerate(variables) if n in row}
    found = list(entries.values())
    if unsupported(graph, found) or graph.operations([*nodes, *found]) > LARGEST_PROGRAM:
        return None
    of_all = graph, entries, size * count, variables
    values = differentiated_as(_by_xla(*of_all), nodes_called(*of_all, effort=0), "forward")
    return lambda x: values(x).reshape(size, count)


def _by_xla(graph: Graph, places: dict[int, int], size: int, variables: Sequence[int]) -> Callable[[Array], Array]:
    where = np.array(list(places), int)

    def of(x):
        found = run(graph, places.values(), dict(zip(variables, x, strict=True)))
        zeros = jnp.zeros(size, x.dtype)
        return zeros.at[where].set(jnp.stack([jnp.asarray(value, x.dtype) for value in found]), unique_indices=True) if found else zeros

    return of
