"""Derivatives of what is put onto the rows, of a start off them by some finite amount, against differences of what is computed."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import linkages
import moving_linkages
import numpy as np
import pytest
import small_scenes
from jax.flatten_util import ravel_pytree
from numpy.testing import assert_allclose

import jourdain_jax as jj
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.least_change import least_change

STEP = 2e-3


def _slope(function, s: float = 0.0) -> np.ndarray:
    """The derivative by Richardson's extrapolation of central differences, of order 6."""
    D = [(np.asarray(function(s + h)) - np.asarray(function(s - h))) / (2 * h) for h in (STEP, STEP / 2, STEP / 4)]
    D = [(4 * b - a) / 3 for a, b in pairwise(D)]
    return (16 * D[1] - D[0]) / 15


def _along(scene: jj.Scene, held: tuple[str, ...], off: float):
    """What is put onto the rows as a function of one number, on which parameters, time, coordinates and speeds depend."""
    generator = np.random.default_rng(2)
    _, q, u = jj.sample_states(scene, 1)
    numbers, restored = ravel_pytree((jax.tree.map(jnp.asarray, scene), jnp.asarray(0.2), jnp.asarray(q[0]), jnp.asarray(u[0])))
    moved = jnp.asarray(off * generator.normal(size=len(q[0]) + len(u[0])))
    numbers = numbers.at[-moved.size :].add(moved)
    direction = jnp.asarray(generator.normal(size=numbers.size)) * (0.1 + 0.1 * jnp.abs(numbers))

    def put(s):
        here, t, q, u = restored(numbers + s * direction)
        state = jj.consistent(here, t, q, u, jnp.full(len(scene.inputs), 0.3), held=held)
        return jnp.concatenate([state.q, state.u])

    return put


@pytest.mark.parametrize(
    ("scene", "held", "off"),
    [
        (jj.models.DoublePendulumRods(), ("x1", "x2"), 0.02),
        (linkages.Parallelogram(), (), 1e-2),
        (small_scenes.BeadOnTurningWire(), (), 0.1),
    ],
    ids=["held", "redundant rows", "rows of time"],
)
def test_derivatives_are_those_of_what_is_computed(scene, held, off):
    put = _along(scene, held, off)
    weights = jnp.asarray(np.random.default_rng(3).normal(size=put(0.0).size))
    forward = jax.jit(jax.jacfwd(put))(0.0)
    assert_allclose(forward, _slope(jax.jit(put)), atol=1e-8 * np.max(np.abs(forward)))
    assert_allclose(jax.jit(jax.grad(lambda s: weights @ put(s)))(0.0), weights @ forward, rtol=1e-10)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_values_that_are_all_given_move_with_the_rows_in_derivatives(derivative):
    """A longer rod moves the bob outwards, a rate along the rod is taken away: x = l sin a, z = -l cos a, also where x, z and both rates are given."""
    sin, cos = 0.28, 0.96

    def begins(length, along):
        scene = moving_linkages.NarrowPendulum(length=length)
        rates = {"x_rate": cos + along * sin, "z_rate": sin - along * cos}
        state = jj.start(scene, {"x": sin, "z": -cos, **rates})
        return jnp.concatenate([state.q, state.u])

    assert_allclose(begins(1.0, 0.0), [sin, -cos, cos, sin], atol=1e-15)
    by_length, by_rate = jax.jit(derivative(begins, argnums=(0, 1)))(1.0, 0.0)
    assert_allclose(by_length, [sin, -cos, 0.0, 0.0], atol=1e-12)
    assert_allclose(by_rate, np.zeros(4), atol=1e-12)


def test_second_derivatives_are_differences_of_first_ones():
    put = _along(small_scenes.BeadOnTurningWire(), (), 0.1)
    expected = _slope(jax.jit(jax.jacfwd(put)))
    for second in (jax.jacfwd(jax.jacfwd(put)), jax.jacfwd(jax.jacrev(put)), jax.jacrev(jax.jacrev(put))):
        assert_allclose(jax.jit(second)(0.0), expected, atol=1e-7 * np.max(np.abs(expected)))


@pytest.mark.parametrize(("metric", "rows"), [(True, "independent"), (False, "redundant"), (True, "redundant"), (True, "contradicting")])
def test_the_least_change_has_the_derivatives_of_a_pseudo_inverse(metric, rows):
    generator = np.random.default_rng(0)
    A0, A1, r0, r1 = (jnp.asarray(generator.normal(size=shape)) for shape in ((4, 7), (4, 7), 4, 4))
    B0, B1 = np.eye(7) + 0.2 * generator.normal(size=(7, 7)), 0.5 * generator.normal(size=(7, 7))
    free = np.arange(7) != 2

    def problem(s):
        A, r, B = A0 + s * A1, r0 + s * r1, B0 + s * B1
        if rows != "independent":
            A = jnp.concatenate([A[:2], A[:2] * jnp.array([[2.0], [1.0 + s]])])
        if rows == "redundant":
            r = jnp.concatenate([r[:2], r[:2] * jnp.array([2.0, 1.0 + s])])
        return A, r, B @ B.T if metric else None

    def change(s):
        return least_change(*problem(s), jnp.asarray(free), typical=jnp.full(4, 100.0)).x  # rows of one scale, which is constant

    def expected(s):
        A, r, M = (None if x is None else np.asarray(x) for x in problem(s))
        L = np.eye(6) if M is None else np.linalg.cholesky(M[np.ix_(free, free)])
        return np.linalg.solve(L.T, np.linalg.pinv(np.linalg.solve(L, A[:, free].T).T, rcond=1e-10) @ r)

    changed = eval_numpy(change)(0.1)
    assert_allclose(changed[free], expected(0.1), rtol=1e-11)
    assert changed[2] == 0.0
    first, reverse, second = (eval_numpy(of(change)) for of in (jax.jacfwd, jax.jacrev, lambda change: jax.jacfwd(jax.jacfwd(change))))
    assert_allclose(first(0.1)[free], _slope(expected, 0.1), rtol=1e-8, atol=1e-8)
    assert_allclose(reverse(0.1), first(0.1), rtol=1e-11, atol=1e-12)
    assert_allclose(second(0.1), _slope(first, 0.1), rtol=1e-7, atol=1e-7)
