"""A fit as one HTML file for a browser: tables, and drawings in SVG; nothing is loaded from elsewhere.

prediction = value + sigma residual,   R^2 = 1 - sum (prediction - value)^2 / sum (value - mean)^2,   r_k = sum r_i r_(i+k) / sum r_i^2
"""

import html
from collections.abc import Sequence

import numpy as np

from jourdain_jax.analysis.measurements import Measurements

_WIDTH, _HEIGHT, _EDGE = 420, 170, 46  # of a drawing, in pixels
_MOST_DRAWN = 400  # samples in one drawing, evenly chosen
_MOST_PANELS = 40  # runs times channels that are drawn
_MOST_CORRELATED = 30  # unknowns in the table of correlations
_LAGS = 20
_STYLE = (
    "body{font:15px/1.45 sans-serif;max-width:960px;margin:2em auto;padding:0 1em;color:#222}table{border-collapse:collapse;margin:.6em 0}"
    "td,th{padding:.2em .7em;border-bottom:1px solid #ddd;text-align:right}td:first-child,th:first-child{text-align:left}"
    ".warning{background:#fff2d8;border-left:4px solid #d98c00;padding:.4em .8em;margin:.4em 0}figure{display:inline-block;margin:.4em}"
    "figcaption{font-size:13px}svg{font:11px sans-serif}"
)


def fit_page(fit, runs: Sequence[Measurements]) -> str:
    """The page of a `Fit` of one experiment; `runs`: the measurements that it was fitted to, none where data are not to be drawn."""
    name = type(fit.scene).__name__
    state = "converged" if fit.converged else "NOT CONVERGED"
    about = (
        f"{state} in {int(fit.steps)} steps; {int(fit.samples)} samples, {len(fit.labels)} unknowns, reduced chi-square {float(fit.reduced_chi_square):.4g}. "
        f"Intervals: 95 %, standard errors from the {fit.errors}."
    )
    parts = [f"<h1>Fit of {html.escape(name)}</h1>", f"<p>{about}</p>"]
    parts += [f'<p class="warning">{html.escape(sentence)}</p>' for sentence in fit.warnings]
    if fit.guesses > 1:
        parts.append(f"<p>{int(fit.agreeing)} of {fit.guesses} first guesses led to this minimum.</p>")
    parts += ["<h2>Estimates</h2>", _table("estimates", _estimates(fit))]
    sentences = [*fit.not_identifiable, *fit.correlated]
    parts += ["<h2>What the data do not tell</h2>", "".join(f"<p>{html.escape(s)}</p>" for s in sentences) or "<p>Nothing of this kind was found.</p>"]
    parts += ["<h2>Correlations</h2>", _table("correlations", _correlations(fit))]
    parts += ["<h2>Channels</h2>", _table("channels", _channels(fit, runs))]
    if runs:
        parts += ["<h2>Data (dots) and prediction (line)</h2>", *_drawn_runs(fit, runs)]
    parts += ["<h2>Autocorrelation of whitened residuals</h2>", *_drawn_autocorrelations(fit)]
    head = f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Fit of {html.escape(name)}</title><style>{_STYLE}</style></head>'
    return f"{head}<body>{''.join(parts)}</body></html>\n"


def prediction(fit, run: int, data: Measurements, channel: str) -> np.ndarray:
    """What the fit predicts for a channel of a run, in its unit, shape (times, *channel); NaN where the sample is missing."""
    sigma = fit.sigma.get(channel, np.asarray(data.sigma_of(channel)))
    return np.asarray(data.values[channel]) + sigma * np.asarray(fit.residuals[run][channel])


def _estimates(fit) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("unknown", "unit", "estimate", "std. error", "low", "high")]
    for (name, e), bound in zip(fit.estimates.items(), fit.at_bound, strict=True):
        ends = ("-", "-") if np.isnan(e.low + e.high) else (f"{e.low:.6g}", f"{e.high:.6g}")
        rows.append((name + (" (at its bound)" if bound else ""), e.unit, f"{e.value:.6g}", f"{e.standard_error:.2g}", *ends))
    return rows


def _correlations(fit) -> list[tuple[str, ...]]:
    names = fit.labels[:_MOST_CORRELATED]
    return [("", *names), *((name, *("-" if np.isnan(c) else f"{c:.2f}" for c in fit.correlation[i, : len(names)])) for i, name in enumerate(names))]


def _channels(fit, runs: Sequence[Measurements]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("channel", "run", "samples", "mean / sigma", "rms / sigma", "largest / sigma", "sigma (estimated)", "R²")]
    for s in fit.residual_summary():
        share = "-"
        if runs:
            value = np.asarray(runs[s.run].values[s.channel])
            error = prediction(fit, s.run, runs[s.run], s.channel) - value
            about = np.where(np.isfinite(error), value, np.nan)
            spread = np.nansum((about - np.nanmean(about, axis=0)) ** 2) if s.samples else 0.0
            share = f"{1 - np.nansum(error**2) / spread:.6f}" if spread > 0 else "-"
        sigma = f"{float(fit.sigma[s.channel]):.4g}" if s.channel in fit.sigma else "-"
        rows.append((s.channel, str(s.run), str(s.samples), f"{s.mean:.2g}", f"{s.rms:.3g}", f"{s.largest:.3g}", sigma, share))
    return rows


def _drawn_runs(fit, runs: Sequence[Measurements]) -> list[str]:
    panels = []
    for run, data in enumerate(runs):
        for name in fit.residuals[run]:
            ts, value = np.asarray(data.ts), np.asarray(data.values[name]).reshape(len(data.ts), -1)
            predicted = prediction(fit, run, data, name).reshape(value.shape)
            some = np.unique(np.linspace(0, len(ts) - 1, min(len(ts), _MOST_DRAWN)).astype(int))
            for k in range(value.shape[1]):
                caption = f"run {run}: {name}" + (f" [{k}]" if value.shape[1] > 1 else "") + " over t in s"
                panels.append(_drawing(caption, ts[some], value[some, k], predicted[some, k]))
    left = f"<p>{len(panels) - _MOST_PANELS} more are not drawn.</p>" if len(panels) > _MOST_PANELS else ""
    return [*panels[:_MOST_PANELS], left]


def _drawn_autocorrelations(fit) -> list[str]:
    figures = []
    for name, (_, limit) in fit.autocorrelation.items():
        series = [np.asarray(run[name]).reshape(len(run[name]), -1) for run in fit.whitened if name in run]
        total = sum(np.nansum(r**2) for r in series)
        lags = np.arange(1, min(_LAGS, max(map(len, series)) - 1) + 1)
        found = np.array([sum(np.nansum(r[lag:] * r[:-lag]) for r in series) / total for lag in lags])
        figures.append(_drawing(f"{name}, by lag in samples; grey: what white noise hardly exceeds ({limit:.2f})", lags, found, band=limit))
    return figures


def _drawing(caption: str, x: np.ndarray, dots: np.ndarray, line: np.ndarray | None = None, band: float | None = None) -> str:
    """Dots over x, with a line through `line`, or a grey band of +- `band` about zero; infinite and missing numbers are left out."""
    shown = np.concatenate([dots, *([line] if line is not None else []), *([[-band, band]] if band is not None else [])])
    shown = shown[np.isfinite(shown)]
    if not shown.size:
        return ""
    low, high, first, last = shown.min(), shown.max(), x[0], x[-1]
    right = lambda x: _EDGE + (_WIDTH - _EDGE - 8) * (x - first) / ((last - first) or 1.0)  # noqa: E731
    down = lambda y: 8 + (_HEIGHT - 32) * (high - y) / ((high - low) or 1.0)  # noqa: E731
    parts = [f'<rect x="{_EDGE}" y="8" width="{_WIDTH - _EDGE - 8}" height="{_HEIGHT - 32}" fill="none" stroke="#bbb"/>']
    if band is not None:
        parts.append(f'<rect x="{_EDGE}" y="{down(band):.1f}" width="{_WIDTH - _EDGE - 8}" height="{down(-band) - down(band):.1f}" fill="#ddd"/>')
    parts += [f'<circle cx="{right(a):.1f}" cy="{down(b):.1f}" r="2" fill="#d1495b"/>' for a, b in zip(x, dots, strict=True) if np.isfinite(b)]
    if line is not None:
        points = " ".join(f"{right(a):.1f},{down(b):.1f}" for a, b in zip(x, line, strict=True) if np.isfinite(b))
        parts.append(f'<polyline points="{points}" fill="none" stroke="#1b4f72" stroke-width="1.2"/>')
    ends = ((_EDGE - 4, 16, "end", high), (_EDGE - 4, _HEIGHT - 24, "end", low), (_EDGE, _HEIGHT - 8, "start", first), (_WIDTH - 8, _HEIGHT - 8, "end", last))
    parts += [f'<text x="{a}" y="{b}" text-anchor="{anchor}">{number:.3g}</text>' for a, b, anchor, number in ends]
    return f'<figure><svg width="{_WIDTH}" height="{_HEIGHT}">{"".join(parts)}</svg><figcaption>{html.escape(caption)}</figcaption></figure>'


def _table(name: str, rows: list[tuple[str, ...]]) -> str:
    head, *body = rows
    cells = lambda row, tag: "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row) + "</tr>"  # noqa: E731
    return f'<table id="{name}">{cells(head, "th")}{"".join(cells(row, "td") for row in body)}</table>'
