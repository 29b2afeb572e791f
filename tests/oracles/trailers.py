"""Trailers on on-axle hitches (B18). Kinematics: each axle rolls along its own heading. Laumond 1993;
Sordalen 1993.

gamma = heading of the pulling vehicle minus heading of the trailer, L the trailer's length, v the pulling
axle's speed, w its yaw rate: gamma' = w - (v/L) sin gamma. v < 0 (backing) is unstable at rate |v|/L.
"""

import numpy as np

from .reference import integrate

RUN = {"length": 0.7, "v": 1.2, "w": 0.4, "gamma0": 1.0, "t_end": 5.0}


def hitch_angle(t, *, length, v, w, gamma0, t_end=None) -> np.ndarray:
    """gamma for constant v and w, modulo 2 pi: h = tan(gamma/2) solves a Riccati equation; w = 0: h = h0
    exp(-v t/L).
    """
    t = np.asarray(t, float)
    rate = np.sqrt(complex((v / length) ** 2 - w**2)) / 2
    even = np.cosh(rate * t).real
    odd = t if rate == 0 else (np.sinh(rate * t) / rate).real
    sine, cosine = np.sin(gamma0 / 2), np.cos(gamma0 / 2)
    upper = (even - v / (2 * length) * odd) * sine + w / 2 * odd * cosine
    lower = (even + v / (2 * length) * odd) * cosine - w / 2 * odd * sine
    return 2 * np.arctan2(upper, lower)


def steady_hitch_angle(length: float, v: float, w: float) -> float:
    """asin(w L / v); beyond |w L / v| = 1 the trailer jackknifes."""
    return float(np.arcsin(w * length / v))


def steady_radii(radius: float, lengths) -> np.ndarray:
    """Radii of the axles behind a leader on a circle: R_{i+1}^2 = R_i^2 - L_i^2."""
    return np.sqrt(radius**2 - np.cumsum(np.square(lengths)))


def chain(t, *, lengths, speed, yaw_rate, headings0, x0=0.0, y0=0.0) -> dict[str, np.ndarray]:
    """Kinematics of a leader and n trailers, given the leader's speed(t) and yaw_rate(t).

    **Returns:** x, y of the leader's axle, `headings` (times, n + 1), leader first, and `speeds`, the axles'
    speeds.
    """

    def rates(time, headings):
        speeds, turns = [speed(time)], [yaw_rate(time)]
        for i, length in enumerate(lengths):
            angle = headings[i] - headings[i + 1]
            turns.append(speeds[i] * np.sin(angle) / length)
            speeds.append(speeds[i] * np.cos(angle))
        return speeds, turns

    def rhs(time, state):
        speeds, turns = rates(time, state[2:])
        return [speeds[0] * np.cos(state[2]), speeds[0] * np.sin(state[2]), *turns]

    states = integrate(rhs, [x0, y0, *headings0], t)
    speeds = np.array([rates(time, row[2:])[0] for time, row in zip(t, states, strict=True)], float)
    return {"x": states[:, 0], "y": states[:, 1], "headings": states[:, 2:], "speeds": speeds}
