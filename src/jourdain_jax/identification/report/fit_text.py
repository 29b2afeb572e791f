"""The text that `print` shows of a fit, or of a batch of fits.

`warnings_of` returns the warnings of a fit: reasons not to rely on its estimates or intervals.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jourdain_jax.identification.inference.bound_limits import FAR_BEYOND
from jourdain_jax.identification.report.estimates import Estimates
from jourdain_jax.identification.solve.levenberg_marquardt import LEAST_SQUARES
from jourdain_jax.scene.coordinates import Labels, Sentences
from jourdain_jax.scene.printing import table


def warnings_of(fit: Estimates) -> Sentences:
    """Return warnings of a fit of one experiment, one sentence each, the most serious first."""
    if not np.isfinite(fit.chi_square):
        # residuals in sigmas whose squares overflow
        if any(np.any(np.abs(r) > 1e150) for run in fit.residuals for r in run.values()):
            return ("residuals overflow at the first guess: use NaN for missing values, and check `sigma`",)
        failed = "the motion fails at the first guess; examine it with `simulate`"
        return failed, *fit.events_met
    return (
        *_of_the_minimum(fit),
        *fit.impossible,
        *fit.events_met,
        *fit.oddities,
        *fit.too_narrow,
        *_of_the_data(fit),
        *_of_residuals(fit),
    )


def _of_the_minimum(fit: Estimates) -> Iterator[str]:
    """Yield warnings if no minimum was found, if it lies at a bound, or if a channel has no degrees of
    freedom left.
    """
    if fit.stuck:
        yield (
            "no step improves the fit, but this is not a minimum: nearby the motion fails, or is rougher "
            "than its tolerance; use another first guess"
        )
    elif fit.shooting is not None and fit.shooting.continuity > 1:
        jump = float(fit.shooting.continuity)
        yield (
            f"pieces of runs do not join: states jump by up to {jump:.2g} tolerances of the simulation; take "
            "shorter pieces, or a closer first guess"
        )
    elif not fit.converged:
        yield "no minimum was found; raise `max_iterations`, or use a closer first guess"
    if names := [f"`{name}`" for name, far in zip(fit.labels, fit.beyond, strict=True) if far > FAR_BEYOND]:
        if len(names) == 1:
            verb = "lies at a bound, which decides its value"
        else:
            verb = "lie at bounds, which decide their values"
        yield f"{', '.join(names)} {verb}; standard errors are meaningless: widen the bounds"
    for name in fit.untold:
        yield (
            f"channel `{name}` has no degrees of freedom left to estimate its sigma; pass `sigma`: its "
            "samples are fitted exactly, and do not count in intervals"
        )


def _of_the_data(fit: Estimates) -> Iterator[str]:
    """Yield warnings of duplicate channels, of a minimum found from only one first guess, and of priors that
    the data contradict.
    """
    first: dict[bytes, str] = {}
    for run, of_run in enumerate(fit.residuals):
        for name, r in of_run.items():
            counted = np.round(r[np.isfinite(r)], 6)
            here = f"`{name}` of run {run}"
            there = first.setdefault(counted.tobytes(), here)
            # fewer different residuals may be equal in two channels by chance
            if here != there and len(np.unique(counted)) > 3:
                yield (
                    f"{there} and {here} hold equal numbers: counted as two measurements, they make intervals"
                    " too narrow; omit one"
                )
    if fit.guesses > 1 and fit.converged and fit.agreeing == 1:
        yield (
            f"only one of {fit.guesses} first guesses led to this minimum, so there may be a lower one; try"
            " more `guesses`, or narrower bounds"
        )
    for name, far in zip(fit.labels, fit.from_prior, strict=True):
        if abs(far) > 4.0:  # standard deviations: a larger distance from the prior is significant
            yield (
                f"`{name}` lies {abs(far):.2g} standard deviations from its prior: check the prior, the data"
                " and the scene"
            )


def _of_residuals(fit: Estimates) -> Iterator[str]:
    """Yield warnings of residuals that are larger or smaller than sigmas allow, or not white."""
    # standard deviations beyond which a mean square differs significantly from 1
    sizes, sure = _sizes_of_residuals(fit), 5.0
    coloured = {name: rho for name, (rho, limit) in fit.autocorrelation.items() if abs(rho) > limit}
    if large := [size for size in sizes if size.least > _by_chance(size.narrow, sure)]:
        why = "this is a local minimum (use another first guess), the scene is wrong, or sigmas are too small"
        yield f"the residuals{large[0].named} are larger than the sigmas allow: {why}"

    def larger(channels: list[str]) -> float:
        """Return the factor by which correlated residuals increase variances: (1 + rho)/(1 - rho) for a
        correlation rho of neighbours.
        """
        return max(
            (1 + rho) / max(1 - rho, 1e-9) for rho in (0.0, *(coloured.get(name, 0.0) for name in channels))
        )

    if small := [size for size in sizes if size.most * larger(size.channels) < _by_chance(size.wide, -sure)]:
        times = f" by a factor of about {1 / np.sqrt(small[0].most):.2g}" if small[0].most > 0 else ""
        yield (
            f"the residuals{small[0].named} are smaller than the sigmas predict{times}: sigmas are too "
            "large, which makes intervals too wide, or samples were smoothed or have no noise; give `None` "
            "to estimate a sigma"
        )
    wide = {name for size in small for name in size.channels}
    named = ", ".join(f"`{name}` ({rho:.2f})" for name, rho in coloured.items() if name not in wide)
    own = [name for name in fit.labels if name.startswith("run ")]
    start = (
        f"residuals of {named} are not white (in brackets: correlation of neighbouring ones), which makes"
        " intervals"
    )
    if named and fit.errors == "sigmas":
        yield (
            f"{start} too narrow: check the scene, sensors and noise; `correlation_time=None` "
            "estimates the correlation of the noise, and with five runs "
            'or more, errors="runs" accounts for it'
        )
    elif named and own:
        yield (
            f'{start} of unknowns of single runs (`{own[0]}`) too narrow: errors="runs" widens only'
            " intervals of shared unknowns"
        )


class _Size(NamedTuple):
    """The mean square of the residuals of some channels, in sigmas."""

    channels: list[str]
    named: str  # names of the channels in the sentence; empty for all channels
    least: float  # mean square if these channels determined only their own unknowns
    narrow: float  # standard deviation of `least` for normal residuals
    most: float  # mean square if these channels determined all unknowns
    wide: float  # standard deviation of `most`


def _by_chance(spread: float, deviations: float) -> float:
    """Return the mean square of normal residuals that is `deviations` standard deviations from 1. Its cube
    root is nearly normal (Wilson and Hilferty). `spread`: the standard deviation of the mean square.
    """
    return max(1 - spread**2 / 9 + deviations * spread / 3, 0.0) ** 3


def _sizes_of_residuals(fit: Estimates) -> list[_Size]:
    """Return the sizes of the residuals of all channels with known sigmas together, and of each such channel.
    With a robust loss, sizes are based on medians.
    """
    robust, determined = fit.asked.loss != LEAST_SQUARES, float(fit.samples - fit.degrees_of_freedom)
    names = [
        name for name in dict.fromkeys(name for run in fit.whitened for name in run) if name not in fit.sigma
    ]
    found = []
    for channels in (names, *([name] for name in names)):
        parts = [np.ravel(run[name]) for run in fit.whitened for name in channels if name in run]
        squares = np.concatenate([np.zeros(0), *parts]) ** 2
        squares = squares[np.isfinite(squares)]
        if squares.size:
            some = len(channels) < len(names)
            named = f" of {', '.join(f'`{name}`' for name in channels)}" if some else ""
            own = 0.0 if some else determined
            least, most = (_mean_square(squares, p, robust) for p in (own, determined))
            found.append(_Size(channels, named, *least, *most))
    return found


def _mean_square(squares: np.ndarray, determined: float, robust: bool) -> tuple[float, float]:
    """Return the mean square of residuals from which `determined` unknowns were estimated, and its standard
    deviation if residuals are normal. If `robust`, the mean square is computed from the median.
    """
    degrees = max(squares.size - determined, 1)
    # the median of w^2 is 0.4549 for a normal w; its relative standard deviation for n residuals is 2.33 /
    # sqrt(n)
    if robust:
        return float(np.median(squares)) / 0.4549, 2.33 / degrees**0.5
    return float(np.sum(squares)) / degrees, (2 / degrees) ** 0.5  # chi-square has mean n and variance 2 n


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
            f"found by multiple shooting in {pieces} pieces with jumps of at most "
            f"{float(fit.shooting.continuity):.1g} tolerances of the simulation"
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
