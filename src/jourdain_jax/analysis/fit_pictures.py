"""The figures of a fit: data beside prediction, residuals, how well each unknown is known, what informs it, its profile, and the way to the minimum."""

from itertools import pairwise

import numpy as np

from jourdain_jax.analysis.estimates import Estimates
from jourdain_jax.analysis.held_out import Prediction
from jourdain_jax.analysis.informed import Informed
from jourdain_jax.analysis.likelihood_profiles import RISE_95, Profile
from jourdain_jax.calculus.figures import DATA, MODEL, QUIET, figure

_WIDTH, _HEIGHT = 460, 200  # pixels
_MOST_ROWS = 40  # unknowns in one figure
_NARROWEST, _WIDEST = 1e-4, 100.0  # per cent
_LEAST_ABOVE = 1e-3  # F above its minimum: less is drawn as this


def data_and_prediction(caption: str, label: str, one: Prediction, component: int) -> str:
    """Draw samples of one component and their prediction; below, errors in sigmas, over a band of two."""
    value, predicted, sigma = (np.asarray(x).reshape(len(one.ts), -1)[:, component] for x in (one.values, one.prediction, one.sigma))

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


def autocorrelation(name: str, found: np.ndarray, limit: float) -> str:
    """Draw the correlation of whitened residuals by lag, over the band that white noise hardly leaves."""

    def draw(whole) -> None:
        axes = whole.add_subplot(xlabel="lag in samples", ylabel=f"correlation of {name}")
        axes.axhspan(-limit, limit, color="#e6e6e6")
        axes.stem(np.arange(1, len(found) + 1), found, basefmt=" ")

    return figure(draw, _WIDTH, _HEIGHT)


def interval_widths(fit: Estimates) -> str:
    """Draw half the width of the 95 % interval of each unknown, in per cent of the estimate, on an axis of powers of ten."""
    names = fit.labels[:_MOST_ROWS]
    values = np.asarray(fit.values[: len(names)], float)
    half = np.array([max(e.high - e.value, e.value - e.low) for e in (fit[name] for name in names)], float)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = 100 * half / np.abs(values)
    told = np.isfinite(half)
    words = [f"{v:.4g} {unit}".strip() + (f" ± {h:.2g}" if s < 1000 else "") for v, unit, h, s in zip(values, fit.units, half, share, strict=False)]
    words = [w if good else "one-sided" if bound else "the data do not tell" for w, good, bound in zip(words, told, fit.at_bound, strict=False)]

    def draw(whole) -> None:
        axes = whole.add_subplot(xlabel="half of the 95 % interval, in % of the estimate", xscale="log")
        shown = np.where(told, np.clip(share, _NARROWEST, _WIDEST), _NARROWEST)
        bars = axes.barh(range(len(names)), shown, color=[MODEL if s < 100 else DATA for s in share])
        axes.bar_label(bars, words, padding=3, fontsize=8)
        axes.set_yticks(range(len(names)), [name if len(name) <= 30 else name[:29] + "…" for name in names])
        axes.set_xlim(max(_NARROWEST, 0.5 * shown.min()), 40 * _WIDEST)
        axes.invert_yaxis()

    notes = ["red: the interval is wider than the estimate"] if np.any(share >= 100) else []
    notes += [f"{len(fit.labels) - len(names)} more unknowns are not drawn"] if len(fit.labels) > len(names) else []
    return figure(draw, 700, 20 * len(names) + 60, "; ".join(notes))


def information_over_time(shares: Informed, run: int) -> str:
    """Draw what the samples of a run tell of each unknown per second, by channel; the highest value of each unknown, of all runs, has full height."""
    spans = [np.gradient(ts) if len(ts) > 1 else np.ones(1) for ts in shares.times]
    most = np.max([np.max(sum(of.values()) / span, axis=1) for of, span in zip(shares.of_samples, spans, strict=True)], axis=0)

    def draw(whole) -> None:
        rows = whole.subplots(len(shares.labels), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for i, (axes, name) in enumerate(zip(rows, shares.labels, strict=True)):
            told = shares.of_samples[run]
            axes.stackplot(shares.times[run], *(of[i] / spans[run] / most[i] for of in told.values()), labels=list(told), step="mid")
            axes.set_yticks([0.5], [name if len(name) <= 22 else name[:21] + "…"])
            axes.text(1.01, 0.3, f"{100 * shares.of_runs[i, run]:.0f} %", transform=axes.transAxes, fontsize=8)
        rows[0].legend(fontsize=7, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0))
        rows[-1].set(xlabel="t in s", ylim=(0.0, 1.05))

    return figure(draw, _WIDTH + 90, 24 * len(shares.labels) + 80, f"run {run}: share of what the data tell of each unknown, along time")


def profile(one: Profile, error: float) -> str:
    """Draw the rise along an unknown, its 95 % interval, and the parabola of the standard error."""
    shown = one.rise <= 3 * RISE_95
    values, rise = one.values[shown], one.rise[shown]

    def draw(whole) -> None:
        axes = whole.add_subplot(xlabel=f"{one.name} in {one.unit}" if one.unit else one.name, ylabel="2 (F - F_min)")
        axes.plot(values, rise, ".-", color=MODEL, lw=1.2)
        axes.axhline(RISE_95, color=DATA, ls="--", lw=0.8)
        axes.axvline(one.estimate, color=QUIET, lw=0.8)
        for end, closed in zip((one.low, one.high), one.is_closed, strict=True):
            if closed:
                axes.axvline(end, color=DATA, ls="--", lw=0.8)
        (low, high), (bottom, top) = axes.get_xlim(), axes.get_ylim()
        if np.isfinite(error) and error > 0:
            x = np.linspace(low, high, 60)
            axes.plot(x, ((x - one.estimate) / error) ** 2, "--", color=QUIET, lw=0.8)
        axes.set(xlim=(low, high), ylim=(bottom, max(top, 1.3 * RISE_95)))

    return figure(draw, _WIDTH, _HEIGHT, str(one).replace("`", ""))


def way_to_the_minimum(trace: tuple[tuple[str, tuple[float, ...]], ...]) -> str:
    """Draw F above the lowest of each stretch, after each step tried; a line stands where another function is minimised."""

    def draw(whole) -> None:
        axes = whole.add_subplot(xlabel="steps tried", ylabel="F above its minimum", yscale="log")
        begins = np.cumsum([0, *(len(costs) for _, costs in trace)])
        for (a, b), (_, costs) in zip(pairwise(begins), trace, strict=True):
            finite = np.where(np.isfinite(costs), costs, np.nan)
            lowest = np.nanmin(finite) if np.isfinite(finite).any() else np.nan
            axes.plot(np.arange(a, b), np.maximum(finite - lowest, _LEAST_ABOVE), ".-", color=MODEL, lw=1.2)
        for begin in begins[1:-1]:
            axes.axvline(begin - 0.5, color=QUIET, ls="--", lw=0.8)

    return figure(draw, 2 * _WIDTH if sum(len(costs) for _, costs in trace) > 60 else _WIDTH, _HEIGHT)
