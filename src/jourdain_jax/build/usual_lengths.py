"""The usual lengths of the rows of a motion, for the parameters of that motion: they tell a row that vanishes on the way from one that is short.

Of a scene whose parameters are numbers, `structure_of` knows it. Where they are traced, the lengths are found while the motion runs, at the states that
were probed with numbers near the class's defaults.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.build.probed import generic_inputs
from jourdain_jax.build.structure import closure_lengths, structure_of, usual_rows
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.equations.listed import names_of_position_rows
from jourdain_jax.equations.rows import UsualRows, velocity_residual
from jourdain_jax.equations.scaling import speed_scale
from jourdain_jax.equations.virtual_power import mass_matrix_at
from jourdain_jax.scene.scene import Scene

STATES = 12  # at which traced parameters are looked at


class UsualLengths(eqx.Module):
    """Usual lengths of the rows in scaled speeds, with their rank; and of geometric rows and quaternion norms in the coordinates."""

    rows: UsualRows
    closures: Float[Array, "closures"]


def usual_lengths(scene: Scene) -> UsualLengths:
    """The usual lengths for the parameters of `scene`; no derivative passes through them."""
    if not is_traced(scene):
        return UsualLengths(jax.tree.map(jnp.asarray, usual_rows(scene)), jnp.asarray(closure_lengths(scene)))
    known = structure_of(scene)
    count = min(STATES, known.random)
    t, q, inputs = jnp.asarray(known.times[:count]), jnp.asarray(known.coordinates[:count]), jnp.asarray(generic_inputs(scene))
    still = jax.lax.stop_gradient(scene)
    u = jnp.ones(len(scene.speed_names), q.dtype)

    def lengths(t, q):
        A = jax.jacfwd(lambda u: velocity_residual(still, t, q, u, inputs.astype(q.dtype)))(u)
        return tuple(jnp.sqrt(jnp.sum(rows**2, axis=1)) for rows in (A * speed_scale(mass_matrix_at(still, t, q)), A))

    scaled, plain = (usual(x) for x in jax.vmap(lengths)(t, q))
    norms = jnp.ones(len(scene.coordinates.quaternions), plain.dtype)
    closures = jnp.concatenate([plain[: len(names_of_position_rows(scene))], norms])
    return UsualLengths(UsualRows(scaled, jnp.asarray(known.rank, jnp.int32)), closures)


def usual(sizes: Float[Array, "states *rows"]) -> Float[Array, "*rows"]:
    """The median over states, or the largest for what vanishes at half of them; what is no number does not count, and no derivative passes through."""
    median = jnp.nanmedian(sizes, axis=0)
    return jax.lax.stop_gradient(jnp.where(median > 0, median, jnp.nanmax(sizes, axis=0, initial=0.0)))
