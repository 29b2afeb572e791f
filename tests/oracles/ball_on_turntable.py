"""Ball rolling on a turning plane, flat or tilted (B8). Fowler; Weltner, Am. J. Phys. 47 (1979) 984; inertia
kap m r^2.

Axes of the plane: z its normal, x downhill, the plane turns at Om about z through the origin. R'' = n z x R'
+ G/(1 + kap),
n = Om kap/(1 + kap), G = g sin(tilt) along +x. Body rates are components on the plane's (non-turning) axes;
the contact point of the ball moves with the plane: wx = (Om X - Vy)/r, wy = (Vx + Om Y)/r, wz constant. For
Om > 0 the drift is along +y.
"""

import numpy as np

RUN = {
    "radius": 0.05,
    "turn_rate": 2.0,
    "tilt": 0.1,
    "gravity": 9.81,
    "inertia_ratio": 0.4,
    "x0": 0.2,
    "y0": 0.0,
    "vx0": 0.1,
    "vy0": 0.3,
    "wz": 1.0,
    "t_end": 10.0,
}
RUN_FLAT = {**RUN, "tilt": 0.0}


def motion(
    t, *, radius, turn_rate, tilt, gravity, inertia_ratio, x0, y0, vx0, vy0, wz=0.0, mass=None, t_end=None
) -> dict[str, np.ndarray]:
    """x, y, vx, vy of the centre and the angular velocity wx, wy, wz."""
    t = np.asarray(t, float)
    n = turn_rate * inertia_ratio / (1 + inertia_ratio)
    push = gravity * np.sin(tilt) / (1 + inertia_ratio)
    position, velocity = complex(x0, y0), complex(vx0, vy0)
    if n == 0.0:
        speed = velocity + push * t
        place = position + velocity * t + push * t**2 / 2
    else:
        drift = 1j * push / n
        # (exp(i n t) - 1)/(i n) without cancellation at small n t
        arc = t * np.sinc(n * t / (2 * np.pi)) * np.exp(1j * n * t / 2)
        speed = drift + (velocity - drift) * np.exp(1j * n * t)
        place = position + drift * t + (velocity - drift) * arc
    return {
        "x": place.real,
        "y": place.imag,
        "vx": speed.real,
        "vy": speed.imag,
        "wx": (turn_rate * place.real - speed.imag) / radius,
        "wy": (speed.real + turn_rate * place.imag) / radius,
        "wz": wz + 0 * t,
    }
