"""Whether velocity rows that depend on each other contradict each other along a motion: a result code, inside `jit` and in every lane.

    A u + phi_0 = 0,   rank A < number of rows:   there are such speeds only where phi_0 is in the range of A, (1 - A A+) phi_0 = 0

Where phi_0 = 0 it always is. Rows that move with time or with an input may contradict each other at some times although the start meets all of them.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.build.structure import plain_row_lengths, structure_of
from jourdain_jax.calculus.pseudo_inverse import pseudo_inverse
from jourdain_jax.equations.rows import velocity_residual
from jourdain_jax.motion.setup import Setup

VIOLATED = 1e-2  # of a row at these speeds, or at rest: far more than steps at loose tolerances leave
NEARLY = 1e-3  # of the largest singular value: rows as near to dependent as this count as such, since coordinates may be off their rows


def may_contradict(setup: Setup) -> bool:
    """Whether the rows depend on each other and ask for motion even at rest."""
    known = structure_of(setup.scene)
    return known.rank < len(known.row_names) and not (known.affine and known.homogeneous)


def contradicted(setup: Setup, t: Float[Array, "times"], q: Float[Array, "times coordinates"], u: Float[Array, "times speeds"]) -> Bool[Array, ""]:
    """Whether at some of these states no speeds near u meet all rows; states that were not reached are NaN, and do not count."""
    scene, inputs, states = jax.lax.stop_gradient((setup.scene, setup.inputs, (t, q, u)))
    usual = plain_row_lengths(scene)

    def linear(at):
        t, q, u = at
        rows = lambda u: velocity_residual(scene, t, q, u, inputs(t))  # noqa: E731
        phi, A = rows(u), jax.jacfwd(rows)(u)
        return phi, A, jnp.maximum(jnp.abs(phi - A @ u), usual * jnp.max(jnp.abs(u)))

    phi, A, sizes = jax.lax.map(linear, states)
    size = jnp.nanmax(sizes, axis=0)
    size = jnp.where(size > 0, size, 1.0)

    def left(at):  # (1 - A A+) phi: what a motion violates for another reason, such as drift, other speeds would meet
        phi, A = at[0] / size, at[1] / size[:, None]
        return phi - A @ (pseudo_inverse(A, NEARLY) @ phi)

    return jnp.any(jnp.abs(jax.lax.map(left, (phi, A))) > VIOLATED)
