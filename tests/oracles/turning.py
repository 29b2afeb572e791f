"""A push along a heading that turns uniformly: heading h = h0 + w t, forward speed u = u0 + k * integral of
cos h.

The common core of the axle (S11, B1) and of the skate (B2). With x = w t,
    S = int cos h = t cos(h0 + x/2) sinc(x/2),   C = int sin h = t sin(h0 + x/2) sinc(x/2),
and all double integrals in terms of sinc and e(x) = (x - sin x)/x^2, so that nothing cancels at w = 0.
"""

import numpy as np


def _sinc(x):
    return np.sinc(np.asarray(x) / np.pi)


def _excess(x):
    """(x - sin x)/x^2, by its series below 0.7."""
    x = np.asarray(x, float)
    small = np.abs(x) < 0.7
    series, term = np.zeros_like(x), x / 6
    for n in range(1, 12):
        series = series + term
        term = -term * x**2 / ((2 * n + 2) * (2 * n + 3))
    safe = np.where(small, 1.0, x)
    return np.where(small, series, (safe - np.sin(safe)) / safe**2)


def push_while_turning(t, u0: float, k: float, heading0: float, rate: float) -> dict[str, np.ndarray]:
    """Heading, forward speed, path length s = int u, and x = int u cos h, y = int u sin h, all from zero."""
    t = np.asarray(t, float)
    x, cos0, sin0 = rate * t, np.cos(heading0), np.sin(heading0)
    middle = heading0 + x / 2
    along = t * np.cos(middle) * _sinc(x / 2)  # S
    across = t * np.sin(middle) * _sinc(x / 2)  # C
    double = t**2 * (cos0 * _sinc(x / 2) ** 2 / 2 - sin0 * _excess(x))  # int S
    sine, versine = t * _sinc(x), t * (x / 2) * _sinc(x / 2) ** 2  # sin(x)/w, (1 - cos x)/w
    mixed = t**2 * (_excess(2 * x) - _excess(x))  # int (versine cos x)
    # int S sin h, with S = cos0 sine - sin0 versine and sin h = sin0 cos x + cos0 sin x
    moment = (
        cos0 * sin0 * sine**2 / 2
        + cos0**2 * t**2 * _excess(2 * x)
        - sin0**2 * mixed
        - sin0 * cos0 * versine**2 / 2
    )
    return {
        "heading": heading0 + x,
        "u": u0 + k * along,
        "s": u0 * t + k * double,
        "x": u0 * along + k * along**2 / 2,
        "y": u0 * across + k * moment,
    }
