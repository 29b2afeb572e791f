"""Free snakeboard through phi = 90 degrees (B14). Lewis, Ostrowski, Murray & Burdick 1994.

(x, y) middle, th board heading, psi rotor angle relative to the board, wheels at phi (front) and -phi (back);
rows -sin(th +- phi) xd + cos(th +- phi) yd +- l cos(phi) thd = 0;
T = m v^2/2 + J thd^2/2 + Jr (thd + psid)^2/2 + Jw ((thd + phid)^2 + (thd - phid)^2)/2. Without torques phid
and thd + psid are constant; u = c l cos(phi)/D, thd = c sin(phi)/D, D^2 = m l^2 cos^2 phi + (J + 2 Jw) sin^2
phi, c^2/2 = energy of (u, th).
"""

import numpy as np

from .reference import integrate

RUN = {
    "mass": 6.0,
    "half_length": 0.2,
    "board_inertia": 0.1,
    "rotor_inertia": 0.05,
    "wheel_inertia": 0.002,
    "phi0": 0.3,
    "phi_rate": 0.5,
    "u0": 1.0,
    "psi_rate": 0.4,
    "t_end": (np.pi - 0.6) / 0.5,  # to pi - phi0; the rows are parallel at the middle
}


def velocities(
    t, *, mass, half_length, board_inertia, wheel_inertia, phi0, phi_rate, u0, psi_rate, **_
) -> dict[str, np.ndarray]:
    """phi, u (forward speed), th_rate, psi_rate in closed form; keeps long double times."""
    inertia = board_inertia + 2 * wheel_inertia

    def size(phi):
        return np.sqrt(mass * half_length**2 * np.cos(phi) ** 2 + inertia * np.sin(phi) ** 2)

    c = u0 * size(phi0) / (half_length * np.cos(phi0))
    phi = phi0 + phi_rate * np.asarray(t)
    turn = c * np.sin(phi) / size(phi)
    total = psi_rate + c * np.sin(phi0) / size(phi0)
    return {
        "phi": phi,
        "u": c * half_length * np.cos(phi) / size(phi),
        "th_rate": turn,
        "psi_rate": total - turn,
    }


def motion(t, **parameters) -> dict[str, np.ndarray]:
    """The closed forms and th, psi, x, y by quadrature from zero at t[0] = 0."""

    def rhs(time, state):
        rates = velocities(time, **parameters)
        th = state[0]
        return [rates["th_rate"], rates["psi_rate"], rates["u"] * np.cos(th), rates["u"] * np.sin(th)]

    th, psi, x, y = integrate(rhs, np.zeros(4), t).T
    return {**velocities(np.asarray(t, float), **parameters), "th": th, "psi": psi, "x": x, "y": y}
