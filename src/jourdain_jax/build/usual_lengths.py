"""The usual lengths of the rows of a motion on dense matrices: they tell a row that vanishes on the way from one that is short."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.build.structure import closure_lengths, usual_rows
from jourdain_jax.equations.rows import UsualRows
from jourdain_jax.scene.scene import Scene


class UsualLengths(eqx.Module):
    """Usual lengths of the rows in scaled speeds, with their rank; and of geometric rows and quaternion norms in the coordinates."""

    rows: UsualRows
    closures: Float[Array, "closures"]


def usual_lengths(scene: Scene) -> UsualLengths:
    """The usual lengths as `usual_rows` and `closure_lengths` have them; no derivative passes through them."""
    return UsualLengths(jax.tree.map(jnp.asarray, usual_rows(scene)), jnp.asarray(closure_lengths(scene)))
