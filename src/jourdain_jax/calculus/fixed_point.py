"""An iteration x <- step(x) that ends where it changes nothing more, differentiable in any mode and to any order.

Where it converges quadratically, each further step doubles the order of derivatives that are right: two steps that change nothing give those up to the
third. Steps left out cost nothing, under `vmap` neither once all lanes have settled.
"""

from collections.abc import Callable

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

QUIET = 2  # steps in a row
ROUND_OFF = 1e3  # units of it, relative to 1 + |x|: a change


def fixed_point(step: Callable, x: Float[Array, "entries"], most: int) -> Float[Array, "entries"]:
    """x after at most so many steps; what is not a number has settled."""
    if most <= QUIET:
        return jax.lax.scan(lambda x, _: (step(x), None), x, length=most)[0]

    def once(carry, _):
        x, quiet = carry
        going = quiet < QUIET
        new = jax.lax.cond(eqxi.unvmap_any(going), step, lambda x: x, x)
        old_value, value = jax.lax.stop_gradient((x, new))
        changed = jnp.any(jnp.abs(value - old_value) > ROUND_OFF * jnp.finfo(x.dtype).eps * (1 + jnp.abs(old_value)))
        return (jnp.where(going, new, x), jnp.where(going & changed, 0, jnp.minimum(quiet + 1, QUIET))), None

    return jax.lax.scan(once, (x, jnp.zeros((), jnp.int32)), length=most)[0][0]
