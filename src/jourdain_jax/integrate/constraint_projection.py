"""Project a state onto the constraints, first its coordinates, then its speeds, by machine code if possible,
otherwise by XLA. XLA also computes the derivatives of the projection. If it fails, the search for coordinates
begins again from other guesses.

JAX can differentiate constraints and a mass matrix that machine code evaluates. Their derivative consists of
two calls of machine code.

    g(t, q),   G = dg/dq;        phi(t, q, u),   A = dphi/du;        M(t, q)
    d o_i = sum_j J_ij d x_j     o: any of these numbers, x: parameters, time, coordinates, speeds, inputs
                                 J: derived on the graph (`integrate/loop/value_kernels.py`)
"""

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
    Count,
    Entries,
    Flag,
    PerCoordinate,
    PerRow,
    Scalar,
    Speeds,
    eps_of,
    rank_cutoff,
    real_type,
    static,
)
from jourdain_jax.calculus.roots import first_root
from jourdain_jax.equations.projection import BY_AUTODIFF, RowFunctions, project_positions, project_speeds
from jourdain_jax.equations.reductions import row_scale
from jourdain_jax.equations.rows import names_of_position_rows, names_of_rows
from jourdain_jax.integrate.loop import projection_kernel
from jourdain_jax.integrate.loop.projection_kernel import Rows, write
from jourdain_jax.integrate.loop.value_kernels import called, entries, values_of_nodes
from jourdain_jax.integrate.state import State
from jourdain_jax.kernels import ffi
from jourdain_jax.kernels.scalar_program import unsupported
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import coordinate_bounds
from jourdain_jax.structure.plausibility import elsewhere, faults_at
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
    if not len(usual.closures):
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
    if not len(usual.rows):
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


OFF = 1e4  # numerics: a residual above this many eps is more than round-off


class Guess(NamedTuple):
    """Coordinates and speeds to project, and which of them may change."""

    q: Float[Entries, "coordinates"]
    u: Float[Entries, "speeds"]
    free_q: Bool[Entries, "coordinates"]
    free_u: Bool[Entries, "speeds"]
    bounded: Bool[Entries, "coordinates"]  # whether a coordinate must end inside the scene's domain
    usual: Usual

    def inside(self, q) -> Bool[Array, "coordinates"]:
        """Return which coordinates are within their bounds."""
        q = jax.lax.stop_gradient(q)
        return ~self.bounded | ((q >= self.usual.low) & (q <= self.usual.high))


def projected(scene: Scene, t, start: State, inputs, usual: Usual) -> State:
    """Project a state as `consistent` does, as a part of a larger compiled function."""
    every_q, every_u = np.ones(len(start.q), bool), np.ones(len(start.u), bool)
    return put_onto_constraints(
        scene, t, Guess(start.q, start.u, every_q, every_u, ~every_q, usual), inputs, None
    )[0]


def put_onto_constraints(scene: Scene, t, start: Guess, inputs, guesses) -> tuple[State, Flag]:
    """Project the start onto the constraints. Also return whether the projection of the coordinates converged
    within the domain. If it did not, search from `guesses`, if any.

    The residual is infinite if a number is not finite or a coordinate is out of its permitted range.
    """
    q, u, usual = jnp.asarray(start.q), jnp.asarray(start.u), start.usual
    near_q, g, guess, arrived = q, jnp.zeros(0, q.dtype), jnp.int32(0), jnp.array(True)
    if len(usual.closures):
        near_q, g, guess, arrived = _put_coordinates(scene, t, q, start, guesses)
    near_u, phi = put_speeds(scene, t, near_q, u, jnp.asarray(inputs), jnp.asarray(start.free_u), usual)
    left = jnp.concatenate([g, phi])
    left = stopped(jnp.concatenate([left, 0.0 * near_q, 0.0 * near_u]))  # NaN if a number is not finite
    moved_q, moved_u, residual = (jnp.max(jnp.abs(x), initial=0.0) for x in (near_q - q, near_u - u, left))
    right = ~jnp.isnan(residual) & jnp.all(start.inside(near_q))
    names = scene.coordinate_names, scene.speed_names
    moved = moved_q, moved_u, jnp.where(right, residual, jnp.inf)
    return State(jnp.asarray(t), near_q, near_u, *moved, names, guess.astype(q.dtype)), arrived


def _put_coordinates(scene: Scene, t, q, start: Guess, guesses) -> tuple[Array, Array, Count, Flag]:
    """Return the nearest coordinates, the residual, the index of the guess, and whether q converged."""
    free, usual = jnp.asarray(start.free_q), start.usual
    here, at, begin = stopped((scene, t, q))
    near_q, g = put_positions(here, at, begin, free, usual)
    arrived = _arrived(begin, near_q, g, start)
    found = _Put(near_q, g, jnp.zeros((), jnp.int32), begin, jnp.array(True))
    if guesses is not None:
        other = jax.lax.cond(
            eqxi.unvmap_any(~arrived),
            lambda: _searched(here, at, begin, start, jax.lax.stop_gradient(guesses)),
            lambda: found,
        )
        better = ~arrived & (left_of(other.g) <= left_of(g))
        found = jax.tree.map(lambda x, y: jnp.where(better, x, y), other, found)
        q = jnp.where(better & free, found.begin, q)
    # add the derivatives of Newton's method from its starting point; without a solution they would diverge
    near_q, g = put_positions(scene, t, q, free, usual, (found.q, found.g))
    return jnp.where(found.met, near_q, q), g, found.guess, arrived


def coordinates_elsewhere(scene: Scene, native: bool) -> Float[Array, "3 coordinates"]:
    """Return the coordinates of the states `elsewhere`, projected onto the geometric constraints. Those
    without a solution in the domain are NaN.

    `native`: machine code may project them.
    """
    t, q, u = jax.tree.map(lambda x: jnp.asarray(x, real_type()), elsewhere(scene))
    if not names_of_position_rows(scene):
        return q
    here, usual = jax.lax.stop_gradient(scene), usual_sizes(scene, False, native)
    every = jnp.ones(q.shape[1], bool)

    def put(state):
        t, q = state
        near_q, g = put_positions(here, t, q, every, usual)
        return jnp.where(_arrived(q, near_q, g, Guess(q, u[0], every, every, every, usual)), near_q, jnp.nan)

    return jax.lax.map(put, (t, q))  # constraints may be callbacks that cannot be batched


@eval_numpy
def known_faults_at(scene: Scene, t, q, u, inputs) -> dict[str, Flag]:
    """Return for each possible fault whether a concrete scene has it, at this state or elsewhere."""
    return faults_at(scene, t, q, u, inputs, coordinates_elsewhere(scene, False))


def left_of(g: Float[Array, "closures"]) -> Scalar:
    """Return the largest residual of the geometric constraints. NaN counts as infinite, a residual too small
    for a contradiction as zero.
    """
    left = jax.lax.stop_gradient(jnp.max(jnp.abs(g), initial=0.0))
    return jnp.where(left < contradiction(g.dtype), 0.0, jnp.where(jnp.isfinite(left), left, jnp.inf))


def _arrived(q, near_q, g, start: Guess) -> Flag:
    """Return whether the coordinates satisfy the constraints, are in their permitted range, and are near the
    guess.
    """
    # a change by more than ten widths of the domain, or NaN, counts as divergence
    close = jnp.all(jnp.abs(near_q - q) <= 10.0 * start.usual.width)
    return jax.lax.stop_gradient(close & (left_of(g) == 0)) & jnp.all(start.inside(near_q))


class _Put(NamedTuple):
    """Projected coordinates, without derivatives."""

    q: PerCoordinate
    g: Float[Array, "closures"]
    guess: Count
    begin: PerCoordinate  # starting point of Newton's method
    met: Flag  # whether a solution was found


def _searched(scene: Scene, t, q, start: Guess, guesses) -> _Put:
    """Return the solution from the first successful guess, beginning with q itself."""
    free, usual = jnp.asarray(start.free_q), start.usual
    size = jnp.where(free, jnp.asarray(usual.width, q.dtype), 0.0)
    every = jnp.where(free, jnp.vstack([q, guesses]), q)
    by = functions_of_rows(usual)
    given = by.given(scene)
    G = jax.vmap(lambda q: by.closures(given, t, q)[1])(every)
    low, high = (
        jnp.where(start.bounded, x, side * jnp.inf) for x, side in ((usual.low, -1), (usual.high, 1))
    )
    # coordinates on which no constraint depends keep the value of q
    every = jnp.clip(jnp.where(jnp.any(G != 0, axis=(0, 1)), every, q), low, high)
    d = row_scale(jnp.max(jnp.abs(G), axis=0) * size, usual.closures * jnp.mean(usual.width))
    tolerance = 16 * float(eps_of(q))
    scaled = lambda q: jax.tree.map(lambda x: (x.T * d).T, by.closures(given, t, q))
    good = float(eps_of(q)) ** 0.5
    found, guess = first_root(scaled, every, size, tolerance, good, low, high)
    begin, met = jnp.where(free, found.x, q), found.left <= good
    near_q = jnp.where(met, put_positions(scene, t, begin, free, usual)[0], begin)
    return _Put(near_q, by.closures(given, t, near_q)[0], guess, begin, met)


def contradiction(dtype) -> float:
    """Return the residual (m, rad) above which given values count as contradictory. It allows for values with
    few digits, and for round-off.
    """
    return max(1.5e-5, OFF * float(np.finfo(dtype).eps))  # 1.5e-5: for values with few digits
