"""Where in time a stop event lies, to the accuracy of the steps and with the right derivative.

For motions by diffrax, which stops at the end of the step in which an event value c changed sign (`event_search` serves the lean loop). From there
the motion is integrated back to c = 0:

    tau* by Newton on c(y(t_f + tau)) = 0 (held constant in differentiation),   then   t_e = t* - c / cdot,   y_e = y* - f c / cdot   twice

The last corrections are zero in value, and carry the derivatives of the event time and of the state at the event (the saltation term). Newton's
method doubles the order at which it is right: one correction gives first derivatives, two give the second and third ones too.
"""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

_NEWTON_STEPS = 12
_CORRECTIONS = 2  # differentiable ones


class Located(eqx.Module):
    """Time and state of an event."""

    t: Float[Array, ""]
    y: PyTree


def locate(rates: Callable, value: Callable, t_f, y_f: PyTree, args: PyTree, happened: Bool[Array, ""], longest: Float[Array, ""]) -> Located:
    """Time and state where `value(t, y, args)` is zero, near and before (t_f, y_f); (t_f, y_f) itself where nothing happened.

    `rates(t, y, args)` is the vector field; `longest` bounds how far back the event can lie (s, signed like the motion).
    """
    earliest, latest = jnp.minimum(-longest, 0.0), jnp.maximum(-longest, 0.0)

    def corrected(tau, y_f, args):
        """One Newton step from `t_f + tau`: by how much, and the time and state it leads to."""
        y, f = _moved(rates, t_f, y_f, args, tau)
        c, c_dot = jax.jvp(lambda t, y: value(t, y, args), (t_f + tau, y), (jnp.ones_like(t_f), f))
        usable = happened & (c_dot != 0) & jnp.isfinite(c) & jnp.isfinite(c_dot)
        shift = jnp.where(usable, -c / jnp.where(usable, c_dot, 1.0), 0.0)
        return shift, Located(t_f + tau + shift, jax.tree.map(lambda a, b: a + shift * b, y, f))

    def step(tau, i):
        # tau* is a number to differentiation; the last, vanishing, corrections are not, and carry the derivatives of the event time
        tau = jnp.where(i <= _NEWTON_STEPS, jax.lax.stop_gradient(tau), tau)
        shift, located = corrected(tau, y_f, args)
        return jnp.where(i < _NEWTON_STEPS, jnp.clip(tau + shift, earliest, latest), tau + shift), located

    # one loop for both: one copy of the vector field to compile
    _, located = jax.lax.scan(step, jnp.zeros_like(t_f), jnp.arange(_NEWTON_STEPS + _CORRECTIONS))
    return jax.tree.map(lambda x: x[-1], located)


def _moved(rates: Callable, t_f, y_f, args, tau):
    """State and rate at `t_f + tau`, by one step of the eighth-order Dormand-Prince method."""
    flat, unravel = ravel_pytree(y_f)
    tableau = diffrax.Dopri8.tableau
    stages = len(tableau.b_sol)
    # one row per stage, and the solution itself as a last stage, whose slope is the rate there
    A = jnp.zeros((stages + 1, stages + 1), flat.dtype).at[jnp.tril_indices(stages, -1)].set(jnp.concatenate([jnp.asarray(row) for row in tableau.a_lower]))
    A = A.at[stages, :stages].set(jnp.asarray(tableau.b_sol))
    c = jnp.concatenate([jnp.zeros(1), jnp.asarray(tableau.c), jnp.ones(1)])

    def stage(carry, i):
        slopes, _ = carry
        at = flat + tau * (A[i] @ slopes)
        return (slopes.at[i].set(ravel_pytree(rates(t_f + c[i] * tau, unravel(at), args))[0]), at), None

    (slopes, at), _ = jax.lax.scan(stage, (jnp.zeros((stages + 1, flat.size), flat.dtype), flat), jnp.arange(stages + 1))
    return unravel(at), unravel(slopes[-1])
