"""Numbers as a user writes them (plain, of NumPy, in a list), made into floating-point arrays."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

Number = ArrayLike  # one number
Numbers = Real[Array | np.ndarray, "_"] | Sequence[ArrayLike]  # any count of them
Vector = Real[Array | np.ndarray, "3"] | Sequence[ArrayLike]  # three numbers


def as_real(x) -> Float[Array, "*shape"]:
    """`x` as a floating-point array: integers become the default float, floats keep their type; never weakly typed, so that one trace serves all."""
    array = jnp.asarray(x)
    dtype = array.dtype if jnp.issubdtype(array.dtype, jnp.floating) else jnp.result_type(float)
    return jnp.asarray(array, dtype)
