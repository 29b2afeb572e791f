"""Motions inside of JAX's other transformations are those by themselves."""

import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose

import jourdain_jax as jj

SKATE = jj.models.Skate()
SPEEDS = jnp.array([0.5, 1.0])


def _place(speed):
    return jj.simulate(SKATE, {"x_rate": speed, "heading_rate": 0.7}, ts=[0.5]).q[0]


def _converted(speed):
    function, constants = jax.closure_convert(lambda x: _place(x * speed), 1.0)
    return function(1.0, *constants)


WAYS = {
    "checkpoint": jax.vmap(jax.checkpoint(_place)),
    "scan": lambda speeds: jax.lax.scan(lambda none, speed: (none, _place(speed)), None, speeds)[1],
    "map": lambda speeds: jax.lax.map(_place, speeds, batch_size=2),
    "cond": jax.vmap(lambda speed: jax.lax.cond(speed > 0.0, _place, lambda speed: jnp.zeros(3), speed)),
    "closure_convert": jax.vmap(_converted),
}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_values_and_gradients(way):
    def both(function):
        found, back = jax.vjp(function, SPEEDS)
        return found, back(jnp.sin(found))[0]

    for found, expected in zip(jax.jit(both, static_argnums=0)(way), jax.jit(both, static_argnums=0)(jax.vmap(_place)), strict=True):
        assert_allclose(found, expected, rtol=1e-12)


def test_with_floats_checked():
    with jax.debug_nans(True):
        assert_allclose(jax.jit(_place)(1.0), _place(1.0), rtol=1e-12)
