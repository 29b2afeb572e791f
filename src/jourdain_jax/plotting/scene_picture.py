"""A drawing of a scene at its example start, as SVG: what a notebook shows beside its parameters. Nothing but NumPy is needed, nothing is loaded."""

from itertools import groupby

import numpy as np

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.motion.start import start
from jourdain_jax.plotting.looks import looks_at
from jourdain_jax.plotting.solids import parts_in_space
from jourdain_jax.plotting.still import VIEWS, lit
from jourdain_jax.plotting.still_axes import GRID, GROUND, SHADOW, camera_at, floor_under, shadows

_WIDE, _HIGH, _RIM = 300, 190, 6  # pixels


def scene_svg(scene) -> str:
    """The bodies of a scene where its `example` puts them, in space, on a floor with their shadows; empty where there is none to draw.

    A scene that cannot be started has no picture: a notebook displays what is still being written, and `jj.start` says what is wrong.
    """
    if is_traced(scene):
        return ""
    try:
        drawn = looks_at(scene, start(scene, **scene.example))
    except Exception:  # whatever the user's methods raise
        return ""
    camera = camera_at(*VIEWS["space"])
    painted = [
        lit(part, look.visual.colour or body.colour, 1.0, camera, look.visual.opacity)
        for body in drawn.bodies.values()
        for look, part in parts_in_space(body, 0)
    ]
    painted = sorted((part for part in painted if part.polygons), key=lambda part: part.nearness)
    if not painted:
        return ""
    solid = [polygon for part in painted for polygon in part.polygons]
    corners = np.concatenate(solid)
    low, high = corners.min(axis=0), corners.max(axis=0)
    side, base = float(max(high - low)), floor_under(low, high)
    x, y = ((low[k] - 0.15 * side, high[k] + 0.15 * side) for k in range(2))
    floor = np.array([(x[0], y[0], base), (x[1], y[0], base), (x[1], y[1], base), (x[0], y[1], base)])
    shown = camera.flat(np.concatenate([corners, floor]))
    least, most = shown.min(axis=0), shown.max(axis=0)
    scale = min((_WIDE - 2 * _RIM) / (most[0] - least[0]), (_HIGH - 2 * _RIM) / (most[1] - least[1]))

    def outline(points: np.ndarray) -> str:
        return "M" + " ".join(f"{_RIM + scale * (u - least[0]):.1f},{_RIM + scale * (most[1] - v):.1f}" for u, v in camera.flat(points)) + "Z"

    parts = [
        f"<path d='{outline(floor)}' fill='{GROUND}' stroke='{GRID}'/>",
        f"<path d='{''.join(map(outline, shadows(camera, solid, x, y, base)))}' fill='{SHADOW}'/>",
    ]
    for colour, faces in groupby(((c, p) for part in painted for c, p in zip(part.colours, part.polygons, strict=True)), key=lambda face: _written(face[0])):
        parts.append(f"<path d='{''.join(outline(polygon) for _, polygon in faces)}' fill='{colour}' stroke='{colour}' stroke-width='0.4'/>")
    width, height = scale * (most - least) + 2 * _RIM
    return f"<svg width='{width:.0f}' height='{height:.0f}' role='img' aria-label='{type(scene).__name__}'>{''.join(parts)}</svg>"


def _written(colour: tuple[float, ...]) -> str:
    """Red, green, blue and opacity as "#rrggbbaa"."""
    return "#" + "".join(f"{round(255 * min(max(float(part), 0.0), 1.0)):02x}" for part in colour)
