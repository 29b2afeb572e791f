"""Animations straight from a scene's bodies: solid bodies, paths of points, and the ground."""

import os
from collections.abc import Sequence

import numpy as np

from jourdain_jax.calculus.reals import described
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.plotting.looks import looks_of
from jourdain_jax.plotting.space import axes_in_space, box_of, draw, legend, painted
from jourdain_jax.scene.arguments import of_known_numbers


def check_suffix(path: str | os.PathLike) -> None:
    """ValueError where an animation cannot be written to a file of this name."""
    if not str(path).lower().endswith(".gif"):
        raise ValueError(f"cannot write `{path}`: an animation is a .gif file")


@of_known_numbers
def animate(
    trajectory: Trajectory,
    path: str | os.PathLike,
    *,
    frames: int = 60,
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

    drawn = looks_of(trajectory, "animate", int(frames))
    ends = [(name, (0.0, 0.0, 0.0)) for name in drawn.bodies if name] if paths is None else list(paths)
    traces = [np.asarray(trajectory.point(*end))[drawn.reached] for end in ends]
    bodies = [painted(drawn, k) for k in range(len(drawn.ts))]
    boxes = np.stack([box_of(faces[:1]) for faces in bodies])
    whole = box_of([*boxes, *traces])
    half = np.ptp(boxes, axis=1).max() * 0.62  # of the side of the square that follows the bodies
    figure = plt.figure(figsize=(6.0, 5.0))
    axes = axes_in_space(figure, view, (0.03, 0.02, 0.9, 0.88))
    clock = figure.text(0.03, 0.91, "", family="monospace")
    if title:
        figure.text(0.25, 0.91, title)
    legend(figure, drawn)

    def draw_frame(k: int):
        shown = whole.copy()
        if follow:
            shown[:, :2] = boxes[k, :, :2].mean(axis=0) + np.array([[-half], [half]])
        draw(axes, bodies[k], [trace[: k + 1] for trace in traces], shown)
        clock.set_text(f"t = {drawn.ts[k]:6.2f} s")
        return [clock]

    count = len(drawn.ts)
    seconds = float(np.clip(abs(drawn.ts[-1] - drawn.ts[0]), 2.0, 12.0))
    FuncAnimation(figure, draw_frame, frames=count, blit=False).save(path, writer=PillowWriter(fps=max(1, round(count / seconds))), dpi=80)
    plt.close(figure)
