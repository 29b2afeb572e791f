"""Pictures of a scene's bodies with matplotlib: animations, stills, and the view of a scene in a notebook."""

from collections.abc import Sequence

import numpy as np

from jourdain_jax.calculus.figures import figure as figure_in_html
from jourdain_jax.calculus.figures import pyplot
from jourdain_jax.calculus.files import FilePath, check_place
from jourdain_jax.calculus.reals import checked_whole, described
from jourdain_jax.motion.start import start
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.views.looks import Drawn, looks_at, looks_of
from jourdain_jax.views.space import axes_in_space, box_of, draw, legend, painted

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
    angles, plt, still = (
        VIEWS[view] if isinstance(view, str) else view,
        pyplot(),
        str(path).lower().endswith(_STILL),
    )
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
