"""What the loops over steps integrate: rates, projection and events as functions of (tau, y, args), for one motion and for lanes side by side.

`args`: the form of the state, the scene, its inputs, what the rates need of the scene, and the time from which tau counts.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.motion.state_form import Integrated


def state_norm(y: Integrated) -> Float[Array, "*lanes"]:
    """Root mean square over coordinates and speeds; the work that rides along does not decide the step size.

    What is not a number counts as infinite: the step shrinks and the motion ends, where NaN would be tried until the last allowed step.
    """
    squared = sum(jnp.sum(part**2, axis=0) for part in (y.q, y.v)) / (len(y.q) + len(y.v))
    squared = jnp.where(jnp.isnan(squared), jnp.inf, squared)
    return jnp.where(squared == 0, 0.0, jnp.sqrt(jnp.where(squared == 0, 1.0, squared)))


@eqx.filter_jit  # traced once, not once per stage and derivative
def rates(tau, y, args):
    form, scene, inputs, fixed, origin = args
    t = origin + tau
    return form.rates(scene, fixed, t, y, form.now(inputs, t))


@eqx.filter_jit
def rates_and_pivots(tau, y, args):
    form, scene, inputs, fixed, origin = args
    t = origin + tau
    return form.rates_and_pivots(scene, fixed, t, y, form.now(inputs, t))


@eqx.filter_jit
def pivots(tau, y, args):
    return rates_and_pivots(tau, y, args)[1]


@eqx.filter_jit  # traced once, not once per stage and derivative
def project(tau, y, args):
    form, scene, inputs, fixed, origin = args
    t = origin + tau
    return form.project(scene, fixed, t, y, inputs(t))


def project_of_lanes(tau, y, args):
    form, scene, inputs, fixed, origin = args
    t = origin + tau
    return form.project(scene, fixed, t, y, _inputs_of_lanes(inputs, t))


@eqx.filter_jit
def events(tau, y, args) -> Float[Array, "events *lanes"]:
    form, scene, inputs, fixed, origin = args
    t = origin + tau
    return form.events(scene, fixed, t, y, inputs(t))


def events_of_lanes(tau, y, args):
    form, scene, inputs, fixed, origin = args
    if form.lowers_events:
        t = origin + tau
        return form.events(scene, fixed, t, y, _inputs_of_lanes(inputs, t))
    return _lane_by_lane(events)(tau, y, args)


def _lane_by_lane(function):
    """A function `(t, y, args)` of one lane for states with lanes last and `args` with lanes first."""
    return lambda t, y, args: eqx.filter_vmap(function, in_axes=(0, -1, eqx.if_array(0)), out_axes=-1)(t, y, args)


def rates_of_lanes(tau, y, args):
    form, scene, inputs, fixed, origin = args
    t = origin + tau
    return form.rates(scene, fixed, t, y, _inputs_of_lanes(inputs, t))


def rates_and_pivots_of_lanes(tau, y, args):
    form, scene, inputs, fixed, origin = args
    t = origin + tau
    return form.rates_and_pivots(scene, fixed, t, y, _inputs_of_lanes(inputs, t))


def _inputs_of_lanes(inputs, t) -> Float[Array, "inputs lanes"]:
    return eqx.filter_vmap(lambda inputs, t: inputs(t), out_axes=-1)(inputs, t)
