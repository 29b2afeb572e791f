"""Two wheels on a rigid axle on an incline. Wang & Pao (2003), eq. (57)-(67); the variant with disc wheels
and a heavy axle.

Axes: x down the slope, y across it, z along its normal. phi is the heading: the wheels' forward direction is
(cos phi, sin phi, 0), the axle direction j'' = (-sin phi, cos phi, 0); wheel 2 lies on the +j'' side, r2 - r1
= l j''. psi_j > 0 rolls forward: xdot_j = a psidot_j cos phi, ydot_j = a psidot_j sin phi; a psidot_2 = a
psidot_1 - l phidot. Equations (64) give phi'' = 0 and psi1'' = M g sin(alpha) cos(phi) / (a (M + m')); no
initial value is special, phi rate zero included.
"""

import numpy as np

from .turning import push_while_turning

# Wheel radius a, axle length l, wheel mass M, rim mass m', slope alpha.
RUN = {
    "radius": 0.3,
    "length": 0.8,
    "mass": 1.2,
    "rim_mass": 0.5,
    "slope": 0.2,
    "gravity": 9.81,
    "phi0": 0.0,
    "phi_rate": 1.1,
    "psi1_rate": 0.7 / 0.3,
    "t_end": 10.0,
}
# B1: wheel radius R, half track b, wheel mass M (uniform discs), axle mass m. th passes 90 degrees.
RUN_HEAVY_AXLE = {
    "radius": 0.3,
    "half_track": 0.4,
    "wheel_mass": 1.2,
    "axle_mass": 0.5,
    "slope": 0.2,
    "gravity": 9.81,
    "u0": 0.7,
    "th0": 0.0,
    "th_rate": 1.1,
    "t_end": 10.0,
}


def motion(
    t, *, radius, length, mass, rim_mass, slope, gravity, phi0, phi_rate, psi1_rate, **_
) -> dict[str, np.ndarray]:
    """x1, y1, psi1, x2, y2, psi2, from zero but for y2, and the rates psi1_rate, phi_rate (S11)."""
    k = mass * gravity * np.sin(slope) / (mass + rim_mass)  # a psi1'' = k cos(phi)
    path = push_while_turning(t, radius * psi1_rate, k, phi0, phi_rate)
    x, y, phi = path["x"], path["y"], path["heading"]
    return {
        "x1": x,
        "y1": y,
        "psi1": path["s"] / radius,
        "x2": x - length * np.sin(phi),
        "y2": y + length * np.cos(phi),
        "psi2": (path["s"] - length * phi_rate * np.asarray(t, float)) / radius,
        "psi1_rate": path["u"] / radius,
        "phi_rate": phi_rate + 0 * phi,
    }


def motion_heavy_axle(
    t, *, radius, half_track, wheel_mass, axle_mass, slope, gravity, u0, th0, th_rate, t_end=None
) -> dict[str, np.ndarray]:
    """x, y (middle of the axle), th, p1, p2 and u, with rows c xd + s yd -+ b thd = R p1d, R p2d (B1). Starts
    at zero.
    """
    k = gravity * np.sin(slope) * (2 * wheel_mass + axle_mass) / (3 * wheel_mass + axle_mass)
    path = push_while_turning(t, u0, k, th0, th_rate)
    turned = half_track * th_rate * np.asarray(t, float)
    return {
        "x": path["x"],
        "y": path["y"],
        "th": path["heading"],
        "p1": (path["s"] - turned) / radius,
        "p2": (path["s"] + turned) / radius,
        "u": path["u"],
    }
