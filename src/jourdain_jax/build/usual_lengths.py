"""The usual lengths of the rows of a motion on dense matrices: they tell a row that vanishes on the way from one that is short."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.build.probed_on_graph import generic_inputs
from jourdain_jax.build.reference_parameters import with_reference_parameters
from jourdain_jax.build.structure import closure_lengths, structure_whatever_its_faults, trust, usual_rows
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.equations.kinematics import rates_by_own_speeds
from jourdain_jax.equations.listed import names_of_position_rows
from jourdain_jax.equations.rows import UsualRows, velocity_residual
from jourdain_jax.equations.scaling import speed_scale
from jourdain_jax.equations.virtual_power import mass_matrix_at
from jourdain_jax.scene.scene import Scene


class UsualLengths(eqx.Module):
    """Usual lengths of the rows in scaled speeds, with their rank; and of geometric rows and quaternion norms in the coordinates."""

    rows: UsualRows
    closures: Float[Array, "closures"]
    own_speeds: Float[Array, "own_speeds"]  # of the rates of coordinates by each speed of the scene's own


def usual_lengths(scene: Scene) -> UsualLengths:
    """The usual lengths for the parameters of `scene`; no derivative passes through them."""
    with jax.ensure_compile_time_eval():  # they are kept from one call to the next, whether inside `jit` or not
        own_speeds = _of_own_speeds(scene)
        if not is_traced(scene):
            return UsualLengths(jax.tree.map(jnp.asarray, usual_rows(scene)), jnp.asarray(closure_lengths(scene)), own_speeds)
    return UsualLengths(*_of_traced(scene), own_speeds)


def _of_traced(scene: Scene) -> tuple[UsualRows, Float[Array, "closures"]]:
    """Return lengths of rows at states probed with numbers near the class's defaults; computed while the motion runs."""
    known, still = structure_whatever_its_faults(scene), jax.lax.stop_gradient(scene)
    count = min(12, known.random)
    t, q, inputs = jnp.asarray(known.times[:count]), jnp.asarray(known.coordinates[:count]), jnp.asarray(generic_inputs(scene))
    u = jnp.ones(len(scene.speed_names), q.dtype)

    def lengths(t, q):
        A = jax.jacfwd(lambda u: velocity_residual(still, t, q, u, inputs.astype(q.dtype)))(u)
        return jnp.linalg.norm(A * speed_scale(mass_matrix_at(still, t, q)), axis=1), jnp.linalg.norm(A, axis=1)

    scaled, plain = (_usual(x) for x in jax.vmap(lengths)(t, q))
    norms = jnp.ones(len(scene.coordinates.quaternions), plain.dtype)
    rank = jnp.asarray(known.rank, jnp.int32)
    return UsualRows(scaled, rank), jnp.concatenate([plain[: len(names_of_position_rows(scene))], norms])


def _usual(sizes: Float[Array, "states rows"]) -> Float[Array, "rows"]:
    """Return the median over states, or the largest where half of them are zero; NaN does not count."""
    median = jnp.nanmedian(sizes, axis=0)
    return jax.lax.stop_gradient(jnp.where(median > 0, median, jnp.nanmax(sizes, axis=0, initial=0.0)))


def _of_own_speeds(scene: Scene) -> Float[Array, "own_speeds"]:
    """Return the median over probed states; a thousand times as much where parameters are traced, so that only longer rates count as infinite."""
    known, reference = structure_whatever_its_faults(scene), with_reference_parameters(scene)
    t, q = jnp.asarray(known.times), jnp.asarray(known.coordinates)
    lengths = jnp.nanmedian(jax.vmap(lambda t, q: jnp.linalg.norm(rates_by_own_speeds(reference, t, q), axis=1))(t, q), axis=0)
    return jnp.where(lengths > 0, lengths, jnp.inf) / trust(scene)
