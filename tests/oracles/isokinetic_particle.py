"""Particle of constant speed c under gravity: the row |v| = c, nonlinear in the velocity.

The Gaussian isokinetic thermostat (Evans, Hoover et al., Phys. Rev. A 28 (1983) 1016) in a uniform field.

x horizontal, y up, direction theta from +x. m v' = m g - lambda v / c has the solution sin theta = -tanh tau,
tau = tau0 + g t/c, x = (c^2/g) gd(tau), y = -(c^2/g) ln cosh tau (differences from the start).
"""

import numpy as np

RUN = {"speed": 1.7, "gravity": 9.81, "theta0": 0.0, "t_end": 2.0}


def motion(t, *, speed, gravity, theta0, **_) -> dict[str, np.ndarray]:
    """x, y (from zero), vx, vy; |theta0| < 90 deg."""
    t = np.asarray(t, float)
    tau0 = -np.arctanh(np.sin(theta0))
    tau = tau0 + gravity * t / speed
    size = speed**2 / gravity

    def height(z):  # ln cosh, without overflow
        return np.abs(z) + np.log1p(np.exp(-2 * np.abs(z))) - np.log(2)

    turned = np.arctan(np.sinh(tau)) - np.arctan(np.sinh(tau0))
    return {
        "x": size * turned,
        "y": size * (height(tau0) - height(tau)),
        "vx": speed / np.cosh(tau),
        "vy": -speed * np.tanh(tau),
    }
