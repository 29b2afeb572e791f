"""Options of XLA are given to whole programs only: a function compiled with some serves inside and outside of every transformation."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.compiled import RUN_SELDOM, compiled

X = jnp.linspace(0.1, 1.0, 4)


@partial(compiled, options=RUN_SELDOM)
def total(x):
    return jnp.sum(jnp.sin(x) ** 2)


def test_a_function_compiled_with_options_serves_inside_every_transformation():
    expected, slope = np.sum(np.sin(X) ** 2), np.sin(2 * X)
    np.testing.assert_allclose(total(X), expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(total)(X), expected, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(lambda y: y * total(X))(2.0), 2 * expected, rtol=1e-14)  # its own argument is known there
    np.testing.assert_allclose(jax.grad(total)(X), slope, rtol=1e-14)
    np.testing.assert_allclose(jax.jvp(total, (X,), (X,))[1], slope @ X, rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(total)(X[:, None]), np.sin(X) ** 2, rtol=1e-14)
    np.testing.assert_allclose(jax.jacfwd(jax.grad(total))(X), np.diag(2 * np.cos(2 * X)), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(jax.linearize(total, X)[1](X), slope @ X, rtol=1e-14)
    np.testing.assert_allclose(jax.grad(lambda y: y * total(X))(1.0), expected, rtol=1e-14)
