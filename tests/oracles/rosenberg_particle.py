"""Rosenberg's nonholonomic particle (B5). Rosenberg, Analytical Dynamics, 1977; Bates & Sniatycki 1993.

Free unit particle with the row zdot = y xdot. ydot = b and xdot sqrt(1 + y^2) = c are constant. b = 0 gives
xdot constant. RUN's c is that constant, so xdot(0) = c / sqrt(1 + y0^2).
"""

import numpy as np

RUN = {"b": 0.8, "c": 1.1, "x0": 0.0, "y0": -1.0, "z0": 0.0, "t_end": 5.0}


def motion(t, *, b, c, x0, y0, z0, t_end=None) -> dict[str, np.ndarray]:
    """x, y, z."""
    t = np.asarray(t, float)
    y = y0 + b * t
    root = np.sqrt(1 + y**2)
    if b == 0.0:
        x, z = x0 + c * t / root, z0 + y0 * c * t / root
    else:
        x = x0 + (c / b) * (np.arcsinh(y) - np.arcsinh(y0))
        z = z0 + (c / b) * (root - np.sqrt(1 + y0**2))
    return {"x": x, "y": y, "z": z}
