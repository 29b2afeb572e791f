"""Small plots of coordinates over time, shown in notebooks."""

import numpy as np

from jourdain_jax.calculus.figures import MODEL, figure
from jourdain_jax.motion.trajectories.values_in_time import Record


def sketch(record: Record) -> str:
    """Draw each coordinate with its name and range, without unreached times."""
    return _drawn(record, np.asarray(record.ts), np.asarray(record.q)[None])


def sketch_of_lanes(record: Record) -> str:
    """Draw a batch of motions: the median, and bands that contain 50 % and 95 % of the samples still running.
    Return "" if samples have different saved times.
    """
    levels = 0.025, 0.25, 0.5, 0.75, 0.975  # the limits of two bands, with the median in the middle
    lanes = _spread(len(record.q), 1000)
    ts, q = np.asarray(record.ts[0]), np.asarray(record.q[lanes])
    if not np.all(np.asarray(record.ts) == ts):
        return ""
    reached = np.isfinite(q).all(axis=2).any(axis=0)
    found = np.full((len(levels), *q.shape[1:]), np.nan)
    chosen = np.flatnonzero(reached)[_spread(int(reached.sum()))]
    found[:, chosen] = np.nanquantile(q[:, chosen], levels, axis=0)
    return _drawn(record, ts, found)


def _spread(count: int, most: int = 120) -> np.ndarray:
    """Return at most `most` of the indices 0 to count - 1, evenly spaced."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(most, count)).astype(int))


def _drawn(record: Record, ts: np.ndarray, levels: np.ndarray) -> str:
    """Draw the coordinates. `levels` (levels, times, coordinates): the middle level is drawn as a line, the
    others as bands around it.
    """
    reached = np.flatnonzero(np.isfinite(levels).all(axis=(0, 2)))
    if reached.size < 2:
        return ""
    chosen, names = reached[_spread(reached.size)], record.scene.coordinate_names.entries
    half, shown = len(levels) // 2, min(len(names), 12)
    rows, columns = -(-shown // 4), min(shown, 4)

    def draw(whole) -> None:
        for k, name in enumerate(names[:shown]):
            axes, y = whole.add_subplot(rows, columns, k + 1), levels[:, chosen, k]
            for j in range(half):
                axes.fill_between(ts[chosen], y[j], y[-1 - j], color=MODEL, alpha=0.25, lw=0)
            axes.plot(ts[chosen], y[half], color=MODEL, lw=1.2)
            axes.set(
                title=f"{name}: {y.min():.3g} to {y.max():.3g}", xticks=[], yticks=[], xlim=(ts[0], ts[-1])
            )

    more = f"and {len(names) - shown} more" if len(names) > shown else ""
    return figure(draw, 190 * columns, 66 * rows, more)
