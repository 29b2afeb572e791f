"""Suslov's problem (B12). Suslov 1902; Kozlov 1988. Rigid body about a fixed point, body-fixed row w3 = 0, no
torque.

I13 is the entry of the inertia matrix (minus the integral of x z), I12 = I23 = 0. With 2E = I11 w1^2 + I22
w2^2:
w1 = +-sqrt(2E/I11) sech(tau), w2 = sqrt(2E/I22) tanh(tau), tau = tau0 + k t, k = (I13/I11) sqrt(2E/I22).
"""

import numpy as np

from .reference import integrate

RUN = {"i11": 1.0, "i22": 2.0, "i33": 1.5, "i13": 0.5, "w1": 0.6, "w2": 0.8, "t_end": 10.0}


def motion(t, *, i11, i22, i13, w1, w2, i33=None, t_end=None) -> dict[str, np.ndarray]:
    """w1, w2 and the constraint torque about body axis 3; w3 is zero."""
    t = np.asarray(t)  # long double stays
    if w1 == 0.0:
        rates = {"w1": 0 * t, "w2": w2 + 0 * t}
    else:
        energy = i11 * w1**2 + i22 * w2**2  # 2E
        tau = np.arcsinh(w2 * np.sqrt(i22 / i11) / abs(w1)) + (i13 / i11) * np.sqrt(energy / i22) * t
        rates = {
            "w1": np.sign(w1) * np.sqrt(energy / i11) / np.cosh(tau),
            "w2": np.sqrt(energy / i22) * np.tanh(tau),
        }
    first, second = rates["w1"], rates["w2"]
    torque = -(i13**2 / i11) * first * second + (i22 - i11) * first * second
    return {**rates, "torque": torque}


def attitude(t, **parameters) -> np.ndarray:
    """Quaternion (w, x, y, z), body to space, shape (times, 4), from the identity at t[0]; integrated in
    extended precision.
    """

    def rhs(time, quaternion):
        state = motion(time, **parameters)
        a, b = state["w1"], state["w2"]
        w, x, y, z = quaternion
        return [(-x * a - y * b) / 2, (w * a - z * b) / 2, (w * b + z * a) / 2, (x * b - y * a) / 2]

    return integrate(rhs, [1, 0, 0, 0], t)
