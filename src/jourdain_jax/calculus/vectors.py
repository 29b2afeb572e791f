"""Vectors of three numbers."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Number


def vec(x: Number, y: Number, z: Number) -> Float[Array, "*times 3"]:
    """Return the vector (x, y, z) of three numbers, also traced ones: `jj.vec(q.x, q.y, 0)`.

    Arrays of equal shape, such as values along a motion, give a vector for each entry.
    """
    dtype = jnp.result_type(float, x, y, z)
    return jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(part, dtype) for part in (x, y, z))), axis=-1)
