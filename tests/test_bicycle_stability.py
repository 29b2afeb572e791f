"""Stability speeds of linear bicycles: published numbers, eigenvalues on either side, and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import whipple_bicycle as oracle
from tolerances import tolerance

from jourdain_jax.bicycle import eigenvalues, read_bicycle, shipped_bicycles, stability_speeds

jax.config.update("jax_enable_x64", True)

BENCHMARK = (oracle.M, oracle.C1, oracle.K0, oracle.K2, 9.81)
RIDEABLE = [name for name in shipped_bicycles() if name != "Tms"]

speeds_of = jax.jit(stability_speeds)
eigenvalues_of = jax.jit(eigenvalues)


def _parameters(name):
    return read_bicycle(shipped_bicycles()[name]).values


def _matrices(parameters):
    parts = oracle.matrices(parameters, jnp.cos, jnp.sin)
    return (*(jnp.array(parts[name]) for name in ("M", "C1", "K0", "K2")), jnp.asarray(parameters["g"]))


def _growth_rates(matrices, speed):
    """Ascending real parts of numpy's eigenvalues of the first-order system, and their imaginary parts."""
    M, C1, K0, K2, g = (np.asarray(matrix) for matrix in matrices)
    system = np.block(
        [
            [np.zeros((2, 2)), np.eye(2)],
            [-np.linalg.solve(M, g * K0 + speed**2 * K2), -np.linalg.solve(M, speed * C1)],
        ]
    )
    values = np.linalg.eigvals(system)
    return values[np.lexsort((values.imag, values.real))]


def test_the_appendix_formulas_give_the_published_matrices():
    for matrix, published in zip(_matrices(_parameters("Benchmark"))[:4], BENCHMARK[:4], strict=True):
        assert_allclose(matrix, published, rtol=1e-14, atol=1e-13)


@pytest.mark.parametrize("speed", oracle.EIGENVALUES)
def test_the_benchmark_eigenvalues_are_the_published_ones(speed):
    castering, capsize, *weave = oracle.EIGENVALUES[speed]
    (found,) = eigenvalues_of(*BENCHMARK, np.array([float(speed)]))
    assert_allclose(found, [castering, capsize, *sorted(weave, key=lambda root: (root.real, root.imag))], rtol=1e-12, atol=1e-12)


def test_the_benchmark_speeds_are_the_published_ones():
    found = speeds_of(*BENCHMARK)
    close = {"rtol": 5e-14, "atol": 0}
    assert_allclose(found.weave_speed, oracle.WEAVE_SPEED, **close)
    assert_allclose(found.capsize_speed, oracle.CAPSIZE_SPEED, **close)
    assert_allclose(found.double_root_speed, oracle.DOUBLE_ROOT_SPEED, **close)
    assert_allclose(found.weave_frequency, oracle.WEAVE_FREQUENCY, **close)
    assert_allclose(found.double_root_eigenvalue, oracle.DOUBLE_ROOT, **close)
    assert_allclose(found.stable_from, found.weave_speed, **close)
    assert_allclose(found.stable_to, found.capsize_speed, **close)
    assert bool(found.stable_range_exists)


@pytest.mark.parametrize("name", RIDEABLE)
def test_the_eigenvalues_cross_where_the_speeds_say(name):
    matrices = _matrices(_parameters(name))
    found = speeds_of(*matrices)

    def weave(v):
        values = _growth_rates(matrices, v)
        return values[values.imag > 0][-1].real

    def slowest_real(v):
        values = _growth_rates(matrices, v)
        return values[values.imag == 0].real.max()

    assert weave(found.weave_speed * (1 - 1e-6)) > 0 > weave(found.weave_speed * (1 + 1e-6))
    assert abs(weave(found.weave_speed)) < 1e-11
    if np.isnan(found.capsize_speed):
        assert all(slowest_real(v) < 0 for v in np.linspace(float(found.weave_speed), 50.0, 50))
        assert float(found.stable_to) == 50.0
    else:
        assert slowest_real(found.capsize_speed * (1 - 1e-6)) < 0 < slowest_real(found.capsize_speed * (1 + 1e-6))

    below, above = (_growth_rates(matrices, found.double_root_speed * (1 + shift))[2:] for shift in (-1e-6, 1e-6))
    assert (below.imag == 0).all()
    assert (above.imag != 0).all()
    assert_allclose([below.real, above.real], found.double_root_eigenvalue, rtol=1e-2)

    assert bool(found.stable_range_exists)
    middle = 0.5 * (found.stable_from + found.stable_to)
    assert (_growth_rates(matrices, middle).real < 0).all()


@pytest.mark.parametrize("name", ["Pista", "Rigid"])
def test_modes_keep_their_names_along_the_speeds(name):
    found = np.asarray(eigenvalues_of(*_matrices(_parameters(name)), np.linspace(0.0, 10.0, 401)))
    assert np.abs(np.diff(found.real, axis=0)).max() < 0.6  # without names they would jump by several 1/s
    assert (found[-1].imag[:2] == 0).all()
    assert found[-1, 2] == np.conj(found[-1, 3])


def test_a_bicycle_that_speed_does_not_change_has_no_stable_range():
    # C1 = K2 = 0: it falls at every speed as it does at rest.
    M, _, K0, _, g = BENCHMARK
    found = speeds_of(M, np.zeros((2, 2)), K0, np.zeros((2, 2)), g)
    assert np.isnan([found.weave_speed, found.capsize_speed, found.double_root_speed]).all()
    assert np.isnan([found.weave_frequency, found.stable_from, found.stable_to]).all()
    assert not bool(found.stable_range_exists)

    def weave_and_double_root(M):
        found = stability_speeds(M, np.zeros((2, 2)), K0, np.zeros((2, 2)), g)
        return jnp.stack([found.weave_speed, found.weave_frequency, found.double_root_speed, found.capsize_speed])

    assert (np.asarray(jax.jit(jax.jacrev(weave_and_double_root))(M)) == 0).all()


def test_speeds_beyond_the_largest_are_not_reported():
    found = speeds_of(*BENCHMARK, max_speed=5.0)
    assert np.isnan(found.capsize_speed)
    assert_allclose([found.weave_speed, found.stable_to], [oracle.WEAVE_SPEED, 5.0], rtol=1e-13)


def test_speeds_scale_with_the_square_root_of_gravity_and_with_nothing_else():
    M, C1, K0, K2, g = BENCHMARK
    here, there = speeds_of(*BENCHMARK), speeds_of(*(7.0 * A for A in (M, C1, K0, K2)), 4.0 * g)
    for name in ("weave_speed", "capsize_speed", "double_root_speed", "stable_from", "stable_to"):
        assert_allclose(getattr(there, name), 2.0 * getattr(here, name), rtol=1e-13)


@pytest.mark.parametrize("quantity", ["weave_speed", "capsize_speed", "double_root_speed", "weave_frequency"])
def test_derivatives_of_the_speeds_are_their_central_differences(quantity):
    names = ("c", "lam", "zB", "IHzz", "g")
    parameters = _parameters("Benchmark")

    @jax.jit
    def speed(changed):
        changed = {**parameters, **dict(zip(names, changed, strict=True))}
        return getattr(stability_speeds(*_matrices(changed)), quantity)

    start = jnp.array([parameters[name] for name in names])
    reverse, forward = jax.jit(jax.grad(speed))(start), jax.jit(jax.jacfwd(speed))(start)
    assert_allclose(reverse, forward, rtol=tolerance("round_off"))
    for k, size in enumerate(np.abs(start)):
        step = 1e-4 * size * np.eye(len(names))[k]
        near, far = (speed(start + h * step) - speed(start - h * step) for h in (1, 2))
        difference = (8 * near - far) / (12 * 1e-4 * size)  # fourth order
        assert_allclose(forward[k], difference, rtol=tolerance("gradient_fd"))


def test_a_missing_speed_does_not_spoil_the_derivatives_of_the_others():
    parameters = _parameters("Yellowrev")

    def speeds(parameters):
        found = stability_speeds(*_matrices(parameters))
        return jnp.stack([found.weave_speed, found.capsize_speed])

    found, pull_back = jax.vjp(jax.jit(speeds), parameters)
    assert np.isnan(found[1])
    assert all(np.isfinite(derivative) for derivative in pull_back(jnp.array([1.0, 0.0]))[0].values())
