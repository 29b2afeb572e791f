"""Where a still picture stands: its camera, a plane with two axes in metres, or a floor with three."""

from dataclasses import dataclass

import numpy as np

_ROOM = np.array([36.0, 14.0])  # pixels, of a number
GROUND, GRID, SHADOW, INK = "#f4f4f1", "#d9d9d4", "#d3d3ce", "#444444"


@dataclass(frozen=True)
class Camera:
    """A parallel projection: unit vectors to the right and up in the picture, and from the scene towards the eye."""

    right: np.ndarray
    up: np.ndarray
    towards: np.ndarray

    @property
    def light(self) -> np.ndarray:
        """Unit vector towards the light: from over the eye's left shoulder."""
        light = 0.5 * self.towards - 0.45 * self.right + np.array([0.0, 0.0, 0.6])
        return light / np.linalg.norm(light)

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in the picture (..., 2), m."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


def camera_at(elevation, azimuth) -> Camera:
    """The camera that looks from this elevation and azimuth (degrees) at the scene."""
    e, a = np.radians(elevation), np.radians(azimuth)
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return Camera(np.array([-np.sin(a), np.cos(a), 0.0]), np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]), towards)


def draw_plane(axes, camera: Camera, corners: np.ndarray, upwards: str) -> None:
    """Axes x and `upwards` in m with a grid, around these corners (points, 3)."""
    axes.set_xlabel("x in m")
    axes.set_ylabel(upwards)
    axes.grid(color=GRID, lw=0.6)
    axes.set_axisbelow(True)
    _limits(axes, camera.flat(corners), 0.06)


def floor_under(low: np.ndarray, high: np.ndarray) -> float:
    """Height (m) of a floor under the box from `low` to `high`: z = 0 where bodies stand on it, else below them."""
    side = float(max(high - low))
    return 0.0 if -0.05 * side < low[2] < 0.2 * side else low[2] - 0.05 * side


def shadows(camera: Camera, polygons: list[np.ndarray], xs, ys, base: float) -> list[np.ndarray]:
    """Shadows (corners, 3) of polygons on the floor at height `base`, within the spans that `xs` and `ys` begin and end with."""
    fallen = [polygon - np.outer((polygon[:, 2] - base) / camera.light[2], camera.light) for polygon in polygons]
    return [np.column_stack([np.clip(p[:, 0], xs[0], xs[-1]), np.clip(p[:, 1], ys[0], ys[-1]), np.full(len(p), base)]) for p in fallen]


def draw_floor(axes, camera: Camera, corners: np.ndarray, polygons: list[np.ndarray]) -> None:
    """A tiled floor, shadows of the polygons on it, and three axes in m along its edges."""
    from matplotlib.collections import PolyCollection

    axes.set_axis_off()
    low, high = corners.min(axis=0), corners.max(axis=0)
    side, base = float(max(high - low)), floor_under(low, high)
    xs, ys = (_ticks(low[k], high[k], 0.25 * side, max(1, round(5 * (high[k] - low[k]) / side))) for k in range(2))
    zs = [z for z in _ticks(base, high[2], 0.15 * side, 3) if z >= base - 1e-9 * side]
    flat = lambda *point: camera.flat(np.array(point))  # noqa: E731
    rim = [(x, y) for x, y in ((xs[0], ys[0]), (xs[-1], ys[0]), (xs[-1], ys[-1]), (xs[0], ys[-1]))]
    axes.add_collection(PolyCollection([[flat(*corner, base) for corner in rim]], facecolors=GROUND, edgecolors=GRID, zorder=0))
    lines = [[flat(x, ys[0], base), flat(x, ys[-1], base)] for x in xs] + [[flat(xs[0], y, base), flat(xs[-1], y, base)] for y in ys]
    axes.add_collection(PolyCollection(lines, facecolors="none", edgecolors=GRID, linewidths=0.7, closed=False, zorder=1))
    inside = [camera.flat(shadow) for shadow in shadows(camera, polygons, xs, ys, base)]
    axes.add_collection(PolyCollection(inside, facecolors=SHADOW, edgecolors=SHADOW, linewidths=0.3, zorder=2))
    near_x, near_y = xs[-1] if camera.towards[0] > 0 else xs[0], ys[0] if camera.towards[1] < 0 else ys[-1]
    pole = min(rim, key=lambda corner: flat(*corner, base)[0])
    heights = np.array([flat(*pole, base), *(flat(*pole, z) for z in zs)])
    _limits(axes, np.concatenate([camera.flat(corners), heights, [flat(*corner, base) for corner in rim]]), 0.09)
    _edge(axes, [(x, flat(x, near_y, base)) for x in xs], "x in m", flat((xs[0] + xs[-1]) / 2, (ys[0] + ys[-1]) / 2, base))
    _edge(axes, [(y, flat(near_x, y, base)) for y in ys], "y in m", flat((xs[0] + xs[-1]) / 2, (ys[0] + ys[-1]) / 2, base))
    axes.plot(*heights.T, color=GRID, lw=0.9, zorder=1)
    for z, place in zip(zs, heights[1:], strict=True):
        if z > base + 0.05 * side:
            _text(axes, f"{z:g}", place, (-5, 0), ha="right", va="center")
    _text(axes, "z in m", heights[-1], (0, 6), ha="center", va="bottom")


def _ticks(low, high, least, most: int = 5) -> list[float]:
    """Round numbers that hold the span from `low` to `high` between them, widened to `least`."""
    from matplotlib.ticker import MaxNLocator

    wider = max(least - (high - low), 0.0) / 2
    return list(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low - wider, high + wider))


def _edge(axes, ticks: list, name: str, middle: np.ndarray) -> None:
    """Numbers along an edge of the floor, outside of it, and its name beyond them."""
    first, last = ticks[0][1], ticks[-1][1]
    away = (first + last) / 2 - middle
    aside = "right" if away[0] < 0 else "left"
    sign = -1 if aside == "right" else 1
    pixels, written = axes.transData.transform([place for _, place in ticks]), -np.inf
    for (value, place), pixel in list(zip(ticks, pixels, strict=True))[1 : -1 if len(ticks) > 3 else None]:
        if np.max(np.abs(pixel - written) / _ROOM) >= 1:
            _text(axes, f"{value:g}", place, (4 * sign, -4), ha=aside, va="top")
            written = pixel
    _text(axes, name, (first + last) / 2, (22 * sign, -18), ha=aside, va="top")


def _text(axes, text: str, place: np.ndarray, offset: tuple[int, int], ha: str, va: str) -> None:
    axes.annotate(text, place, xytext=offset, ha=ha, va=va, fontsize=8, color=INK, textcoords="offset points", annotation_clip=False)


def _limits(axes, flat: np.ndarray, margin: float) -> None:
    """Limits that hold these points (points, 2), with as much of the plane around them as the axes have room for at equal scales."""
    box = axes.get_position()
    width, height = np.multiply(axes.figure.get_size_inches(), (box.width, box.height))
    middle, span = (flat.min(axis=0) + flat.max(axis=0)) / 2, (1 + 2 * margin) * np.maximum(np.ptp(flat, axis=0), 1e-9)
    scale = max(span[0] / width, span[1] / height)
    axes.set_xlim(middle[0] - scale * width / 2, middle[0] + scale * width / 2)
    axes.set_ylim(middle[1] - scale * height / 2, middle[1] + scale * height / 2)
    axes.set_autoscale_on(False)
