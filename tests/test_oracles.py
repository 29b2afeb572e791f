"""Each closed form against the equations it claims to solve: Newton-Euler balances, constraint rows,
multiplier models.

Nothing of the package is used, so a failure here is a failure of the answer, not of the engine.
"""

import ast
from functools import partial
from pathlib import Path

import mpmath
import numpy as np
import pytest
from oracles import (
    ball_on_turntable,
    chaplygin_sleigh,
    double_pendulum,
    free_rigid_body,
    heisenberg_particle,
    isokinetic_particle,
    rattleback,
    rolling_disc,
    rosenberg_particle,
    skate,
    snakeboard,
    spring_and_rod,
    suslov,
    trailers,
    two_wheel_axle,
    vertical_disc,
    whipple_bicycle,
)
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


# Constant masses on rows: axle, skate, sleigh, particles


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


def edge(offset):
    return lambda q: [[-np.sin(q[2]), np.cos(q[2]), -offset]]


def on_a_slope():
    p, times = skate.RUN, np.linspace(0, 10, 9)
    q = columns(skate.motion(times, **p), "x", "y", "th")
    push = p["mass"] * p["gravity"] * np.sin(p["slope"])
    return (
        q,
        {},
        times,
        edge(0.0),
        [p["mass"], p["mass"], p["inertia"]],
        [push, 0, 0],
        [0, 0, 0],
        [0, 0, p["th_rate"]],
    )


def sleigh(**change):
    p, times = {**chaplygin_sleigh.RUN, "th0": 0.0, **change}, np.linspace(0, 12, 9)
    exact = chaplygin_sleigh.motion(times, **p)
    q, masses = columns(exact, "x", "y", "th"), [p["mass"], p["mass"], p["inertia"]]
    c, s, v, w, a = np.cos(p["th0"]), np.sin(p["th0"]), p["v0"], p["w0"], p["a"]
    return (
        q,
        {5: exact["w"]},
        times,
        edge(a),
        masses,
        [0, 0, 0],
        [0, 0, p["th0"]],
        [v * c - a * w * s, v * s + a * w * c, w],
    )


def particle(oracle, rows, end, **change):
    p, times = {**oracle.RUN, **change}, np.linspace(0, end, 9)
    exact = oracle.motion(times, **p)
    q, rates = columns(exact, "x", "y", "z"), [exact[name] for name in ("xdot", "ydot", "zdot")]
    return (
        q,
        dict(enumerate(rates, 3)),
        times,
        rows,
        [1, 1, 1],
        [0, 0, 0],
        [p["x0"], p["y0"], p["z0"]],
        [rate[0] for rate in rates],
    )


ON_ROWS = {
    **{f"axle turned at {rate}": partial(axle, rate) for rate in (1.1, -2.0, 1e-3, 0.0)},
    **{f"heavy axle turned at {rate}": partial(heavy_axle, rate) for rate in (1.1, 0.0)},
    "skate": on_a_slope,
    **{
        f"sleigh {change}": partial(sleigh, **change)
        for change in ({}, {"w0": -0.9}, {"v0": 1.0, "th0": 0.5}, {"w0": 0.0})
    },
    **{
        f"Rosenberg's particle, b = {b}": partial(
            particle, rosenberg_particle, lambda q: [[-q[1], 0, 1]], 5, b=b
        )
        for b in (0.8, -0.3, 0.0)
    },
    "Heisenberg's particle": partial(particle, heisenberg_particle, lambda q: [[-q[1], q[0], 1]], 10),
}


@pytest.mark.parametrize("made", ON_ROWS.values(), ids=ON_ROWS)
def test_a_closed_form_solves_the_multiplier_equations(made):
    q, rates, times, rows, masses, force, q0, v0 = made()
    motion = constrained_motion(masses, rows, force, q0, v0, times)
    assert_same(q, motion[:, : q.shape[1]])
    for place, rate in rates.items():
        assert_same(rate, motion[:, place])


@pytest.mark.parametrize("phi_rate", [2.0, 0.0])
def test_vertical_disc_rolls_and_its_multipliers_push_it(phi_rate):
    p = {**vertical_disc.RUN, "phi_rate": phi_rate, "radius": 0.8, "mass": 1.7}
    grid = Interpolant(1.0)
    exact = vertical_disc.motion(grid.times, **p, x0=0.3)
    velocity = grid.derivative(columns(exact, "x", "y"))
    heading = np.stack([np.cos(exact["phi"]), np.sin(exact["phi"])], -1)
    assert_same(velocity, 0.8 * p["th_rate"] * heading, DIFFERENCE)
    assert_same(1.7 * grid.derivative(velocity), columns(exact, "l1", "l2"), 1e-7)


# Balls and particles


@pytest.mark.parametrize(
    "run", [ball_on_turntable.RUN, ball_on_turntable.RUN_FLAT, {**ball_on_turntable.RUN, "turn_rate": 0.0}]
)
def test_ball_rolls_on_the_turning_plane_with_newton_and_euler(run):
    grid = Interpolant(3.0)
    exact = ball_on_turntable.motion(grid.times, **run)
    place, velocity = columns(exact, "x", "y"), columns(exact, "vx", "vy")
    assert_same(place[0], [run["x0"], run["y0"]])
    assert_same(velocity[0], [run["vx0"], run["vy0"]])
    assert_same(grid.derivative(place), velocity, DIFFERENCE)
    spin = columns(exact, "wx", "wy", "wz")
    below = np.array([0.0, 0.0, -run["radius"]])
    contact = velocity + np.cross(spin, below)[:, :2]
    assert_same(contact, run["turn_rate"] * np.stack([-place[:, 1], place[:, 0]], -1))
    # friction per mass from Newton; its torque must turn the ball
    friction = np.zeros((len(grid.times), 3))
    friction[:, :2] = grid.derivative(velocity)
    friction[:, 0] -= run["gravity"] * np.sin(run["tilt"])
    turning = run["inertia_ratio"] * run["radius"] ** 2 * grid.derivative(spin)
    assert_same(turning, np.cross(below, friction), DIFFERENCE)


def test_isokinetic_particle_keeps_its_speed_and_obeys_newton():
    for theta0 in (0.0, 0.7):
        p = {**isokinetic_particle.RUN, "theta0": theta0}
        grid = Interpolant(1.0)
        exact = isokinetic_particle.motion(grid.times, **p)
        velocity = columns(exact, "vx", "vy")
        direction = np.stack([np.cos(exact["theta"]), np.sin(exact["theta"])], -1)
        assert_same(velocity, p["speed"] * direction)
        assert_same(exact["theta"][0], theta0)
        assert_same(grid.derivative(columns(exact, "x", "y")), velocity, DIFFERENCE)
        expected = exact["force"][:, None] * direction + np.array([0.0, -p["gravity"]])
        assert_same(grid.derivative(velocity), expected, DIFFERENCE)


# Rigid bodies


@pytest.mark.parametrize("w1", [0.6, -0.6, 0.0])
def test_suslov_body_obeys_euler_with_a_torque_about_its_axis_only(w1):
    p = {**suslov.RUN, "w1": w1}
    inertia = np.array([[p["i11"], 0, p["i13"]], [0, p["i22"], 0], [p["i13"], 0, p["i33"]]])
    grid = Interpolant(6.0, 60)
    exact = suslov.motion(grid.times, **p)
    w = columns(exact, "w1", "w2", "w3")
    assert_same(w[0], [w1, p["w2"], 0.0])
    torque = grid.derivative(w) @ inertia + np.cross(w, w @ inertia)
    assert_same(torque, np.stack([0 * w[:, 0], 0 * w[:, 0], exact["torque"]], -1), DIFFERENCE)


def test_suslov_attitude_turns_with_the_angular_velocity():
    grid = Interpolant(2.0)
    rotation = free_rigid_body.rotation(suslov.attitude(grid.times, **suslov.RUN))
    spin = np.swapaxes(rotation, -1, -2) @ grid.derivative(rotation)
    w = suslov.motion(grid.times, **suslov.RUN)
    assert_same(
        np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], -1), columns(w, "w1", "w2", "w3"), DIFFERENCE
    )


@pytest.mark.parametrize("inertia", [(1.0, 2.0, 3.5), (3.5, 1.0, 2.0), (2.0, 1.0, 3.5), (1.0, 3.5, 2.0)])
@pytest.mark.parametrize(
    "w0", [(0.9, 0.4, -0.7), (-0.9, 0.4, 0.1), (0.1, 0.2, 0.8), (0.3, -0.9, 0.2), (0.0, 0.0, 1.0)]
)
def test_elliptic_functions_solve_eulers_equations(inertia, w0):
    i1, i2, i3 = inertia
    times = np.linspace(0, 20, 9)

    def rhs(t, w):
        return [(i2 - i3) / i1 * w[1] * w[2], (i3 - i1) / i2 * w[2] * w[0], (i1 - i2) / i3 * w[0] * w[1]]

    assert_same(free_rigid_body.motion(times, inertia=inertia, w0=w0), integrate(rhs, w0, times))


def test_free_rigid_body_keeps_its_momentum_in_space():
    p = free_rigid_body.RUN
    times = np.linspace(0, 20, 9)
    rotation = free_rigid_body.rotation(free_rigid_body.attitude(times, **p))
    momentum = np.einsum("tij,tj->ti", rotation, free_rigid_body.motion(times, **p) * p["inertia"])
    assert_same(momentum, np.broadcast_to(momentum[0], momentum.shape))


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


def test_rolling_disc_obeys_newton_and_euler():
    p = rolling_disc.RUN
    grid = Interpolant(0.5)
    exact = rolling_disc.motion_yaw_lean_spin(grid.times, **p)
    th, ps = exact["theta"], exact["psi"]
    zero = 0 * th
    e1 = np.stack([np.cos(ps), np.sin(ps), zero], -1)
    e3 = np.stack([np.sin(th) * np.sin(ps), -np.sin(th) * np.cos(ps), np.cos(th)], -1)
    e2 = np.cross(e3, e1)
    centre, contact = columns(exact, "cx", "cy", "cz"), np.stack([exact["x"], exact["y"], zero], -1)
    assert_same(centre - contact, p["radius"] * e2)
    w = exact["w1"][:, None] * e1 + exact["w2"][:, None] * e2 + exact["w3"][:, None] * e3
    assert_same(grid.derivative(e3), np.cross(w, e3), DIFFERENCE)
    velocity = grid.derivative(centre)
    assert_same(velocity, np.cross(w, centre - contact), DIFFERENCE)
    a_moment, c_moment = rolling_disc.uniform_inertia(p["mass"], p["radius"])
    momentum = a_moment * w + (c_moment - a_moment) * exact["w3"][:, None] * e3
    force = p["mass"] * (grid.derivative(centre, 2) + np.array([0, 0, p["gravity"]]))
    assert_same(grid.derivative(momentum), np.cross(contact - centre, force), 1e-7)


def test_rolling_disc_starts_with_the_rates_given():
    p = rolling_disc.RUN
    grid = Interpolant(0.2, 30)
    exact = rolling_disc.motion_yaw_lean_spin(grid.times, **p)
    assert_same(exact["lean"][0], p["lean"])
    for name in ("yaw", "lean", "spin"):
        assert_same(grid.derivative(exact[name])[0], p[f"{name}_rate"], DIFFERENCE)


@pytest.mark.parametrize("inertia", [None, (0.5 * 0.25, 0.25)])
def test_rolling_disc_keeps_energy_and_the_legendre_constants(inertia):
    times = np.linspace(0, 10, 15)
    exact = rolling_disc.motion_yaw_lean_spin(times, **rolling_disc.RUN, inertia=inertia)
    first, second = rolling_disc.legendre_constants(
        exact["theta"], exact["w2"], exact["w3"], mass=1.0, radius=0.5, inertia=inertia
    )
    for constant in (first, second, exact["energy"]):
        assert_same(constant, np.full(15, constant[0]), 1e-13)


def test_rolling_disc_circles_steadily():
    body = {"mass": 1.0, "radius": 0.5, "gravity": 9.81}
    theta, yaw_rate = 1.2, 2.5
    circle = rolling_disc.steady_circle(theta, yaw_rate, **body)
    times = np.linspace(0, 2 * np.pi / yaw_rate, 7)
    exact = rolling_disc.motion(times, **body, theta=theta, w1=0.0, w2=circle["w2"], w3=circle["w3"])
    assert_same(exact["theta"], np.full(7, theta))
    assert_same(
        np.hypot(exact["x"] + 0, exact["y"] - circle["contact_radius"] * -1),
        np.full(7, abs(circle["contact_radius"])),
    )


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


@pytest.mark.parametrize("start", [{}, dict(zip(rattleback.NAMES, rattleback.REFERENCE[10.0], strict=True))])
def test_rattleback_obeys_newton_and_euler(start):
    p = {**rattleback.RUN, **start}
    grid = Interpolant(0.02, 30)  # it pitches at about 100 rad/s
    exact = rattleback.motion(grid.times, **p)
    al, be, ga = exact["alpha"], exact["beta"], exact["gamma"]

    def about(axis, angle):
        c, s, one, zero = np.cos(angle), np.sin(angle), 1 + 0 * angle, 0 * angle
        rows = {
            1: [[one, zero, zero], [zero, c, -s], [zero, s, c]],
            2: [[c, zero, s], [zero, one, zero], [-s, zero, c]],
            3: [[c, -s, zero], [s, c, zero], [zero, zero, one]],
        }[axis]
        return np.moveaxis(np.array(rows), -1, 0)

    rotation = about(3, ga) @ about(1, al) @ about(2, be)  # n3 down
    spin = np.swapaxes(rotation, -1, -2) @ grid.derivative(rotation)
    w = columns(exact, "w1", "w2", "w3")
    assert_same(np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], -1), w, DIFFERENCE)
    # the lowest point of the ellipsoid, and the height of the mass centre above it
    down = rotation[:, 2, :]
    squares = np.array([p["a"], p["b"], p["c"]]) ** 2
    arm = squares * down / np.sqrt((squares * down**2).sum(-1, keepdims=True)) - np.array([0, 0, p["h"]])
    space_arm = np.einsum("tij,tj->ti", rotation, arm)
    velocity = -np.einsum("tij,tj->ti", rotation, np.cross(w, arm))
    assert_same(velocity[:, 2], -grid.derivative(space_arm[:, 2]), DIFFERENCE)
    force = grid.derivative(velocity) - np.array([0, 0, p["gravity"]])
    inertia = np.array([[p["A"], p["D"], 0], [p["D"], p["B"], 0], [0, 0, p["C"]]])
    momentum = np.einsum("tij,jk,tk->ti", rotation, inertia, w)
    assert_same(grid.derivative(momentum), np.cross(space_arm, force), DIFFERENCE)


def test_rattleback_reproduces_the_first_row_of_the_reference():
    exact = rattleback.motion([0.0, 1.0])
    assert_same(columns(exact, *rattleback.NAMES)[1], np.array(rattleback.REFERENCE[1.0]))
    assert_same(exact["energy"], np.full(2, rattleback.ENERGY), 1e-14)


def test_rattleback_turns_back_first_when_it_is_said_to():
    assert abs(rattleback.motion([0.0, rattleback.FIRST_REVERSAL])["w3"][1]) < 3e-6


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


# Pendulums, springs and rods


def test_double_pendulum_in_angles_is_the_one_with_rods():
    p = double_pendulum.RUN
    times = np.linspace(0, 5, 9)
    exact = double_pendulum.motion(times, **p)
    weights = np.array([[0, -p["m1"] * p["gravity"]], [0, -p["m2"] * p["gravity"]]], np.longdouble)
    rods = spring_and_rod.newton(
        times,
        masses=(p["m1"], p["m2"]),
        force=lambda *_: weights,
        r0=[[exact["x1"][0], exact["y1"][0]], [exact["x2"][0], exact["y2"][0]]],
        v0=[[exact["vx1"][0], exact["vy1"][0]], [exact["vx2"][0], exact["vy2"][0]]],
        rods=[(0, 1)],
        anchors=[(0, (0.0, 0.0))],
    )
    assert_same(columns(exact, "x1", "y1", "x2", "y2"), rods["r"].reshape(-1, 4))
    assert_same(columns(exact, "vx1", "vy1", "vx2", "vy2"), rods["v"].reshape(-1, 4))
    assert_same(columns(exact, "tension2", "tension1"), rods["tensions"], 1e-11)
    assert_same(exact["energy"], np.full(9, exact["energy"][0]), 1e-13)


def test_spring_and_rod_keep_energy_and_length():
    p = spring_and_rod.RUN
    times = np.linspace(0, 5, 9)
    exact = spring_and_rod.motion(times, **p)
    assert_same(exact["energy"], np.full(9, exact["energy"][0]), 1e-13)
    assert_same(np.linalg.norm(exact["r"][:, 0] - exact["r"][:, 1], axis=-1), np.full(9, 0.6), 1e-14)


def test_a_spring_without_rods_swings_the_bob_in_and_out():
    # straight up and down: a harmonic oscillator about the stretched length
    k, g, rest = 40.0, 9.81, 0.5
    fixed = np.zeros(2, np.longdouble)

    def force(t, r, v):
        return [spring_and_rod.spring(r[0], fixed, k, rest) + np.array([0, -g], np.longdouble)]

    times = np.linspace(0, 3, 7)
    exact = spring_and_rod.newton(times, masses=[1.0], force=force, r0=[[0, -0.6]], v0=[[0, 0]])
    still, rate = -rest - g / k, np.sqrt(k)
    assert_same(exact["r"][:, 0, 1], still + (-0.6 - still) * np.cos(rate * times))


# Trailers


@pytest.mark.parametrize(("v", "w"), [(1.2, 0.0), (1.2, 0.4), (1.2, 3.0), (-0.5, 0.1), (0.7, 1.0)])
def test_hitch_angle_solves_its_equation(v, w):
    times = np.linspace(0, 5, 11)
    p = {"length": 0.7, "v": v, "w": w, "gamma0": 1.0}
    states = integrate(lambda t, y: [w - v / 0.7 * np.sin(y[0])], [1.0], times)[:, 0]
    exact = trailers.hitch_angle(times, **p)
    assert_same(np.exp(1j * exact), np.exp(1j * states), 1e-11)
    if w == 0.0:
        assert_same(np.tan(exact / 2), np.tan(0.5) * np.exp(-v * times / 0.7))


def test_a_chain_of_trailers_settles_on_its_circles():
    lengths, v, w = (0.5, 0.4, 0.3), 1.0, 0.8
    times = np.array([0.0, 10.0, 20.0])
    chain = trailers.chain(
        times, lengths=lengths, speed=lambda t: v, yaw_rate=lambda t: w, headings0=[0, 0, 0, 0]
    )
    first = trailers.hitch_angle(times, length=0.5, v=v, w=w, gamma0=0.0)
    assert_same(chain["headings"][:, 0] - chain["headings"][:, 1], first)
    assert abs(first[-1] - trailers.steady_hitch_angle(0.5, v, w)) < 1e-9
    assert_same(chain["speeds"][-1, 1:] / w, trailers.steady_radii(v / w, lengths), 1e-6)


# Bicycle


@pytest.fixture
def forty_digits():
    with mpmath.workdps(40):
        yield whipple_bicycle.matrices(whipple_bicycle.exact_parameters(), mpmath.cos, mpmath.sin)


def test_the_appendix_gives_every_printed_digit(forty_digits):
    for name, text in (
        ("M", whipple_bicycle.M_TEXT),
        ("C1", whipple_bicycle.C1_TEXT),
        ("K0", whipple_bicycle.K0_TEXT),
        ("K2", whipple_bicycle.K2_TEXT),
    ):
        for i in range(2):
            for j in range(2):
                printed = mpmath.mpf(text[i][j])
                assert abs(forty_digits[name][i][j] - printed) <= mpmath.mpf("1e-21") * max(
                    1, abs(printed)
                ), (name, i, j)


def test_the_appendix_in_double_precision():
    parts = whipple_bicycle.matrices(whipple_bicycle.BENCHMARK)
    for name in ("M", "C1", "K0", "K2"):
        assert_same(np.array(parts[name], float), getattr(whipple_bicycle, name), 1e-14)


def test_the_forty_four_eigenvalues(forty_digits):
    gravity = mpmath.mpf("9.81")
    for v, printed in whipple_bicycle.EIGENVALUES.items():
        roots = np.array(
            [complex(z) for z in whipple_bicycle.exact_eigenvalues(mpmath.mpf(v), forty_digits, gravity)]
        )
        for value in printed:
            assert np.min(np.abs(roots - value)) <= 1e-14 * max(1, abs(value)), (v, value)
        double = np.linalg.eigvals(whipple_bicycle.state_matrix(v))
        assert max(np.min(np.abs(double - value)) for value in printed) < 1e-12


def test_the_weave_capsize_and_double_root_speeds(forty_digits):
    gravity = mpmath.mpf("9.81")

    def coefficients(v):
        return whipple_bicycle.exact_polynomial(v, forty_digits, gravity)

    def hurwitz(v):  # a1 a2 a3 - a0 a3^2 - a1^2 a4: zero where a pair crosses the imaginary axis
        a4, a3, a2, a1, a0 = coefficients(v)
        return a1 * a2 * a3 - a0 * a3**2 - a1**2 * a4

    weave = mpmath.findroot(hurwitz, 4.3)
    assert abs(weave - mpmath.mpf("4.2923825363411039587")) < mpmath.mpf("1e-18")
    assert abs(weave - whipple_bicycle.WEAVE_SPEED) < 1e-15
    capsize = mpmath.findroot(lambda v: coefficients(v)[-1], 6.0)
    assert abs(capsize - mpmath.mpf("6.0242620153883588899")) < mpmath.mpf("1e-18")

    def tangent(v, s):
        a4, a3, a2, a1, a0 = coefficients(v)
        return [(((a4 * s + a3) * s + a2) * s + a1) * s + a0, ((4 * a4 * s + 3 * a3) * s + 2 * a2) * s + a1]

    speed, root = mpmath.findroot(tangent, (0.684, 3.78))
    assert abs(speed - whipple_bicycle.DOUBLE_ROOT_SPEED) < 1e-13
    assert abs(root - whipple_bicycle.DOUBLE_ROOT) < 1e-12
