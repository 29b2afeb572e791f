"""Free particle with the Heisenberg row zdot = y xdot - x ydot (B5): straight lines, zero multiplier. Bloch,
2003, sec. 1.8.

A variational (vakonomic) reading of the same row would give helices.
"""

import numpy as np

RUN = {"x0": 0.3, "y0": -0.2, "z0": 0.0, "xdot": 0.7, "ydot": 0.4, "t_end": 10.0}


def motion(t, *, x0, y0, z0, xdot, ydot, t_end=None) -> dict[str, np.ndarray]:
    """x, y, z."""
    t = np.asarray(t, float)
    zdot = y0 * xdot - x0 * ydot  # the row's value does not change along the line
    return {"x": x0 + xdot * t, "y": y0 + ydot * t, "z": z0 + zdot * t}
