"""Detect special points between two neighbouring points of a curve: a smooth test function changes its sign.

    fold of a named unknown     t_k = 0                       t: tangent
    branch point                det (U'J; t) = 0              U: the independent rows of J, continued
    zero eigenvalue             s = 0, real
    pair on the imaginary axis  Re s = 0, complex
    double root                 (s_a - s_b)^2 = 0             two real eigenvalues become complex, or reverse

A test function may change its sign twice within a step. Therefore, if it keeps its sign but the parabola
through three neighbours nearly vanishes, it is evaluated there.

The module also finds the start of a curve of steady motions, and follows it to its ends.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from jourdain_jax.analysis.families.curve import (
    CLOSED,
    Point,
    Targets,
    along,
    located,
    reversed_at,
    solved,
    traced,
)
from jourdain_jax.analysis.families.equations import DOUBLE, Motions, Vector, partners
from jourdain_jax.calculus.reals import all_finite, largest

SURE = 1e-7  # numerics: real parts and differences of eigenvalues above SURE (1 + |s|) are not round-off


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
    (before, _, after), (a, b, c) = at, map(abs, f)
    if min(f) * max(f) <= 0 or min(a, b, c) <= least or not before < 0 < after:
        return None
    low, high = (a - b) / before, (c - b) / after
    curvature = (high - low) / (after - before)
    slope = low - curvature * before
    s = -slope / (2 * curvature) if curvature > 0 else after
    near = min(abs(s - x) for x in at) < 1e-4 * (after - before)
    return s if before < s < after and not near and b + slope * s / 2 < 0.02 * max(a, b, c) else None


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
            growth = lambda p, k=k: float(equations.growth(p.modes)[k])
            yield Test(equations.crossing(s), growth, SURE * (1 + abs(s)), columns)
    for a, b in np.argwhere(np.triu(partners(before, now))).tolist():
        square = lambda p, a=a, b=b: float(((p.modes[a] - p.modes[b]) ** 2).real)
        yield Test(DOUBLE, square, (SURE * (1 + abs(before[a]))) ** 2, (a, b))


def followed(
    equations: Motions, begin: Point, targets: Targets, most: int
) -> tuple[list[Point], tuple[str, str]]:
    """Return all points of a curve in order, and the reasons why it ends on either side. If there are
    targets, the curve is followed only towards them.
    """
    ahead = [(target - begin.z[k]) * begin.tangent[k] for k, target in targets]
    if (ahead[0] if ahead else begin.tangent[np.argmax(np.abs(begin.tangent))]) < 0:
        begin = reversed_at(begin)
    points, last = traced(equations, begin, targets, most)
    if last == CLOSED or targets:
        return points, (last if last == CLOSED else "the start", last)
    back, first = traced(equations, reversed_at(begin), targets, most)
    return [*(reversed_at(point) for point in reversed(back[1:])), *points], (first, last)


def special(
    equations: Motions, points: Sequence[Point], turning: dict[str, int]
) -> Iterator[tuple[Test, Point]]:
    """Yield the special points between the points of a curve, in order, each with its test."""
    for here, there in pairwise(_with_dips(equations, points, turning)):
        found = []
        for test in tests_between(equations, here, there, turning):
            if test.changes(here, there):
                point = located(equations, here, there, test.of, bool(test.columns))
                found.append(
                    (test, point) if point else (replace(test, kind=f"{test.kind}, before this point"), there)
                )
        branch = next((point for test, point in found if test.kind == "branch point"), None)
        # near a branch point tangents lose digits, so special points this close count as the branch point
        if branch is not None:
            found = [(test, branch if largest(point.z - branch.z) < 1e-4 else point) for test, point in found]
        yield from sorted(found, key=lambda pair: here.tangent @ (pair[1].z - here.z))


def _with_dips(equations: Motions, points: Sequence[Point], turning: dict[str, int]) -> list[Point]:
    """Insert a point wherever a test nearly vanishes between two points, except near branch points: the test
    may vanish twice there, at two special points.
    """
    points, k = list(points), 1
    while k < len(points) - 1:
        _, here, there = three = points[k - 1 : k + 2]
        at = tuple(float(here.tangent @ (point.z - here.z)) for point in three)
        branch, *tests = tests_between(equations, here, there, turning)
        places = (dip(at, tuple(map(test.of, three)), test.least) for test in (branch, *tests))
        at_branch = min(map(branch.of, three)) * max(map(branch.of, three)) < 0
        s = None if at_branch else next((s for s in places if s is not None), None)
        new = None if s is None else along(equations, here, s)
        if s is None or new is None:
            k += 1
        else:
            points.insert(k + (s > 0), new)
    return points


def first_point(equations: Motions, named: list[str], kept: list[str]) -> Point:
    """Return the motion near the guess. It keeps all `named` values if possible, otherwise only the `kept`
    ones (held or followed).
    """
    z, scene, look = equations.start, type(equations.scene).__name__, equations(equations.start)
    if not all_finite(look.R):
        raise ValueError(f"the equations of `{scene}` are undefined near the guess; start at another state")
    for fixed in ([*named, *kept], kept):
        rows = np.eye(len(z))[[equations.index(name) for name in fixed]]
        found = solved(equations, z, rows, rows @ z, 30, 0.25)
        if found and largest(found[1].R) < 1e-9:
            break
    else:
        raise ValueError(
            f"no {equations.what[:-1]} of `{scene}` was found near the guess; search farther with `jj.steady`"
        )
    z, look, _ = found
    sigma, V = np.linalg.svd(look.J)[1:]
    count = len(z) - int(np.sum(sigma >= 1e-8 * sigma[0]))
    if count == 0:
        raise ValueError(
            f"this {equations.what[:-1]} of `{scene}` is isolated: no degree of freedom is left; "
            "hold fewer quantities, or name a parameter in `vary`"
        )
    if count > 1:
        free = [
            f"`{name}`"
            for name, share in zip(equations.unknowns, np.linalg.norm(V[-count:], axis=0), strict=True)
            if share > 1e-3
        ]
        raise ValueError(
            f"the {equations.what} of `{scene}` near this one have {count} freedoms, but a family has one: "
            f"name {count - 1} of {', '.join(free)} in `held`, or start next to a branch point"
        )
    return Point(z, V[-1], look, equations.eigenvalues(look, V[-1]))


def across(equations: Motions, tangent: Vector) -> Point:
    """Return the branch point at the guess, with the unit tangent of the other curve through it.

    The tangents of both curves are the vectors a in the null space of J with l . R_zz a a = 0. R_zz is a
    central difference of J. Only one of the left null vectors l gives a nonzero quadratic form. If it has
    no such zeros, the null vectors themselves are taken.
    """
    z = equations.start
    look = equations(z)
    U, _, V = np.linalg.svd(look.J)
    left, null, h = U[:, look.J.shape[1] - 2 :], V[:-3:-1].T, 1e-4  # h: in sizes of the unknowns
    of_a, of_b = ((equations(z + h * v).J - equations(z - h * v).J) @ null / (2 * h) for v in null.T)
    aa, ab, bb = np.linalg.svd(left.T @ np.column_stack([of_a, of_b[:, 1]]))[2][0]
    (low, high), axes = np.linalg.eigh([[aa, ab], [ab, bb]])
    if low * high < 0:
        a, b = np.sqrt([high, -low] / (high - low))
        null = null @ axes @ [[a, a], [b, -b]]
    other = min(null.T, key=lambda t: abs(t @ tangent))
    return Point(z, other, look, equations.eigenvalues(look, other))
