"""Cotangents of a motion's start as a function that JAX differentiates once: by cotangents of the motion with a tangent.

Let S be the sum of all states, each times its cotangent g, and g' what S' changes by along a tangent. What is asked for is dS/dx, x the start's state and the
numbers known. It changes by d(dS)/dx, where dS is the sum of the states times g' and of their tangents times g: cotangents are g' of the states and g of
their tangents. As in `flow.py`, where times change by dt, of the start by dt_0,

    dy = dPhi (dy_0 - f_0 dt_0) + f dt

and cotangents g of dy are also those of f dt, and those of dPhi's start, which are dS/dy_0, also those of -f_0 dt_0.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.motion.integrators.tableaus import Method
from jourdain_jax.motion.native.flow import Stopped, filled, is_zero, on_times, rates, scaled, with_tangents
from jourdain_jax.motion.native.functions import Form
from jourdain_jax.motion.native.kernel import Start, kernel_back, kernel_of_pulled_rates


def flow_back(form: Form, method: Method, asked: tuple[int, ...]) -> Callable[..., Float[Array, "found"]]:
    """Cotangents of the start's state, and of the numbers `asked` for of those known, as a function of the start, of how the motion stopped, and of cotangents
    of the states at the goals, and of the end and its time.
    """
    n = form.layout.y

    @jax.custom_jvp
    def own(start: Start, found: Stopped, g: Float[Array, "times y"], ends: Float[Array, "ends"]):
        return _pulled(form, method, asked, start, g, ends)

    @partial(own.defjvp, symbolic_zeros=True)
    def rule(primals, tangents):
        (start, stopped, g, ends), (along, _, dg, dends) = primals, tangents
        found, dg, dends = own(*primals), filled(dg), filled(dends)
        raised, more = with_tangents(form, start, along)
        added = jnp.zeros_like(found)
        if not (is_zero(along.goals) and is_zero(along.origin)):
            origin = filled(along.origin)
            (before,) = rates(form)(start, (jnp.zeros(()),))
            more = more._replace(y=(start.y[0], more.y[1] - scaled(before, origin)))
            at, by_rates = on_times(start, stopped), partial(_pulled_rates, form, asked, start)
            by_states = jax.vmap(by_rates)(*stopped.y, at.t, jax.vmap(scaled)(g.at[-1].add(ends[:n]), at.absolute(filled(along.goals), origin)))
            dg = dg + by_states[:, :n]
            added = by_rates(*start.y, jnp.zeros(()), -scaled(found[:n], origin)).at[n:].add(jnp.sum(by_states[:, n:], axis=0))
        # of the state and its tangent, at the goals, at the end, and of the time of that
        both = jnp.concatenate([dg, g], axis=1), jnp.concatenate([dends[:n], ends[:n], dends[n:], ends[n:]])
        raised = replace(raised, time_moves=form.has_events and bool(form.sampled))  # an event needs to know how fast samples change
        d = _pulled(raised, method, asked, more, *both)
        return found, jnp.concatenate([d[:n], d[2 * n :]]) + added

    return own


def _pulled(form: Form, method: Method, asked: tuple[int, ...], start: Start, g, ends) -> Float[Array, "found"]:
    rows = start.rows(jnp.zeros(()), [jnp.zeros(())] * len(form.moving))
    return kernel_back(form, method, asked)(*start.of_samples, rows, g, ends, start.goals)


def _pulled_rates(form: Form, asked: tuple[int, ...], start: Start, y, t, g) -> Float[Array, "found"]:
    """Cotangents of a state and of what is asked for, from those of the rates there."""
    return kernel_of_pulled_rates(form, asked)(*start.of_samples, start._replace(y=(y,)).rows(t, ()), g)
