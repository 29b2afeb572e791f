"""Continue a curve of steady motions: find its start, its points, its ends and its special points."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
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
from jourdain_jax.analysis.families.equations import Motions, Vector
from jourdain_jax.analysis.families.special_points import Test, dip, tangents_across, tests_between
from jourdain_jax.calculus.reals import all_finite, largest


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
        branch, *tests = (
            (tuple(map(test.of, three)), test.least)
            for test in tests_between(equations, here, there, turning)
        )
        beside = min(branch[0]) * max(branch[0]) < 0
        s = (
            None
            if beside
            else next((s for one in (branch, *tests) if (s := dip(at, *one)) is not None), None)
        )
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
            f"this {equations.what[:-1]} of `{scene}` is isolated: no freedom is left; hold "
            "fewer quantities, or name a parameter in `vary`"
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
    """Return the branch point at the guess, with the tangent of the other curve through it."""
    other = min(
        tangents_across(equations, equations.start), key=lambda t: abs(t @ tangent) / np.linalg.norm(tangent)
    )
    look = equations(equations.start)
    return Point(equations.start, other, look, equations.eigenvalues(look, other))
