"""A still picture of a motion: solid bodies at a few times, paths of points, the ground, and axes in metres; from above, from the side or in space.

Convex parts are projected in parallel and painted from far to near; of each, the faces that look away are left out.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jourdain_jax.calculus.reals import described
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.plotting.looks import Drawn, looks_of
from jourdain_jax.plotting.solids import Part, parts_in_space, shaded
from jourdain_jax.plotting.still_axes import Camera, camera_at, draw_floor, draw_plane

VIEWS = {"above": (90.0, -90.0), "side": (0.0, -90.0), "space": (28.0, -60.0)}  # elevation and azimuth, degrees
_PATH = (0.27, 0.27, 0.27)  # the colour of paths
_PATH_WIDTH = 1.3  # points
Ends = tuple[str, Sequence]  # a body and a point (3,) of it, m, body frame


@dataclass(frozen=True)
class _Painted:
    """A part of a body or a piece of a path in space: polygons with a colour each, and how near it is."""

    polygons: list[np.ndarray]
    colours: list[tuple[float, ...]]
    nearness: float
    width: float  # of the edges, points
    casts: bool  # whether it has a shadow


def draw_still(
    trajectory: Trajectory,
    path: str | os.PathLike,
    *,
    at: int | Sequence = 3,
    paths: Sequence[Ends] | None = None,
    view: str | tuple = "space",
    size: tuple[int, int] = (640, 420),
) -> None:
    """Draw a motion as one picture: its bodies, solid, at a few times, earlier ones paler, and the paths of points.

    - `at`: times in s (the nearest saved ones are drawn), or how many, evenly spaced from the start to the end.
    - `paths`: (body, body-frame point in m) pairs to trace; default: the mass centre of the first body.
    - `view`: "above", "side" or "space", or elevation and azimuth in degrees.
    - `size`: width and height in pixels.

    ValueError for a rollout, an unknown view or body, or a motion that reached none of its times; ImportError without matplotlib.
    """
    if not isinstance(trajectory, Trajectory) or trajectory.q.ndim != 2:
        raise ValueError(f"`draw_still` was given {described(trajectory)}, expected one motion; of a rollout take one lane: rollout.lane(0)")
    if isinstance(view, str) and view not in VIEWS:
        raise ValueError(f"`view` is `{view}`, expected one of {', '.join(f'`{name}`' for name in VIEWS)}, or elevation and azimuth in degrees")
    plt = pyplot()
    camera = camera_at(*(VIEWS[view] if isinstance(view, str) else view))
    drawn = looks_of(trajectory)
    chosen = _times(drawn, at)
    bodies = [body for name, body in drawn.bodies.items() if name]
    paths = [(bodies[0].name, (0.0, 0.0, 0.0))] if paths is None else list(paths)
    traces = [np.asarray(trajectory.point(*end))[drawn.reached] for end in paths]
    painted = [_painted([trace[k : k + 2]], [_PATH], camera, _PATH_WIDTH, casts=False) for trace in traces for k in range(len(trace) - 1)]
    for order, k in enumerate(chosen.tolist()):
        strength = 1.0 if len(chosen) == 1 else 0.35 + 0.65 * order / (len(chosen) - 1)
        for body in drawn.bodies.values():
            for look, part in parts_in_space(body, k):
                painted.append(lit(part, look.visual.colour or body.colour, strength, camera, look.visual.opacity))
    figure = plt.figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
    if view in ("above", "side"):
        axes = figure.add_axes((0.115, 0.125, 0.865, 0.765))
        draw_plane(axes, camera, _corners(painted), "y in m" if view == "above" else "z in m")
    else:
        axes = figure.add_axes((0.01, 0.01, 0.98, 0.89))
        draw_floor(axes, camera, _corners(painted), [polygon for part in painted if part.casts for polygon in part.polygons])
    _fill(axes, camera, painted)
    _legend(figure, plt, {body.name: body.colour for body in bodies}, len(paths))
    axes.set_aspect("equal")
    figure.savefig(path)
    plt.close(figure)


def _times(drawn: Drawn, at: int | Sequence) -> np.ndarray:
    """Numbers of the times at which bodies are drawn."""
    if isinstance(at, int):
        wanted = drawn.ts[-1:] if at <= 1 else np.linspace(drawn.ts[0], drawn.ts[-1], at)
    else:
        wanted = np.asarray(at, float)
    return np.unique([int(np.argmin(np.abs(drawn.ts - t))) for t in wanted])


def lit(part: Part, colour: str, strength: float, camera: Camera, opacity: float) -> _Painted:
    """The faces of a part that look at the eye, in the light."""
    seen = [face for face in part if face.normal() @ camera.towards > 1e-9]
    polygons = [face.corners for face in seen]
    colours = [shaded(face, colour, camera.light, opacity, strength) for face in seen]
    lifted = np.ptp(np.concatenate(polygons) @ camera.towards) if opacity < 1 and polygons else 0.0
    return _painted(polygons, colours, camera, 0.0 if opacity < 1 else 0.4, lifted=lifted)


def _painted(polygons: list[np.ndarray], colours: list, camera: Camera, width: float, *, lifted: float = 0.0, casts: bool = True) -> _Painted:
    nearness = float(np.mean(np.concatenate(polygons) @ camera.towards)) if polygons else 0.0
    return _Painted(polygons, colours, nearness + lifted, width, casts)


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
