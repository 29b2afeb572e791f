"""The integrands of the loops: rates, projection and events as functions of (tau, y, args), for one motion
and for batches.

`args`: the vector field, the scene, its inputs, what the rates need of the scene, and the time from which tau counts; of lanes, with their axis first.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import PerLane
from jourdain_jax.motion.inputs import seen_from_within
from jourdain_jax.motion.vector_fields.field import Integrated


def state_norm(y: Integrated) -> Float[Array, "*lanes"]:
    """Root mean square over coordinates and speeds; the work that rides along does not decide the step size.

    NaN counts as infinite: the step shrinks and the motion ends, where NaN would be tried until the last
    allowed step.
    """
    squared = sum(jnp.sum(part**2, axis=0) for part in (y.q, y.v)) / (len(y.q) + len(y.v))
    squared = jnp.where(jnp.isnan(squared), jnp.inf, squared)
    return jnp.where(squared == 0, 0.0, jnp.sqrt(jnp.where(squared == 0, 1.0, squared)))


@eqx.filter_jit  # traced once, not once per stage and derivative
def rates(tau, y, args):
    field, scene, inputs, fixed, origin = args
    t = origin + tau
    return field.rates(scene, fixed, t, y, _at(field.now, inputs, t))


@eqx.filter_jit
def rates_and_pivots(tau, y, args):
    field, scene, inputs, fixed, origin = args
    t = origin + tau
    return field.rates_and_pivots(scene, fixed, t, y, _at(field.now, inputs, t))


@eqx.filter_jit
def project(tau, y, args):
    field, scene, inputs, fixed, origin = args
    t = origin + tau
    return field.project(scene, fixed, t, y, _at(_values, inputs, t))


@eqx.filter_jit
def events(tau, y, args) -> Float[Array, "events *lanes"]:
    field, scene, inputs, fixed, origin = args
    if jnp.ndim(tau) and not field.lowers_events:
        return eqx.filter_vmap(events, in_axes=(0, -1, eqx.if_array(0)), out_axes=-1)(tau, y, args)
    t = origin + tau
    return field.events(scene, fixed, t, y, _at(_values, inputs, t))


@eqx.filter_jit
def resets(tau, y, args) -> Float[Array, "events rows *lanes"]:
    field, scene, inputs, fixed, origin = args
    if jnp.ndim(tau) and not field.lowers_events:
        return eqx.filter_vmap(resets, in_axes=(0, -1, eqx.if_array(0)), out_axes=-1)(tau, y, args)
    t = origin + tau
    return field.resets(scene, fixed, t, y, _at(_values, inputs, t))


@eqx.filter_jit
def energy(tau, y, args) -> PerLane:
    """T + V, J; a number to differentiation."""
    field, scene, inputs, fixed, origin = args
    if jnp.ndim(tau) and field.lowered is None:
        return eqx.filter_vmap(energy, in_axes=(0, -1, eqx.if_array(0)), out_axes=-1)(tau, y, args)
    t = origin + tau
    return jnp.sum(field.energies(scene, fixed, t, y, _at(_values, inputs, t)), axis=0)


def within(middle, args):
    """`args` for the stages of a step with this middle."""
    field, scene, inputs, fixed, origin = args
    return field, scene, seen_from_within(inputs, origin + middle), fixed, origin


def _values(inputs, t) -> Float[Array, "inputs"]:
    return inputs(t)


def _at(values, inputs, t):
    """Return `values(inputs, t)`, for every sample of a batch."""
    return eqx.filter_vmap(values, out_axes=-1)(inputs, t) if jnp.ndim(t) else values(inputs, t)
