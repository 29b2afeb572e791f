"""Following a curve of steady motions: where it begins, its eigenvalues, where it ends, and what is special on the way."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from jourdain_jax.analysis.families.curve import CLOSED, Point, Targets, located, reversed_at, traced
from jourdain_jax.analysis.families.equations import SteadyEquations, Vector
from jourdain_jax.analysis.families.special import Crossing, branches, changes, folds, tangents_across
from jourdain_jax.calculus.reals import largest


def followed(equations: SteadyEquations, begin: Point, targets: Targets, most: int) -> tuple[list[Point], tuple[str, str]]:
    """All points of a curve, in order, and why it ends at the first and at the last of them; towards the targets alone, where there are some."""
    ahead = [(target - begin.z[k]) * begin.tangent[k] for k, target in targets]
    if (ahead[0] if ahead else begin.tangent[np.argmax(np.abs(begin.tangent))]) < 0:
        begin = reversed_at(begin)
    begin = replace(begin, modes=equations.eigenvalues(begin.look, begin.tangent))
    points, last = traced(equations, begin, targets, most)
    if last == CLOSED or targets:
        return points, (last if last == CLOSED else "the start", last)
    back, first = traced(equations, reversed_at(begin), targets, most)
    return [*(reversed_at(point) for point in reversed(back[1:])), *points], (first, last)


def special(equations: SteadyEquations, points: list[Point], turning: dict[str, int]) -> Iterator[tuple[Crossing, Point]]:
    """What is special between the points, in their order."""
    for here, there in pairwise(points):
        found = []
        for crossing in (*branches(here, there), *folds(here, there, turning), *changes(equations, here, there)):
            point = located(equations, here, there, crossing.test)
            found.append((crossing, point) if point else (replace(crossing, kind=f"{crossing.kind}, before this point"), there))
        branch = next((point for crossing, point in found if crossing.kind == "branch point"), None)
        if branch is not None:  # beside it tangents have few digits: what lies as close as this lies there
            found = [(crossing, branch if largest(point.z - branch.z) < 1e-4 else point) for crossing, point in found]
        yield from sorted(found, key=lambda pair: here.tangent @ (pair[1].z - here.z))


def first_point(equations: SteadyEquations, named: list[str], kept: list[str]) -> Point:
    """The steady motion near the guess: what is named keeps its value as long as the rest can be found, then what is held or followed alone."""
    z, scene = equations.start, type(equations.scene).__name__
    for fixed in ([*named, *kept], kept):
        free = np.ones(len(z), bool)
        free[[equations.index(name) for name in fixed]] = False
        for _ in range(30):
            look = equations(z)
            if not (np.all(np.isfinite(look.R)) and np.all(np.isfinite(look.J))):
                raise ValueError(f"the equations of `{scene}` are undefined near the guess; start at another state")
            step = np.zeros(len(z))
            step[free] = np.linalg.lstsq(look.J[:, free], -look.R, rcond=1e-7)[0]
            z = z + step * min(1.0, 0.25 / max(largest(step), 1e-300))
            if largest(step) < 1e-12 * (1 + largest(z)):
                break
    look = equations(z)
    if largest(look.R) > 1e-9:
        raise ValueError(f"no steady motion of `{scene}` is found near the guess (residual {largest(look.R):.1e}); `jj.steady` may find one from afar")
    sigma, V = np.linalg.svd(look.J)[1:]
    sigma = np.append(sigma, np.zeros(len(z) - len(sigma)))
    count = int(np.sum(sigma < 1e-8 * sigma[0]))
    if count == 0:
        raise ValueError(f"this steady motion of `{scene}` stands alone: no freedom is left; hold less, or name a parameter by `vary`")
    if count > 1:
        free = [f"`{name}`" for name, share in zip(equations.unknowns, np.linalg.norm(V[-count:], axis=0), strict=True) if share > 1e-3]
        raise ValueError(
            f"the steady motions of `{scene}` near this one have {count} freedoms, and a family has one: name {count - 1} of {', '.join(free)} in `held`, "
            "or start beside a branch point"
        )
    return Point(z, V[-1], look)


def across(equations: SteadyEquations, tangent: Vector) -> Point:
    """The branch point at the guess, with the tangent of the other curve through it."""
    other = min(tangents_across(equations, equations.start), key=lambda t: abs(t @ tangent) / np.linalg.norm(tangent))
    return Point(equations.start, other, equations(equations.start))
