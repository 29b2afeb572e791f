"""A fit as one HTML file for a browser: sentences, tables, and drawings in SVG; nothing is loaded from elsewhere.

R^2 = 1 - sum (prediction - value)^2 / sum (value - mean)^2,      r_k = sum w_i w_(i+k) / sum w_i^2,  w: whitened residuals
An interval from noise that is taken as white, but is AR(1) noise of correlation r_1, is too narrow by about sqrt((1 + r_1) / (1 - r_1)) where sensitivities
change slowly: G. E. P. Box, G. M. Jenkins and G. C. Reinsel, Time Series Analysis, 3rd ed. (1994), section 2.1.5.
"""

import html
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from jourdain_jax.analysis.fit_pictures import autocorrelation, data_and_prediction, information_over_time, interval_widths, profile, way_to_the_minimum
from jourdain_jax.analysis.fit_text import agreement
from jourdain_jax.analysis.held_out import Prediction
from jourdain_jax.analysis.informed import Informed
from jourdain_jax.analysis.likelihood_profiles import Profile
from jourdain_jax.analysis.weak_directions import CORRELATED, WEAK

_MOST_DRAWN, _MOST_SAMPLES = 1000, 24_000  # samples in one drawing, and in all: two megabytes
_MOST_PANELS = 40  # components of channels of runs that are drawn, of the runs fitted and of those held out
_MOST_CORRELATED = 30  # unknowns in the table of correlations
_MOST_RUNS = 8  # of which it is drawn where they inform
_MOST_ROWS, _MOST_SENTENCES = 300, 12  # of a table, of one kind
_LAGS = 20
_STYLE = (
    "body{font:15px/1.45 sans-serif;max-width:980px;margin:2em auto;padding:0 1em;color:#222}table{border-collapse:collapse;margin:.6em 0}"
    "td,th{padding:.2em .7em;border-bottom:1px solid #ddd;text-align:right}td:first-child,th:first-child{text-align:left}th{vertical-align:bottom}"
    ".warning{background:#fff2d8;border-left:4px solid #d98c00;padding:.4em .8em;margin:.4em 0}figure{display:inline-block;margin:.4em .6em .4em 0;"
    "vertical-align:top}figcaption{font-size:13px;max-width:460px}h2{margin-top:1.6em}.scroll{overflow-x:auto}.note{color:#555;font-size:14px}"
)


def fit_page(
    fit,
    *,
    fitted: Sequence[dict[str, Prediction]] = (),
    shares: Informed | None = None,
    held_out: Sequence[dict[str, Prediction]] = (),
    profiles: Mapping[str, Profile] | None = None,
    units: Mapping[str, str] | None = None,
) -> str:
    """The page of a `Fit` of one experiment; `fitted` and `held_out`: predictions by run, `units`: of channels."""
    name = type(fit.scene).__name__
    profiles, units = profiles or {}, units or {}
    parts = [f"<h1>Fit of {html.escape(name)}</h1>", *_summary(fit), "<h2>Estimates</h2>", _estimates(fit, profiles), interval_widths(fit)]
    parts += _untold(fit)
    if profiles:
        parts += ["<h2>Profile likelihood</h2>", _note(_ABOUT_PROFILES), *(profile(one, _error(fit, one.name)) for one in profiles.values())]
    if shares is not None and shares.labels:
        parts += _informed(shares)
    parts += ["<h2>Correlations</h2>", _correlations(fit), "<h2>Channels</h2>", _channels(fit, fitted, units)]
    panels = sum(len(run) for run in (*fitted, *held_out)) or 1
    most = max(60, min(_MOST_DRAWN, _MOST_SAMPLES // min(panels, 2 * _MOST_PANELS)))
    if fitted:
        parts += ["<h2>Data (dots) and prediction (line)</h2>", *_drawn_runs(fitted, units, most, "run")]
    if held_out:
        parts += ["<h2>Runs held out</h2>", _note(_ABOUT_HELD_OUT), _held_out(held_out, units), *_drawn_runs(held_out, units, most, "held out, run")]
    parts += ["<h2>Are the residuals white?</h2>", *_whiteness(fit, fitted), "<h2>The way to the minimum</h2>", *_way(fit)]
    head = f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>Fit of {html.escape(name)}</title><style>{_STYLE}</style></head>'
    return f"{head}<body>{''.join(parts)}</body></html>\n"


_ABOUT_PROFILES = (
    "By how much the sum of squares rises where one unknown is held and all others are fitted anew. The interval ends where it passes 3.84 (red, dashed). "
    "Grey: the parabola of the standard error; where both differ, trust the profile."
)
_ABOUT_HELD_OUT = (
    "These runs had no part in the fit. What all runs share is held at its estimate; start values that are unknown, and numbers of sensors of each run, are "
    "fitted to the run itself."
)
_ABOUT_SHARES = (
    "By how much the variance of an estimate would fall if these samples were a little more precise, of all samples together; it allows for all other unknowns "
    "being estimated, too."
)


def _summary(fit) -> list[str]:
    state = "converged" if fit.converged else "NOT CONVERGED"
    whence = "how much the runs differ" if fit.errors == "runs" else "the sigmas"
    runs = "1 run" if len(fit.residuals) == 1 else f"{len(fit.residuals)} runs"
    about = (
        f"{state} in {int(fit.steps)} steps; {int(fit.samples)} samples in {runs}, {len(fit.labels)} unknowns, "
        f"reduced chi-square {float(fit.reduced_chi_square):.4g} (near 1 where scene and sigmas are right). "
        f"Intervals: 95 %, standard errors from {whence}."
    )
    return [f"<p>{about}</p>", *(f'<p class="warning">{_words(sentence)}</p>' for sentence in fit.warnings)]


def _estimate(name: str, e) -> list[str]:
    return [name, e.unit, f"{e.value:.6g}", _number(e.standard_error, ".2g"), _number(e.low), _number(e.high)]


def _estimates(fit, profiles: Mapping[str, Profile]) -> str:
    heads = ["unknown", "unit", "estimate", "std. error", "low", "high"]
    heads += ["profile", "low (profile)", "high (profile)"] if profiles else []
    rows = []
    for i, (name, e) in enumerate(fit.estimates.items()):
        row = _estimate(name + (" (at its bound)" if fit.at_bound[i] else ""), e)
        if profiles:
            one = profiles.get(name)
            row += ["-"] * 3 if one is None else [one.kind, *(_end(x, closed) for x, closed in zip((one.low, one.high), one.is_closed, strict=True))]
        rows.append(tuple(row))
    tied = [_estimate(f"{name} (tied)", e) for name, e in fit.tied.items() if e.value.ndim == 0]
    rows += [(*row, *["-"] * (len(heads) - len(row))) for row in tied]
    return _table("estimates", tuple(heads), rows)


def _untold(fit) -> list[str]:
    kinds = (("Not at all", fit.not_identifiable), ("Poorly: weak directions", fit.weak), ("Not one by one: estimates that correlate", fit.correlated))
    parts = ["<h2>What the data do not tell</h2>"]
    for head, sentences in kinds:
        parts += [f"<h3>{head}</h3>"] if sentences else []
        parts += [f"<p>{_words(sentence)}</p>" for sentence in sentences[:_MOST_SENTENCES]]
        parts += [_note(f"and {len(sentences) - _MOST_SENTENCES} more")] if len(sentences) > _MOST_SENTENCES else []
    if len(parts) == 1:
        parts.append(
            f"<p>Nothing was found: each combination of unknowns has a standard error below {100 * WEAK:g} %, and no two estimates "
            f"correlate by {CORRELATED:g} or more.</p>"
        )
    return parts


def _informed(shares: Informed) -> list[str]:
    of_runs, of_channels, of_priors = shares.of_runs, shares.of_channels, shares.of_priors
    top = np.argsort(-of_runs.sum(axis=0), kind="stable")[:_MOST_RUNS]
    shown = np.sort(top)
    with_priors, several = bool(np.any(of_priors > 1e-3)), of_runs.shape[1] > 1
    which = shown if several else []
    heads = ["unknown", *(f"run {run}" for run in which), *of_channels, *(["priors"] if with_priors else [])]
    heads.append("half of what the best run tells: where" if several else "half of it: where")
    rows, percents = [], []
    for i, name in enumerate(shares.labels):
        numbers = [*(of_runs[i, run] for run in which), *(share[i] for share in of_channels.values()), *([of_priors[i]] if with_priors else [])]
        percents.append(numbers)
        run, begin, end = shares.half(i)
        half = (f"run {run}, " if several else "") + (f"{begin:.3g} to {end:.3g} s" if end > begin else f"at {begin:.3g} s")
        rows.append((name, *(f"{100 * x:.1f} %" for x in numbers), half))
    parts = ["<h2>What informs which unknown</h2>", _note(_ABOUT_SHARES)]
    parts.append(_table("informed", tuple(heads), rows, lambda i, j: percents[i][j - 1] if 0 < j <= len(percents[i]) else 0.0))
    parts += [information_over_time(shares, int(run)) for run in shown]
    more = of_runs.shape[1] - len(shown)
    return parts + ([_note(f"The {len(shown)} runs that tell most are shown; {more} more are not.")] if more else [])


def _correlations(fit) -> str:
    names = fit.labels[:_MOST_CORRELATED]
    found = fit.correlation[: len(names), : len(names)]
    rows = [(name, *(_number(c, ".2f") for c in row)) for name, row in zip(names, found, strict=True)]
    more = _note(f"The first {len(names)} of {len(fit.labels)} unknowns.") if len(fit.labels) > len(names) else ""
    return f'<div class="scroll">{_table("correlations", ("", *names), rows, lambda i, j: abs(found[i, j - 1]) if 0 < j != i + 1 else 0.0)}</div>' + more


def _channels(fit, fitted: Sequence[dict[str, Prediction]], units: Mapping[str, str]) -> str:
    heads = ("channel", "unit", "run", "samples", "mean / sigma", "rms / sigma", "largest / sigma", "sigma", "rms", "R²")
    rows = []
    for s in fit.residual_summary():
        sigma = f"{float(fit.sigma[s.channel]):.4g} (estimated)" if s.channel in fit.sigma else "given"
        one = fitted[s.run][s.channel] if fitted and s.samples else None
        size = ("-", "-") if one is None else (f"{one.rms:.3g}", _number(one.r_squared, ".6f"))
        rows.append(
            (s.channel, _unit(s.channel, units), str(s.run), str(s.samples), f"{round(s.mean, 3) + 0.0:.3f}", f"{s.rms:.3g}", f"{s.largest:.3g}", sigma, *size)
        )
    more = _note(f"{len(rows) - _MOST_ROWS} more are not shown.") if len(rows) > _MOST_ROWS else ""
    return _table("channels", heads, rows[:_MOST_ROWS]) + more


def _held_out(runs: Sequence[dict[str, Prediction]], units: Mapping[str, str]) -> str:
    rows = [
        (name, _unit(name, units), str(run), str(int(np.isfinite(one.error).sum())), f"{one.rms:.3g}", _rms_in_sigmas(one), _number(one.r_squared, ".6f"))
        for run, channels in enumerate(runs)
        for name, one in channels.items()
    ]
    return _table("held_out", ("channel", "unit", "run", "samples", "rms", "rms / sigma", "R²"), rows[:_MOST_ROWS])


def _rms_in_sigmas(one: Prediction) -> str:
    return f"{np.sqrt(np.nanmean((one.error / one.sigma) ** 2)):.3g}"


def _drawn_runs(runs: Sequence[dict[str, Prediction]], units: Mapping[str, str], most: int, what: str) -> list[str]:
    panels = []
    for run, channels in enumerate(runs):
        for name, one in channels.items():
            count = int(np.prod(one.values.shape[1:], dtype=int))
            for k in range(count):
                component = f"{name}[{k}]" if count > 1 else name
                panels.append((f"{what} {run}: {component}", f"{component} in {_unit(name, units)}", one, k))
    left = [_note(f"{len(panels) - _MOST_PANELS} more are not drawn.")] if len(panels) > _MOST_PANELS else []
    return [*(data_and_prediction(caption, label, one, k, most) for caption, label, one, k in panels[:_MOST_PANELS]), *left]


def _whiteness(fit, fitted: Sequence[dict[str, Prediction]]) -> list[str]:
    rows, figures = [], []
    for name, (rho, limit) in fit.autocorrelation.items():
        white = abs(rho) <= limit
        time = f"{float(fit.correlation_time[name]):.3g} s" if name in fit.correlation_time else "-"
        if not white and rho > 0 and name not in fit.correlation_time and fitted:
            interval = np.median(np.concatenate([np.diff(run[name].ts) for run in fitted if name in run]))
            time = f"about {-interval / np.log(min(rho, 0.999)):.2g} s"
        narrow = "-" if white or rho < 0 else f"about {np.sqrt((1 + rho) / (1 - min(rho, 0.999))):.2g}"
        rows.append((name, f"{rho:.3f}", f"{limit:.3f}", "yes" if white else "NO", time, narrow))
        series = [np.asarray(run[name]).reshape(len(run[name]), -1) for run in fit.whitened if name in run]
        total = sum(np.nansum(r**2) for r in series)
        lags = range(1, min(_LAGS, max(map(len, series)) - 1) + 1)
        found = np.array([sum(np.nansum(r[lag:] * r[:-lag]) for r in series) / total for lag in lags])
        figures.append(autocorrelation(name, found, limit))
    heads = ("channel", "correlation of neighbours", "white ones hardly exceed", "white", "correlation time", "intervals too narrow by")
    if not rows:
        return ["<p>There are no residuals to tell it from.</p>"]
    about = "Of residuals from which the memory of the noise was taken out, where that was estimated or stated."
    if any(row[3] == "NO" for row in rows):
        allowed = "" if fit.errors == "sigmas" else " Those given here come from how much the runs differ, and allow for it."
        about = f"Where residuals are not white, intervals from the sigmas are too narrow, by about the factor in the last column.{allowed} {about}"
    return [_note(about), _table("whiteness", heads, rows), *figures]


def _way(fit) -> list[str]:
    first, last = (fit.trace[k][1][k] for k in (0, -1))
    parts = [f"<p>F went from {first:.6g} to {last:.6g}. "]
    parts.append("The first guess led elsewhere: the minimum was found over growing spans of the runs. " if fit.grown else "")
    if fit.guesses > 1:
        parts.append(f"{agreement(fit).capitalize()}. ")
    else:
        parts.append("One first guess was tried; <code>guesses=30</code> would tell how many lead here. ")
    rows = [(what, str(len(costs) - 1), f"{costs[0]:.6g}", f"{costs[-1]:.6g}") for what, costs in fit.trace]
    return ["".join(parts) + "</p>", _table("trace", ("what is minimised", "steps tried", "F at first", "F at last"), rows), way_to_the_minimum(fit.trace)]


def _end(x: float, closed: bool) -> str:
    return f"{x:.6g}" if closed else f"{x:.6g} (its bound)" if np.isfinite(x) else "none"


def _error(fit, name: str) -> float:
    return float(fit[name].standard_error) if name in fit.labels else np.nan


def _number(x, form: str = ".6g") -> str:
    return "-" if np.isnan(x) else format(float(x), form)


def _unit(channel: str, units: Mapping[str, str]) -> str:
    return units.get(channel, "SI units")


def _words(sentence: str) -> str:
    """A sentence, with names in backticks as code."""
    plain = html.escape(sentence).split("`")
    return "".join(f"<code>{part}</code>" if k % 2 and k < len(plain) - 1 else part for k, part in enumerate(plain))


def _note(words: str) -> str:
    return f'<p class="note">{html.escape(words)}</p>'


def _table(name: str, heads: tuple[str, ...], rows: Sequence[tuple[str, ...]], shade: Callable[[int, int], float] | None = None) -> str:
    """`shade(row, column)`: how dark a cell is, from 0 to 1."""
    cell = lambda x, i, j: f"<td{_shaded(shade(i, j) if shade else 0.0)}>{html.escape(x)}</td>"  # noqa: E731
    body = "".join("<tr>" + "".join(cell(x, i, j) for j, x in enumerate(row)) + "</tr>" for i, row in enumerate(rows))
    return f'<table id="{name}"><tr>{"".join(f"<th>{html.escape(head)}</th>" for head in heads)}</tr>{body}</table>'


def _shaded(share: float) -> str:
    return f' style="background:rgba(27,79,114,{0.55 * min(share, 1.0):.2f})"' if np.isfinite(share) and share >= 0.05 else ""
