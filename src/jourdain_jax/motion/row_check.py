"""Whether velocity rows that depend on each other contradict each other along a motion: a result code, inside `jit` and in every lane.

    A u + phi_0 = 0,   rank A < number of rows:   a row that is left out holds by itself only where phi_0 is in the range of A

Where phi_0 = 0 it always does. Rows that move with time or with an input may contradict each other at some times although the start meets all of them.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.equations.projection import linearised_rows
from jourdain_jax.motion.setup import Setup


def rows_violated(setup: Setup, t: Float[Array, "times"], q: Float[Array, "times coordinates"], u: Float[Array, "times speeds"]) -> Bool[Array, ""]:
    """Whether some row is violated at some of these states; those that were not reached are NaN, and do not count.

    |phi| > 1 % of |phi - A u| + |A| |u|, where that is largest
    """
    scene, inputs, states = jax.lax.stop_gradient((setup.scene, setup.inputs, (t, q, u)))

    def left_and_size(state):
        phi, A = linearised_rows(scene, *state, inputs(state[0]))
        return jnp.abs(phi), jnp.abs(phi - A @ state[2]) + jnp.abs(A) @ jnp.abs(state[2])

    left, size = jax.lax.map(left_and_size, states)  # rows may be callbacks, which need not know batches
    # 1 % is far more than steps at loose tolerances leave
    return jnp.any(left > 1e-2 * jnp.nanmax(size, axis=0))
