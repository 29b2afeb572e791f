"""A fit as text: what `print` shows of one, and of a batch."""

import numpy as np

from jourdain_jax.analysis.estimates import Estimates
from jourdain_jax.analysis.fit_warnings import warnings_of
from jourdain_jax.analysis.table import table

MOST_NAMED = 8  # combinations of unknowns that are told poorly, pairs that correlate


@np.errstate(over="ignore", invalid="ignore")
def text(fit: Estimates) -> str:
    """The text of a fit of one experiment: estimates with their intervals, warnings, what the data do not tell, residuals by channel."""
    lines = [
        f"Fit of {type(fit.scene).__name__}: {'converged' if fit.converged else 'NOT CONVERGED'} in {int(fit.steps)} steps; "
        f"{int(fit.samples)} samples, {len(fit.labels)} unknowns, reduced chi-square {float(fit.reduced_chi_square):.4g}"
    ]
    lines += [f"WARNING: {sentence}" for sentence in warnings_of(fit)]
    if fit.grown:
        lines.append("found over growing spans: the first guess led elsewhere")
    if fit.shooting is not None:
        pieces = " + ".join(map(str, fit.shooting.pieces[:MOST_NAMED])) + (" + ..." if len(fit.shooting.pieces) > MOST_NAMED else "")
        lines.append(f"found by multiple shooting in {pieces} pieces, which join to {float(fit.shooting.continuity):.1g} of the simulation's tolerance")
    if fit.guesses > 1:
        lines.append(agreement(fit))
    if fit.errors == "runs":
        lines.append(f"standard errors from how much the {len(fit.residuals)} runs differ")
    lines += [f"sigma of `{name}`, estimated: {float(sigma):.4g}" for name, sigma in fit.sigma.items()]
    lines += [f"correlation time of the noise of `{name}`, estimated: {float(tau):.4g} s" for name, tau in fit.correlation_time.items()]
    rows = [("unknown", "unit", "estimate", "std. error", "95 % interval")]
    rows += [_row(name, e, " (one-sided, at its bound)" if at_bound else "") for (name, e), at_bound in zip(fit.estimates.items(), fit.at_bound, strict=True)]
    rows += [_row(name, e, " (tied)") for name, e in fit.tied.items() if e.value.ndim == 0]
    lines += table(rows)
    if fit.not_identifiable:
        lines.append(f"singular values below {fit.cutoff:g} of the largest count as zero:")
        lines += [f"  {sentence}" for sentence in fit.not_identifiable]
    for sentences, what in ((fit.weak, "combinations"), (fit.correlated, "pairs")):
        lines += [f"  {sentence}" for sentence in sentences[:MOST_NAMED]]
        lines += [f"  and {len(sentences) - MOST_NAMED} more {what}"] if len(sentences) > MOST_NAMED else []
    rows = [("run", "channel", "samples", "mean", "rms", "largest residual (in sigmas)")]
    for s in fit.residual_summary():
        rows.append((str(s.run), s.channel, str(s.samples), f"{s.mean:.2g}", f"{s.rms:.3g}", f"{s.largest:.3g}"))
    return "\n".join(lines + table(rows))


def _row(name: str, e, remark: str) -> tuple[str, ...]:
    error = f"{e.standard_error:.2g}" if np.isfinite(e.standard_error) else "-"
    interval = f"[{e.low:.6g}, {e.high:.6g}]" if not np.isnan(e.low + e.high) else "none"
    return name, e.unit, f"{e.value:.6g}", error, interval + remark


def batch_text(fit: Estimates) -> str:
    """The text of many fits: mean and spread of the estimates that converged."""
    good = np.asarray(fit.converged)
    rows = [("unknown", "unit", "mean", "std. deviation", "mean std. error")]
    for name, e in fit.estimates.items():
        values, errors = np.asarray(e.value)[good], np.asarray(e.standard_error)[good]
        errors = errors[np.isfinite(errors)]  # an estimate at its bound has none
        some, error = good.sum() > 1, f"{errors.mean():.2g}" if errors.size else "-"
        numbers = (f"{values.mean():.6g}", f"{values.std(ddof=1):.2g}", error) if some else ("-", "-", "-")
        rows.append((name, e.unit, *numbers))
    return "\n".join([f"{good.size} fits of {type(fit.scene).__name__}: {good.sum()} converged", *table(rows)])


def agreement(fit: Estimates) -> str:
    """How many first guesses led to the minimum."""
    return f"{int(fit.agreeing) or 'none'} of {fit.guesses} first guesses led to {'this' if fit.agreeing else 'a'} minimum"
