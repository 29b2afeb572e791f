"""Planar double pendulum of two point masses: Lagrange's equations in angles, integrated in extended
precision.

x to the right, y up, pivot at the origin; theta_k from straight down, counterclockwise: r1 = l1 (sin th1,
-cos th1),
r2 = r1 + l2 (sin th2, -cos th2).
"""

import numpy as np

from .reference import integrate

RUN = {
    "m1": 1.0,
    "m2": 0.7,
    "l1": 1.0,
    "l2": 0.8,
    "gravity": 9.81,
    "th1": 0.8,
    "th2": -0.4,
    "th1_rate": 0.3,
    "th2_rate": 0.5,
    "t_end": 5.0,
}


def motion(t, *, m1, m2, l1, l2, gravity, th1, th2, th1_rate, th2_rate, t_end=None) -> dict[str, np.ndarray]:
    """th1, th2, th1_rate, th2_rate, x1, y1, x2, y2, vx1, vy1, vx2, vy2, tension1, tension2 (> 0: the rod
    pulls), energy.
    """

    def accelerations(p, q, u, v):
        # (m1 + m2) l1 p'' + m2 l2 cos(p - q) q'' = -m2 l2 sin(p - q) v^2 - (m1 + m2) g sin p
        # l1 cos(p - q) p'' + l2 q'' = l1 sin(p - q) u^2 - g sin q
        c, s = np.cos(p - q), np.sin(p - q)
        first = -m2 * l2 * s * v**2 - (m1 + m2) * gravity * np.sin(p)
        second = l1 * s * u**2 - gravity * np.sin(q)
        p_acc = (first - m2 * c * second) / (l1 * (m1 + m2 - m2 * c * c))
        return p_acc, (second - l1 * c * p_acc) / l2

    p, q, u, v = integrate(lambda _, y: [y[2], y[3], *accelerations(*y)], [th1, th2, th1_rate, th2_rate], t).T
    p_acc, q_acc = accelerations(p, q, u, v)
    x1, y1 = l1 * np.sin(p), -l1 * np.cos(p)
    vx1, vy1 = l1 * u * np.cos(p), l1 * u * np.sin(p)
    vx2, vy2 = vx1 + l2 * v * np.cos(q), vy1 + l2 * v * np.sin(q)
    x2, y2 = x1 + l2 * np.sin(q), y1 - l2 * np.cos(q)
    ax1, ay1 = l1 * (p_acc * np.cos(p) - u**2 * np.sin(p)), l1 * (p_acc * np.sin(p) + u**2 * np.cos(p))
    ax2 = ax1 + l2 * (q_acc * np.cos(q) - v**2 * np.sin(q))
    ay2 = ay1 + l2 * (q_acc * np.sin(q) + v**2 * np.cos(q))
    tension2 = m2 * (-ax2 * np.sin(q) + (ay2 + gravity) * np.cos(q))
    tension1 = m1 * (-ax1 * np.sin(p) + (ay1 + gravity) * np.cos(p)) + tension2 * np.cos(p - q)
    energy = (m1 * (vx1**2 + vy1**2) + m2 * (vx2**2 + vy2**2)) / 2 + gravity * (m1 * y1 + m2 * y2)
    return {
        "th1": p, "th2": q, "th1_rate": u, "th2_rate": v, "x1": x1, "y1": y1, "x2": x2, "y2": y2,
        "vx1": vx1, "vy1": vy1, "vx2": vx2, "vy2": vy2,
        "tension1": tension1, "tension2": tension2, "energy": energy,
    }  # fmt: skip
