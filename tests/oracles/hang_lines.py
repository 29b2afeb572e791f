"""Mass centre of a hung part as the published parameters take it: the mean over all pairs of upright lines of
where the two meet.

Source: J. K. Moore, Human control of a bicycle, Ph.D. thesis, Davis (2012), section 4.5. A line through (x,
z), from where the part hangs by:
x sin b + z cos b = -a, b = lam - alpha.
"""

from itertools import combinations

import numpy as np


def mean_of_intersections(alpha: np.ndarray, a: np.ndarray, lam: float) -> np.ndarray:
    """(x, z) in m, from slopes of the steer axis (rad) and places of the rod (m)."""
    rows = np.stack([np.sin(lam - alpha), np.cos(lam - alpha)], axis=1)
    return np.mean(
        [np.linalg.solve(rows[[i, j]], -a[[i, j]]) for i, j in combinations(range(len(a)), 2)], axis=0
    )
