"""Animations straight from a scene's bodies: solid bodies, paths of points, and the ground."""

import os
from collections.abc import Sequence

import numpy as np

from jourdain_jax.calculus.reals import described
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.plotting.looks import Look, looks_of
from jourdain_jax.plotting.solids import parts_of, rgb
from jourdain_jax.scene.arguments import of_known_numbers

FRAMES = 60
_LIGHT = np.array([0.1, -0.6, 0.79])  # unit vector towards the light


class _Polygons:
    """The faces of a look in its own axes: all corners (corners, 3), where each but the last face ends, normals (faces, 3), and how bright they are painted."""

    def __init__(self, look: Look, k: int):
        faces = [face for part in parts_of(look, k) for face in part]
        self.corners = np.concatenate([face.corners for face in faces])
        self.ends = np.cumsum([len(face.corners) for face in faces])[:-1]
        self.normals = np.array([face.normal() for face in faces])
        self.bright = np.array([1 - face.dark for face in faces])


class _Figure:
    """What is drawn: faces of all bodies in space with their colours at every frame, boxes that hold them, and paths of points (frames, 3)."""

    def __init__(self, trajectory: Trajectory, frames: int, paths: Sequence[tuple[str, Sequence[float]]] | None):
        whole = looks_of(trajectory, "animate")
        self.drawn = whole.at(np.unique(np.linspace(0, len(whole.ts) - 1, min(frames, len(whole.ts))).astype(int)))
        self.ts, self.bodies = self.drawn.ts, {name: body for name, body in self.drawn.bodies.items() if name}
        self._known: dict = {}  # polygons of the looks that keep their shape
        self.faces, self.colours = zip(*(self._frame(k) for k in range(len(self.ts))), strict=True)
        self.boxes = [(np.concatenate(faces).min(axis=0), np.concatenate(faces).max(axis=0)) for faces in self.faces]
        ends = [(name, (0.0, 0.0, 0.0)) for name in self.bodies] if paths is None else list(paths)
        self.paths = [np.asarray(trajectory.point(name, local))[self.drawn.reached] for name, local in ends]

    def _frame(self, k: int) -> tuple[list[np.ndarray], np.ndarray]:
        """Polygons in space and their colours, in the light."""
        faces, colours = [], []
        for body in self.drawn.bodies.values():
            for look in body.looks:
                key = id(look) if look.visual.kind != "line" or len(np.unique(look.points, axis=0)) == 1 else (id(look), k)
                if key not in self._known:
                    self._known[key] = _Polygons(look, k)
                own, turn, at = self._known[key], body.orientations[k], body.positions[k]
                if look.visual.kind != "line":
                    turn, at = turn @ look.orientations[k], turn @ look.positions[k] + at
                faces += np.split(own.corners @ turn.T + at, own.ends)
                shade = (0.62 + 0.38 * np.maximum(own.normals @ (turn.T @ _LIGHT), 0.0)) * own.bright
                colours.append(np.column_stack([shade[:, None] * rgb(look.visual.colour or body.colour), np.full(len(shade), look.visual.opacity)]))
        return faces, np.concatenate(colours)

    def extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the box that holds everything."""
        lows, highs = zip(*self.boxes, *((path.min(axis=0), path.max(axis=0)) for path in self.paths), strict=True)
        return np.min(lows, axis=0), np.max(highs, axis=0)


def check_suffix(path: str | os.PathLike) -> None:
    """ValueError where an animation cannot be written to a file of this name."""
    if not str(path).lower().endswith(".gif"):
        raise ValueError(f"cannot write `{path}`: an animation is a .gif file")


@of_known_numbers
def animate(
    trajectory: Trajectory,
    path: str | os.PathLike,
    *,
    frames: int = FRAMES,
    paths: Sequence[tuple[str, Sequence[float]]] | None = None,
    follow: bool = False,
    view: tuple[float, float] = (22.0, -60.0),
    title: str | None = None,
) -> None:
    """Write an animation of a `trajectory` to `path` (.gif), drawn from the scene's bodies.

    - `frames`: at most so many, evenly chosen from the saved times; the playing time is the motion's own, 2 to 12 s.
    - `paths`: (body, body-frame point in m) pairs to trace; default: the mass centre of every body.
    - `follow`: keep the view on the bodies as they move, instead of showing the whole path. `view`: elevation and azimuth in degrees.
    - `title`: a line above the drawing (default: none).

    ValueError for another suffix than .gif, or a motion that reached none of its times; ImportError without matplotlib.
    """
    if not isinstance(trajectory, Trajectory) or trajectory.q.ndim != 2:
        what = described(trajectory)
        raise ValueError(f"`animate` was given {what}, expected one motion; of a rollout take one lane: jj.animate(rollout.lane(0), 'lane-0.gif')")
    if not isinstance(frames, int | np.integer) or frames < 1:
        raise ValueError(f"`frames` is {frames!r}, expected a whole number of at least 1")
    check_suffix(path)
    plt = pyplot()
    from matplotlib.animation import FuncAnimation, PillowWriter
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    drawn = _Figure(trajectory, frames, paths)
    figure = plt.figure(figsize=(6.0, 5.0))
    axes = figure.add_axes((0.0, 0.0, 1.0, 0.96), projection="3d")
    axes.set_proj_type("persp")
    axes.set_autoscale_on(False)  # limits are ours; what Matplotlib finds of a collection without faces is anything
    solid = axes.add_collection3d(Poly3DCollection(drawn.faces[0], zorder=5))
    traces = [axes.plot([], [], [], color="0.45", lw=1.0)[0] for _ in drawn.paths]
    clock = figure.text(0.03, 0.95, "", family="monospace")
    if title:
        figure.text(0.25, 0.95, title)
    if len(drawn.bodies) > 1:
        handles = [plt.Rectangle((0, 0), 1, 1, color=body.colour, label=name) for name, body in drawn.bodies.items()]
        axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.03, 0.97), fontsize=8, frameon=False)
    axes.view_init(*view)
    _label(axes)
    low, high = drawn.extent()
    size = max(np.max(high - low) for low, high in drawn.boxes) * 0.62 if follow else np.max(high - low) / 2 * 1.05
    radius = float(max(size, 1e-3))  # half the side of the cube that is shown
    grounded = _ground(axes, low, high, radius)

    def draw(i):
        solid.set_verts(drawn.faces[i])
        solid.set_facecolors(drawn.colours[i])
        solid.set_edgecolors(drawn.colours[i])
        solid.set_linewidths(0.3)
        for trace, points in zip(traces, drawn.paths, strict=True):
            trace.set_data_3d(*points[: i + 1].T)
        clock.set_text(f"t = {drawn.ts[i]:6.2f} s")
        here = np.mean(drawn.boxes[i], axis=0)
        centre = here if follow else (low + high) / 2
        _frame(axes, np.array([centre[0], centre[1], 0.9 * radius]) if grounded else centre, radius)
        return [solid, *traces, clock]

    count = len(drawn.ts)
    seconds = float(np.clip(abs(drawn.ts[-1] - drawn.ts[0]), 2.0, 12.0))
    with np.errstate(over="ignore", invalid="ignore"):  # Matplotlib projects corners that it never set, of faces with fewer than others, and draws none of them
        FuncAnimation(figure, draw, frames=count, blit=False).save(path, writer=PillowWriter(fps=max(1, round(count / seconds))), dpi=80)
    plt.close(figure)


def _frame(axes, centre, radius: float) -> None:
    for set_limits, middle in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), centre, strict=True):
        set_limits(middle - radius, middle + radius)
    axes.set_box_aspect((1, 1, 1), zoom=1.0)  # beyond, the labels of the axes are cut off


def _ground(axes, low, high, radius: float) -> bool:
    """A grid at z = 0 under the motion, where the bodies stand on it; whether they do."""
    if low[2] < -0.05 * radius or low[2] > 0.2 * radius:
        return False
    step = 10.0 ** np.floor(np.log10(radius)) / 2
    xs = np.arange(np.floor((low[0] - radius) / step), np.ceil((high[0] + radius) / step) + 1) * step
    ys = np.arange(np.floor((low[1] - radius) / step), np.ceil((high[1] + radius) / step) + 1) * step
    if len(xs) + len(ys) > 160:  # a long ride: a grid so fine would be a grey smear
        return True
    for x, y in [([x, x], ys[[0, -1]]) for x in xs] + [(xs[[0, -1]], [y, y]) for y in ys]:
        axes.plot(x, y, [0, 0], color="0.85", lw=0.6, zorder=0)
    return True


def _label(axes) -> None:
    axes.set_xlabel("x in m")
    axes.set_ylabel("y in m")
    axes.set_zlabel("z in m")
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.get_major_locator().set_params(nbins=4)
    axes.tick_params(labelsize=8, pad=0)
    axes.grid(False)
