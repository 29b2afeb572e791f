"""Torque-free rigid body: Euler's equations by Jacobi elliptic functions. Landau & Lifshitz, Mechanics,
section 37.

w: body components, I_k w_k' = (I_l - I_m) w_l w_m cyclically; three different principal moments in any order;
not on the separatrix (|L|^2 = 2 E I_middle) itself.
"""

import numpy as np
from scipy.special import ellipj, ellipkinc

from .reference import integrate

RUN = {"inertia": (1.0, 2.0, 2.9), "w0": (0.9, 0.4, -0.7), "t_end": 20.0}


def _parity(order) -> int:
    return 1 if tuple(order) in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1


def motion(t, *, inertia, w0, t_end=None) -> np.ndarray:
    """Body angular velocity (times, 3)."""
    t = np.asarray(t, float)
    moments, start = np.asarray(inertia, float), np.asarray(w0, float)
    energy, momentum = np.sum(moments * start**2), np.sum((moments * start) ** 2)  # 2E, |L|^2
    order = np.argsort(moments)
    if momentum < energy * moments[order[1]]:
        order = order[::-1]  # the axis that keeps its sign is the last
    (i1, i2, i3), w = moments[order], start[order]
    # 2E I3 - L^2 and L^2 - 2E I1 (or both with the other sign), written without cancellation
    low = i1 * (i3 - i1) * w[0] ** 2 + i2 * (i3 - i2) * w[1] ** 2
    high = i2 * (i2 - i1) * w[1] ** 2 + i3 * (i3 - i1) * w[2] ** 2
    a1, a2 = np.sqrt(low / (i1 * (i3 - i1))), np.sqrt(low / (i2 * (i3 - i2)))
    a3 = np.sqrt(high / (i3 * (i3 - i1)))
    rate = np.sqrt((i3 - i2) * high / (i1 * i2 * i3))
    modulus = (i2 - i1) * low / ((i3 - i2) * high)
    third = 1.0 if w[2] >= 0 else -1.0
    second = -_parity(order) * np.sign(i2 - i3) * third
    phase = 0.0 if low == 0 else ellipkinc(np.arctan2(second * w[1] / a2, w[0] / a1), modulus)
    sn, cn, dn, _ = ellipj(phase + rate * t, modulus)
    result = np.empty((*t.shape, 3))
    for axis, values in zip(order, (a1 * cn, second * a2 * sn, third * a3 * dn), strict=True):
        result[..., axis] = values
    return result


def attitude(t, *, inertia, w0, t_end=None) -> np.ndarray:
    """Quaternion (w, x, y, z), body to space, (times, 4), integrated in extended precision from the identity
    at t[0].
    """
    i1, i2, i3 = inertia

    def rhs(_, state):
        w, x, y, z, a, b, c = state
        return [
            (-x * a - y * b - z * c) / 2,
            (w * a + y * c - z * b) / 2,
            (w * b + z * a - x * c) / 2,
            (w * c + x * b - y * a) / 2,
            (i2 - i3) / i1 * b * c,
            (i3 - i1) / i2 * c * a,
            (i1 - i2) / i3 * a * b,
        ]

    return integrate(rhs, [1, 0, 0, 0, *w0], t)[:, :4]


def rotation(quaternion) -> np.ndarray:
    """Rotation matrices (..., 3, 3), body to space, of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
