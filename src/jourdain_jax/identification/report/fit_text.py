"""The text that `print` shows of a fit, or of a batch of fits."""

import numpy as np

from jourdain_jax.identification.report.estimates import Estimates
from jourdain_jax.identification.report.fit_warnings import warnings_of
from jourdain_jax.scene.names import Labels
from jourdain_jax.scene.printing import table


@np.errstate(over="ignore", invalid="ignore")
def text(fit: Estimates) -> str:
    """Return the text of a fit of one experiment: estimates with intervals, warnings, undetermined
    combinations, residuals by channel.
    """
    most = 8  # printed combinations of unknowns, correlated pairs, pieces of runs
    lines = [
        f"Fit of {type(fit.scene).__name__}: {'converged' if fit.converged else 'NOT CONVERGED'} in "
        f"{int(fit.steps)} steps; {int(fit.samples)} samples, {len(fit.labels)} unknowns, reduced chi-square "
        f"{float(fit.reduced_chi_square):.4g}"
    ]
    lines += [f"WARNING: {sentence}" for sentence in warnings_of(fit)]
    if fit.grown:
        lines.append("found over growing spans: the first guess led elsewhere")
    if fit.shooting is not None:
        pieces = " + ".join(map(str, fit.shooting.pieces[:most])) + (
            " + ..." if len(fit.shooting.pieces) > most else ""
        )
        lines.append(
            f"found by multiple shooting in {pieces} pieces, which join to "
            f"{float(fit.shooting.continuity):.1g} of the simulation's tolerance"
        )
    if fit.guesses > 1:
        lines.append(fit.agreement)
    if fit.errors == "runs":
        lines.append(f"standard errors from the differences between the {len(fit.residuals)} runs")
    lines += [f"sigma of `{name}`, estimated: {float(sigma):.4g}" for name, sigma in fit.sigma.items()]
    lines += [
        f"correlation time of the noise of `{name}`, estimated: {float(tau):.4g} s"
        for name, tau in fit.correlation_time.items()
    ]
    rows = [("unknown", "unit", "estimate", "std. error", "95 % interval")]
    rows += [
        _row(name, e, " (one-sided, at its bound)" if at_bound else "")
        for (name, e), at_bound in zip(fit.estimates.items(), fit.at_bound, strict=True)
    ]
    rows += [_row(name, e, " (tied)") for name, e in fit.tied.items() if e.value.ndim == 0]
    lines += table(rows)
    if fit.not_identifiable:
        lines.append(f"singular values below {fit.asked.control.cutoff:g} of the largest count as zero:")
        lines += [f"  {sentence}" for sentence in fit.not_identifiable]
    for sentences, what in ((fit.weak, "combinations"), (fit.correlated, "pairs")):
        lines += [f"  {sentence}" for sentence in sentences[:most]]
        lines += [f"  and {len(sentences) - most} more {what}"] if len(sentences) > most else []
    rows = [("run", "channel", "samples", "mean", "rms", "largest residual (in sigmas)")]
    for s in fit.residual_summary():
        rows.append(
            (str(s.run), s.channel, str(s.samples), f"{s.mean:.2g}", f"{s.rms:.3g}", f"{s.largest:.3g}")
        )
    return "\n".join(lines + table(rows))


def _row(name: str, e, remark: str) -> Labels:
    error = f"{e.standard_error:.2g}" if np.isfinite(e.standard_error) else "-"
    interval = f"[{e.low:.6g}, {e.high:.6g}]" if not np.isnan(e.low + e.high) else "none"
    return name, e.unit, f"{e.value:.6g}", error, interval + remark


def batch_text(fit: Estimates) -> str:
    """Return the text of many fits: mean and spread of the converged estimates."""
    good = np.asarray(fit.converged)
    rows = [("unknown", "unit", "mean", "std. deviation", "mean std. error")]
    for name, e in fit.estimates.items():
        values, errors = np.asarray(e.value)[good], np.asarray(e.standard_error)[good]
        errors = errors[np.isfinite(errors)]  # an estimate at its bound has none
        some, error = good.sum() > 1, f"{errors.mean():.2g}" if errors.size else "-"
        numbers = (f"{values.mean():.6g}", f"{values.std(ddof=1):.2g}", error) if some else ("-", "-", "-")
        rows.append((name, e.unit, *numbers))
    return "\n".join(
        [f"{good.size} fits of {type(fit.scene).__name__}: {good.sum()} converged", *table(rows)]
    )
