"""Slow references of many motions at once: Dormand and Prince's method of order 8 in NumPy, with steps that
suit the worst of them.

Nothing here knows the engine. Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, 1993, II.5
and II.10 (coefficients from SciPy).
"""

import numpy as np
from scipy.integrate._ivp import dop853_coefficients as table

A, B, C = table.A[: table.N_STAGES, : table.N_STAGES], table.B, table.C[: table.N_STAGES]
CLOSE = 1e-12  # error of a step, relative to 1 + |y|
SHORTEST = 1e-7  # of a span: a motion that needs shorter steps is given up
MOST = 20_000  # steps


def integrate(rates, start, ts, *, t0=0.0, width=0.05):
    """States (n, cases, times) of y' = rates(t, *y) from n numbers at times ts (cases, times); first step
    `width` s.

    Every number, and the time, is a column of cases, (cases, 1). A start may be complex, for derivatives by a
    complex step. A case that is given up is NaN from then on.
    """
    y, t = (np.stack([np.broadcast_to(x, (len(ts), 1)) for x in some]) for some in (start, [t0]))
    t = t[0].astype(float)
    whole, found, left = ts[:, -1:] - t, [], MOST
    part = min(
        1.0, width / max(float(np.max(np.abs(whole))), 1e-300)
    )  # length of a step, as a part of the whole span
    with np.errstate(all="ignore"):
        for stop in ts.T[:, :, None]:
            done, span = 0.0, stop - t
            share = float(np.max(np.abs(span) / np.maximum(np.abs(whole), 1e-300)))
            while done < 1.0 and share > 0:
                step = min(part / share, 1.0 - done)
                new, off = _step(rates, t + done * span, y, step * span)
                worst = float(np.max(off, initial=0.0))
                left -= 1
                if worst > 1.0 and step * share > SHORTEST and left > 0:
                    part = step * share * max(0.2, 0.9 * worst**-0.125)
                    continue
                y = np.where(off > 1.0, np.nan, new)
                done = 1.0 if 1.0 - done - step < 1e-14 else done + step
                part = (
                    max(part, step * share * min(5.0, 0.9 * max(worst, 1e-9) ** -0.125))
                    if worst <= 1.0
                    else 1e-3
                )
            t = stop
            found.append(y)
    return np.concatenate(found, axis=-1)


def _step(rates, t, y, h):
    """The next state, and its error (cases, 1) relative to what is let pass; zero where a case was given
    up.
    """
    stages = []
    at = lambda t, y: np.stack([np.broadcast_to(x, t.shape) for x in rates(t, *y)])
    for i in range(table.N_STAGES):
        slope = sum((A[i, j] * stages[j] for j in range(i) if A[i, j]), np.zeros_like(y))
        stages.append(at(t + C[i] * h, y + h * slope))
    new = y + h * sum(b * k for b, k in zip(B, stages, strict=True) if b)
    stages.append(at(t + h, new))
    fifth, third = (
        np.abs(h * sum(e * k for e, k in zip(row, stages, strict=True) if e)) for row in (table.E5, table.E3)
    )
    scale = CLOSE * (1 + np.maximum(np.abs(y), np.abs(new)))
    off = np.max(fifth**2 / np.sqrt(fifth**2 + 0.01 * third**2 + 1e-300) / scale, axis=0)
    given_up = ~np.all(np.isfinite(y), axis=0)
    return new, np.where(given_up, 0.0, np.nan_to_num(off, nan=1e30, posinf=1e30))


def along(value, x, direction):
    """Derivative of an analytic `value` at x (a tuple of arrays) along `direction`, by a complex step: exact
    to round-off.
    """
    return np.imag(value(*(a + 1e-30j * d for a, d in zip(x, direction, strict=True)))) / 1e-30
