"""A fit as one HTML file for a browser: texts, tables and figures; nothing is loaded from elsewhere.

r_k = sum w_i w_(i+k) / sum w_i^2,  w: whitened residuals
An interval from noise that is taken as white, but is AR(1) noise of correlation r_1, is too narrow by about sqrt((1 + r_1) / (1 - r_1)) where sensitivities
change slowly: G. E. P. Box, G. M. Jenkins and G. C. Reinsel, Time Series Analysis, 3rd ed. (1994), section 2.1.5.
"""

import html
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jourdain_jax.analysis.estimates import Estimates
from jourdain_jax.analysis.fit_pictures import autocorrelation, data_and_prediction, information_over_time, interval_widths, profile, way_to_the_minimum
from jourdain_jax.analysis.fit_text import agreement
from jourdain_jax.analysis.held_out import Prediction
from jourdain_jax.analysis.informed import Informed
from jourdain_jax.analysis.likelihood_profiles import Profile
from jourdain_jax.analysis.table import table

_MOST_PANELS = 40  # components of channels of runs that are drawn, of the runs fitted and of those held out
_MOST_CORRELATED = 30  # unknowns in the table of correlations
_MOST_RUNS = 8  # of which it is drawn where they inform
_LAGS = 20
_PAGE = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body{{font:15px/1.45 sans-serif;max-width:980px;margin:2em auto;padding:0 1em;color:#222}}pre{{font-size:13px;white-space:pre-wrap}}
figure{{display:inline-block;margin:.4em .6em .4em 0;vertical-align:top}}figcaption{{font-size:13px;max-width:460px}}h2{{margin-top:1.6em}}
</style></head><body><h1>{title}</h1>{sections}</body></html>
"""


class Section(NamedTuple):
    """A part of the page: what it is about, lines of text, figures in HTML."""

    title: str
    about: str
    lines: Sequence[str]
    figures: Sequence[str] = ()

    def __str__(self) -> str:
        head = f"<h2>{html.escape(self.title)}</h2>" if self.title else ""
        about = f"<p>{html.escape(self.about)}</p>" if self.about else ""
        text = html.escape("\n".join(self.lines))
        return f"{head}{about}<pre>{text}</pre>{''.join(self.figures)}"


def fit_page(
    fit: Estimates,
    *,
    fitted: Sequence[dict[str, Prediction]] = (),
    shares: Informed | None = None,
    held_out: Sequence[dict[str, Prediction]] = (),
    profiles: Mapping[str, Profile] | None = None,
    units: Mapping[str, str] | None = None,
) -> str:
    """The page of a `Fit` of one experiment; `fitted` and `held_out`: predictions by run, `units`: of channels."""
    sections = [Section("", "", [str(fit)], [interval_widths(fit)])]
    if profiles:
        about = (
            "By how much the sum of squares rises where one unknown is held and all others are fitted anew. The interval ends where it passes 3.84 (red, "
            "dashed). Grey: the parabola of the standard error; where both differ, trust the profile."
        )
        errors = {name: float(e.standard_error) for name, e in fit.estimates.items()}
        figures = [profile(one, errors.get(one.name, np.nan)) for one in profiles.values()]
        sections.append(Section("Profile likelihood", about, [str(one) for one in profiles.values()], figures))
    if shares is not None and shares.labels:
        sections.append(_informed(shares))
    sections.append(_correlations(fit))
    if fitted:
        sections.append(_predicted("Data (dots) and prediction (line)", "", fitted, units or {}, "run"))
    if held_out:
        about = (
            "These runs had no part in the fit. What all runs share is held at its estimate; start values that are unknown, and numbers of sensors of each "
            "run, are fitted to the run itself."
        )
        sections.append(_predicted("Runs held out", about, held_out, units or {}, "held out, run"))
    sections += [_whiteness(fit, fitted), _way(fit)]
    return _PAGE.format(title=html.escape(f"Fit of {type(fit.scene).__name__}"), sections="".join(map(str, sections)))


def _informed(shares: Informed) -> Section:
    about = (
        "By how much the variance of an estimate would fall if these samples were a little more precise, of all samples together; it allows for all other "
        "unknowns being estimated, too."
    )
    shown = np.sort(np.argsort(-shares.of_runs.sum(axis=0), kind="stable")[:_MOST_RUNS])
    columns = {f"run {run}": shares.of_runs[:, run] for run in shown} | shares.of_channels | {"priors": shares.of_priors}
    rows = [("unknown", *columns, "half of what the best run tells")]
    for i, name in enumerate(shares.labels):
        run, begin, end = shares.half(i)
        rows.append((name, *(f"{100 * share[i]:.1f} %" for share in columns.values()), f"run {run}, {begin:.3g} to {end:.3g} s"))
    more = shares.of_runs.shape[1] - len(shown)
    lines = [*table(rows), *([f"The {len(shown)} runs that tell most are shown; {more} more are not."] if more else [])]
    return Section("What informs which unknown", about, lines, [information_over_time(shares, int(run)) for run in shown])


def _correlations(fit: Estimates) -> Section:
    names = fit.labels[:_MOST_CORRELATED]
    found = fit.correlation[: len(names), : len(names)]
    rows = [("", *names), *((name, *(_number(c, ".2f") for c in row)) for name, row in zip(names, found, strict=True))]
    about = f"The first {len(names)} of {len(fit.labels)} unknowns." if len(fit.labels) > len(names) else ""
    return Section("Correlations", about, table(rows))


def _predicted(title: str, about: str, runs: Sequence[dict[str, Prediction]], units: Mapping[str, str], what: str) -> Section:
    lines = [f"`{name}` of {what} {run}, in {units.get(name, 'SI units')}: {one}" for run, channels in enumerate(runs) for name, one in channels.items()]
    panels = []
    for run, channels in enumerate(runs):
        for name, one in channels.items():
            count = int(np.prod(one.values.shape[1:], dtype=int))
            for k in range(count):
                component = f"{name}[{k}]" if count > 1 else name
                panels.append((f"{what} {run}: {component}", f"{component} in {units.get(name, 'SI units')}", one, k))
    lines += [f"{len(panels) - _MOST_PANELS} more are not drawn."] if len(panels) > _MOST_PANELS else []
    return Section(title, about, lines, [data_and_prediction(*panel) for panel in panels[:_MOST_PANELS]])


def _whiteness(fit: Estimates, fitted: Sequence[dict[str, Prediction]]) -> Section:
    about = "Of residuals from which the memory of the noise was taken out, where that was estimated or stated."
    rows, figures = [("channel", "correlation of neighbours", "white ones hardly exceed", "white", "correlation time", "intervals too narrow by")], []
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
    if any(row[3] == "NO" for row in rows):
        allowed = "" if fit.errors == "sigmas" else " Those given here come from how much the runs differ, and allow for it."
        about = f"Where residuals are not white, intervals from the sigmas are too narrow, by about the factor in the last column.{allowed} {about}"
    return Section("Are the residuals white?", about, table(rows), figures)


def _way(fit: Estimates) -> Section:
    told = agreement(fit) if fit.guesses > 1 else "one first guess was tried; `guesses=30` would tell how many lead here"
    rows = [("what is minimised", "steps tried", "F at first", "F at last")]
    rows += [(what, str(len(costs) - 1), f"{costs[0]:.6g}", f"{costs[-1]:.6g}") for what, costs in fit.trace]
    return Section("The way to the minimum", told, table(rows), [way_to_the_minimum(fit.trace)])


def _number(x, form: str) -> str:
    return "-" if np.isnan(x) else format(float(x), form)
