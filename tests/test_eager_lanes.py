"""Functions of one lane run on NumPy for many: as JAX's `vmap` has them, whatever they are made of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from jourdain_jax.program.eager import uncompiled_lanes

CONSTANT = np.arange(12.0).reshape(3, 4)


def _linear_algebra(x, A):
    M = A @ A.T + jnp.eye(3)
    L = jnp.linalg.cholesky(M)
    lower = jax.scipy.linalg.solve_triangular(L, x[:3], lower=True)
    return lower, jnp.linalg.solve(M, x[:3]), jnp.linalg.svd(A, compute_uv=False), jnp.linalg.det(M)


def _products(x, A):
    return (
        A @ CONSTANT.T,
        CONSTANT @ A.T,
        jnp.tensordot(A, CONSTANT, 2),
        jnp.einsum("ij,kj,j->ik", A, CONSTANT, x),
        jnp.cross(A[:, :3], CONSTANT[:, :3]),
    )


def _shapes(x, A):
    stacked, apart = jnp.stack([x, 2.0 * x, CONSTANT[0]], axis=1), (jnp.split(A, 2, axis=1), jnp.unstack(x))
    return (
        stacked[::-1],
        apart,
        jnp.concatenate([A, CONSTANT], 0)[1:5:2],
        A.T.reshape(2, 6),
        jnp.pad(x, (1, 2)),
        jnp.where(x[0] > 0, A, 1.0),
    )


def _places(x, A):
    k = jnp.argmax(x)
    return (
        A[:, jnp.array([2, 0])],
        A[jnp.array([1, 1]), jnp.array([0, 3])],
        x[k],
        x.at[k].set(0.0),
        jax.lax.dynamic_slice(A, (0, k % 2), (2, 2)),
        jnp.take(x, 9),
    )


def _branches(x, A):
    by_number = jax.lax.cond(x[0] > 0, lambda: jnp.sin(x), lambda: jnp.cos(x))
    total, each = jax.lax.scan(lambda s, row: (s + row.sum(), s * row), x[1], A)
    root = jax.lax.while_loop(lambda y: y > 1.0, lambda y: 0.5 * y, jnp.abs(x[2]) + 3.0)
    return (
        by_number,
        total,
        each,
        root,
        jnp.sum(A),
        jnp.max(A, axis=0),
        jnp.all(A > 0),
        jnp.any(A > 0, axis=1),
        x**3,
        x**-2,
    )


def _derivatives(x, A):
    return (
        jax.jacfwd(lambda x: jnp.tanh(A @ x))(x),
        jax.grad(lambda x: jnp.sum(jnp.arctan2(x, 2.0)) + jnp.linalg.norm(x))(x),
        jnp.ones(3),
        CONSTANT,
    )


@pytest.mark.parametrize(
    "f", [_linear_algebra, _products, _shapes, _places, _branches, _derivatives], ids=lambda f: f.__name__[1:]
)
def test_lanes_are_those_of_vmap(f):
    random = np.random.default_rng(0)
    x, A = random.normal(size=(5, 4)), random.normal(size=(5, 3, 4))
    found, expected = uncompiled_lanes(f)(x, A), jax.jit(jax.vmap(f))(x, A)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_integers_and_rounding_run_uncompiled_are_those_of_jax():
    n, flags = np.array([5, 6, -7]), np.array([True, False, True])
    x = np.array([0.5, 1.5, 2.5, -0.5, -2.5, 0.49999999999999994, 3.2, -3.7])

    def f(n, flags, x):
        m = n[::-1]
        of_integers = n & m, n | m, n ^ m, ~n, jnp.bitwise_and.reduce(n), jnp.bitwise_or.reduce(n)
        of_flags = (
            flags & flags[::-1],
            flags | flags[::-1],
            flags ^ flags[::-1],
            ~flags,
            jnp.all(flags),
            jnp.any(flags),
        )
        return of_integers, of_flags, jax.lax.round(x), jnp.round(x)

    for found, expected in zip(
        jax.tree.leaves(uncompiled_lanes(f, None)(n, flags, x)), jax.tree.leaves(f(n, flags, x)), strict=True
    ):
        assert found.dtype == expected.dtype
        assert_array_equal(found, expected)
