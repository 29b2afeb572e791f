"""Bodies as flat faces for matplotlib: every shape in convex pieces, or nearly so, in space."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from jourdain_jax.plotting.looks import DrawnBody, Look
from jourdain_jax.scene.visuals import Visual

_FLAT = 0.05  # a mesh so thin, of its size, is a plate


@dataclass(frozen=True)
class Face:
    """A flat polygon (corners, 3) in m, anticlockwise seen from outside, and how dark it is painted (0 to 1)."""

    corners: np.ndarray
    dark: float = 0.0

    def normal(self) -> np.ndarray:
        """Unit vector out of the face; zero where it has no area."""
        c = self.corners
        area = np.sum(np.cross(c[1:-1] - c[0], c[2:] - c[0]), axis=0)
        return area / max(float(np.linalg.norm(area)), 1e-300)


Part = list[Face]  # the faces of one convex piece, or nearly so: what lies before it hides it, and the other way round


def shaded(face: Face, colour: str, light: np.ndarray, opacity: float = 1.0, strength: float = 1.0) -> tuple[float, ...]:
    """Red, green, blue and opacity of a face of this "#rrggbb" in this `light` (unit vector towards it); `strength` below 1: paler."""
    shade = (0.62 + 0.38 * max(float(face.normal() @ light), 0.0)) * (1 - face.dark)
    return (*(1 - strength * (1 - shade * rgb(colour))), opacity)


def rgb(colour: str) -> np.ndarray:
    """Red, green and blue, 0 to 1, of a colour "#rrggbb"."""
    return np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])


def parts_in_space(body: DrawnBody, k: int) -> list[tuple[Look, Part]]:
    """The parts of a body at the time with number `k`, in space, with the looks that they belong to."""
    found = []
    for look in body.looks:
        parts, turn, at = parts_of(look, k), body.orientations[k], body.positions[k]
        if look.visual.kind != "line":
            turn, at = turn @ look.orientations[k], turn @ look.positions[k] + at
        found += [(look, [Face(face.corners @ turn.T + at, face.dark) for face in part]) for part in parts]
    return found


def parts_of(look: Look, k: int) -> list[Part]:
    """Parts of a shape at the time with number `k`, in its own axes; of a line, in those of its body."""
    visual, size = look.visual, np.asarray(look.visual.size)
    if visual.kind == "line":
        return [part for a, b in pairwise(look.points[k]) if np.linalg.norm(b - a) > 0 for part in bar(a, b, look.radius)]
    if visual.kind == "ellipsoid":
        return [_ball(size)]
    if visual.kind == "wheel":
        return [_round([(size[0], -size[1] / 2), (size[0], size[1] / 2)], 40, painted=True)]
    if visual.kind == "cylinder":
        return [_round([(size[0], -size[1] / 2), (size[0], size[1] / 2)], 24)]
    if visual.kind == "capsule":
        bow = [(size[0] * np.sin(a), size[1] / 2 - size[0] * np.cos(a)) for a in np.linspace(np.pi / 2, np.pi, 5)[:-1]]
        return [_round([(r, -z) for r, z in reversed(bow)] + bow, 24)]
    if visual.kind == "box":
        return _tiled([Face(size / 2 * corners) for corners in _CUBE], size)
    return _mesh(visual)


_CUBE = [np.roll(np.array([[side, side * a, b] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))], float), k, axis=1) for k in range(3) for side in (-1, 1)]


def _mesh(visual: Visual) -> list[Part]:
    corners = visual.faces.corners * np.asarray(visual.size)  # type: ignore[union-attr]
    return _tiled([Face(corners[list(polygon)]) for polygon in visual.faces.polygons], np.ptp(corners, axis=0))  # type: ignore[union-attr]


def _tiled(faces: Part, sides: np.ndarray) -> list[Part]:
    """One part; of a plate every face is one, those with four corners in tiles, so that what stands on it is seen."""
    if sides.min() > _FLAT * sides.max():
        return [faces]
    steps, parts = np.linspace(0.0, 1.0, 21), []
    for face in faces:
        rim = face.corners
        if len(rim) != 4 or min(np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1)) < _FLAT * sides.max():
            parts.append([face])
            continue
        at = lambda r, s, rim=rim: (1 - r) * ((1 - s) * rim[0] + s * rim[3]) + r * ((1 - s) * rim[1] + s * rim[2])  # noqa: E731
        parts += [[Face(np.array([at(r, s), at(q, s), at(q, t), at(r, t)]))] for r, q in pairwise(steps) for s, t in pairwise(steps)]
    return parts


def _ball(semi_axes: np.ndarray) -> Part:
    """An ellipsoid, its octants painted in turn, so that one sees it roll."""
    across, around = np.linspace(0, np.pi, 13), np.linspace(0, 2 * np.pi, 25)
    faces = []
    for i in range(12):
        for j in range(24):
            angles = [(across[i], around[j]), (across[i + 1], around[j]), (across[i + 1], around[j + 1]), (across[i], around[j + 1])]
            corners = [[np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)] for p, a in angles]
            faces.append(Face(semi_axes * np.array(corners), 0.35 * ((i // 6 + j // 6) % 2)))
    return faces


def _round(profile: list, around: int, painted: bool = False) -> Part:
    """A body of revolution about z with a `profile` (radius, z) from below, closed by flat ends; painted: a dark tread, and quarters in turn."""
    angle = np.linspace(0, 2 * np.pi, around + 1)
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full_like(angle, z)], axis=1) for r, z in profile]
    tread = 0.5 if painted else 0.0
    faces = [Face(np.array([low[n], low[n + 1], high[n + 1], high[n]]), tread) for low, high in pairwise(rings) for n in range(around)]
    quarter = around // 4
    for ring, order in ((rings[0], -1), (rings[-1], 1)):
        centre = np.array([0.0, 0.0, ring[0, 2]])
        for n in range(4) if painted else ():
            arc = np.array([centre, *ring[n * quarter : (n + 1) * quarter + 1]])
            faces.append(Face(arc if order > 0 else arc[::-1], 0.35 * (n % 2)))
        if not painted:
            faces.append(Face(ring[:-1][::order]))
    return faces


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
