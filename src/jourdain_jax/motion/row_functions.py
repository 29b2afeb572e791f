"""Rows and mass matrix of a scene by machine code, as functions that JAX can differentiate: a derivative has two calls in it, in place of the scene itself.

g(t, q),   G = dg/dq;        phi(t, q, u),   A = dphi/du;        M(t, q)
d o_i = sum_j J_ij d x_j     o: any of these numbers, x: parameters, time, coordinates, speeds, inputs;   J: derived on the graph (`values_of_nodes.py`)
"""

from collections.abc import Sequence
from functools import lru_cache

import jax.numpy as jnp

from jourdain_jax.build.row_program import RowProgram
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.equations.projection import BY_AUTODIFF, RowFunctions
from jourdain_jax.motion.native import onto_rows
from jourdain_jax.motion.native.seen import entries
from jourdain_jax.motion.native.values_of_nodes import values_of_nodes
from jourdain_jax.native.scalar_program import unsupported
from jourdain_jax.scene.scene import Scene


@lru_cache(maxsize=64)
def row_functions(program: RowProgram) -> RowFunctions:
    """g and G, phi and A, and M, by the program; of what is no machine code, by autodiff."""
    nodes = [*program.g, *program.G.values(), *program.phi, *program.A.values(), *(program.M or {}).values()]
    if unsupported(program.graph, nodes) or program.graph.operations(nodes) > onto_rows.LARGEST_PROGRAM:
        return BY_AUTODIFF
    rows, speeds = len(program.phi), len(program.u)
    closures, coordinates = len(program.g), len(program.q)
    parameters = [n for leaf in program.parameters for n in leaf if n >= 0]
    at = [*parameters, program.t, *program.q]
    of_closures = values_of_nodes(program.graph, _places(program.g, program.G, coordinates), closures * (1 + coordinates), at)
    of_rows = values_of_nodes(program.graph, _places(program.phi, program.A, speeds), rows * (1 + speeds), [*at, *program.u, *program.inputs])
    M = {key: node for (i, k), node in (program.M or {}).items() for key in ((i, k), (k, i))}
    of_masses = values_of_nodes(program.graph, _places((), M, speeds), speeds**2, at)

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
