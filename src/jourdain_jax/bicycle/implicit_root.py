"""A root of a small nonlinear system, polished by Newton's method and differentiable in the system's parameters.

    F(x, theta) = 0   =>   dx = - (dF/dx)^-1 (dF/dtheta) dtheta     (implicit function theorem)

The rule calls the wrapped function again, so it nests: derivatives of any order, forward and reverse.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, PyTree

_NEWTON_STEPS = 4  # from a bracketed root two reach round-off


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def implicit_root(residual: Callable, guess: Float[Array, " n"], parameters: PyTree, present: Bool[Array, ""]) -> Float[Array, " n"]:
    """x with `residual(x, parameters) = 0` near `guess`.

    **Arguments:** `residual`, a function defined at module level, (n,) and parameters -> (n,); `guess`, close to the
    root; `parameters`, arrays; `present`, False where there is no such root.
    **Returns:** the root, or the unchanged guess with zero derivative where `present` is False. A Newton step that does
    not lower the residual is not taken.
    """

    def step(_, x):
        value = residual(x, parameters)
        better = x - jnp.linalg.solve(_jacobian(residual, x, parameters, present), value)
        size, new_size = jnp.max(jnp.abs(value)), jnp.max(jnp.abs(residual(better, parameters)))
        return jnp.where(present & (new_size < size), better, x)

    return jax.lax.fori_loop(0, _NEWTON_STEPS, step, guess)


@implicit_root.defjvp
def _implicit_root_jvp(residual, primals, tangents):
    guess, parameters, present = primals
    x = implicit_root(residual, guess, parameters, present)
    _, residual_tangent = jax.jvp(lambda theta: residual(x, theta), (parameters,), (tangents[1],))
    residual_tangent = jnp.where(present, residual_tangent, 0.0)
    return x, -jnp.linalg.solve(_jacobian(residual, x, parameters, present), residual_tangent)


def _jacobian(residual, x, parameters, present):
    """dF/dx; the identity where there is no root, so that no division by zero enters a batch's derivatives."""
    return jnp.where(present, jax.jacfwd(residual)(x, parameters), jnp.eye(x.size, dtype=x.dtype))
