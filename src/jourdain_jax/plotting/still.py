"""A still picture of a motion: solid bodies at a few times, paths of points, the ground, and axes in metres; from above, from the side or in space.

Faces are projected in parallel and painted from far to near; those that look away are left out.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.plotting.solids import Face, solid_of
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.numbers import described

VIEWS = {"above": (90.0, -90.0), "side": (0.0, -90.0), "space": (28.0, -60.0)}  # elevation and azimuth, degrees
_LIGHT = np.array([-0.35, -0.5, 0.79])
_GROUND, _GRID, _SHADOW, _INK = "#f4f4f1", "#d9d9d4", "#d3d3ce", "#444444"
_PATH_WIDTH = 1.3  # points


@dataclass(frozen=True)
class _Camera:
    right: np.ndarray
    up: np.ndarray
    towards: np.ndarray  # from the scene to the eye

    def flat(self, points: np.ndarray) -> np.ndarray:
        return np.stack([points @ self.right, points @ self.up], axis=-1)


def _camera(elevation: float, azimuth: float) -> _Camera:
    e, a = np.radians(elevation), np.radians(azimuth)
    towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    return _Camera(np.array([-np.sin(a), np.cos(a), 0.0]), np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]), towards)


def draw_still(
    trajectory: Trajectory,
    path: str | os.PathLike,
    *,
    at: int | Sequence[float] = 3,
    paths: Sequence[tuple[str, Sequence[float]]] | None = None,
    view: str | tuple[float, float] = "space",
    size: tuple[int, int] = (640, 420),
) -> None:
    """Draw a motion as one picture: its bodies, solid, at a few times, later ones stronger, and the paths of points.

    - `at`: times in s (the nearest saved ones are drawn), or how many, evenly spaced from the start to the end.
    - `paths`: (body, body-frame point in m) pairs; default: the mass centre of the first body.
    - `view`: "above", "side" or "space", or elevation and azimuth in degrees. `size`: width and height in pixels.

    ValueError for a rollout, an unknown view or body, or a motion that reached none of its times; ImportError without matplotlib.
    """
    if not isinstance(trajectory, Trajectory) or trajectory.q.ndim != 2:
        raise ValueError(f"`draw_still` was given {described(trajectory)}, expected one motion; of a rollout take one lane: rollout.lane(0)")
    if isinstance(view, str) and view not in VIEWS:
        raise ValueError(f"`view` is `{view}`, expected one of {', '.join(f'`{name}`' for name in VIEWS)}, or elevation and azimuth in degrees")
    camera = _camera(*(VIEWS[view] if isinstance(view, str) else view))
    reached = np.flatnonzero(np.asarray(trajectory.valid))
    if reached.size == 0:
        raise ValueError("the motion reached none of its saved times; there is nothing to draw")
    ts = np.asarray(trajectory.ts)[reached]
    wanted = np.linspace(ts[0], ts[-1], max(at, 1)) if isinstance(at, int) else np.asarray(at, float)
    chosen = reached[np.unique([int(np.argmin(np.abs(ts - t))) for t in np.atleast_1d(wanted)])]
    if isinstance(at, int) and at == 1:
        chosen = reached[-1:]
    bodies = trajectory.motions().bodies
    paths = [(next(iter(bodies)), (0.0, 0.0, 0.0))] if paths is None else list(paths)
    traces = [np.asarray(trajectory.point(name, local))[reached] for name, local in paths]
    plt = pyplot()
    colours = plt.rcParams["axes.prop_cycle"].by_key()["color"]
    thickness = 0.02 * _reach(bodies, chosen, traces)
    painted: list[_Painted] = []
    for k, body in enumerate(bodies.values()):
        for faces, strength in _placed(body.body, chosen, thickness):
            painted += [_paint(corners, normal, colours[k % len(colours)], dark, strength, camera) for corners, normal, dark in faces]
    for trace in traces:
        painted += [_Painted(segment, _INK, trace_line=True) for segment in _segments(trace)]
    figure = plt.figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
    axes = figure.add_axes((0.09, 0.12, 0.88, 0.76) if view in ("above", "side") else (0.02, 0.02, 0.96, 0.86))
    corners = np.concatenate([p.corners for p in painted])
    low, high = corners.min(axis=0), corners.max(axis=0)
    if view in ("above", "side"):
        _flat_axes(axes, view, low, high)
    else:
        _floor(axes, camera, low, high, painted)
    _fill(axes, camera, [p for p in painted if p.trace_line or p.seen])
    handles = [plt.Rectangle((0, 0), 1, 1, color=colours[k % len(colours)], label=name) for k, name in enumerate(bodies)]
    handles += [plt.Line2D([], [], color=_INK, lw=_PATH_WIDTH, label="path of " + ", ".join(dict.fromkeys(name for name, _ in paths)))] if paths else []
    if len(handles) > 6:
        handles = [handles[0], handles[1], handles[-2], handles[-1]]
    figure.legend(handles=handles, loc="upper center", ncols=len(handles), frameon=False, fontsize=9, handlelength=1.4, columnspacing=1.6)
    axes.set_aspect("equal", adjustable="datalim" if view in ("above", "side") else "box")
    figure.savefig(path)
    plt.close(figure)


@dataclass(frozen=True)
class _Painted:
    """A polygon or a piece of a path in space, and its colour."""

    corners: np.ndarray
    colour: object
    seen: bool = True
    trace_line: bool = False


def _reach(bodies, chosen, traces) -> float:
    """The longest side of what is drawn, m."""
    places = [np.asarray(body.body.position)[chosen].reshape(-1, 3) for body in bodies.values()] + traces
    wide = [np.ptp(np.asarray(body.body.outline)[0], axis=0).max() for body in bodies.values() if isinstance(body.body, RigidBody) and body.body.outline.shape[-2]]
    together = np.concatenate(places)
    return float(max(np.ptp(together, axis=0).max(), *wide, 1e-3)) if wide else float(max(np.ptp(together, axis=0).max(), 1e-3))


def _placed(body, chosen, thickness: float):
    """Faces of a body in space at each chosen time, with their normals, and how strong they are drawn (the last is 1)."""
    rigid = isinstance(body, RigidBody)
    outline = np.asarray(body.outline)[chosen[0]] if rigid else np.zeros((0, 3))
    solid: list[Face] = solid_of(outline, thickness)
    for order, k in enumerate(chosen):
        turned = np.asarray(body.orientation)[k] if rigid else np.eye(3)
        place = np.asarray(body.position)[k]
        faces = []
        for face in solid:
            corners = face.corners @ turned.T + place
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
            if not normal.any():  # a corner of a ball's cap counts twice
                normal = np.cross(corners[2] - corners[0], corners[-1] - corners[0])
            faces.append((corners, normal / max(np.linalg.norm(normal), 1e-300), face.dark))
        yield faces, 1.0 if len(chosen) == 1 else 0.35 + 0.65 * order / (len(chosen) - 1)


def _paint(corners, normal, colour, dark: float, strength: float, camera: _Camera) -> _Painted:
    from matplotlib.colors import to_rgb

    lit = (0.62 + 0.38 * max(float(normal @ _LIGHT), 0.0)) * (1 - dark)
    rgb = np.clip(lit * np.array(to_rgb(colour)), 0, 1)
    return _Painted(corners, tuple(1 - strength * (1 - rgb)), seen=bool(normal @ camera.towards > 1e-9))


def _segments(trace: np.ndarray) -> list[np.ndarray]:
    return [trace[k : k + 2] for k in range(len(trace) - 1)]


def _fill(axes, camera: _Camera, painted: list[_Painted]) -> None:
    """All polygons and pieces of paths, the farthest first."""
    from matplotlib.collections import PolyCollection

    order = np.argsort([np.mean(p.corners @ camera.towards) for p in painted], kind="stable")
    polygons = [camera.flat(painted[k].corners) for k in order]
    colours = [painted[k].colour for k in order]
    widths = [_PATH_WIDTH if painted[k].trace_line else 0.4 for k in order]
    axes.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors=colours, linewidths=widths, closed=False, zorder=3))


def _flat_axes(axes, view: str, low: np.ndarray, high: np.ndarray) -> None:
    axes.set_xlabel("x in m")
    axes.set_ylabel("y in m" if view == "above" else "z in m")
    axes.grid(color=_GRID, lw=0.6)
    axes.set_axisbelow(True)
    across = 1 if view == "above" else 2
    margin = 0.06 * max(high[0] - low[0], high[across] - low[across])
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[across] - margin, high[across] + margin)
    axes.set_autoscale_on(False)


def _floor(axes, camera: _Camera, low: np.ndarray, high: np.ndarray, painted: list[_Painted]) -> None:
    """A tiled floor under the motion (the plane z = 0 where bodies stand on it) with shadows, and three axes in m along its edges."""
    from matplotlib.collections import PolyCollection
    from matplotlib.ticker import MaxNLocator

    axes.set_axis_off()
    side = float(max(high - low))
    stands = -0.05 * side < low[2] < 0.2 * side
    base = 0.0 if stands else low[2] - 0.05 * side
    spread = np.maximum(high - low, 0.3 * side)
    middle = (low + high) / 2
    ticks = [MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]).tick_values(middle[k] - spread[k] / 2, middle[k] + spread[k] / 2) for k in range(2)]
    heights = [z for z in MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]).tick_values(base, max(high[2], base + 0.2 * side)) if z >= base - 1e-12]
    (x0, x1), (y0, y1) = ((t[0], t[-1]) for t in ticks)
    flat = lambda *point: camera.flat(np.array(point))  # noqa: E731
    axes.add_collection(PolyCollection([[flat(x, y, base) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]], facecolors=_GROUND, edgecolors=_GRID, zorder=0))
    lines = [(flat(x, y0, base), flat(x, y1, base)) for x in ticks[0]] + [(flat(x0, y, base), flat(x1, y, base)) for y in ticks[1]]
    axes.add_collection(PolyCollection([np.array(line) for line in lines], facecolors="none", edgecolors=_GRID, linewidths=0.7, closed=False, zorder=1))
    shadows = []
    for p in painted:
        if not p.trace_line:
            fallen = p.corners - np.outer((p.corners[:, 2] - base) / _LIGHT[2], _LIGHT)
            fallen = np.column_stack([np.clip(fallen[:, 0], x0, x1), np.clip(fallen[:, 1], y0, y1), np.full(len(fallen), base)])
            shadows.append(camera.flat(fallen))
    axes.add_collection(PolyCollection(shadows, facecolors=_SHADOW, edgecolors=_SHADOW, linewidths=0.3, zorder=2))
    near_y = y0 if camera.towards[1] < 0 else y1
    near_x = x1 if camera.towards[0] > 0 else x0
    text = {"fontsize": 8, "color": _INK, "textcoords": "offset points", "annotation_clip": False}
    for k, x in enumerate(ticks[0][:-1]):
        axes.annotate(f"{x:g}" + (" m" if k == 0 else ""), flat(x, near_y, base), xytext=(-3, -5), ha="right", va="top", **text)
    for y in ticks[1][1:]:
        axes.annotate(f"{y:g}", flat(near_x, y, base), xytext=(5, -3), ha="left", va="top", **text)
    axes.annotate("x in m", flat((x0 + x1) / 2, near_y, base), xytext=(-14, -20), ha="right", va="top", **text)
    axes.annotate("y in m", flat(near_x, (y0 + y1) / 2, base), xytext=(24, -14), ha="left", va="top", **text)
    left = min(((x, y) for x in (x0, x1) for y in (y0, y1)), key=lambda corner: flat(*corner, base)[0])
    pole = np.array([flat(*left, base), flat(*left, heights[-1])])
    axes.plot(*pole.T, color=_GRID, lw=0.9, zorder=1)
    for z in heights[1:]:
        axes.annotate(f"{z:g}", flat(*left, z), xytext=(-5, 0), ha="right", va="center", **text)
    axes.annotate("z in m", pole[1], xytext=(0, 6), ha="center", va="bottom", **text)
    corners = np.array([flat(x, y, base) for x in (x0, x1) for y in (y0, y1)] + [*pole, *camera.flat(np.stack([low, high]))])
    span = np.ptp(corners, axis=0)
    axes.set_xlim(corners[:, 0].min() - 0.07 * span[0], corners[:, 0].max() + 0.07 * span[0])
    axes.set_ylim(corners[:, 1].min() - 0.1 * span[1], corners[:, 1].max() + 0.06 * span[1])
    axes.set_autoscale_on(False)
