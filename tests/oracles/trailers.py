"""Trailers on on-axle hitches (B18). Kinematics: each axle rolls along its own heading. Laumond 1993;
Sordalen 1993.

gamma = heading of the pulling vehicle minus heading of the trailer, L the trailer's length, v the pulling
axle's speed, w its yaw rate: gamma' = w - (v/L) sin gamma. v < 0 (backing) is unstable at rate |v|/L.
"""

import numpy as np

from .reference import integrate

RUN = {"length": 0.7, "v": 1.2, "w": 0.4}


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
