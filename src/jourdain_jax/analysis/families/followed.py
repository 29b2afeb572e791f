"""Following a curve of steady motions: where it begins, its eigenvalues, where it ends, and what is special on the way."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from jourdain_jax.analysis.families.curve import Point, along, located, reversed_at, traced
from jourdain_jax.analysis.families.equations import Look, SteadyEquations, Vector
from jourdain_jax.analysis.families.special import Crossing, branches, changes, folds, tangents_across
from jourdain_jax.analysis.families.spectrum import Modes, eigenvalues_at, matched
from jourdain_jax.calculus.reals import largest


@dataclass(frozen=True)
class Followed:
    """What a curve is followed by, and where it ends."""

    equations: SteadyEquations
    looked: Callable[[Vector], Look]  # with rows for what is held
    held: tuple[str, ...]  # their names
    targets: dict[int, tuple[str, float]]  # number of an unknown -> its name, and its value at the end in units of its size

    def freedoms(self, look: Look) -> np.ndarray:
        """Directions of (q, y) along which steady motions go on at the same parameters, in columns."""
        state = look.J.shape[1] - (self.equations.vary is not None)
        J, count = look.J[: len(self.equations.rows), :state], len(self.held) + (self.equations.vary is None)
        return self.equations.in_states(np.linalg.svd(J)[2][state - count :].T)

    def spectrum(self, point: Point) -> Modes:
        """Eigenvalues at a point, in any order, without the zeros of going on along the family or along what is held."""
        alone = not self.held and self.equations.vary is None
        return eigenvalues_at(point.look, self.equations.in_states(point.tangent[:, None]) if alone else self.freedoms(point.look))

    def ended(self, first: Point) -> Callable[[Point, Point], str]:
        """Whether the curve has reached what it is followed to, or its own start."""
        left = False  # whether it has gone away from its start

        def ended(here: Point, there: Point) -> str:
            nonlocal left
            for k, (name, target) in self.targets.items():
                if (here.z[k] - target) * (there.z[k] - target) <= 0:
                    return f"{name} is {target * self.equations.size[k]:g}"
            s, step = here.tangent @ (first.z - here.z), np.linalg.norm(there.z - here.z)
            if left and 0 < s <= step and np.linalg.norm(first.z - here.z - s * here.tangent) < 0.1 * step:
                back = along(self.looked, here, s, first.z)
                if back is not None and largest(back.z - first.z) < 1e-7 and back.tangent @ first.tangent > 0:
                    return "the curve is closed"
            left = left or here is not first
            return ""

        return ended

    def followed(self, begin: Point, most: int) -> tuple[list[Point], tuple[str, str]]:
        """All points, in order, and why the curve ends at the first and at the last of them."""
        ahead = [(target - begin.z[k]) * begin.tangent[k] for k, (_, target) in self.targets.items()]
        if (ahead[0] if ahead else begin.tangent[np.argmax(np.abs(begin.tangent))]) < 0:
            begin = reversed_at(begin)
        begin = replace(begin, modes=self.spectrum(begin))
        points, last = traced(self.looked, self.spectrum, begin, self.ended(begin), most)
        if last == "the curve is closed":
            return [*points, replace(begin, modes=matched(points[-1].modes, begin.modes))], (last, last)
        if self.targets:
            for k, (_, target) in self.targets.items() if len(points) > 1 else ():
                past = lambda p, k=k, target=target: p.z[k] - target  # noqa: E731
                if past(points[-2]) * past(points[-1]) < 0 and (end := located(self.looked, points[-2], points[-1], past)):
                    points[-1] = replace(end, modes=matched(points[-1].modes, self.spectrum(end)))
            return points, ("the start", last)
        back, first = traced(self.looked, self.spectrum, reversed_at(begin), self.ended(reversed_at(begin)), most)
        return [*(reversed_at(point) for point in reversed(back[1:])), *points], (first, last)

    def special(self, points: list[Point], turning: dict[str, int]) -> Iterator[tuple[Crossing, Point]]:
        """What is special between the points, in their order."""
        for here, there in pairwise(points):
            crossings = [*branches(here, there), *folds(here, there, turning), *changes(here, there, self.spectrum)]
            found = []
            for crossing in crossings:
                point = located(self.looked, here, there, crossing.test)
                found.append((crossing, point) if point else (replace(crossing, kind=f"{crossing.kind}, before this point"), there))
            branch = next((point for crossing, point in found if crossing.kind == "branch point"), None)
            if branch is not None:  # beside it tangents have few digits: what lies as close as this lies there
                found = [(crossing, branch if largest(point.z - branch.z) < 1e-4 else point) for crossing, point in found]
            yield from sorted(found, key=lambda pair: here.tangent @ (pair[1].z - here.z))


def with_held(equations: SteadyEquations, held: tuple[str, ...]) -> Callable[[Vector], Look]:
    """The equations with a row for every unknown that keeps its value."""
    if not held:
        return equations
    places = [equations.index(name) for name in held]
    rows, values = np.eye(len(equations.unknowns))[places], equations.start[places]

    def looked(z: Vector) -> Look:
        look = equations(z)
        return Look(np.append(look.R, z[places] - values), np.vstack([look.J, rows]), look.F, look.C)

    return looked


def first_point(looked: Callable, equations: SteadyEquations, named: list[str], kept: list[str]) -> Point:
    """The steady motion near the guess: what is named keeps its value as long as the rest can be found, then what is held or followed alone."""
    z, scene = equations.start, type(equations.scene).__name__
    for fixed in ([*named, *kept], kept):
        free = np.ones(len(z), bool)
        free[[equations.index(name) for name in fixed]] = False
        for _ in range(30):
            look = looked(z)
            if not (np.all(np.isfinite(look.R)) and np.all(np.isfinite(look.J))):
                raise ValueError(f"the equations of `{scene}` are undefined near the guess; start at another state")
            step = np.zeros(len(z))
            step[free] = np.linalg.lstsq(look.J[:, free], -look.R, rcond=1e-7)[0]
            z = z + step * min(1.0, 0.25 / max(largest(step), 1e-300))
            if largest(step) < 1e-12 * (1 + largest(z)):
                break
    look = looked(z)
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


def across(looked: Callable[[Vector], Look], z: Vector, tangent: Vector) -> Point:
    """The branch point z, with the tangent of the other curve through it."""
    other = min(tangents_across(looked, z), key=lambda t: abs(t @ tangent) / np.linalg.norm(tangent))
    return Point(z, other, looked(z))
