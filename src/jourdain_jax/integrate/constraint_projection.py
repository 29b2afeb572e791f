"""Project coordinates or speeds onto the constraints, by machine code if possible, otherwise by XLA. XLA also
computes the derivatives of the projection.

JAX can differentiate constraints and a mass matrix that machine code evaluates. Their derivative consists of
two calls of machine code.

    g(t, q),   G = dg/dq;        phi(t, q, u),   A = dphi/du;        M(t, q)
    d o_i = sum_j J_ij d x_j     o: any of these numbers, x: parameters, time, coordinates, speeds, inputs
                                 J: derived on the graph (`integrate/loop/value_kernels.py`)
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.derivatives import differentiated_as, with_derivatives_of
from jourdain_jax.calculus.markers import stopped
from jourdain_jax.calculus.reals import (
    Entries,
    PerCoordinate,
    PerRow,
    Speeds,
    eps_of,
    rank_cutoff,
    real_type,
    static,
)
from jourdain_jax.equations.projection import BY_AUTODIFF, RowFunctions, project_positions, project_speeds
from jourdain_jax.equations.rows import names_of_position_rows, names_of_rows
from jourdain_jax.integrate.loop import projection_kernel
from jourdain_jax.integrate.loop.projection_kernel import Rows, write
from jourdain_jax.integrate.loop.value_kernels import called, entries, nodes_called, values_of_nodes
from jourdain_jax.kernels import ffi
from jourdain_jax.kernels.scalar_program import unsupported
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import coordinate_bounds
from jourdain_jax.structure.probes import coordinates_on_rows
from jourdain_jax.structure.row_program import RowProgram, row_program
from jourdain_jax.structure.sampling import NEARLY_INSIDE
from jourdain_jax.structure.structure import (
    closure_lengths,
    plain_row_lengths,
    structure_whatever_its_faults,
    usual_rows,
)


class Usual(eqx.Module):
    """Typical sizes of constraints and coordinates, and properties of the constraints."""

    closures: Float[Entries, "closures"]
    # per unit of scaled speeds, or of plain speeds if constraints determine the free speeds
    rows: Float[Entries, "rows"]
    width: Float[Entries, "coordinates"]  # of the domain
    # bounds of coordinates that constraints determine; infinite if unbounded
    low: Float[Entries, "coordinates"]
    high: Float[Entries, "coordinates"]
    affine: bool = static()  # constraints are affine in the speeds
    determined: bool = static()  # constraints determine the free speeds
    program: RowProgram | None = static()  # program for projection by machine code; None: use XLA
    plain: tuple[Scene, ...] = ()  # as in `project_speeds`


def usual_sizes(scene: Scene, determined: bool, native: bool) -> Usual:
    """Return the typical sizes for the parameters of a scene. `determined`: as in `Usual`; `native`: machine
    code may project states.
    """
    low, high = (x.astype(real_type()) for x in coordinate_bounds(scene))
    width = np.where(high > low, high - low, 1.0).astype(real_type())
    program = row_program(scene) if native and not ffi.reason_against() else None
    try:
        rows = plain_row_lengths(scene) if determined else usual_rows(scene).lengths
        # the stated domain, slightly widened, for coordinates on which constraints depend
        bounded = coordinates_on_rows(scene) & [
            name in scene.domain for name in scene.coordinate_names.entries
        ]
        more = NEARLY_INSIDE * (high - low)
        low, high = np.where(bounded, low - more, -np.inf), np.where(bounded, high + more, np.inf)
        affine = structure_whatever_its_faults(scene).affine
        low, high = (x.astype(width.dtype) for x in (low, high))
        return Usual(closure_lengths(scene), rows, width, low, high, affine, determined, program)
    except ValueError:  # the scene is invalid; `structure_of` reports it
        norms, geometric = len(scene.coordinates.quaternions), len(names_of_position_rows(scene))
        no_lengths = np.zeros(geometric + norms), np.zeros(len(names_of_rows(scene)))
        return Usual(*no_lengths, width, -np.inf * width, np.inf * width, False, False, None)


def put_positions(
    scene: Scene, t, q, free, usual: Usual, known: tuple | None = None
) -> tuple[PerCoordinate, Float[Array, "closures"]]:
    """Return the coordinates nearest to q that satisfy the geometric constraints, and the residual. `known`:
    both results if already computed; then only derivatives are added.
    """
    if usual.program is not None and not usual.program.g:
        return q, jnp.zeros(0, q.dtype)

    def by_xla(by: RowFunctions, scenes, t, q, free, lengths):
        near_q = project_positions(scenes[0], t, q, free=free, typical=lengths, by=by, plain=scenes[1:])
        return near_q, by.closures(by.given(*scenes), t, near_q)[0]

    given = (scene, *usual.plain), jnp.asarray(t), q, free, usual.closures
    if known is None:
        return _by_either(usual, "positions", False, by_xla, 1)(*given)

    return with_derivatives_of(lambda _, *given: by_xla(functions_of_rows(usual), *given), known, *given)


def put_speeds(scene: Scene, t, q, u, inputs, free, usual: Usual) -> tuple[Speeds, PerRow]:
    """Return the speeds nearest to u that satisfy the velocity constraints, and the residual."""
    affine, determined = usual.affine, usual.determined
    if usual.program is not None and not usual.program.phi:
        return u, jnp.zeros(0, u.dtype)

    def by_xla(by: RowFunctions, scenes, t, q, u, inputs, free, lengths):
        how: dict = {"affine": affine, "determined": determined, "by": by, "plain": scenes[1:]}
        near_u = project_speeds(scenes[0], t, q, u, inputs, free=free, typical=lengths, **how)
        return near_u, by.rows(by.given(*scenes), t, q, near_u, inputs)[0]

    kind = "determined speeds" if determined else "speeds"
    return _by_either(usual, kind, affine or determined, by_xla, 2)(
        (scene, *usual.plain), jnp.asarray(t), q, u, inputs, free, usual.rows
    )


def functions_of_rows(usual: Usual) -> RowFunctions:
    """Return the constraint functions that XLA uses for projections, derivatives and searches."""
    return BY_AUTODIFF if usual.program is None else row_functions(usual.program)


def _by_either(usual: Usual, kind, affine: bool, by_xla, place: int):
    """Return the projection of the variables at a `place` among its vectors."""
    by = functions_of_rows(usual)
    of_rows = partial(by_xla, by)
    if usual.program is None:
        return of_rows
    if not (rows := Rows(usual.program, kind, affine)).reason_against():
        return differentiated_as(of_rows, partial(_put, rows))
    at = by.closures if kind == "positions" else by.rows

    def unless_settled(scenes: tuple[Scene, ...], *vectors):
        x = vectors[place]
        r, A = at(by.given(*scenes), *vectors[:-2])
        size, eps = jnp.abs(x), eps_of(x)  # as in the kernel
        moves = ~jnp.all(jnp.abs(r) <= 8 * eps * (jnp.abs(A) @ (size + eps * jnp.max(size))))
        moved = jax.lax.cond(eqxi.unvmap_any(moves), lambda: of_rows(scenes, *vectors), lambda: (x, r))
        return tuple(jnp.where(moves, *pair) for pair in zip(moved, (x, r), strict=True))

    return differentiated_as(of_rows, unless_settled)


@lru_cache(maxsize=64)
def _kernel(rows: Rows, given_in: np.dtype):
    count, cutoff = len(rows.moving) + len(rows.residuals), rank_cutoff(given_in)
    return called(lambda w: write(w, rows, cutoff), lambda *_: ((count,),), effort=1)


def _put(rows: Rows, scenes: tuple[Scene, ...], *vectors) -> tuple[Array, Array]:
    """Return the projected quantities and the residual, by machine code."""
    real, given = real_type(), (*entries(scenes[-1], rows.program.parameters), *vectors)
    found = _kernel(rows, real)(tuple(jnp.asarray(x, real) for x in given))[0]
    return found[: len(rows.moving)], found[len(rows.moving) :]


class Validity(NamedTuple):
    """The truth values `RowProgram.right`, by machine code."""

    others: int  # number of coordinates of other states
    at: Callable[..., Bool[Array, "3"]]  # function of the scene, t, q, u, inputs and these coordinates


@lru_cache(maxsize=64)
def validity(program: RowProgram) -> Validity | None:
    """Return the validity of a start; None if machine code cannot evaluate it."""
    if unsupported(program.graph, program.right):
        return None
    given = [*program.entries, program.t, *program.q, *program.u, *program.inputs, *program.others]
    values = nodes_called(program.graph, program.right, given)
    return Validity(
        len(program.others),
        lambda scene, *state: values(*stopped((*entries(scene, program.parameters), *state))) > 0,
    )


@lru_cache(maxsize=64)
def row_functions(program: RowProgram) -> RowFunctions:
    """Return functions for (g, G), (phi, A) and M from the program. They use automatic differentiation if
    machine code cannot evaluate them.
    """
    nodes = [*program.g, *program.G.values(), *program.phi, *program.A.values(), *(program.M or {}).values()]
    if (
        unsupported(program.graph, nodes)
        or program.graph.operations(nodes) > projection_kernel.LARGEST_PROGRAM
    ):
        return BY_AUTODIFF
    rows, speeds = len(program.phi), len(program.u)
    closures, coordinates = len(program.g), len(program.q)
    at = [*program.entries, program.t, *program.q]

    def matrix(entries: dict[tuple[int, int], int], rows: int, columns: int) -> list[int]:
        return [entries.get((i, k), program.graph.zero) for i in range(rows) for k in range(columns)]

    of_closures = values_of_nodes(program.graph, [*program.g, *matrix(program.G, closures, coordinates)], at)
    of_rows = values_of_nodes(
        program.graph, [*program.phi, *matrix(program.A, rows, speeds)], [*at, *program.u, *program.inputs]
    )
    M = {key: node for (i, k), node in (program.M or {}).items() for key in ((i, k), (k, i))}
    of_masses = values_of_nodes(program.graph, matrix(M, speeds, speeds), at)

    def parameters_of(*scenes: Scene):
        each = [entries(scene, program.parameters) for scene in scenes]
        return tuple(jnp.concatenate(found) if found else jnp.zeros(0, real_type()) for found in each)

    def numbers_of(given):
        return parameters_of(given) if isinstance(given, Scene) else given

    def closures_at(given, t, q):
        found = of_closures(numbers_of(given), t, q)
        return found[:closures], found[closures:].reshape(closures, coordinates)

    def rows_at(given, t, q, u, inputs):
        found = of_rows(numbers_of(given), t, q, u, inputs)
        return found[:rows], found[rows:].reshape(rows, speeds)

    def masses_at(given, t, q):
        return of_masses(numbers_of(given), t, q).reshape(speeds, speeds)

    if program.M is None:
        return RowFunctions(closures_at, rows_at, BY_AUTODIFF.masses)
    return RowFunctions(closures_at, rows_at, masses_at, parameters_of)
