"""Closed forms that no other test compares with independent equations, against those that they claim to
solve, and numbers against the literature.

Nothing of the package is used, so a failure here is a failure of the answer, not of the engine. The other
closed forms are compared with motions of the engine, which tests both.
"""

import ast
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from oracles import rattleback, rolling_disc, snakeboard, two_wheel_axle, whipple_bicycle
from oracles.reference import constrained_motion, integral, integrate, solve
from tolerances import tolerance

ORACLE = tolerance("oracle")
DIFFERENCE = 1e-9  # a derivative of a degree-40 interpolant loses about three digits


class Interpolant:
    """Chebyshev interpolation on [0, span], to differentiate a motion that is known at any times."""

    def __init__(self, span, degree=40):
        self.degree, self.span = degree, span
        nodes = np.cos(np.pi * (np.arange(degree, -1, -1)) / degree)
        self.times = (nodes + 1) * span / 2
        self._nodes = nodes

    def derivative(self, values, order=1) -> np.ndarray:
        """Time derivative of values (times, ...) at the same times."""
        cheb = np.polynomial.chebyshev
        flat = np.asarray(values, float).reshape(len(self.times), -1)
        coefficients = np.linalg.solve(cheb.chebvander(self._nodes, self.degree), flat)
        slopes = cheb.chebval(self._nodes, cheb.chebder(coefficients, order)).T * (2 / self.span) ** order
        return slopes.reshape(np.shape(values))


def columns(motion, *names: str) -> np.ndarray:
    return np.stack([motion[name] for name in names], -1)


def assert_same(value, expected, limit=ORACLE):
    value, expected = np.asarray(value), np.asarray(expected)
    assert value.shape == expected.shape
    error = np.max(np.abs(value - expected)) / max(1.0, np.max(np.abs(expected)))
    assert error <= limit, f"off by {error:.1e}"


def test_the_oracles_do_not_know_the_package():
    for path in (Path(__file__).parent / "oracles").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = (
                [alias.name for alias in getattr(node, "names", [])] if isinstance(node, ast.Import) else []
            )
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
            assert all(name.split(".")[0] != "jourdain_jax" for name in names), path


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


# Constant masses on rows: an axle


def axle(phi_rate):
    p = {**two_wheel_axle.RUN, "phi0": 0.4, "phi_rate": phi_rate}
    a, m, times = p["radius"], p["mass"], np.linspace(0, 10, 9)
    exact = two_wheel_axle.motion(times, **p, x1=0.2, psi2=0.5)
    assert_same(np.hypot(exact["x2"] - exact["x1"], exact["y2"] - exact["y1"]), np.full(9, p["length"]))

    def rows(q):
        c, s = np.cos(q[6]), np.sin(q[6])
        rolling = [
            [1, 0, -a * c, 0, 0, 0, 0],
            [0, 1, -a * s, 0, 0, 0, 0],
            [0, 0, 0, 1, 0, -a * c, 0],
            [0, 0, 0, 0, 1, -a * s, 0],
        ]
        return [*rolling, [0, 0, -a, 0, 0, a, p["length"]]]

    spin, push = p["rim_mass"] * a**2, m * p["gravity"] * np.sin(p["slope"])
    psi1, psi2, phi = (exact[f"{name}_rate"][0] for name in ("psi1", "psi2", "phi"))
    c, s = a * np.cos(0.4), a * np.sin(0.4)
    q = columns(exact, "x1", "y1", "psi1", "x2", "y2", "psi2", "phi")
    v0 = [c * psi1, s * psi1, psi1, c * psi2, s * psi2, psi2, phi]
    return (
        q,
        {9: exact["psi1_rate"]},
        times,
        rows,
        [m, m, spin, m, m, spin, spin],
        [push, 0, 0, push, 0, 0, 0],
        q[0],
        v0,
    )


def heavy_axle(th_rate):
    p = {**two_wheel_axle.RUN_HEAVY_AXLE, "th_rate": th_rate, "th0": 0.2}
    r, b, wheel, times = p["radius"], p["half_track"], p["wheel_mass"], np.linspace(0, 10, 9)
    total, spin, u0 = 2 * wheel + p["axle_mass"], wheel * r**2 / 2, p["u0"]

    def rows(q):
        c, s = np.cos(q[2]), np.sin(q[2])
        return [[-s, c, 0, 0, 0], [c, s, -b, -r, 0], [c, s, b, 0, -r]]

    q = columns(two_wheel_axle.motion_heavy_axle(times, **p), "x", "y", "th", "p1", "p2")
    push = total * p["gravity"] * np.sin(p["slope"])
    v0 = [u0 * np.cos(0.2), u0 * np.sin(0.2), th_rate, (u0 - b * th_rate) / r, (u0 + b * th_rate) / r]
    return q, {}, times, rows, [total, total, 0.37, spin, spin], [push, 0, 0, 0, 0], [0, 0, 0.2, 0, 0], v0


ON_ROWS = {
    **{f"axle turned at {rate}": partial(axle, rate) for rate in (1.1, -2.0, 1e-3, 0.0)},
    **{f"heavy axle turned at {rate}": partial(heavy_axle, rate) for rate in (1.1, 0.0)},
}


@pytest.mark.parametrize("made", ON_ROWS.values(), ids=ON_ROWS)
def test_a_closed_form_solves_the_multiplier_equations(made):
    q, rates, times, rows, masses, force, q0, v0 = made()
    motion = constrained_motion(masses, rows, force, q0, v0, times)
    assert_same(q, motion[:, : q.shape[1]])
    for place, rate in rates.items():
        assert_same(rate, motion[:, place])


# Rigid bodies


def test_snakeboard_obeys_its_rows_and_momentum_through_ninety_degrees():
    p = snakeboard.RUN
    grid = Interpolant(p["t_end"], 80)
    exact = snakeboard.motion(grid.times, **p)
    assert exact["phi"][0] < np.pi / 2 < exact["phi"][-1]
    velocity, turn = grid.derivative(columns(exact, "x", "y")), grid.derivative(exact["th"])
    assert_same(turn, exact["th_rate"], DIFFERENCE)
    assert_same(grid.derivative(exact["psi"]), exact["psi_rate"], DIFFERENCE)
    assert_same(exact["psi_rate"][0], p["psi_rate"])
    assert_same(exact["u"][0], p["u0"])
    for sign in (1, -1):
        angle = exact["th"] + sign * exact["phi"]
        row = -np.sin(angle) * velocity[:, 0] + np.cos(angle) * velocity[:, 1]
        row += sign * p["half_length"] * np.cos(exact["phi"]) * turn
        assert_same(row, 0 * row, DIFFERENCE)
    # virtual power along the one free direction (l cos phi, sin phi) of (u, thdot)
    inertia = p["board_inertia"] + 2 * p["wheel_inertia"]
    push = p["mass"] * grid.derivative(exact["u"]) * p["half_length"] * np.cos(exact["phi"])
    push += inertia * grid.derivative(exact["th_rate"]) * np.sin(exact["phi"])
    assert_same(push, 0 * push, DIFFERENCE)


def test_rolling_disc_thresholds_of_the_uniform_disc():
    body = {"mass": 1.3, "radius": 0.5, "gravity": 9.81}
    assert_same(rolling_disc.rolling_threshold(**body) ** 2, 9.81 / 1.5)
    assert_same(rolling_disc.spinning_threshold(**body) ** 2, 4 * 9.81 / 2.5)
    assert_same(rolling_disc.upright_rolling_frequency_squared(3.0, **body), 12 / 5 * 9 - 4 * 9.81 / 2.5)
    assert_same(
        rolling_disc.upright_rolling_frequency_squared(rolling_disc.rolling_threshold(**body), **body), 0.0
    )


def test_rolling_disc_swings_round_when_it_nearly_falls():
    body = {key: rolling_disc.NEAR_FALL[key] for key in ("mass", "radius", "gravity")}
    exact = rolling_disc.motion(
        np.array([0.0, 2 * 0.153997]), **body, theta=rolling_disc.NEAR_FALL["theta0"], w1=0.0, w2=1e-3, w3=0.0
    )
    assert abs(exact["psi"][-1] - 7.0272) < 2e-3  # from and to rest, by the literature


# Rattleback


def test_rattleback_reference_keeps_energy_and_the_published_digits_to_twenty_seconds():
    shape, _ = rattleback._split(rattleback.RUN)
    for time, row in rattleback.REFERENCE.items():
        assert_same(rattleback.energy(np.array([row]).T, **shape), np.array([rattleback.ENERGY]), 1e-14)
        if time in rattleback.TABLE:
            assert np.all(np.abs(np.subtract(row, rattleback.TABLE[time])) <= rattleback.DIGITS[time]), time


def test_rattleback_reference_is_reproduced_to_twenty_seconds():
    times = [0.0, *rattleback.REFERENCE]
    states = columns(rattleback.motion(times), *rattleback.NAMES)
    assert_same(states[1:], np.array(list(rattleback.REFERENCE.values())))


# Bicycle


def test_the_appendix_in_double_precision():
    parts = whipple_bicycle.matrices(whipple_bicycle.BENCHMARK)
    for name in ("M", "C1", "K0", "K2"):
        assert_same(np.array(parts[name], float), getattr(whipple_bicycle, name), 1e-14)
