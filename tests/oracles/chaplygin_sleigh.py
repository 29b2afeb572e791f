"""Chaplygin sleigh (B3). Chaplygin 1911; Bloch, 2003, sec. 1.7.

(x, y) is the mass centre, a ahead of the blade; heading th; row -s xdot + c ydot - a thdot = 0. v is the
forward speed of the blade, w = thdot. v' = a w^2, w' = -(a/k^2) v w, k^2 = inertia/mass + a^2; v = V tanh
tau, w = +-(V/k) sech tau,
tau = tau0 + a V t / k^2, th = +-(k/a)(gd tau - gd tau0). The path is a quadrature.
"""

import numpy as np

from .reference import integral

RUN = {"mass": 1.3, "inertia": 0.4, "a": 0.25, "v0": -0.6, "w0": 0.9, "t_end": 12.0}


def _gudermannian(x):
    return 2 * np.arctan(np.tanh(x / 2))


def velocities(t, *, mass, inertia, a, v0, w0, t_end=None) -> dict[str, np.ndarray]:
    """v, w, th in closed form at any times (a may not be zero)."""
    t = np.asarray(t, float)
    if w0 == 0.0:
        return {"v": v0 + 0 * t, "w": 0 * t, "th": 0 * t}
    k = np.sqrt(inertia / mass + a**2)
    speed, sign = np.hypot(v0, k * w0), np.sign(w0)
    tau0 = np.arcsinh(v0 / (k * abs(w0)))
    tau = tau0 + a * speed * t / k**2
    return {
        "v": speed * np.tanh(tau),
        "w": sign * speed / k / np.cosh(tau),
        "th": sign * (k / a) * (_gudermannian(tau) - _gudermannian(tau0)),
    }


def motion(t, **parameters) -> dict[str, np.ndarray]:
    """v, w, th, x, y (mass centre, from zero); t[0] is the time of the start, 0."""
    a = parameters["a"]
    result = velocities(t, **parameters)

    def component(function):
        def rate(s):
            state = velocities(s, **parameters)
            return state["v"] * function(state["th"])

        return integral(rate, t)

    # of the blade, which starts at -a
    x = component(np.cos) + a * (np.cos(result["th"]) - 1)
    return {**result, "x": x, "y": component(np.sin) + a * np.sin(result["th"])}
