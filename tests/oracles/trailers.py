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


def chain(t, *, lengths, speed, yaw_rate, headings0) -> dict[str, np.ndarray]:
    """Kinematics of a leader and n trailers, given the leader's speed(t) and yaw_rate(t).

    **Returns:** `headings` (times, n + 1), leader first.
    """

    def rates(time, headings):
        along, turns = speed(time), [yaw_rate(time)]
        for length, ahead, own in zip(lengths, headings[:-1], headings[1:], strict=True):
            turns.append(along * np.sin(ahead - own) / length)
            along = along * np.cos(ahead - own)
        return turns

    return {"headings": integrate(rates, headings0, t)}
