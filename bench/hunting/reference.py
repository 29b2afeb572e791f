"""Slow references of many motions at once: Dormand and Prince's method of order 8 in NumPy, with steps halved until nothing changes.

Nothing here knows the engine. Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, 1993, II.5 (coefficients from SciPy).
"""

from collections.abc import Callable

import numpy as np
from scipy.integrate._ivp import dop853_coefficients as table

A, B, C = table.A[: table.N_STAGES, : table.N_STAGES], table.B, table.C[: table.N_STAGES]


def _step(rates: Callable, t, y, h):
    stages: list[np.ndarray] = []
    for i in range(table.N_STAGES):
        slope = sum((A[i, j] * stages[j] for j in range(i) if A[i, j]), np.zeros_like(y))
        stages.append(rates(t + C[i] * h, y + h[:, None] * slope))
    return y + h[:, None] * sum(b * k for b, k in zip(B, stages, strict=True) if b)


def _with_steps(rates: Callable, y0, t0, ts, width: float):
    y, t, found = y0, t0, []
    for i in range(ts.shape[1]):
        span = ts[:, i] - t
        count = max(1, int(np.ceil(np.max(np.abs(span)) / width)))
        for k in range(count):
            y = _step(rates, t + k / count * span, y, span / count)
        t = ts[:, i]
        found.append(y)
    return np.stack(found, axis=1)


def integrate(rates: Callable, y0: np.ndarray, ts: np.ndarray, *, t0=0.0, width: float = 0.05, close: float = 1e-11) -> np.ndarray:
    """States (cases, times, n) of y' = rates(t, y) from y0 (cases, n) at times ts (cases, times); steps of at most `width` s, halved until they agree to `close`.

    `rates(t, y)`: t (cases,), y (cases, n); y0 may be complex, for derivatives by a complex step. A case that does not settle is NaN.
    """
    t0 = np.broadcast_to(np.asarray(t0, float), ts.shape[:1])
    found = _with_steps(rates, y0, t0, ts, width)
    for _ in range(5):
        width /= 2
        with np.errstate(all="ignore"):
            before, found = found, _with_steps(rates, y0, t0, ts, width)
            off = np.nan_to_num(np.abs(found - before) / (1 + np.abs(found)), nan=np.inf)
        if not np.max(off) > close:
            return found
    found[np.max(off, axis=(1, 2)) > 1e3 * close] = np.nan
    return found


def along(value: Callable, x, direction) -> np.ndarray:
    """Derivative of an analytic `value` at x (a tuple of arrays) along `direction`, by a complex step: exact to round-off."""
    return np.imag(value(*(a + 1e-30j * d for a, d in zip(x, direction, strict=True)))) / 1e-30
