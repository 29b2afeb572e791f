"""Vertical disc rolling on a level plane (B4). Bloch, Nonholonomic Mechanics and Control, 2003, sec. 1.4.

phi heading, th rolling angle; rows xdot = R cos(phi) thdot, ydot = R sin(phi) thdot. Both rates are constant.
The multipliers are those of the rows xdot - R cos(phi) thdot = 0 and ydot - R sin(phi) thdot = 0: the forces
(l1, l2) on (x, y).
"""

import numpy as np

from .turning import push_while_turning

RUN = {"mass": 1.0, "radius": 1.0, "phi0": 0.0, "phi_rate": 2.0, "th_rate": 1.0, "t_end": 1.0}


def motion(t, *, radius, phi0, phi_rate, th_rate, mass, **_) -> dict[str, np.ndarray]:
    """x, y, phi, th and the multipliers l1, l2; regular at phi_rate = 0."""
    path = push_while_turning(t, radius * th_rate, 0.0, phi0, phi_rate)
    size = mass * phi_rate * radius * th_rate
    return {
        "x": path["x"],
        "y": path["y"],
        "phi": path["heading"],
        "th": th_rate * np.asarray(t, float),
        "l1": -size * np.sin(path["heading"]),
        "l2": size * np.cos(path["heading"]),
    }
