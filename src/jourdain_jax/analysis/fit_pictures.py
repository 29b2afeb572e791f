"""The pictures of a fit: data beside prediction, residuals, how well each unknown is known, what informs it, its profile, and the way to the minimum."""

from itertools import pairwise

import numpy as np

from jourdain_jax.analysis.drawings import COLOURS, DATA, MODEL, PALE, QUIET, Axes, drawing, span_of, text
from jourdain_jax.analysis.held_out import Prediction
from jourdain_jax.analysis.informed import Informed
from jourdain_jax.analysis.likelihood_profiles import RISE_95, Profile

_WIDTH, _LEFT, _RIGHT = 460, 62, 20  # pixels
_BINS = 60  # of time, at most
_MOST_ROWS = 40  # unknowns in one drawing
_NARROWEST, _WIDEST = 1e-4, 100.0  # per cent
_LEAST_ABOVE = 1e-3  # F above its minimum: less is drawn as this


def data_and_prediction(caption: str, label: str, one: Prediction, component: int, most: int) -> str:
    """Samples of one component and what is predicted for them; below, what is left in sigmas, over a band of two. At most so many samples, evenly chosen."""
    count = len(one.ts)
    value, predicted, sigma = (np.asarray(x).reshape(count, -1)[:, component] for x in (one.values, one.prediction, one.sigma))
    every = -(-count // most)
    ts, value, predicted, sigma = (x[::every] for x in (one.ts, value, predicted, sigma))
    left = (predicted - value) / sigma
    x, width = (float(one.ts[0]), float(one.ts[-1])), _WIDTH - _LEFT - _RIGHT
    if x[0] == x[1]:
        x = span_of(x)
    above = Axes(_LEFT, 20, width, 130, x, span_of(value, predicted))
    below = Axes(_LEFT, 182, width, 52, x, span_of(left, [-3.0, 3.0]))
    parts = [above.frame("", label, numbers=False), above.dots(ts, value, PALE, size=3.6), above.line(ts, predicted)]
    in_sigmas = ((-2, "-2"), (0, "0"), (2, "2")) if below.y[1] - below.y[0] < 12 else None
    parts += [
        below.band(-2, 2),
        below.frame("t in s", "(prediction - value) / sigma", y_ticks=in_sigmas),
        below.level(0.0),
        below.dots(ts, left, MODEL, "left", 2.4),
    ]
    return drawing(_WIDTH, 268, parts, caption + (f"; every {every}th sample is drawn" if every > 1 else ""))


def autocorrelation(name: str, found: np.ndarray, limit: float) -> str:
    """Correlation of whitened residuals by lag, over the band that white noise hardly leaves."""
    lags = np.arange(1, len(found) + 1)
    low, high = span_of(found, [-limit, limit])
    axes = Axes(_LEFT, 20, _WIDTH - _LEFT - _RIGHT, 120, (0.0, len(found) + 0.5), (max(low, -1.05), max(high, 1.0)))
    parts = [axes.band(-limit, limit), axes.frame("lag in samples", f"correlation of {name}"), axes.level(0.0, "#444")]
    parts += ["".join(axes.bar(lag - 0.06, lag + 0.06, 0.0, r, QUIET) for lag, r in zip(lags, found, strict=True)), axes.dots(lags, found, DATA, size=5)]
    return drawing(_WIDTH, 176, parts)


def interval_widths(fit) -> str:
    """How well each unknown is known: half the width of its 95 % interval, in per cent of the estimate, on an axis of powers of ten."""
    names = fit.labels[:_MOST_ROWS]
    half = [max(e.high - e.value, e.value - e.low) for e in (fit[name] for name in names)]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 100 * np.array(half, float) / np.abs(np.asarray(fit.values[: len(names)], float))
    finite = share[np.isfinite(share) & (share > 0)]
    low = np.floor(np.log10(np.clip(finite.min() if finite.size else 1.0, _NARROWEST, 10.0)))
    left = 12 + 6.4 * min(max(map(len, names)), 30)
    axes = Axes(left, 8, 300, 18 * len(names), (low - 0.3, 2.0), (len(names), 0.0))
    powers = [(p, f"{10.0**p:g} %") for p in np.arange(low, 2.5)]
    parts = [axes.frame("half of the 95 % interval, in % of the estimate", x_ticks=powers, y_ticks=())]
    for row, (name, s) in enumerate(zip(names, share, strict=True)):
        parts.append(text(left - 6, 8 + 18 * row + 13, name if len(name) <= 30 else name[:29] + "…", "end"))
        unit = f" {fit.units[row]}" if fit.units[row] else ""
        told = f"{fit.values[row]:.4g}{unit}"
        if not np.isfinite(half[row]):
            parts.append(text(left + 6, 8 + 18 * row + 13, "one-sided" if fit.at_bound[row] else "the data do not tell"))
            told = told if fit.at_bound[row] else ""
        else:
            end = np.clip(np.log10(s) if s > 0 else -np.inf, axes.x[0] + 0.05, 2.0)
            parts.append(axes.bar(axes.x[0], end, row + 0.25, row + 0.75, COLOURS[0] if s < 100 else DATA))
            told += f" ± {half[row]:.2g}" if s < 1000 else ""
        parts.append(text(left + 306, 8 + 18 * row + 13, told))
    notes = ["red: the interval is wider than the estimate"] if np.any(share >= 100) else []
    notes += [f"{len(fit.labels) - len(names)} more unknowns are not drawn"] if len(fit.labels) > len(names) else []
    return drawing(int(left + 306 + 190), 18 * len(names) + 44, parts, "; ".join(notes))


def information_over_time(shares: Informed, run: int) -> str:
    """What the samples of a run tell of each unknown per second, in colours of the channels; the highest bar of each unknown, of all runs, has full height."""
    names, (edges, _) = shares.labels, _cells(shares.times[run])
    channels = list(shares.of_channels)
    most = np.max([np.max(_per_second(ts, sum(of.values())), axis=1) for ts, of in zip(shares.times, shares.of_samples, strict=True)], axis=0)
    axes = Axes(150, 26, _WIDTH - 120, 22 * len(names), (float(edges[0]), float(edges[-1])), (len(names), 0.0))
    parts = [axes.frame("t in s", y_ticks=())]
    for k, name in enumerate(channels):
        at = 150 + 130 * k
        parts += [f'<rect x="{at}" y="8" width="9" height="9" fill="{COLOURS[k % len(COLOURS)]}"/>', text(at + 13, 17, name)] if k < 3 else []
    for row, name in enumerate(names):
        parts.append(text(144, axes.top + 22 * row + 16, name if len(name) <= 22 else name[:21] + "…", "end"))
        parts.append(text(axes.left + axes.width + 6, axes.top + 22 * row + 16, f"{100 * shares.of_runs[row, run]:.0f} %"))
        base = np.zeros(len(edges) - 1)
        for k, channel in enumerate(channels):
            if channel in shares.of_samples[run]:
                found = _per_second(shares.times[run], shares.of_samples[run][channel][row]) / most[row]
                drawn = np.flatnonzero(found > 2e-3)
                bars = (axes.bar(edges[i], edges[i + 1], row + 0.95 - 0.85 * base[i], row + 0.95 - 0.85 * (base[i] + found[i])) for i in drawn)
                parts.append(f'<g fill="{COLOURS[k % len(COLOURS)]}">{"".join(bars)}</g>')
                base = base + found
        parts.append(axes.level(row + 1.0, "#ddd"))
    return drawing(_WIDTH + 90, 22 * len(names) + 62, parts, f"run {run}: share of what the data tell of each unknown, along time")


def _cells(ts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges of cells of equally many samples, halfway between neighbours, and the first sample of each; cells at the ends reach as far beyond as within."""
    first = np.arange(0, len(ts), -(-len(ts) // _BINS))
    if len(ts) == 1:
        return np.array([ts[0] - 0.5, ts[0] + 0.5]), first
    halfway = np.concatenate([[1.5 * ts[0] - 0.5 * ts[1]], (ts[1:] + ts[:-1]) / 2, [1.5 * ts[-1] - 0.5 * ts[-2]]])
    return np.append(halfway[first], halfway[-1]), first


def _per_second(ts: np.ndarray, told: np.ndarray) -> np.ndarray:
    """Sums over the samples of each cell, by its width; the last axis is that of the samples."""
    edges, first = _cells(ts)
    return np.add.reduceat(told, first, axis=-1) / np.diff(edges)


def profile(one: Profile, error: float) -> str:
    """The rise along an unknown, its 95 % interval, and the parabola of the standard error."""
    shown = one.rise <= 3 * RISE_95
    values, rise = one.values[shown], one.rise[shown]
    label = f"{one.name} in {one.unit}" if one.unit else one.name
    axes = Axes(_LEFT, 20, _WIDTH - _LEFT - _RIGHT, 130, span_of(values), span_of(rise, [0.0, 1.3 * RISE_95]))
    parts = [axes.frame(label, "2 (F - F_min)"), axes.level(RISE_95, DATA, dashed=True), axes.upright(one.estimate)]
    if np.isfinite(error) and error > 0:
        x = np.linspace(*axes.x, 60)
        parabola = ((x - one.estimate) / error) ** 2
        parts.append(axes.line(x, np.where(parabola <= axes.y[1], parabola, np.nan), QUIET, "parabola", dashed=True))
    parts += [axes.upright(end, DATA, dashed=True) for end, closed in zip((one.low, one.high), one.is_closed, strict=True) if closed]
    parts += [axes.line(values, rise), axes.dots(values, rise, MODEL, size=4)]
    return drawing(_WIDTH, 190, parts, str(one).replace("`", ""))


def way_to_the_minimum(trace: tuple[tuple[str, tuple[float, ...]], ...]) -> str:
    """F above the lowest of each stretch, after each step tried, on an axis of powers of ten; a line stands where another function is minimised."""
    above: list[float] = []
    begins = [0]
    for _, costs in trace:
        finite = np.where(np.isfinite(costs), costs, np.nan)
        above += np.log10(np.maximum(finite - np.nanmin(finite), _LEAST_ABOVE)).tolist() if np.isfinite(finite).any() else [np.nan] * len(costs)
        begins.append(len(above))
    low, high = span_of(above, [-3.0, 0.0])
    low, high = np.floor(low + 0.2), np.ceil(high - 0.2)
    whole = 2 * _WIDTH if len(above) > 60 else _WIDTH
    axes = Axes(_LEFT, 20, whole - _LEFT - _RIGHT, 130, (-0.5, len(above) - 0.5), (low - 0.15, high + 0.15))
    every = int(np.ceil((high - low) / 5))
    powers = [(p, f"1e{p:.0f}" if abs(p) > 2 else f"{10.0**p:g}") for p in np.arange(low, high + 0.5, every)]
    parts = [axes.frame("steps tried", "F above its minimum", y_ticks=powers)]
    parts += [axes.upright(begin - 0.5, QUIET, dashed=True) for begin in begins[1:-1]]
    for a, b in pairwise(begins):
        parts.append(axes.line(np.arange(a, b), above[a:b]) + axes.dots(np.arange(a, b), above[a:b], MODEL, size=4))
    return drawing(int(axes.left + axes.width + _RIGHT), 186, parts)
