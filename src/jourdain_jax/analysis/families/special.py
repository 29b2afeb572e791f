"""Special points between two neighbours of a curve: where a smooth test changes its sign.

fold of a named unknown     t_k = 0                       t: tangent
branch point                det (U'J; t) = 0              U: the rows that J holds independently, carried on from the neighbour
zero eigenvalue             s = 0, real
pair on the imaginary axis  Re s = 0, complex
double root                 (s_a - s_b)^2 = 0             a pair of real ones becomes complex, or the reverse
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from jourdain_jax.analysis.families.curve import Point
from jourdain_jax.analysis.families.equations import DOUBLE, Motions, Vector
from jourdain_jax.analysis.families.spectrum import are_partners

SURE = 1e-7  # relative to 1 + |s|: a real part, or a distance of two eigenvalues, that is not round-off


@dataclass(frozen=True)
class Crossing:
    """A test that changes its sign between two neighbours."""

    kind: str
    test: Callable[[Point], float]
    columns: tuple[int, ...] = ()  # of the eigenvalues concerned


def folds(here: Point, there: Point, unknowns: dict[str, int]) -> Iterator[Crossing]:
    """Folds of the named unknowns."""
    for name, k in unknowns.items():
        if here.tangent[k] * there.tangent[k] < 0 and min(abs(here.tangent[k]), abs(there.tangent[k])) > 1e-10:  # not round-off
            yield Crossing(f"fold in {name}", lambda p, k=k: p.tangent[k])


def branches(here: Point, there: Point) -> Iterator[Crossing]:
    """A branch point."""
    held = len(here.z) - 1
    U = np.linalg.svd(here.look.J)[0][:, :held]

    def test(point: Point) -> float:
        side = np.linalg.slogdet(np.vstack([U.T @ point.look.J, point.tangent]))[0]
        return float(side * np.linalg.svd(point.look.J, compute_uv=False)[held - 1])

    if test(here) * test(there) < 0:
        yield Crossing("branch point", test)


def changes(equations: Motions, here: Point, there: Point) -> Iterator[Crossing]:
    """Eigenvalues that pass zero or the imaginary axis, and pairs that meet."""
    before, now = here.modes, there.modes
    for k, (a, b) in enumerate(zip(equations.growth(before), equations.growth(now), strict=True)):
        if a * b < 0 and min(abs(a), abs(b)) > SURE * (1 + abs(before[k])) and before[k].imag >= 0 and (before[k].imag == 0) == (now[k].imag == 0):
            columns = tuple(np.flatnonzero(np.isin(before, (before[k], np.conj(before[k])))).tolist())
            yield Crossing(equations.crossing(before[k]), lambda point, k=k: float(equations.growth(point.modes)[k]), columns)
    for a, b in combinations(range(len(before)), 2):
        test = lambda point, a=a, b=b: float(((point.modes[a] - point.modes[b]) ** 2).real)  # noqa: E731
        values = test(here), test(there)
        least = (SURE * (1 + abs(before[a]))) ** 2
        if are_partners(before, now, a, b) and values[0] * values[1] < 0 and min(map(abs, values)) > least:
            yield Crossing(DOUBLE, test, (a, b))


def tangents_across(equations: Motions, z: Vector) -> list[Vector]:
    """Unit tangents of the two curves that cross at a branch point: a a' in its null space with l . R_zz a a = 0.

    R_zz by central differences of J; l: the left null vectors, of which only one has such a form that does not vanish.
    """
    look = equations(z)
    U, _, V = np.linalg.svd(look.J)
    left, null, h = U[:, look.J.shape[1] - 2 :], V[:-3:-1].T, 1e-4  # h: sizes of the unknowns
    of_a, of_b = ((equations(z + h * v).J - equations(z - h * v).J) @ null / (2 * h) for v in null.T)
    aa, ab, bb = np.linalg.svd(left.T @ np.column_stack([of_a, of_b[:, 1]]))[2][0]
    (low, high), axes = np.linalg.eigh([[aa, ab], [ab, bb]])
    if low * high >= 0:
        return [*null.T]
    return [null @ axes @ [np.sqrt(high), side * np.sqrt(-low)] / np.sqrt(high - low) for side in (1, -1)]
