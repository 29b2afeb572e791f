"""Integrands of the loops: rates, projection and events as functions of (tau, y, args), for one motion or a
batch.

`args`: the vector field, the scene, its inputs, the part of the rates that depends on parameters only, and
the origin of tau. In a batch, their batch axis comes first.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import PerLane
from jourdain_jax.integrate.input_knots import seen_from_within
from jourdain_jax.integrate.vector_fields.field import Instant, Integrated, VectorField, Watched


def state_norm(y: Integrated) -> PerLane:
    """Return the root mean square over coordinates and speeds. Integrated work is excluded, so that it does
    not influence the step size.

    NaN counts as infinite. Steps then shrink until the motion ends, instead of using up all steps.
    """
    squared = sum(jnp.sum(part**2, axis=0) for part in (y.q, y.v)) / (len(y.q) + len(y.v))
    squared = jnp.where(jnp.isnan(squared), jnp.inf, squared)
    return jnp.where(squared == 0, 0.0, jnp.sqrt(jnp.where(squared == 0, 1.0, squared)))


def at_time(tau, y: Integrated, args, of_rates: bool = False) -> tuple[VectorField, Instant]:
    """Return the vector field and its arguments at a state. With `of_rates`, inputs are as the rates need
    them (`VectorField.now`). The batch axis is last.
    """
    field, scene, inputs, fixed, origin = args
    t = origin + tau
    values = field.now if of_rates else lambda inputs, t: inputs(t)
    inputs = eqx.filter_vmap(values, out_axes=-1)(inputs, t) if jnp.ndim(t) else values(inputs, t)
    return field, Instant(scene, fixed, t, y, inputs)


def _lane_by_lane(knows_lanes: Callable[[VectorField], bool]) -> Callable:
    """Return a decorator that maps a function of (tau, y, args) over a batch, unless the field supports
    batches.
    """

    def decorated(function: Callable) -> Callable:
        @eqx.filter_jit
        def of_lanes(tau, y, args):
            if jnp.ndim(tau) and not knows_lanes(args[0]):
                return eqx.filter_vmap(function, in_axes=(0, -1, eqx.if_array(0)), out_axes=-1)(tau, y, args)
            return function(tau, y, args)

        return of_lanes

    return decorated


@eqx.filter_jit  # traced once, not once per stage and derivative
def rates(tau, y, args) -> Integrated:
    field, at = at_time(tau, y, args, of_rates=True)
    return field.rates(at)


@eqx.filter_jit
def rates_and_pivots(tau, y, args) -> Watched:
    field, at = at_time(tau, y, args, of_rates=True)
    return field.rates_and_pivots(at)


@eqx.filter_jit
def project(tau, y, args) -> Integrated:
    field, at = at_time(tau, y, args)
    return field.project(at)


@_lane_by_lane(lambda field: field.lowers_events)
def events(tau, y, args) -> Float[Array, "events *lanes"]:
    field, at = at_time(tau, y, args)
    return field.events(at)


@_lane_by_lane(lambda field: field.lowers_events)
def resets(tau, y, args) -> Float[Array, "events rows *lanes"]:
    field, at = at_time(tau, y, args)
    return field.resets(at)


@_lane_by_lane(lambda field: field.lowered is not None)
def energy(tau, y, args) -> PerLane:
    """Return T + V (J). It has no derivatives."""
    field, at = at_time(tau, y, args)
    return jnp.sum(field.energies(at), axis=0)


def within(middle, args):
    """Return `args` for the stages of the step around the time `middle`."""
    field, scene, inputs, fixed, origin = args
    return field, scene, seen_from_within(inputs, origin + middle), fixed, origin
