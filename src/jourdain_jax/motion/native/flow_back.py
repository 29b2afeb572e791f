"""Cotangents of a motion's start as a function that JAX differentiates once: by cotangents of the motion with a tangent.

Let S be the sum of all states, each times its cotangent g, and g' what S' changes by along a tangent. What is asked for is dS/dx, x the start's state and the
numbers known. It changes by d(dS)/dx, where dS is the sum of the states times g' and of their tangents times g: cotangents are g' of the states and g of
their tangents.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.derivatives import filled
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.native.flow import with_tangents
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.kernel import Start, kernel_back


def flow_back(form: Form, method: Method, asked: tuple[int, ...]) -> Callable[..., Float[Array, "found"]]:
    """Cotangents of the start's state, and of the numbers `asked` for of those known, as a function of the start, and of cotangents of the states at the
    goals, and of the end and its time.
    """
    n = form.layout.y

    @jax.custom_jvp
    def own(start: Start, g: Float[Array, "times y"], ends: Float[Array, "ends"]):
        return _pulled(form, method, asked, start, g, ends)

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (start, g, ends), (along, dg, dends) = primals, tangents
        dg, dends = filled(dg), filled(dends)
        raised, more = with_tangents(form, start, along)
        # of the state and its tangent, at the goals, at the end, and of the time of that
        both = jnp.concatenate([dg, g], axis=1), jnp.concatenate([dends[:n], ends[:n], dends[n:], ends[n:]])
        raised = replace(raised, time_moves=form.has_events and bool(form.sampled))  # an event needs to know how fast samples change
        d = _pulled(raised, method, asked, more, *both)
        return own(*primals), jnp.concatenate([d[:n], d[2 * n :]])

    return own


def _pulled(form: Form, method: Method, asked: tuple[int, ...], start: Start, g, ends) -> Float[Array, "found"]:
    rows = start.rows([jnp.zeros(())] * len(form.moving))
    return kernel_back(form, method, asked)(*start.of_samples, rows, g, ends, start.goals)
