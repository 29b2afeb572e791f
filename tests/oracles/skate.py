"""Knife edge on an incline (B2). Neimark & Fufaev, Dynamics of Nonholonomic Systems, 1972, ch. III; Bloch,
2003, sec. 1.6.

x down the slope, y across; heading th from the x axis towards y; row xdot sin th - ydot cos th = 0, edge
under the mass centre. th = th0 + w t, forward speed u' = g sin(alpha) cos th. From rest at th0 = 0: x = (g
sin alpha / 2 w^2) sin^2 wt.
"""

import numpy as np

from .turning import push_while_turning

RUN = {
    "slope": 0.3,
    "mass": 1.0,
    "inertia": 0.2,
    "gravity": 9.81,
    "u0": 0.0,
    "th0": 0.0,
    "th_rate": 1.3,
    "t_end": 10.0,
}


def motion(t, *, slope, gravity, u0, th0, th_rate, **_) -> dict[str, np.ndarray]:
    """x, y, th, u; mass and inertia do not matter."""
    path = push_while_turning(t, u0, gravity * np.sin(slope), th0, th_rate)
    return path | {"th": path["heading"]}
