"""Newton's method to round-off, differentiable through the implicit function theorem.

    F(x, theta) = 0   =>   dx = - (dF/dx)^-1 (dF/dtheta) dtheta

The iteration itself is never differentiated, nor unrolled: `jax.lax.custom_root` linearises F once, at the root. Derivatives of any order, in
either mode, cost one linear solve each.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Root(eqx.Module):
    """Where an iteration ended, and whether that is a root."""

    x: Float[Array, "unknowns"]
    converged: Bool[Array, ""]


def newton_root(residual: Callable, guess: Float[Array, "unknowns"], scale: Float[Array, "unknowns"]) -> Root:
    """x with `residual(x) = 0` near `guess`; `residual` may close over anything, traced numbers included.

    `scale`: the size of each unknown, against which round-off counts; infinite for an unknown that need not be looked at. Iterates until the
    corrections no longer shrink; what then is still larger than round-off to the power 0.6 has not converged.
    """

    eps = jnp.finfo(guess.dtype).eps

    def solve(f, x0):
        def running(carry):
            _, _, settled, k = carry
            return ~settled & (k < 20)

        def iterate(carry):
            x, size, _, k = carry
            value, derivative = jax.linearize(f, x)
            dx = jnp.linalg.solve(_matrix(derivative, x), value)
            new_size = jnp.max(jnp.abs(dx) / scale, initial=0.0)
            at_round_off = new_size <= 4.0 * eps  # units of round-off
            # an iteration that no longer shrinks the correction to a tenth has met round-off
            stalled = (new_size <= eps**0.6) & (new_size > 0.1 * size)
            return x - dx, new_size, at_round_off | stalled | ~jnp.isfinite(new_size), k + 1

        start = (x0, jnp.asarray(jnp.inf, x0.dtype), jnp.array(False), jnp.array(0, jnp.int32))
        x, size, _, _ = jax.lax.while_loop(running, iterate, start)
        return x, (size <= eps**0.6).astype(x0.dtype)

    x, converged = jax.lax.custom_root(residual, jax.lax.stop_gradient(guess), solve, lambda f, y: jnp.linalg.solve(_matrix(f, y), y), has_aux=True)
    return Root(x, converged > 0)


def _matrix(linear: Callable, like) -> Float[Array, "unknowns unknowns"]:
    """The matrix of a linear function, column by column."""
    return jax.vmap(linear, in_axes=1, out_axes=1)(jnp.eye(like.shape[0], dtype=like.dtype))
