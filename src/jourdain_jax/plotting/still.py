"""A still picture of a motion: solid bodies at a few times and paths of points; from above, from the side or in space."""

import os
from collections.abc import Sequence

import numpy as np

from jourdain_jax.calculus.reals import described
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.plotting.backend import pyplot
from jourdain_jax.plotting.looks import Drawn, looks_of
from jourdain_jax.plotting.space import axes_in_space, box_of, draw, legend, painted

VIEWS = {"above": (90.0, -90.0), "side": (0.0, -90.0), "space": (28.0, -60.0)}  # elevation and azimuth, degrees


def draw_still(
    trajectory: Trajectory,
    path: str | os.PathLike,
    *,
    at: int | Sequence = 3,
    paths: Sequence[tuple[str, Sequence]] | None = None,
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
    plt, drawn = pyplot(), looks_of(trajectory)
    chosen = _times(drawn, at)
    ends = [(next(name for name in drawn.bodies if name), (0.0, 0.0, 0.0))] if paths is None else list(paths)
    traces = [np.asarray(trajectory.point(*end))[drawn.reached] for end in ends]
    strengths = np.linspace(0.35, 1.0, len(chosen)) if len(chosen) > 1 else [1.0]
    faces, colours = zip(*(painted(drawn, k, strength) for k, strength in zip(chosen, strengths, strict=True)), strict=True)
    figure = plt.figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
    axes = axes_in_space(figure, VIEWS[view] if isinstance(view, str) else view, (0.05, 0.07, 0.88, 0.83))
    draw(axes, (np.concatenate(faces), np.concatenate(colours)), traces, box_of([*faces, *traces]))
    legend(figure, drawn, len(ends))
    figure.savefig(path)
    plt.close(figure)


def _times(drawn: Drawn, at: int | Sequence) -> list[int]:
    """Numbers of the times at which bodies are drawn."""
    wanted = np.asarray(at, float) if not isinstance(at, int) else drawn.ts[-1:] if at <= 1 else np.linspace(drawn.ts[0], drawn.ts[-1], at)
    return np.unique(np.argmin(np.abs(drawn.ts - wanted[:, None]), axis=1)).tolist()
