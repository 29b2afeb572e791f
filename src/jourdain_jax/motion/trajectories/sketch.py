"""Small drawings of motions for notebooks: coordinates against time, as SVG, from the saved numbers alone."""

import html

import numpy as np

from jourdain_jax.motion.trajectories.over_times import Record

_MOST = 12  # coordinates that are drawn
_WIDE, _HIGH, _POINTS, _LANES = 170, 34, 120, 1000  # pixels of a line; points and lanes at most
_LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)  # quantiles of lanes: the ends of two bands, the median between them


def sketch(record: Record) -> str:
    """One small line for each coordinate, with its name and its range; times that were not reached are left out."""
    ts, q = np.asarray(record.ts), np.asarray(record.q)
    return _drawn(record, ts, q[None])


def sketch_of_lanes(record: Record) -> str:
    """Many motions, with a leading axis of lanes, as one drawing: the median, and the bands that hold half and 95 % of those that are under way.

    There is none of lanes that were saved at times of their own.
    """
    lanes = _spread(len(record.q), _LANES)
    ts, q = np.asarray(record.ts[0]), np.asarray(record.q[lanes])
    if not np.all(np.asarray(record.ts) == ts):
        return ""
    reached = np.isfinite(q).all(axis=2).any(axis=0)
    levels = np.full((len(_LEVELS), *q.shape[1:]), np.nan)
    chosen = np.flatnonzero(reached)[_spread(int(reached.sum()), _POINTS)]
    levels[:, chosen] = np.nanquantile(q[:, chosen], _LEVELS, axis=0)
    return _drawn(record, ts, levels)


def _spread(count: int, most: int) -> np.ndarray:
    """At most so many of the numbers 0 to count - 1, evenly chosen."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(most, count)).astype(int))


def _drawn(record: Record, ts: np.ndarray, levels: np.ndarray) -> str:
    """A drawing of each coordinate; `levels` (levels, times, coordinates): the line in the middle, bands around it."""
    reached = np.flatnonzero(np.isfinite(levels).all(axis=(0, 2)))
    if reached.size < 2:
        return ""
    chosen = reached[_spread(reached.size, _POINTS)]
    x = 1 + (_WIDE - 2) * (ts[chosen] - ts[0]) / (ts[-1] - ts[0])
    names = record.scene.coordinate_names.entries
    parts = [_line(name, x, levels[:, chosen, k]) for k, name in enumerate(names[:_MOST])]
    more = len(names) - _MOST
    return f"<div style='display:flex;flex-wrap:wrap;gap:10px'>{''.join(parts)}</div>" + (f"<div>and {more} more</div>" if more > 0 else "")


def _line(name: str, x: np.ndarray, levels: np.ndarray) -> str:
    low, high = float(levels.min()), float(levels.max())
    span = high - low if high - low > 1e-12 * max(abs(low), abs(high), 1e-300) else np.inf
    y = _HIGH / 2 + 0 * levels if np.isinf(span) else _HIGH - 2 - (_HIGH - 4) * (levels - low) / span
    half = len(y) // 2
    bands = "".join(f"<polygon points='{_points(x, y[k])} {_points(x[::-1], y[-1 - k, ::-1])}' fill='#1f77b4' fill-opacity='0.25'/>" for k in range(half))
    line = f"<polyline points='{_points(x, y[half])}' fill='none' stroke='#1f77b4' stroke-width='1.5'/>"
    drawing = f"<svg width='{_WIDE}' height='{_HIGH}'>{bands}{line}</svg>"
    return f"<div style='font-size:11px;text-align:left'>{html.escape(name)}: {low:.3g} to {high:.3g}<br>{drawing}</div>"


def _points(x: np.ndarray, y: np.ndarray) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
