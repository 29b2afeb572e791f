"""True values at the end of every problem, each with a second computation that shares neither equations nor integrator with the first.

First: closed forms and extended-precision integrations of `tests/oracles`; for the bicycle, which has none, heyoka in extended precision on the
engine's equations. Second: heyoka in extended precision on the engine's equations, or for the bicycle dense autodiff by diffrax; where heyoka is not
installed, the engine at a tolerance of 1e-14. The uncertainty is their largest difference over the quantities compared.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from baselines import dense
from oracles import ball_on_turntable, chaplygin_sleigh, rattleback, rolling_disc, snakeboard, two_wheel_axle
from oracles.reference import LONG, integrate

import jourdain_jax as jj
from work_precision_cases import peer_heyoka
from work_precision_cases.problem import Problem, Reference, largest_error

TIGHT = 1e-14


def by_engine(problem: Problem) -> dict[str, float]:
    """The engine's own end, at a tolerance of 1e-14; not inside `jit`, where a motion that fails is not run again in another way."""
    options = {"ts": jnp.array([problem.end]), "rtol": TIGHT, "atol": TIGHT, "events": False}
    motion = jj.simulate(problem.scene, problem.state, solver=diffrax.Dopri8(), **options).raise_if_failed()
    return dict(zip((*problem.scene.coordinate_names.entries, *problem.scene.speed_names.entries), (*motion.q_end, *motion.u_end), strict=True))


def second(problem: Problem) -> tuple[dict[str, float], str]:
    """Another computation of the end."""
    if peer_heyoka.heyoka is not None and peer_heyoka.applies(problem):
        found = peer_heyoka.extended(problem)
        if np.all(np.isfinite(list(found.values()))):  # a Taylor series may begin where rows lose rank: the snakeboard at 90 degrees
            return found, "heyoka, extended precision, the engine's equations"
    return by_engine(problem), "the engine, Dopri8 at 1e-14"


def checked(problem: Problem, values: dict[str, float], how: str) -> Reference:
    """Values with the largest difference from a second computation."""
    other, by = second(problem)
    names = tuple(name for name in problem.compared if name in other)
    return Reference(values, how, largest_error(other, values, names), by)


def disc(problem: Problem) -> Reference:
    """Euler's equations in Appell's variables, by the oracle."""
    found = rolling_disc.motion_yaw_lean_spin([0.0, problem.end], **rolling_disc.RUN)
    values = {name: found[name][-1] for name in ("x", "y", "yaw", "lean", "spin")}
    values |= {"lean_rate": found["w1"][-1], "yaw_rate": found["w2"][-1] / np.cos(values["lean"])}
    values["spin_rate"] = -found["w3"][-1] - values["yaw_rate"] * np.sin(values["lean"])
    return checked(problem, values, "Appell's equations, extrapolation of order 18 in extended precision")


def sleigh(problem: Problem) -> Reference:
    """Closed form; the path by quadrature."""
    found = {name: values[-1] for name, values in chaplygin_sleigh.motion([0.0, problem.end], **_without(chaplygin_sleigh.RUN, "t_end")).items()}
    c, s, a = np.cos(found["th"]), np.sin(found["th"]), chaplygin_sleigh.RUN["a"]
    values = {"x": found["x"], "y": found["y"], "heading": found["th"], "heading_rate": found["w"]}
    values |= {"x_rate": found["v"] * c - a * found["w"] * s, "y_rate": found["v"] * s + a * found["w"] * c}
    return checked(problem, values, "closed form; path by Gauss-Legendre quadrature")


def celt(problem: Problem) -> Reference:
    """Kane and Levinson's equations, by the oracle."""
    found = rattleback.motion([0.0, problem.end], **_without(rattleback.RUN, "t_end"))
    values = {name: found[name][-1] for name in rattleback.NAMES}
    return checked(problem, values, "Kane and Levinson's equations, extrapolation of order 18 in extended precision")


def axle(problem: Problem) -> Reference:
    """Closed form."""
    found = two_wheel_axle.motion([0.0, problem.end], **two_wheel_axle.RUN)
    return checked(problem, {name: found[name][-1] for name in problem.compared}, "closed form")


def ball(problem: Problem) -> Reference:
    """Closed form of the centre and the angular velocity; the attitude e by `e' = (0, omega/2) e`, omega in space axes."""
    run = ball_on_turntable.RUN
    found = {name: values[-1] for name, values in ball_on_turntable.motion([0.0, problem.end], **run).items()}
    values = {"x": found["x"], "y": found["y"], "x_rate": found["vx"], "y_rate": found["vy"], "roll_x": found["wx"], "roll_y": found["wy"], "spin": found["wz"]}
    r, turn, kappa, wz = (LONG(run[name]) for name in ("radius", "turn_rate", "inertia_ratio", "wz"))
    c, s = np.cos(LONG(run["tilt"])), np.sin(LONG(run["tilt"]))
    n, push = turn * kappa / (1 + kappa), LONG(run["gravity"]) * s / (1 + kappa)

    def rates(_, state):
        x, y, vx, vy, *e = state
        wx, wy = (turn * x - vy) / r, (vx + turn * y) / r
        p, q, w = (wx * c + wz * s) / 2, wy / 2, (wz * c - wx * s) / 2
        turning = [-p * e[1] - q * e[2] - w * e[3], p * e[0] + q * e[3] - w * e[2], q * e[0] + w * e[1] - p * e[3], w * e[0] + p * e[2] - q * e[1]]
        return [vx, vy, push - n * vy, n * vx, *turning]

    attitude = ("attitude_w", "attitude_x", "attitude_y", "attitude_z")
    names = problem.scene.coordinate_names.entries
    at_start = [float(problem.state.q[names.index(name)]) for name in attitude]
    ends = integrate(rates, [run["x0"], run["y0"], run["vx0"], run["vy0"], *at_start], [0.0, problem.end])[-1]
    return checked(problem, values | dict(zip(attitude, ends[4:], strict=True)), "closed form; attitude by extrapolation of order 18 in extended precision")


def board(problem: Problem) -> Reference:
    """Closed form of the speeds; path and angles by extended-precision quadrature."""
    found = {name: np.asarray(values)[-1] for name, values in snakeboard.motion([0.0, problem.end], **snakeboard.RUN).items()}
    values = {"x": found["x"], "y": found["y"], "heading": found["th"], "rotor": found["psi"], "steer": found["phi"]}
    values |= {"heading_rate": found["th_rate"], "rotor_rate": found["psi_rate"], "steer_rate": snakeboard.RUN["phi_rate"]}
    return checked(problem, values, "closed form; path and angles by extrapolation of order 18 in extended precision")


def trailers(problem: Problem) -> Reference:
    """The turn rate of the car is constant, and energy gives its speed, so that only the headings are integrated.

    v_i = v_{i-1} cos(gamma_i), w_i = v_{i-1} sin(gamma_i)/L: T - I_0 w_0^2/2 = v_0^2 m(headings)/2.
    """
    scene, state = problem.scene, problem.state
    n, L = scene.trailers, float(scene.length)
    masses = [float(scene.car_mass), *[float(scene.trailer_mass)] * n]
    named = dict(zip(scene.coordinate_names.entries, np.asarray(state.q), strict=True)) | dict(zip(scene.speed_names.entries, np.asarray(state.u), strict=True))
    turn0, forward0 = named["turn0"], named["forward0"]

    def per_speed(headings):
        """Speeds and turn rates of all bodies for a car at 1 m/s that does not turn, and the mass they amount to."""
        speeds, turns = [1 + 0 * headings[0]], [0 * headings[0]]
        for i in range(n):
            angle = headings[i] - headings[i + 1]
            turns.append(speeds[i] * np.sin(angle) / L)
            speeds.append(speeds[i] * np.cos(angle))
        inertia = float(scene.trailer_inertia)
        return speeds, turns, sum(m * v**2 for m, v in zip(masses, speeds, strict=True)) + inertia * sum(w**2 for w in turns[1:])

    headings0 = np.array([named[f"heading{i}"] for i in range(n + 1)], LONG)
    at_start = per_speed(headings0)[2]

    def car_speed(headings):
        speeds, turns, mass = per_speed(headings)
        return forward0 * np.sqrt(at_start / mass), speeds, turns

    def rates(_, y):
        v, _, turns = car_speed(y[2:])
        return [v * np.cos(y[2]), v * np.sin(y[2]), turn0, *(v * w for w in turns[1:])]

    x, y, *headings = integrate(rates, [named["x0"], named["y0"], *headings0], [0.0, problem.end])[-1]
    v, speeds, turns = car_speed(np.array(headings, LONG))
    values = {"x0": x, "y0": y, "heading0": headings[0], "forward0": float(v), "turn0": turn0}
    for i in range(1, n + 1):
        x, y = x - L * np.cos(headings[i]), y - L * np.sin(headings[i])
        values |= {f"x{i}": x, f"y{i}": y, f"heading{i}": headings[i], f"forward{i}": float(v * speeds[i]), f"turn{i}": float(v * turns[i])}
    return checked(problem, values, "headings alone, the car's speed from the energy; extrapolation of order 18 in extended precision")


def bicycle(problem: Problem) -> Reference:
    """No closed form: heyoka on the engine's equations against dense autodiff of poses written by hand, or the engine against the latter."""
    if peer_heyoka.heyoka is None:
        values, how = by_engine(problem), "the engine, Dopri8 at 1e-14"
    else:
        values, how = peer_heyoka.extended(problem), "heyoka, extended precision, the engine's equations"
    y = np.concatenate([problem.state.q, problem.state.u])
    found = jax.jit(lambda y: dense.integrate(dense.bicycle_rates, dense.BICYCLE_PARAMETERS, y, problem.end, "Dopri8", 1e-13))(y[None])[0]
    other = dict(zip((*problem.scene.coordinate_names.entries, *problem.scene.speed_names.entries), np.asarray(found), strict=True))
    return Reference(values, how, largest_error(other, values, problem.compared), "dense autodiff of poses by hand, diffrax Dopri8 at 1e-13")


def _without(values: dict, *names: str) -> dict:
    return {name: value for name, value in values.items() if name not in names}
