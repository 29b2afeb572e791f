"""The usual lengths of the rows of a motion on dense matrices: they tell a row that vanishes on the way from one that is short."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.build.reference_parameters import with_reference_parameters
from jourdain_jax.build.structure import TRACED, closure_lengths, structure_whatever_its_faults, usual_rows
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.equations.kinematics import rates_by_own_speeds
from jourdain_jax.equations.rows import UsualRows
from jourdain_jax.scene.scene import Scene


class UsualLengths(eqx.Module):
    """Usual lengths of the rows in scaled speeds, with their rank; and of geometric rows and quaternion norms in the coordinates."""

    rows: UsualRows
    closures: Float[Array, "closures"]
    own_speeds: Float[Array, "own_speeds"]  # of the rates of coordinates by each speed of the scene's own


def usual_lengths(scene: Scene) -> UsualLengths:
    """The usual lengths as `usual_rows` and `closure_lengths` have them; no derivative passes through them."""
    with jax.ensure_compile_time_eval():  # they are kept from one call to the next, whether inside `jit` or not
        return UsualLengths(jax.tree.map(jnp.asarray, usual_rows(scene)), jnp.asarray(closure_lengths(scene)), _of_own_speeds(scene))


def _of_own_speeds(scene: Scene) -> Float[Array, "own_speeds"]:
    """The median over probed states; a thousand times as much where parameters are traced, so that only what is longer than that counts as infinite."""
    known, reference = structure_whatever_its_faults(scene), with_reference_parameters(scene)
    t, q = jnp.asarray(known.times), jnp.asarray(known.coordinates)
    lengths = jnp.nanmedian(jax.vmap(lambda t, q: jnp.linalg.norm(rates_by_own_speeds(reference, t, q), axis=1))(t, q), axis=0)
    return jnp.where(lengths > 0, lengths, jnp.inf) / (TRACED if is_traced(scene) else 1.0)
