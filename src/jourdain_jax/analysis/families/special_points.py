"""Detect special points between two neighbouring points of a curve: a smooth test function changes its sign.

    fold of a named unknown     t_k = 0                       t: tangent
    branch point                det (U'J; t) = 0              U: the independent rows of J, continued
    zero eigenvalue             s = 0, real
    pair on the imaginary axis  Re s = 0, complex
    double root                 (s_a - s_b)^2 = 0             two real eigenvalues become complex, or reverse

A test function may change its sign twice within a step. Therefore, if it keeps its sign but the parabola
through three neighbours nearly vanishes, it is evaluated there.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from jourdain_jax.analysis.families.curve import Point
from jourdain_jax.analysis.families.equations import DOUBLE, Motions, Vector, are_partners

SURE = 1e-7  # real parts and differences of eigenvalues above SURE (1 + |s|) are not round-off


@dataclass(frozen=True)
class Test:
    """Test function that changes its sign at special points of one kind. Above the magnitude `least`, its
    sign is reliable.
    """

    kind: str
    of: Callable[[Point], float]
    least: float
    columns: tuple[int, ...] = ()  # of the eigenvalues concerned

    def changes(self, here: Point, there: Point) -> bool:
        """Return whether the function changes its sign between two neighbours."""
        a, b = self.of(here), self.of(there)
        return a * b < 0 and min(abs(a), abs(b)) > self.least


def dip(at: tuple[float, ...], f: tuple[float, ...], least: float) -> float | None:
    """Return the position at which a test function nearly vanishes without changing its sign; None if there
    is none.

    The position is the minimum of the parabola through the values `f` at three neighbours. Positions `at` are
    relative to the second neighbour.
    """
    (before, _, after), (a, b, c) = at, f
    if min(f) * max(f) <= 0 or min(map(abs, f)) <= least or not before < 0 < after:
        return None
    low, high = (a - b) / before, (c - b) / after
    curvature = (high - low) / (after - before)
    slope = low - curvature * before
    s = -slope / (2 * curvature) if curvature * b > 0 else after
    near = min(abs(s - x) for x in at) < 1e-4 * (after - before)
    if before < s < after and not near and 1 + slope * s / (2 * b) < 0.02 * max(a / b, 1.0, c / b):
        return s
    return None


def tests_between(equations: Motions, here: Point, there: Point, unknowns: dict[str, int]) -> Iterator[Test]:
    """Yield the tests between two neighbouring points: for branch points, for folds of the named unknowns,
    and for eigenvalues.
    """
    held = len(here.z) - 1
    U = np.linalg.svd(here.look.J)[0][:, :held]

    def branch(point: Point) -> float:
        side = np.linalg.slogdet(np.vstack([U.T @ point.look.J, point.tangent]))[0]
        return float(side * np.linalg.svd(point.look.J, compute_uv=False)[held - 1])

    yield Test("branch point", branch, 0.0)
    for name, k in unknowns.items():
        yield Test(f"fold in {name}", lambda p, k=k: p.tangent[k], 1e-10)
    before, now = here.modes, there.modes
    for k, s in enumerate(before):
        if s.imag >= 0 and (s.imag == 0) == (now[k].imag == 0):
            columns = tuple(np.flatnonzero(np.isin(before, (s, np.conj(s)))).tolist())
            yield Test(
                equations.crossing(s),
                lambda p, k=k: float(equations.growth(p.modes)[k]),
                SURE * (1 + abs(s)),
                columns,
            )
    for a, b in combinations(range(len(before)), 2):
        if are_partners(before, now, a, b):
            yield Test(
                DOUBLE,
                lambda p, a=a, b=b: float(((p.modes[a] - p.modes[b]) ** 2).real),
                (SURE * (1 + abs(before[a]))) ** 2,
                (a, b),
            )


def tangents_across(equations: Motions, z: Vector) -> list[Vector]:
    """Return the unit tangents of the two curves that cross at a branch point: the vectors a in the null
    space of J with l . R_zz a a = 0.

    R_zz is a central difference of J. Only one of the left null vectors l gives a nonzero quadratic form.
    """
    look = equations(z)
    U, _, V = np.linalg.svd(look.J)
    left, null, h = U[:, look.J.shape[1] - 2 :], V[:-3:-1].T, 1e-4  # h: in sizes of the unknowns
    of_a, of_b = ((equations(z + h * v).J - equations(z - h * v).J) @ null / (2 * h) for v in null.T)
    aa, ab, bb = np.linalg.svd(left.T @ np.column_stack([of_a, of_b[:, 1]]))[2][0]
    (low, high), axes = np.linalg.eigh([[aa, ab], [ab, bb]])
    if low * high >= 0:
        return [*null.T]
    return [null @ axes @ [np.sqrt(high), side * np.sqrt(-low)] / np.sqrt(high - low) for side in (1, -1)]
