"""Derivatives of steps that fail: finite, so that they vanish with the step.

An implicit solver tries steps into states where rates are not numbers: beyond a stop event, or out of the domain of a program. The step is refused and its
derivative dropped; but the derivative of its inner solve would have been an error, or 0 * NaN in reverse mode. Where a value f is not finite,

    df := 0,   linearised at a reference state instead, so that no NaN arises on the way back either

and f itself stays as it is, so that what fails shows.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree


class ZeroTangentIfNonfinite(eqx.Module):
    """`function(t, y, args)`, with derivative zero where its value is not finite; `t`, `y`: a state at which it is."""

    function: Callable
    t: Float[Array, ""]
    y: PyTree

    def __call__(self, t, y, args):
        return _flat(t, y, args, jax.lax.stop_gradient((self.t, self.y)), self.function)


@eqx.filter_custom_jvp
def _flat(t, y, args, reference, function):
    return function(t, y, args)


@_flat.def_jvp
def _flat_jvp(primals, tangents):
    t, y, args, reference, function = primals
    value = function(t, y, args)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(value)]))
    at = jax.tree.map(lambda x, safe: jnp.where(finite, x, safe), (t, y), reference)
    _, slope = eqx.filter_jvp(function, (*at, args), tangents[:3])
    return value, jax.tree.map(lambda d: jnp.where(finite, d, jnp.zeros_like(d)), slope)
