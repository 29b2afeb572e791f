"""Whether velocity rows that depend on each other contradict each other along a motion: a result code, inside `jit` and in every lane.

    A u + phi_0 = 0,   rank A < number of rows:   a row that is left out holds by itself only where phi_0 is in the range of A

Where phi_0 = 0 it always does. Rows that move with time or with an input may contradict each other at some times although the start meets all of them.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.build.structure import plain_row_lengths, structure_of
from jourdain_jax.equations.rows import velocity_residual
from jourdain_jax.motion.setup import Setup

VIOLATED = 1e-2  # of a row at these speeds, or at rest: far more than steps at loose tolerances leave


def may_contradict(setup: Setup) -> bool:
    """Whether the rows depend on each other and ask for motion even at rest."""
    known = structure_of(setup.scene)
    return known.rank < len(known.row_names) and not (known.affine and known.homogeneous)


def contradicted(setup: Setup, t: Float[Array, "times"], q: Float[Array, "times coordinates"], u: Float[Array, "times speeds"]) -> Bool[Array, ""]:
    """Whether some row is violated at some of these states; those that were not reached are NaN, and do not count."""
    scene, inputs, q, u = jax.lax.stop_gradient((setup.scene, setup.inputs, q, u))
    rows = lambda t, q, u: velocity_residual(scene, t, q, u, inputs(t))  # noqa: E731
    phi, at_rest = jax.lax.map(lambda at: (rows(*at), rows(at[0], at[1], jnp.zeros_like(at[2]))), jax.lax.stop_gradient((t, q, u)))
    size = jnp.maximum(jnp.abs(at_rest), plain_row_lengths(scene) * jnp.max(jnp.abs(u), axis=1, keepdims=True))
    return jnp.any(jnp.abs(phi) > VIOLATED * jnp.nanmax(size, axis=0))
