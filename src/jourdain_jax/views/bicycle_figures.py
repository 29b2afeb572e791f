"""Figures of the bicycle command: eigenvalues over speed with uncertainty bands, rides over time, a ride in
space.
"""

import numpy as np

from jourdain_jax.bicycle.job import Study
from jourdain_jax.calculus.figures import pyplot
from jourdain_jax.calculus.files import FilePath
from jourdain_jax.views.pictures import animate
from jourdain_jax.views.quantities import plot

# columns of the eigenvalues; weave is a complex pair, or two real eigenvalues below the double root
_MODES = (("castering", (0,), "tab:green"), ("capsize", (1,), "tab:orange"), ("weave", (2, 3), "tab:blue"))
_CEILING = 12.0  # physics, 1/s; castering falls far below the range of interest


def draw_eigenvalues(study: Study, path: FilePath) -> None:
    """Draw real and imaginary parts of the eigenvalues over forward speed. Bands, including the bands of the
    weave and capsize speeds, span the 2.5 to 97.5 % quantiles of the samples. The stable range is green.
    """
    plt = pyplot()
    figure, (real, imaginary) = plt.subplots(
        2, 1, sharex=True, figsize=(7.5, 6.5), height_ratios=(3, 2), layout="constrained"
    )
    nominal, samples = study.eigenvalues[0], study.eigenvalues[1:][study.physical]
    for name, columns, colour in _MODES:
        for column in columns:
            label = name if column == columns[0] else None
            _band(real, study.grid, nominal[:, column].real, samples[:, :, column].real, colour, label)
    _band(
        imaginary, study.grid, np.abs(nominal[:, 2].imag), np.abs(samples[:, :, 2].imag), "tab:blue", "weave"
    )
    _mark_range(study, (real, imaginary))
    real.axhline(0.0, color="0.3", lw=0.8)
    real.set(ylim=(-_CEILING, _CEILING), ylabel="real part in 1/s")
    imaginary.set(
        ylabel="imaginary part in rad/s", xlabel="forward speed in m/s", xlim=(study.grid[0], study.grid[-1])
    )
    imaginary.set_ylim(bottom=0.0)
    real.set_title(
        f"{study.bicycle.name}: eigenvalues of upright running; bands (grey for the speeds) "
        f"contain 95 % of {len(samples)} samples",
        fontsize=10,
    )
    real.legend(loc="lower right", fontsize=9)
    for axis in (real, imaginary):
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _band(axis, speed, nominal, samples, colour, name) -> None:
    if len(samples):
        low, high = np.quantile(samples, (0.025, 0.975), axis=0)
        axis.fill_between(speed, low, high, color=colour, alpha=0.25, lw=0)
    axis.plot(speed, nominal, color=colour, lw=1.6, label=name)


def _mark_range(study: Study, axes) -> None:
    """Mark the stable range in green and the weave and capsize speeds with their confidence limits."""
    speeds = {
        name: study.speeds[f"{name}_speed"] or {"value": np.inf, "low": None, "high": None}
        for name in ("weave", "capsize")
    }
    weave, last = speeds["weave"]["value"], study.grid[-1]
    end = speeds["capsize"]["value"] if speeds["capsize"]["value"] > weave else last
    spans = [(weave, min(end, last), {"color": "tab:green", "alpha": 0.08})] if weave < np.inf else []
    for name, speed in speeds.items():
        value, low, high = (speed[part] for part in ("value", "low", "high"))
        if value > last:
            continue
        limits = "" if None in (low, high) or low == high else f"\n({low:.2f} to {high:.2f})"
        spans += [(low, high, {"color": "0.4", "alpha": 0.2})] if limits else []
        for axis in axes:
            axis.axvline(value, color="0.4", lw=0.8, ls="--")
        side, beside = ("right", -8) if name == "weave" else ("left", 8)
        text = f"{name} speed\n{value:.2f} m/s{limits}"
        axes[0].annotate(
            text,
            (value, _CEILING),
            xytext=(beside, -6),
            textcoords="offset points",
            ha=side,
            va="top",
            fontsize=9,
        )
    for axis in axes:
        for low, high, paint in spans:
            axis.axvspan(low, high, lw=0, **paint)


def draw_rides(study: Study, path: FilePath) -> None:
    """Draw lean and steer over time for the three rides."""
    lanes = [study.lanes.lane(i) for i in range(len(study.rides))]
    labels = [f"{speed:.2f} m/s, {label}" for label, speed in study.rides.items()]
    title = f"{study.bicycle.name}: hands-free after a kick in lean rate"
    figure, panels = pyplot().subplots(2, 1, sharex=True, figsize=(7.5, 5.5), layout="constrained")
    plot(
        lanes, "lean", "steer", units={"lean": "deg", "steer": "deg"}, labels=labels, title=title, axes=panels
    )
    for panel, name in zip(panels, ("lean", "steer"), strict=True):
        panel.set_ylabel(f"{name} to the right in degrees")
    for lane in lanes:
        if np.isnan(np.asarray(lane["lean"])[-1]):
            end = float(lane.t_end), np.degrees(float(lane.q_end[3]))
            panels[0].plot(*end, "kx")
            panels[0].annotate(
                lane.event_names[int(lane.event)], end, xytext=(6, -4), textcoords="offset points", fontsize=9
            )
    figure.savefig(path, dpi=150)
    pyplot().close(figure)


def animate_ride(study: Study, path: FilePath) -> None:
    """Animate the first ride (below the stable range), with the view following the bicycle."""
    label, speed = next(iter(study.rides.items()))
    title = f"{study.bicycle.name} at {speed:.2f} m/s, {label}"
    animate(study.lanes.lane(0), path, follow=True, paths=[], title=title)
