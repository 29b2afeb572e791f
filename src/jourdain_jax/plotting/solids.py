"""Solid bodies from the outlines of a scene: balls, wheels, plates, boxes and bars as flat faces in the body frame.

An outline says what a body is: points at one distance from the mass centre are a ball, in a plane a wheel; closed lines in a plane are the rim of a plate;
a line through the mass centre or an open one is a bar along it; other points in space are the corners of a convex body.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

_ROUND = 1e-6  # of a body's size: a difference of lengths that counts as none


@dataclass(frozen=True)
class Face:
    """A flat polygon (corners, 3) in m, anticlockwise seen from outside, and how dark it is painted (0 to 1)."""

    corners: np.ndarray
    dark: float = 0.0


Part = list[Face]  # the faces of one convex piece, or nearly so: what lies before it hides it, and the other way round


def solid_of(outline: np.ndarray, thickness: float) -> list[Part]:
    """Parts of the body with this outline (points, 3) in m, body frame; a dot without one. `thickness` in m: of bars, half of it for plates."""
    points = np.asarray(outline, float)
    if len(points) < 2 or np.ptp(points, axis=0).max() == 0.0:
        return [_ball(0.9 * thickness)]
    lengths = np.linalg.norm(points, axis=1)
    size = lengths.max()
    rank = np.linalg.matrix_rank(points - points.mean(axis=0), tol=_ROUND * size)
    if rank == 3 and np.ptp(lengths) < _ROUND * size and len(points) > 20:
        return [_ball(size)]
    if rank == 2 and len(points) > 20 and np.ptp(lengths[:40]) < _ROUND * size:
        return [_wheel(points[:40], 0.1 * size)]
    if rank == 3 and lengths.min() > _ROUND * size:
        return [_hull(points)]
    if rank == 2 and np.linalg.norm(points[-1] - points[0]) < _ROUND * size and lengths.min() > _ROUND * size:
        return _plate(points[:-1], 0.25 * thickness)
    ends = pairwise(points)
    return [part for a, b in ends if np.linalg.norm(b - a) > _ROUND * size for part in bar(a, b, thickness / 2)]


def _ball(radius: float) -> Part:
    """A ball, its octants painted in turn, so that one sees it roll."""
    across, around = np.linspace(0, np.pi, 13), np.linspace(0, 2 * np.pi, 25)
    faces = []
    for i in range(12):
        for j in range(24):
            angles = [(across[i], around[j]), (across[i + 1], around[j]), (across[i + 1], around[j + 1]), (across[i], around[j + 1])]
            corners = [[np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)] for p, a in angles]
            faces.append(Face(radius * np.array(corners), 0.35 * ((i // 6 + j // 6) % 2)))
    return faces


def _wheel(circle: np.ndarray, half: float) -> Part:
    """A disc of some width, its quarters painted in turn, so that one sees it turn."""
    normal = np.cross(circle[0], circle[10])
    normal *= half / np.linalg.norm(normal)
    quarters = [(np.append(circle, circle[:1], axis=0)[k : k + 11], 0.35 * (k // 10 % 2)) for k in range(0, 40, 10)]
    faces = []
    for arc, dark in quarters:
        faces += [Face(np.array([normal, *(arc + normal)]), dark), Face(np.array([-normal, *(arc[::-1] - normal)]), dark)]
    return faces + [Face(np.array([a - normal, b - normal, b + normal, a + normal]), 0.5) for a, b in zip(circle, np.roll(circle, -1, axis=0), strict=True)]


def _plate(rim: np.ndarray, half: float) -> list[Part]:
    """A plate; one with four corners in tiles, so that what stands on it is seen."""
    normal = np.sum(np.cross(rim, np.roll(rim, -1, axis=0)), axis=0)
    normal *= half / np.linalg.norm(normal)
    tiles = [rim]
    if len(rim) == 4:
        steps = np.linspace(0.0, 1.0, 21)
        at = lambda r, s: (1 - r) * ((1 - s) * rim[0] + s * rim[3]) + r * ((1 - s) * rim[1] + s * rim[2])  # noqa: E731
        tiles = [np.array([at(r, s), at(q, s), at(q, t), at(r, t)]) for r, q in pairwise(steps) for s, t in pairwise(steps)]
    sides = [Face(np.array([a - normal, b - normal, b + normal, a + normal])) for a, b in zip(rim, np.roll(rim, -1, axis=0), strict=True)]
    return [*([Face(tile + normal), Face(tile[::-1] - normal)] for tile in tiles), *([side] for side in sides)]


def bar(a: np.ndarray, b: np.ndarray, radius: float) -> list[Part]:
    """A bar of round section from `a` to `b` (m) in pieces, so that nearer things hide no more than what is behind them."""
    along = (b - a) / np.linalg.norm(b - a)
    side = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    side /= np.linalg.norm(side)
    angle = np.linspace(0, 2 * np.pi, 9)[:, None]
    ring = radius * (np.cos(angle) * side + np.sin(angle) * np.cross(along, side))
    pieces = int(np.clip(np.linalg.norm(b - a) / (4 * radius), 1, 12))
    ends = [a + (b - a) * k / pieces for k in range(pieces + 1)]
    parts = []
    for p, q in pairwise(ends):
        sides = [Face(np.array([p + r, p + s, q + s, q + r])) for r, s in pairwise(ring)]
        parts.append([*sides, Face(p + ring[:0:-1]), Face(q + ring[1:])])
    return parts


def _hull(points: np.ndarray) -> Part:
    """Faces of the convex hull; triangles in one plane make one face."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    middle, faces = points[hull.vertices].mean(axis=0), []
    for equation in np.unique(np.round(hull.equations, 6), axis=0):
        members = np.unique(hull.simplices[np.all(np.abs(hull.equations - equation) < 2e-6, axis=1)])
        corners, normal = points[members], equation[:3]
        centre = corners.mean(axis=0)
        first = corners[0] - centre
        second = np.cross(normal, first)
        order = np.argsort(np.arctan2((corners - centre) @ second, (corners - centre) @ first))
        ordered = corners[order]
        faces.append(Face(ordered if (centre - middle) @ normal > 0 else ordered[::-1]))
    return faces
