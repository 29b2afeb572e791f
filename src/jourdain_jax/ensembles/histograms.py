"""Small histograms of a study's outputs for notebooks, as SVG; they need no package beside this one."""

import html
from dataclasses import dataclass

import numpy as np

MOST = 12  # outputs that are drawn
CELLS = 40  # bars of one output, about
_WIDE, _HIGH, _FOOT = 220, 90, 16  # pixels of a picture, of them below the bars


@dataclass(frozen=True)
class Histogram:
    """Lanes per cell of an output, the edges of the cells, which are drawn pale since lanes lie anywhere in them, and the mean."""

    name: str
    unit: str
    counts: np.ndarray  # (cells,)
    edges: np.ndarray  # (cells + 1,)
    pale: np.ndarray  # (cells,)
    mean: float


def pictures(histograms: list[Histogram]) -> str:
    """One small picture for each output that any lane has: bars of lanes per cell, the mean as a line, the ends of the axis in numbers."""
    drawn = [one for one in histograms if one.counts.sum() > 0]
    more = f"<div>and {len(drawn) - MOST} more</div>" if len(drawn) > MOST else ""
    parts = "".join(_picture(one) for one in drawn[:MOST])
    return f"<div style='display:flex;flex-wrap:wrap;gap:14px'>{parts}</div>{more}" if drawn else ""


def _picture(of: Histogram) -> str:
    low, high = float(of.edges[0]), float(of.edges[-1])
    x = _WIDE * (of.edges - low) / (high - low)
    height = _HIGH - _FOOT - 2
    tall = height * of.counts / of.counts.max()
    bars = "".join(
        f"<rect x='{a:.1f}' y='{height + 2 - h:.1f}' width='{b - a:.1f}' height='{h:.1f}'{opacity}/>"
        for a, b, h, opacity in zip(x[:-1], x[1:], tall, np.where(of.pale, " fill-opacity='0.3'", ""), strict=True)
        if h > 0
    )
    mean = _WIDE * float(np.clip((of.mean - low) / (high - low), 0.0, 1.0))
    line = f"<line x1='{mean:.1f}' x2='{mean:.1f}' y1='0' y2='{height + 2}' stroke='#b3470f' stroke-width='1.5'/>"
    foot = f"<text x='0' y='{_HIGH - 3}'>{low:.3g}</text><text x='{_WIDE}' y='{_HIGH - 3}' text-anchor='end'>{high:.3g}</text>"
    drawing = f"<svg width='{_WIDE}' height='{_HIGH}' font-size='11' fill='currentColor'><g fill='#1f5fa8'>{bars}</g>{line}{foot}</svg>"
    unit = f" in {of.unit}" if of.unit else ""
    return f"<div style='font-size:11px;text-align:left'>{html.escape(of.name + unit)}, mean {of.mean:.3g}<br>{drawing}</div>"
