"""Numerical tools of the oracles: integration, quadrature and a linear solve in extended precision.

`integrate` is Gragg's modified midpoint rule with Richardson extrapolation in even steps (Hairer, Norsett &
Wanner, Solving Ordinary Differential Equations I, II.9), run in numpy's long double: about 1e-17 per step
where that has 64 bits of mantissa (x86), about 1e-14 where it is plain double.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

LONG = np.longdouble
_STAGES = 9  # extrapolation columns; order 18
_TOLERANCE = max(1e-16, 300 * float(np.finfo(LONG).eps))


def _midpoint(rhs: Callable, t, y, slope, width, count: int):
    step = width / count
    before, now = y, y + step * slope
    for i in range(1, count):
        before, now = now, before + 2 * step * np.asarray(rhs(t + i * step, now), LONG)
    return (now + before + step * np.asarray(rhs(t + width, now), LONG)) / 2


def _extrapolated_step(rhs: Callable, t, y, width):
    """The state at t + width and the difference of the two best columns."""
    slope = np.asarray(rhs(t, y), LONG)
    counts = [LONG(2 * (j + 1)) for j in range(_STAGES)]
    row: list = []
    for j, count in enumerate(counts):
        column = [_midpoint(rhs, t, y, slope, width, int(count))]
        for k in range(1, j + 1):
            ratio = (count / counts[j - k]) ** 2
            column.append(column[k - 1] + (column[k - 1] - row[k - 1]) / (ratio - 1))
        row = column
    return row[-1], row[-1] - row[-2]


def integrate(rhs: Callable, start: Sequence, times: Sequence) -> np.ndarray:
    """States of y' = rhs(t, y) at `times` (the first is the time of `start`), shape (times, components),
    float64.

    `rhs` must keep long double (numpy functions, no float() and no float64 arrays inside).
    """
    t, y, width = LONG(times[0]), np.asarray(start, LONG), LONG(0.05)
    states = [y]
    for goal in times[1:]:
        goal = LONG(goal)
        sign = 1 if goal >= t else -1
        while t != goal:
            last = abs(goal - t) <= width
            trial = goal - t if last else sign * width
            new, difference = _extrapolated_step(rhs, t, y, trial)
            scale = np.maximum(1, np.maximum(np.abs(y), np.abs(new)))
            error = float(np.max(np.abs(difference) / scale))
            factor = 0.9 * (_TOLERANCE / max(error, 1e-30)) ** (1 / (2 * _STAGES - 1))
            if error <= _TOLERANCE:
                t, y = (goal, new) if last else (t + trial, new)
                width = width if last and factor > 1 else abs(trial) * LONG(min(3.0, factor))
            else:
                width = abs(trial) * LONG(max(0.1, min(0.8, factor)))  # also when the error is NaN
            if width < 1e-12:
                raise RuntimeError(f"step size vanished at t = {float(t)}")
        states.append(y)
    return np.array(states).astype(float)


def solve(matrix, right) -> np.ndarray:
    """Gauss elimination with row pivoting in long double (numpy's LAPACK stops at double)."""
    a = np.array(matrix, LONG)
    b = np.array(right, LONG)
    n = len(b)
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(a[k:, k])))
        if pivot != k:
            a[[k, pivot]], b[[k, pivot]] = a[[pivot, k]], b[[pivot, k]]
        for i in range(k + 1, n):
            factor = a[i, k] / a[k, k]
            a[i, k:] -= factor * a[k, k:]
            b[i] -= factor * b[k]
    x = np.zeros(n, LONG)
    for k in reversed(range(n)):
        x[k] = (b[k] - a[k, k + 1 :] @ x[k + 1 :]) / a[k, k]
    return x


def integral(function: Callable, times: Sequence) -> np.ndarray:
    """Integrals of `function` (of an array of times) from times[0] to each of `times`: Gauss-Legendre, 24
    points a panel.
    """
    nodes, weights = np.polynomial.legendre.leggauss(24)
    total, sums = 0.0, [0.0]
    for left, right in pairwise(times):
        edges = np.linspace(left, right, 1 + max(1, int(np.ceil(abs(right - left) / 0.25))))
        half, middle = np.diff(edges) / 2, (edges[1:] + edges[:-1]) / 2
        values = function((middle[:, None] + half[:, None] * nodes).ravel()).reshape(len(half), -1)
        total += float(np.sum(half * (values @ weights)))
        sums.append(total)
    return np.array(sums)
