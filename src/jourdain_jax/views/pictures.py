"""Pictures of a scene's bodies with matplotlib: animations, stills, and the view of a scene in a notebook.

3D drawings with matplotlib: lit bodies and their shadows on a floor, with axes in metres.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.figures import figure as figure_in_html
from jourdain_jax.calculus.figures import pyplot
from jourdain_jax.calculus.files import FilePath, check_place
from jourdain_jax.calculus.reals import checked_whole, described
from jourdain_jax.motion.start import start
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.views.looks import Drawn, floor_under, looks_at, looks_of
from jourdain_jax.views.solids import Quads, faces_of, split

Painted = tuple[Quads, Float[np.ndarray, "faces 4"]]  # faces in space, and their red, green, blue and opacity
_LIGHT = np.array([0.15, -0.4, 0.9])  # direction towards the light
_INK = "#444444"  # colour of paths


def painted(drawn: Drawn, k: int, strength: float = 1.0) -> Painted:
    """Return the faces and colours of all bodies at time index `k`. A `strength` below 1 makes
    colours paler.
    """
    corners, colours, size = [], [], drawn.size
    for body in drawn.bodies.values():
        for look in body.looks:
            own, dark = faces_of(look, k, drawn.thin)
            own, whose = split(own, size / 12)
            if look.kind != "line":
                own = own @ np.asarray(look.orientation)[k].T + np.asarray(look.position)[k]
            own = own @ body.orientations[k].T + body.positions[k]
            lit = normals_of(own) @ _LIGHT
            shade = (0.7 + 0.3 * np.maximum(lit, 0.0)) * (1 - dark[whose])
            colour = 1 - strength * (1 - shade[:, None] * rgb(look.colour or body.colour))
            corners.append(own)
            colours.append(np.column_stack([colour, np.full(len(own), look.opacity)]))
    return np.concatenate(corners), np.concatenate(colours)


def normals_of(faces: Quads) -> Float[np.ndarray, "faces 3"]:
    """Return the outward unit normals of faces; zero for faces without area."""
    found = np.cross(faces[:, 2] - faces[:, 0], faces[:, 3] - faces[:, 1])
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-300)


def rgb(colour: str) -> Float[np.ndarray, "3"]:
    """Return red, green and blue, 0 to 1, of a colour "#rrggbb"."""
    return np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])


def box_of(faces: Sequence[np.ndarray]) -> Float[np.ndarray, "2 3"]:
    """Return the lowest and highest corners (m) of a box around all points and the floor below them, with a
    margin.
    """
    points = np.concatenate([x.reshape(-1, 3) for x in faces])
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.1 * float(max(high - low)) * np.array([1.0, 1.0, 0.5]) + 1e-3
    return np.stack([np.append((low - room)[:2], floor_under(low, high)), high + room])


def axes_in_space(figure, view: tuple[float, float], place: tuple[float, float, float, float] | None = None):
    """Return 3D axes in a matplotlib figure, viewed from this elevation and azimuth (degrees). The axis along
    the line of sight is hidden. Without `place`, the axes have no numbers.
    """
    axes = figure.add_subplot(projection="3d", proj_type="ortho", computed_zorder=False)
    axes.view_init(*view)
    axes.set_autoscale_on(False)
    axes.tick_params(labelsize=8, pad=0)
    for axis, name, along in zip(
        (axes.xaxis, axes.yaxis, axes.zaxis), "xyz", np.abs(towards(*view)), strict=True
    ):
        axis.set_pane_color("#f4f4f1" if name == "z" else "white")
        axis._axinfo["grid"].update(color="#d9d9d4", linewidth=0.6)
        axis.line.set_visible(place is not None and along < 0.99)
        if axis.line.get_visible():
            axis.set_label_text(f"{name} in m")
        else:
            axis.set_ticks([])
    if place is not None:
        axes.set_position(place)
    return axes


def draw(axes, bodies: Painted, paths: Sequence[np.ndarray], box: Float[np.ndarray, "2 3"]) -> None:
    """Clear the axes and draw bodies with shadows, and paths (times, 3). `box`: lowest and highest corners of
    the visible region.
    """
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    for artist in tuple(axes.collections):
        artist.remove()
    corners, colours = bodies
    fallen = corners - (corners[..., 2:] - box[0, 2]) / _LIGHT[2] * _LIGHT
    fallen[..., :2] = np.clip(fallen[..., :2], *box[:, :2])
    axes.add_collection3d(Poly3DCollection(fallen, facecolors="#d3d3ce", zorder=1))
    seen = (normals_of(corners) @ towards(axes.elev, axes.azim) > 0) | (colours[:, 3] < 1)
    along = [path[:-1, None] + np.diff(path, axis=0)[:, None] * [[0], [1], [1], [0]] for path in paths]
    lines = np.concatenate([np.zeros((0, 4, 3)), *along])
    corners = np.concatenate([corners[seen], lines])
    colours = np.concatenate([colours[seen], np.tile([*rgb(_INK), 1.0], (len(lines), 1))])
    axes.add_collection3d(
        Poly3DCollection(corners, facecolors=colours, edgecolors=colours, linewidths=0.9, zorder=2)
    )
    axes.set(xlim=box[:, 0], ylim=box[:, 1], zlim=box[:, 2])
    sides = box[1] - box[0]
    axes.set_box_aspect(sides)
    for axis, side in zip((axes.xaxis, axes.yaxis, axes.zaxis), sides / max(sides), strict=True):
        if axis.line.get_visible():
            axis.set_major_locator(pyplot().MaxNLocator(1 + round(4 * side)))


def towards(elevation: float, azimuth: float) -> Float[np.ndarray, "3"]:
    """Return the unit vector from the scene towards the viewer; angles in degrees."""
    e, a = np.radians((elevation, azimuth))
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def legend(figure, drawn: Drawn, paths: int = 0) -> None:
    """Draw a legend of the bodies above the picture. If there are more than four, show the first two and the
    last.
    """
    plt, colours = pyplot(), {name: body.colour for name, body in drawn.bodies.items() if name}
    names = list(colours) if len(colours) <= 4 else [*list(colours)[:2], list(colours)[-1]]
    handles = [plt.Rectangle((0, 0), 1, 1, color=colours[name], label=name) for name in names]
    if paths:
        handles.append(plt.Line2D([], [], color=_INK, lw=0.9, label="path" if paths == 1 else "paths"))
    figure.legend(
        handles=handles,
        loc="upper center",
        ncols=len(handles),
        frameon=False,
        fontsize=9,
        handlelength=1.4,
        columnspacing=1.6,
    )


# elevation and azimuth, degrees
VIEWS = {"above": (90.0, -90.0), "side": (0.0, -90.0), "space": (28.0, -60.0)}
_STILL = (".png", ".svg", ".pdf")


def check_suffix(path: FilePath) -> None:
    """Raise ValueError if neither an animation nor a picture can be written to this path."""
    check_place(path)
    if not str(path).lower().endswith((".gif", *_STILL)):
        raise ValueError(
            f"cannot write `{path}`: an animation is a .gif file, one picture a {', '.join(_STILL[:-1])} or "
            f"{_STILL[-1]} file"
        )


@of_known_numbers
def animate(
    trajectory: Trajectory,
    path: FilePath,
    *,
    frames: int = 60,
    at: int | Sequence[float] = 3,
    paths: Sequence[tuple[str, Sequence[float]]] | None = None,
    follow: bool = False,
    view: str | tuple[float, float] = "space",
    title: str | None = None,
) -> None:
    """Write an animation of a `trajectory` to `path` (.gif), drawn from the scene's bodies, or one picture
    (.png, .svg, .pdf) with the bodies at a few times, earlier ones paler.

    - `frames`: maximum number of frames, taken at evenly spaced saved times. The animation lasts as long as
      the motion, but at least 2 and at most 12 s.
    - `at`: times of the bodies in one picture, s (the nearest saved times are drawn), or a number of times,
      evenly spaced from the start to the end.
    - `paths`: (body, body-frame point in m) pairs to trace; default: the mass centre of every body.
    - `follow`: whether the view of an animation moves with the bodies instead of showing the whole path.
    - `view`: "above", "side" or "space", or elevation and azimuth in degrees.
    - `title`: a line of text (default: none).

    Raises ValueError for another suffix, an unknown view or body, or a motion that reached none of its times,
    and ImportError without matplotlib.
    """
    _check_one(trajectory, "`animate`", "jj.animate(rollout.lane(0), 'lane-0.gif')")
    frames = checked_whole(frames, "`frames`", 1, expected="of at least 1")
    check_suffix(path)
    if isinstance(view, str) and view not in VIEWS:
        raise ValueError(
            f"`view` is `{view}`, expected one of {', '.join(f'`{name}`' for name in VIEWS)}, "
            "or elevation and azimuth in degrees"
        )
    angles, plt = VIEWS[view] if isinstance(view, str) else view, pyplot()
    still = str(path).lower().endswith(_STILL)
    drawn = looks_of(trajectory) if still else looks_of(trajectory, "animate", frames)
    if paths is None:
        paths = [(name, np.zeros(3)) for name in drawn.bodies if name]
    traces = [np.asarray(trajectory.point(*end))[drawn.reached] for end in paths]
    if still:
        _draw_still(plt, drawn, traces, path, angles, title, at)
    else:
        _animate(plt, drawn, traces, path, angles, title, follow)


def _animate(plt, drawn: Drawn, traces: list, path: FilePath, angles: tuple, title, follow: bool) -> None:
    from matplotlib.animation import FuncAnimation, PillowWriter

    bodies = [painted(drawn, k) for k in range(len(drawn.ts))]
    boxes = np.stack([box_of(faces[:1]) for faces in bodies])
    whole = box_of([*boxes, *traces])
    half = np.ptp(boxes, axis=1).max() * 0.62  # half the side of the square that follows the bodies
    figure = plt.figure(figsize=(6.0, 5.0))
    axes = axes_in_space(figure, angles, (0.03, 0.02, 0.9, 0.88))
    clock = figure.text(0.03, 0.91, "", family="monospace")
    figure.text(0.25, 0.91, title or "")
    legend(figure, drawn)

    def draw_frame(k: int):
        shown = whole.copy()
        if follow:
            shown[:, :2] = boxes[k, :, :2].mean(axis=0) + np.array([[-half], [half]])
        draw(axes, bodies[k], [trace[: k + 1] for trace in traces], shown)
        clock.set_text(f"t = {drawn.ts[k]:6.2f} s")
        return [clock]

    count, seconds = len(drawn.ts), float(np.clip(abs(drawn.ts[-1] - drawn.ts[0]), 2.0, 12.0))
    FuncAnimation(figure, draw_frame, frames=count, blit=False).save(
        path, writer=PillowWriter(fps=max(1, round(count / seconds))), dpi=80
    )
    plt.close(figure)


def _draw_still(plt, drawn: Drawn, traces: list, path: FilePath, angles: tuple, title, at) -> None:
    if not isinstance(at, int):
        wanted = np.asarray(at, float)
    else:
        wanted = np.linspace(drawn.ts[0], drawn.ts[-1], at) if at > 1 else drawn.ts[-1:]
    chosen = np.unique(np.argmin(np.abs(drawn.ts - wanted[:, None]), axis=1)).tolist()
    strengths = np.linspace(1.0, 0.35, len(chosen))[::-1]
    faces, colours = zip(*map(painted, [drawn] * len(chosen), chosen, strengths), strict=True)
    figure = plt.figure(figsize=(6.4, 4.2), dpi=100)
    axes = axes_in_space(figure, angles, (0.05, 0.07, 0.88, 0.83))
    draw(axes, (np.concatenate(faces), np.concatenate(colours)), traces, box_of([*faces, *traces]))
    legend(figure, drawn, len(traces))
    figure.text(0.05, 0.02, title or "")
    figure.savefig(path)
    plt.close(figure)


def scene_picture(scene) -> str:
    """Return HTML with a picture of a scene's bodies and their shadows at its `example`; empty if there are
    none.

    A scene that cannot start has no picture, because notebooks also display unfinished scenes. `jj.start`
    reports their faults.
    """
    try:
        bodies = painted(looks_at(scene, start(scene, **scene.example)), 0)
    except Exception:  # user methods may raise anything, and the parameters may be traced
        return ""
    return figure_in_html(
        lambda whole: draw(axes_in_space(whole, VIEWS["space"]), bodies, [], box_of(bodies[:1])), 300, 200
    )


def _check_one(trajectory, where: str, example: str) -> None:
    if not isinstance(trajectory, Trajectory) or trajectory.q.ndim != 2:
        raise ValueError(
            f"{where} was given {described(trajectory)}, expected one motion; for a "
            f"rollout pass one lane: {example}"
        )
