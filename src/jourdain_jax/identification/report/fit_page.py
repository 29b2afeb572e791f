"""A fit as one self-contained HTML file: texts, tables and figures.

If AR(1) noise of correlation r_1 is taken for white noise, intervals are too narrow by about sqrt((1 + r_1) /
(1 - r_1)) for slowly changing sensitivities: G. E. P. Box, G. M. Jenkins and G. C. Reinsel, Time Series
Analysis, 3rd ed. (1994), section 2.1.5.

Figures: data and prediction with errors, the interval of each unknown, and its profile.
"""

import html
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jourdain_jax.calculus.figures import DATA, MODEL, QUIET, figure
from jourdain_jax.identification.inference.standard_errors import RISE_95
from jourdain_jax.identification.report.estimates import Estimates
from jourdain_jax.identification.report.resumed_fit import Informed, Prediction, Profile
from jourdain_jax.scene.printing import table

_WIDTH, _HEIGHT = 460, 200  # tuning: pixels


def data_and_prediction(caption: str, label: str, one: Prediction, component: int) -> str:
    """Draw samples of one component with their prediction, and below them the errors in sigmas, with a band
    of two sigmas.
    """
    value, predicted, sigma = (
        np.asarray(x).reshape(len(one.ts), -1)[:, component] for x in (one.values, one.prediction, one.sigma)
    )

    def draw(whole) -> None:
        above, below = whole.subplots(2, 1, sharex=True, height_ratios=(5, 2))
        above.plot(one.ts, value, ".", color=DATA, ms=3, alpha=0.6)
        known = np.isfinite(predicted)
        above.plot(one.ts[known], predicted[known], color=MODEL, lw=1.2)
        below.axhspan(-2, 2, color="#e6e6e6")
        below.axhline(0.0, color=QUIET, lw=0.8)
        below.plot(one.ts, (predicted - value) / sigma, ".", color=MODEL, ms=2)
        above.set_ylabel(label)
        below.set(xlabel="t in s", ylabel="error / sigma")

    return figure(draw, _WIDTH, 270, caption)


def interval_widths(fit: Estimates) -> str:
    """Draw half the width of the 95 % interval of each unknown, in per cent of the estimate, on a logarithmic
    axis.
    """
    names, narrowest, widest = fit.labels[:40], 1e-4, 100.0  # drawn unknowns; limits in per cent
    values, low, high = (np.asarray(x[: len(names)], float) for x in (fit.values, fit.low, fit.high))
    half = np.maximum(high - values, values - low)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 100 * half / np.abs(values)
    told, words = np.isfinite(half), ["one-sided" if bound else "not determined" for bound in fit.at_bound]
    for i in np.flatnonzero(told):
        words[i] = f"{values[i]:.4g} {fit.units[i]}".strip() + (
            f" ± {half[i]:.2g}" if share[i] < 1000 else ""
        )

    def draw(whole) -> None:
        axes = whole.add_subplot(xlabel="half of the 95 % interval, in % of the estimate", xscale="log")
        shown = np.where(told, np.clip(share, narrowest, widest), narrowest)
        bars = axes.barh(range(len(names)), shown, color=[MODEL if s < 100 else DATA for s in share])
        axes.bar_label(bars, words[: len(names)], padding=3, fontsize=8)
        axes.set_yticks(range(len(names)), [name if len(name) <= 30 else name[:29] + "…" for name in names])
        axes.set_xlim(max(narrowest, 0.5 * shown.min()), 40 * widest)
        axes.invert_yaxis()

    notes = ["red: the interval is wider than the estimate"] if np.any(share >= 100) else []
    if len(fit.labels) > len(names):
        notes.append(f"{len(fit.labels) - len(names)} more unknowns are not drawn")
    return figure(draw, 700, 20 * len(names) + 60, "; ".join(notes))


def profile(one: Profile, error: float) -> str:
    """Draw the rise of the sum of squares along an unknown, its 95 % interval, and the parabola of the
    standard error.
    """
    shown = one.rise <= 3 * RISE_95
    values, rise = one.values[shown], one.rise[shown]

    def draw(whole) -> None:
        axes = whole.add_subplot(
            xlabel=f"{one.name} in {one.unit}" if one.unit else one.name, ylabel="2 (F - F_min)"
        )
        axes.plot(values, rise, ".-", color=MODEL, lw=1.2)
        axes.axhline(RISE_95, color=DATA, ls="--", lw=0.8)
        axes.axvline(one.estimate, color=QUIET, lw=0.8)
        for end in np.compress(one.is_closed, (one.low, one.high)):
            axes.axvline(end, color=DATA, ls="--", lw=0.8)
        (low, high), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        x = np.linspace(low, high, 60)
        axes.plot(x, ((x - one.estimate) / error) ** 2, "--", color=QUIET, lw=0.8)
        axes.set(xlim=(low, high), ylim=(bottom, max(top, 1.3 * RISE_95)))

    return figure(draw, _WIDTH, _HEIGHT, str(one).replace("`", ""))


_PAGE = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body{{font:15px/1.45 sans-serif;max-width:980px;margin:2em auto;padding:0 1em;color:#222}}
pre{{font-size:13px;white-space:pre-wrap}}
figure{{display:inline-block;margin:.4em .6em .4em 0;vertical-align:top}}
figcaption{{font-size:13px;max-width:460px}}h2{{margin-top:1.6em}}
</style></head><body><h1>{title}</h1>{sections}</body></html>
"""


class Section(NamedTuple):
    """A part of the page: heading, lines of text, figures in HTML."""

    title: str
    about: str
    lines: Sequence[str]
    figures: Sequence[str] = ()

    def __str__(self) -> str:
        head = f"<h2>{html.escape(self.title)}</h2>" if self.title else ""
        about = f"<p>{html.escape(self.about)}</p>" if self.about else ""
        text = html.escape("\n".join(self.lines))
        return f"{head}{about}<pre>{text}</pre>{''.join(self.figures)}"


Predictions = Sequence[dict[str, Prediction]]  # by run and channel


def fit_page(
    fit: Estimates,
    fitted: Predictions,
    shares: Informed | None,
    held_out: Predictions,
    profiles: Mapping[str, Profile],
    units: Mapping[str, str],
) -> str:
    """Return the page of a `Fit` of one experiment. `fitted`, `held_out`: predictions; `units`: units of
    channels.
    """
    sections = [Section("", "", [str(fit)], [interval_widths(fit)])]
    if profiles:
        about = (
            "The rise of the sum of squares when one unknown is fixed and all others are fitted again. The "
            "interval ends where the rise passes 3.84 (red, dashed). Grey: the parabola of the standard "
            "error; where the two differ, trust the profile."
        )
        figures = [profile(one, float(fit[one.name].standard_error)) for one in profiles.values()]
        sections.append(Section("Profile likelihood", about, list(map(str, profiles.values())), figures))
    if shares is not None and shares.labels:
        sections.append(_informed(shares))
    sections.append(_correlations(fit))
    if fitted:
        sections.append(_predicted("Data (dots) and prediction (line)", "", fitted, units, "run"))
    if held_out:
        about = (
            "These runs were not fitted. Shared unknowns are fixed at their estimates; unknown start values, "
            "and each run's sensor parameters, are fitted to the run itself."
        )
        sections.append(_predicted("Runs held out", about, held_out, units, "held out, run"))
    sections += [_whiteness(fit, fitted), _way(fit)]
    return _PAGE.format(
        title=html.escape(f"Fit of {type(fit.scene).__name__}"), sections="".join(map(str, sections))
    )


def _informed(shares: Informed) -> Section:
    about = (
        "Shares of samples in the information on each unknown. They account for the estimation of all other "
        "unknowns."
    )
    shown = np.sort(np.argsort(-shares.of_runs.sum(axis=0), kind="stable")[:8])  # runs
    columns = {f"run {run}": shares.of_runs[:, run] for run in shown}
    columns |= shares.of_channels | {"priors": shares.of_priors}
    rows = [("unknown", *columns, "half of the best run's share")]
    for i, name in enumerate(shares.labels):
        run, begin, end = shares.half(i)
        parts = (f"{100 * share[i]:.1f} %" for share in columns.values())
        rows.append((name, *parts, f"run {run}, {begin:.3g} to {end:.3g} s"))
    more = shares.of_runs.shape[1] - len(shown)
    note = [f"The {len(shown)} most informative runs are shown; {more} more are not."] if more else []
    return Section("Information on each unknown", about, table(rows) + note)


def _correlations(fit: Estimates) -> Section:
    names = fit.labels[:30]  # unknowns in the table of correlations
    found = fit.correlation[: len(names), : len(names)]
    rows = [("", *names)]
    for name, row in zip(names, found, strict=True):
        rows.append((name, *("-" if np.isnan(c) else f"{c:.2f}" for c in row)))
    about = f"The first {len(names)} of {len(fit.labels)} unknowns." if len(fit.labels) > len(names) else ""
    return Section("Correlations", about, table(rows))


def _predicted(title: str, about: str, runs: Predictions, units: Mapping[str, str], what: str) -> Section:
    named = [
        (f"{what} {run}", name, units.get(name, "SI units"), one)
        for run, channels in enumerate(runs)
        for name, one in channels.items()
    ]
    lines, panels = [f"`{name}` of {of}, in {unit}: {one}" for of, name, unit, one in named], []
    for of, name, unit, one in named:
        count = int(np.prod(one.values.shape[1:], dtype=int))
        components = [f"{name}[{k}]" for k in range(count)] if count > 1 else [name]
        panels += [
            (f"{of}: {component}", f"{component} in {unit}", one, k) for k, component in enumerate(components)
        ]
    lines += [f"{len(panels) - 40} more are not drawn."] if len(panels) > 40 else []
    return Section(title, about, lines, [data_and_prediction(*panel) for panel in panels[:40]])


def _whiteness(fit: Estimates, fitted: Predictions) -> Section:
    about = "Residuals are whitened if the correlation time of their noise was estimated or given."
    rows = [
        (
            "channel",
            "correlation of neighbours",
            "white limit",
            "white",
            "correlation time",
            "intervals too narrow by",
        )
    ]
    for name, (rho, limit) in fit.autocorrelation.items():
        white = abs(rho) <= limit
        time = f"{float(fit.correlation_time[name]):.3g} s" if name in fit.correlation_time else "-"
        if not white and rho > 0 and name not in fit.correlation_time and fitted:
            interval = np.median(np.concatenate([np.diff(run[name].ts) for run in fitted if name in run]))
            time = f"about {-interval / np.log(min(rho, 0.999)):.2g} s"
        narrow = "-" if white or rho < 0 else f"about {np.sqrt((1 + rho) / (1 - min(rho, 0.999))):.2g}"
        rows.append((name, f"{rho:.3f}", f"{limit:.3f}", "yes" if white else "NO", time, narrow))
    if any(row[3] == "NO" for row in rows):
        if fit.errors == "sigmas":
            allowed = ""
        else:
            allowed = " The intervals of this fit use differences between runs, which include this effect."
        about = (
            "Where residuals are not white, intervals from the sigmas are too narrow, by about the factor in"
            f" the last column.{allowed} {about}"
        )
    return Section("Are the residuals white?", about, table(rows))


def _way(fit: Estimates) -> Section:
    if fit.guesses > 1:
        told = fit.agreement
    else:
        told = "one first guess was tried; `guesses=30` would show how many lead here"
    rows = [("objective", "steps tried", "F at first", "F at last")]
    rows += [(what, str(len(costs) - 1), f"{costs[0]:.6g}", f"{costs[-1]:.6g}") for what, costs in fit.trace]
    return Section("Path to the minimum", told, table(rows))
