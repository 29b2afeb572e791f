"""Tools of the closed forms against known answers, and their numbers against the literature.

Nothing of the package is used, so a failure here is a failure of the answer, not of the engine. Closed forms
are compared with motions of the engine, which tests both.
"""

from pathlib import Path

import numpy as np
from oracles import rolling_disc
from oracles.reference import integral, integrate, solve


def assert_same(value, expected, limit):
    value, expected = np.asarray(value), np.asarray(expected)
    assert value.shape == expected.shape
    error = np.max(np.abs(value - expected)) / max(1.0, np.max(np.abs(expected)))
    assert error <= limit, f"off by {error:.1e}"


def test_the_oracles_do_not_know_the_package():
    for path in (Path(__file__).parent / "oracles").glob("*.py"):
        assert "jourdain_jax" not in path.read_text(), path


# The tools


def test_the_integrator_is_exact_on_an_oscillator_and_backwards():
    times = [0.0, 0.3, 7.0, 20.0]
    states = integrate(lambda t, y: [y[1], -y[0]], [1, 0], times)
    assert_same(states, np.stack([np.cos(times), -np.sin(times)], -1), 1e-15)
    back = integrate(lambda t, y: [y[1], -y[0]], states[-1], times[::-1])
    assert_same(back[-1], [1.0, 0.0], 1e-14)


def test_quadrature_and_linear_solve():
    times = np.linspace(0, 9, 7)
    assert_same(integral(np.cos, times), np.sin(times), 1e-14)
    matrix = np.random.default_rng(0).normal(size=(5, 5))
    matrix[0, 0] = 0
    assert_same(solve(matrix, matrix @ np.arange(5.0)).astype(float), np.arange(5.0), 1e-13)


def test_rolling_disc_swings_round_when_it_nearly_falls():
    body = {key: rolling_disc.NEAR_FALL[key] for key in ("mass", "radius", "gravity")}
    exact = rolling_disc.motion(
        np.array([0.0, 2 * 0.153997]), **body, theta=rolling_disc.NEAR_FALL["theta0"], w1=0.0, w2=1e-3, w3=0.0
    )
    assert abs(exact["psi"][-1] - 7.0272) < 2e-3  # from and to rest, by the literature
