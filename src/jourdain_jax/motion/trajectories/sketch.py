"""A small drawing of a motion for notebooks: its coordinates against time, as SVG, from the saved numbers alone."""

import html

import numpy as np

from jourdain_jax.motion.trajectories.over_times import Record

_MOST = 12  # coordinates that are drawn
_WIDE, _HIGH, _POINTS = 170, 34, 120  # pixels of a line; points at most


def sketch(record: Record) -> str:
    """One small line for each coordinate, with its name and its range; times that were not reached are left out."""
    ts, q = np.asarray(record.ts), np.asarray(record.q)
    reached = np.flatnonzero(np.isfinite(q).all(axis=1))
    if reached.size < 2:
        return ""
    chosen = reached[np.unique(np.linspace(0, reached.size - 1, min(_POINTS, reached.size)).astype(int))]
    x = 1 + (_WIDE - 2) * (ts[chosen] - ts[0]) / (ts[-1] - ts[0])
    parts = [_line(name, x, q[chosen, k]) for k, name in enumerate(record.scene.coordinate_names.entries[:_MOST])]
    more = len(record.scene.coordinate_names.entries) - _MOST
    return f"<div style='display:flex;flex-wrap:wrap;gap:10px'>{''.join(parts)}</div>" + (f"<div>and {more} more</div>" if more > 0 else "")


def _line(name: str, x: np.ndarray, values: np.ndarray) -> str:
    low, high = float(values.min()), float(values.max())
    span = high - low if high - low > 1e-12 * max(abs(low), abs(high), 1e-300) else np.inf
    y = _HIGH / 2 + 0 * values if np.isinf(span) else _HIGH - 2 - (_HIGH - 4) * (values - low) / span
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    drawing = f"<svg width='{_WIDE}' height='{_HIGH}'><polyline points='{points}' fill='none' stroke='#1f77b4' stroke-width='1.5'/></svg>"
    return f"<div style='font-size:11px;text-align:left'>{html.escape(name)}: {low:.3g} to {high:.3g}<br>{drawing}</div>"
