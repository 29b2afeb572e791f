"""A still picture of a motion: solid bodies at a few times, paths of points, the ground, and axes in metres; from above, from the side or in space.

Convex parts are projected in parallel and painted from far to near; of each, the faces that look away are left out.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.plotting.solids import Part, bar, solid_of
from jourdain_jax.plotting.still_axes import Camera, camera_at, draw_floor, draw_plane
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.numbers import described

VIEWS = {"above": (90.0, -90.0), "side": (0.0, -90.0), "space": (28.0, -60.0)}  # elevation and azimuth, degrees
_LINK = "#8a8a86"
_PATH = (0.27, 0.27, 0.27)  # the colour of paths
_PATH_WIDTH = 1.3  # points
Ends = tuple[str, Sequence]  # a body and a point (3,) of it, m, body frame


@dataclass(frozen=True)
class _Painted:
    """A part of a body or a piece of a path in space: polygons with a colour each, and how near it is."""

    polygons: list[np.ndarray]
    colours: list[tuple[float, ...]]
    nearness: float
    width: float = 0.4  # of the edges, points
    casts: bool = True  # a shadow


def draw_still(
    trajectory: Trajectory,
    path: str | os.PathLike,
    *,
    at: int | Sequence = 3,
    paths: Sequence[Ends] | None = None,
    links: Sequence[tuple[Ends, Ends]] = (),
    clear: Sequence[str] = (),
    view: str | tuple = "space",
    size: tuple[int, int] = (640, 420),
) -> None:
    """Draw a motion as one picture: its bodies, solid, at a few times, earlier ones paler, and the paths of points.

    - `at`: times in s (the nearest saved ones are drawn), or how many, evenly spaced from the start to the end.
    - `paths`: (body, body-frame point in m) pairs to trace; default: the mass centre of the first body.
    - `links`: pairs of such points to join by a grey bar (springs, rods, tongues); the body `""` is the inertial frame.
    - `clear`: names of bodies that one looks through. `view`: "above", "side" or "space", or elevation and azimuth in degrees.
    - `size`: width and height in pixels.

    ValueError for a rollout, an unknown view or body, or a motion that reached none of its times; ImportError without matplotlib.
    """
    if not isinstance(trajectory, Trajectory) or trajectory.q.ndim != 2:
        raise ValueError(f"`draw_still` was given {described(trajectory)}, expected one motion; of a rollout take one lane: rollout.lane(0)")
    if isinstance(view, str) and view not in VIEWS:
        raise ValueError(f"`view` is `{view}`, expected one of {', '.join(f'`{name}`' for name in VIEWS)}, or elevation and azimuth in degrees")
    plt = pyplot()
    camera = camera_at(*(VIEWS[view] if isinstance(view, str) else view))
    reached, chosen = _times(trajectory, at)
    bodies = {name: motion.body for name, motion in trajectory.motions().bodies.items()}
    paths = [(next(iter(bodies)), (0.0, 0.0, 0.0))] if paths is None else list(paths)
    traces = [_point(trajectory, end)[reached] for end in paths]
    thickness = 0.022 * _reach(bodies.values(), chosen, traces)
    palette = plt.rcParams["axes.prop_cycle"].by_key()["color"]
    colours = {name: palette[k % len(palette)] for k, name in enumerate(bodies)}
    painted = [_painted([trace[k : k + 2]], [_PATH], camera, _PATH_WIDTH) for trace in traces for k in range(len(trace) - 1)]
    for order, k in enumerate(chosen.tolist()):
        strength = 1.0 if len(chosen) == 1 else 0.35 + 0.65 * order / (len(chosen) - 1)
        for name, body in bodies.items():
            for part in _in_space(body, k, thickness):
                painted.append(_lit(part, colours[name], strength, camera, name in clear))
        for one, other in links:
            for part in bar(_point(trajectory, one)[k], _point(trajectory, other)[k], thickness / 3):
                painted.append(_lit(part, _LINK, strength, camera, False))
    figure = plt.figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
    if view in ("above", "side"):
        axes = figure.add_axes((0.115, 0.125, 0.865, 0.765))
        draw_plane(axes, camera, _corners(painted), "y in m" if view == "above" else "z in m")
    else:
        axes = figure.add_axes((0.01, 0.01, 0.98, 0.89))
        draw_floor(axes, camera, _corners(painted), [polygon for part in painted if part.casts for polygon in part.polygons])
    _fill(axes, camera, painted)
    _legend(figure, plt, colours, len(paths))
    axes.set_aspect("equal")
    figure.savefig(path)
    plt.close(figure)


def _times(trajectory: Trajectory, at: int | Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Indices of all saved times that the motion reached, and of those at which bodies are drawn."""
    reached = np.flatnonzero(np.asarray(trajectory.valid))
    if reached.size == 0:
        raise ValueError("the motion reached none of its saved times; there is nothing to draw")
    ts = np.asarray(trajectory.ts)[reached]
    if isinstance(at, int):
        wanted = ts[-1:] if at <= 1 else np.linspace(ts[0], ts[-1], at)
    else:
        wanted = np.asarray(at, float)
    return reached, reached[np.unique([int(np.argmin(np.abs(ts - t))) for t in wanted])]


def _point(trajectory: Trajectory, end: Ends) -> np.ndarray:
    """A point of a body, or of the inertial frame, at all times."""
    name, local = end
    return np.broadcast_to(np.asarray(local, float), (len(trajectory.ts), 3)) if name == "" else np.asarray(trajectory.point(name, local))


def _reach(bodies, chosen, traces) -> float:
    """The longest side of what is drawn, m."""
    together = np.concatenate([np.asarray(body.position)[chosen].reshape(-1, 3) for body in bodies] + traces)
    outlines = [np.asarray(body.outline)[0] for body in bodies if isinstance(body, RigidBody) and body.outline.shape[-2]]
    return float(max([np.ptp(together, axis=0).max(), 1e-3, *(np.ptp(outline, axis=0).max() for outline in outlines)]))


def _in_space(body, k: int, thickness: float) -> list[Part]:
    """Parts of a body at a saved time, in space."""
    rigid = isinstance(body, RigidBody)
    turned, place = np.asarray(body.orientation)[k] if rigid else np.eye(3), np.asarray(body.position)[k]
    parts = solid_of(np.asarray(body.outline)[k] if rigid else np.zeros((0, 3)), thickness)
    return [[type(face)(face.corners @ turned.T + place, face.dark) for face in part] for part in parts]


def _lit(part: Part, colour: str | tuple, strength: float, camera: Camera, clear: bool) -> _Painted:
    """The faces of a part that look at the eye, in the light."""
    from matplotlib.colors import to_rgb

    polygons, colours = [], []
    for face in part:
        normal = np.cross(face.corners[1] - face.corners[0], face.corners[2] - face.corners[0])
        if not np.linalg.norm(normal) > 1e-12 * np.ptp(face.corners, axis=0).max() ** 2:  # the cap of a ball counts one corner twice
            normal = np.cross(face.corners[2] - face.corners[0], face.corners[-1] - face.corners[0])
        normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
        if normal @ camera.towards > 1e-9:
            shade = (0.62 + 0.38 * max(float(normal @ camera.light), 0.0)) * (1 - face.dark)
            polygons.append(face.corners)
            colours.append((*(1 - strength * (1 - shade * np.array(to_rgb(colour)))), 0.3 if clear else 1.0))
    painted = _painted(polygons, colours, camera, 0.0 if clear else 0.4)
    lifted = np.ptp(np.concatenate(polygons) @ camera.towards) if clear and polygons else 0.0
    return _Painted(polygons, colours, painted.nearness + lifted, painted.width)


def _painted(polygons: list[np.ndarray], colours: list, camera: Camera, width: float) -> _Painted:
    nearness = float(np.mean(np.concatenate(polygons) @ camera.towards)) if polygons else 0.0
    return _Painted(polygons, colours, nearness, width, casts=width != _PATH_WIDTH)


def _corners(painted: list[_Painted]) -> np.ndarray:
    return np.concatenate([polygon for part in painted for polygon in part.polygons])


def _fill(axes, camera: Camera, painted: list[_Painted]) -> None:
    """All parts and pieces of paths, the farthest first."""
    from matplotlib.collections import PolyCollection

    ordered = sorted(painted, key=lambda part: part.nearness)
    polygons = [camera.flat(polygon) for part in ordered for polygon in part.polygons]
    colours = [colour for part in ordered for colour in part.colours]
    widths = [part.width for part in ordered for _ in part.polygons]
    axes.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors=colours, linewidths=widths, closed=False, zorder=3))


def _legend(figure, plt, colours: dict, paths: int) -> None:
    """Names of the bodies in a row above the picture: of many the first, the second and the last."""
    names = list(colours)
    names = names if len(names) <= 4 else [*names[:2], names[-1]]
    handles = [plt.Rectangle((0, 0), 1, 1, color=colours[name], label=name) for name in names]
    if paths:
        handles.append(plt.Line2D([], [], color=_PATH, lw=_PATH_WIDTH, label="path" if paths == 1 else "paths"))
    figure.legend(handles=handles, loc="upper center", ncols=len(handles), frameon=False, fontsize=9, handlelength=1.4, columnspacing=1.6)
