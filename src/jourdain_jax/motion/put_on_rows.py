"""Coordinates and speeds put onto the rows: by machine code where that serves, by XLA where not, and for derivatives.

g(t, q) = 0,  phi(t, q, u) = 0
"""

from functools import lru_cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.build.domain import coordinate_bounds
from jourdain_jax.build.probed_on_graph import coordinates_on_rows
from jourdain_jax.build.reference_parameters import once_per_values
from jourdain_jax.build.row_program import RowProgram, row_program
from jourdain_jax.build.sampling import NEARLY_INSIDE
from jourdain_jax.build.structure import closure_lengths, plain_row_lengths, rows_are_affine, usual_rows
from jourdain_jax.calculus.differentiated_as import differentiated_as
from jourdain_jax.calculus.pseudo_inverse import rank_cutoff
from jourdain_jax.calculus.reals import real_type
from jourdain_jax.equations.listed import names_of_position_rows, names_of_rows
from jourdain_jax.equations.projection import BY_AUTODIFF, RowFunctions, project_positions, project_speeds
from jourdain_jax.motion.native.called import called
from jourdain_jax.motion.native.onto_rows import Rows, write
from jourdain_jax.motion.native.seen import entries
from jourdain_jax.motion.row_functions import row_functions
from jourdain_jax.native import ffi
from jourdain_jax.scene.scene import Scene


class Usual(eqx.Module):
    """Sizes by which rows and coordinates are measured, and of what kind rows are."""

    closures: Float[Array | np.ndarray, "closures"]
    rows: Float[Array | np.ndarray, "rows"]  # in scaled speeds; where rows determine the speeds that are free, in the speeds as they are
    width: Float[Array | np.ndarray, "coordinates"]  # of the domain
    low: Float[Array | np.ndarray, "coordinates"]  # where a coordinate is found by the rows; infinite where it may be anywhere
    high: Float[Array | np.ndarray, "coordinates"]
    affine: bool = eqx.field(static=True)  # rows are, in the speeds
    determined: bool = eqx.field(static=True)  # rows determine the speeds that are free
    program: RowProgram | None = eqx.field(static=True)  # by which machine code puts a start onto them; None: XLA does


def _worked_out(scene: Scene, determined: bool, native: bool) -> Usual:
    low, high = (x.astype(real_type()) for x in coordinate_bounds(scene))
    width = np.where(high > low, high - low, 1.0).astype(real_type())
    program = row_program(scene) if native and not ffi.reason_against() else None
    try:
        rows = plain_row_lengths(scene) if determined else usual_rows(scene).lengths
        within = _found_within(scene, low, high)
        return Usual(closure_lengths(scene), rows, width, within[0], within[1], rows_are_affine(scene), determined, program)
    except ValueError:  # of a scene that is wrong in itself; said where its structure is asked for
        norms, geometric = len(scene.coordinates.quaternions), len(names_of_position_rows(scene))
        return Usual(np.zeros(geometric + norms), np.zeros(len(names_of_rows(scene))), width, -np.inf * width, np.inf * width, False, False, None)


def _found_within(scene: Scene, low, high) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of what rows may find: the domain, and a little more, of the coordinates for which a scene states it and on which rows depend."""
    bounded = coordinates_on_rows(scene) & [name in scene.domain for name in scene.coordinate_names.entries]
    more = NEARLY_INSIDE * (high - low)
    return np.where(bounded, low - more, -np.inf).astype(low.dtype), np.where(bounded, high + more, np.inf).astype(low.dtype)


def _as_arrays(scene: Scene, determined: bool, native: bool) -> Usual:
    found = _worked_out(scene, determined, native)  # on NumPy; what it traces must not be computed at once
    with jax.ensure_compile_time_eval():
        return jax.device_put(found)  # kept, and handed over in a fifth of the time that arrays of NumPy take


usual_sizes = once_per_values(_as_arrays, of_traced=_worked_out)


def put_positions(scene: Scene, t, q, free, usual: Usual, known: tuple | None = None) -> tuple[Float[Array, "coordinates"], Float[Array, "closures"]]:
    """The coordinates on the geometric rows nearest to q, and what is left of the rows; of what is `known`, both get their derivatives."""
    if usual.program is not None and not usual.program.g:
        return q, jnp.zeros(0, q.dtype)

    def by_xla(by: RowFunctions, scene, t, q, free, lengths):
        near_q = project_positions(scene, t, q, free=free, typical=lengths, by=by)
        return near_q, by.closures(by.given(scene), t, near_q)[0]

    given = scene, jnp.asarray(t), q, free, usual.closures
    if known is None:
        return _by_either(usual, "positions", False, by_xla)(*given)

    def of_known(_, *given):
        return by_xla(functions_of_rows(usual), *given)

    return differentiated_as(of_known, lambda known, *_: known)(known, *given)


def put_speeds(scene: Scene, t, q, u, inputs, free, usual: Usual) -> tuple[Float[Array, "speeds"], Float[Array, "rows"]]:
    """The speeds on the velocity rows nearest to u, and what is left of the rows."""
    affine, determined = usual.affine, usual.determined
    if usual.program is not None and not usual.program.phi:
        return u, jnp.zeros(0, u.dtype)

    def by_xla(by: RowFunctions, scene, t, q, u, inputs, free, lengths):
        near_u = project_speeds(scene, t, q, u, inputs, free=free, typical=lengths, affine=affine, determined=determined, by=by)
        return near_u, by.rows(by.given(scene), t, q, near_u, inputs)[0]

    kind = "determined speeds" if determined else "speeds"
    return _by_either(usual, kind, affine or determined, by_xla)(scene, jnp.asarray(t), q, u, inputs, free, usual.rows)


def functions_of_rows(usual: Usual) -> RowFunctions:
    """How rows are evaluated where XLA puts something onto them, or a derivative or a search needs them."""
    return BY_AUTODIFF if usual.program is None else row_functions(usual.program)


def _by_either(usual: Usual, kind, affine: bool, by_xla):
    of_rows = partial(by_xla, functions_of_rows(usual))
    if usual.program is None or (rows := Rows(usual.program, kind, affine)).reason_against():
        return of_rows
    return differentiated_as(of_rows, partial(_put, rows))


@lru_cache(maxsize=64)
def _kernel(rows: Rows, given_in: np.dtype):
    count, cutoff = len(rows.moving) + len(rows.residuals), rank_cutoff(given_in)
    return called(lambda w: write(w, rows, cutoff), lambda *_: ((count,),), effort=1)


def _put(rows: Rows, scene: Scene, t, *vectors) -> tuple[Array, Array]:
    """What moved, and what is left of the rows, by machine code."""
    real, given = real_type(), (*entries(scene, rows.program.parameters), t[None], *vectors)
    found = _kernel(rows, real)(jnp.concatenate([jnp.asarray(x, real) for x in given]))[0]
    return found[: len(rows.moving)], found[len(rows.moving) :]
