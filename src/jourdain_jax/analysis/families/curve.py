"""Follow curves of solutions by pseudo-arclength continuation (H. B. Keller, 1977), which can pass turning
points of an unknown.

    R(z) = 0,   t.(z - z_i) = s        t: unit tangent at z_i, J t = 0;   s: distance along it

Some rows are redundant, so every linear system is solved by singular values, and no product `J' J` is formed.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jourdain_jax.analysis.families.equations import Look, Modes, Motions, Vector, matched, surely_matched
from jourdain_jax.calculus.reals import all_finite, largest
from jourdain_jax.scene.coordinates import parameters_of

Targets = list[tuple[int, float]]  # indices of unknowns, and their values at which a curve ends
CLOSED = "the curve is closed"
# length of steps, in units of the unknowns' sizes; far from the origin LONGEST is relative to the distance
LONGEST, SHORTEST = 0.1, 1e-8  # tuning


@dataclass(frozen=True)
class Point:
    """Point of a curve, with the tangent and the equations there."""

    z: Vector
    tangent: Vector
    look: Look
    modes: Modes  # eigenvalues of small motions, in the same order as at the previous points
    hardness: int = 0  # number of corrections by Newton's method


def solved(
    equations: Motions,
    z: Vector,
    rows: Float[np.ndarray, "fixed unknowns"],
    targets: Float[np.ndarray, "fixed"],
    most: int = 8,
    longest: float = np.inf,
) -> tuple[Vector, Look, int] | None:
    """Solve R = 0 and `rows z = targets` by Newton's method. Return z, the equations there, and the number of
    corrections; None if the method does not converge.
    """
    for k in range(most):
        look = equations(z)
        if not (all_finite(look.R) and all_finite(look.J)):
            return None
        step = np.linalg.lstsq(np.vstack([look.J, rows]), -np.append(look.R, rows @ z - targets), rcond=1e-9)[
            0
        ]
        # round-off of R, which causes large steps near a branch point
        noise = 8 * np.finfo(float).eps * np.max(np.abs(look.J) @ np.abs(z))
        z = z + step * min(1.0, longest / max(largest(step), 1e-300))
        if largest(step) < 1e-11 * (1 + largest(z)) or largest(look.R) < noise:
            return z, look, k
    return None


def along(
    equations: Motions, point: Point, s: float, guess: Vector | None = None, with_modes: bool = True
) -> Point | None:
    """Return the point of the curve at the distance s along the tangent of `point`; None if it is not found.
    Unless `with_modes`, it gets the modes of `point`.
    """
    t = point.tangent
    found = solved(equations, point.z + s * t if guess is None else guess, t[None], t[None] @ point.z + s)
    if found is None:
        return None
    z, look, hardness = found
    across = np.linalg.svd(look.J)[2][-1]
    tangent = across * (1.0 if across @ t >= 0 else -1.0)
    modes = matched(point.modes, equations.eigenvalues(look, tangent)) if with_modes else point.modes
    return Point(z, tangent, look, modes, hardness)


def traced(equations: Motions, start: Point, targets: Targets, most: int) -> tuple[list[Point], str]:
    """Return the points of a curve from its start on, and the reason why it ends.

    A step is halved if the curve turns sharply, if many corrections are needed, or if eigenvalues change so
    much that they cannot be matched.
    """
    points, step, easy = [start], LONGEST / 10, 3
    while len(points) < most:
        here = points[-1]
        there = _next(equations, here, step, easy + 1)
        if there is None:
            step /= 2
            if step < SHORTEST:
                return (
                    points,
                    "no further point is found: the equations are undefined, or lose rank, beyond it",
                )
            continue
        reason = ""
        for k, target in targets:
            past = lambda point, k=k, target=target: point.z[k] - target
            if past(here) * past(there) <= 0:
                reason = f"{equations.unknowns[k]} is {target * equations.size[k]:g}"
            if past(here) * past(there) < 0:
                there = located(equations, here, there, past) or there
        if left := _left(equations, there):
            return points, left
        points.append(there)
        if reason:
            return points, reason
        if _closed(equations, start, here, there):
            points.append(replace(start, modes=matched(there.modes, start.modes)))
            return points, CLOSED
        reach = float(largest(there.z))
        if reach > 1e3:
            return points, "it continues without bound"
        if there.hardness <= easy:
            step = min(1.5 * step, LONGEST * max(1.0, reach))
    return points, f"{most} points"


def _left(equations: Motions, point: Point) -> str | None:
    """Return which parameter would have a forbidden sign at a point, so that the curve ends before it; None
    if all signs are allowed.
    """
    values = equations.values(point.z)
    for name, _, declared in parameters_of(equations.scene):
        if name in equations.vary and (
            (declared["positive"] and values[name] <= 0)
            or (declared["non_negative"] and values[name] < -1e-12)
        ):
            return (
                f"`{name}` is declared {'positive' if declared['positive'] else 'non-negative'}, but would be"
                f" {values[name]:.3g} at the next point"
            )
    return None


def _next(equations: Motions, here: Point, step: float, hardest: int) -> Point | None:
    """Return the point at the end of a step; None if the step must be halved."""
    there = along(equations, here, step)
    if there is None or there.hardness > hardest or here.tangent @ there.tangent < np.cos(np.deg2rad(10.0)):
        return None
    # after very short steps, nearly equal eigenvalues may be matched in any order
    sure = step < LONGEST / 1000 or surely_matched(here.modes, there.modes)
    return there if sure else None


def _closed(equations: Motions, first: Point, here: Point, there: Point) -> bool:
    """Return whether a step passes the start of the curve, so that the curve is closed."""
    s, step = here.tangent @ (first.z - here.z), np.linalg.norm(there.z - here.z)
    if not (0 < s <= step and np.linalg.norm(first.z - here.z - s * here.tangent) < 0.1 * step):
        return False
    back = along(equations, here, s, first.z)
    return back is not None and bool(largest(back.z - first.z) < 1e-7 and back.tangent @ first.tangent > 0)


def reversed_at(point: Point) -> Point:
    """Return the point with the opposite tangent."""
    return replace(point, tangent=-point.tangent)


def located(
    equations: Motions, here: Point, there: Point, test: Callable[[Point], float], with_modes: bool = False
) -> Point | None:
    """Return the point between two neighbours at which a smooth `test` changes its sign; None if the curve
    cannot be followed or the equations are undefined.

    The interval is divided repeatedly and finally interpolated linearly. It is not divided in the middle: by
    symmetry, branch points, where the equations lose rank, often lie there.
    """
    share, short = 0.4, 1e-6  # a piece this short differs from its chord by the square of its length
    (a, b), low, high = (0.0, float(here.tangent @ (there.z - here.z))), here, there
    at_a, at_b = test(low), test(high)
    while b - a > short:
        c = a + share * (b - a)
        # the chord is a better guess than the tangent, because another branch may be close
        middle = along(equations, here, c, low.z + share * (high.z - low.z), with_modes)
        if middle is None:
            return None
        value = test(middle)
        if (value > 0) == (at_a > 0):
            low, a, at_a = middle, c, value
        else:
            high, b, at_b = middle, c, value
    part = at_a / (at_a - at_b)
    z, tangent = (
        getattr(low, name) + part * (getattr(high, name) - getattr(low, name)) for name in ("z", "tangent")
    )
    look, tangent = equations(z), tangent / np.linalg.norm(tangent)
    if not all_finite(look.J):
        return None
    return Point(z, tangent, look, matched(low.modes, equations.eigenvalues(look, tangent)))
