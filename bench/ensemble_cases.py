"""Two studies of bicycles at full size, drawn: which measured quantity deserves a better measurement, and
from which starts a bicycle falls.

    python bench/ensemble_cases.py [--quick] [--only NAME ...] [--json FILE] [--out DIR]

    stability   100,000 samples of one bicycle's 25 measured parameters: share of self-stable samples at each
                speed, and total Sobol' indices of the weave speed
    rides       1,000,000 rides of 5 s from random leans and speeds: where the bicycle falls

Writes a list of {"figure", "model", "value", "required", "met"}, and the pictures
`docs/bicycle_stability.png` and `docs/bicycle_rides.png` (into DIR where that is given). `--quick`: a
hundredth of the samples. Needs the extras `studies` and `plot`.
"""

import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from figures import HERE, Figures, figure, main

import jourdain_jax as jj
from jourdain_jax.bicycle import PARAMETERS, eigenvalues, linear_matrices, measured_bicycle, stability_speeds
from jourdain_jax.studies import Design, EventTime, Happened, Normal, Uniform, sobol_indices

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BICYCLE = "Browser"
BLUE, ORANGE = "#1f5fa8", "#b3470f"


def in_parts(function, columns: dict) -> np.ndarray:
    """`function` of one sample, over all samples, some at a time."""
    return np.asarray(jax.jit(lambda columns: jax.lax.map(function, columns, batch_size=4096))(columns))


def stability(quick: bool, out: Path) -> Figures:
    """Self-stability of a measured bicycle, and what its uncertainty comes from."""
    samples = 1_000 if quick else 100_000
    bicycle = measured_bicycle(BICYCLE)
    fixed = {name: value for name, value in bicycle.values.items() if name not in bicycle.prior}
    began = time.perf_counter()
    drawn = Design(bicycle.prior, sampler="sobol", samples=samples, seed=7).values()
    group = len(bicycle.prior) + 2
    design = Design(bicycle.prior, sampler="saltelli", samples=group * max(64, samples // group), seed=7)
    weave = in_parts(lambda p: stability_speeds(*linear_matrices(fixed | p)).weave_speed, design.values())
    indices = sobol_indices(weave, design.names)
    speeds = np.nanmean(weave) + np.linspace(-8.0, 8.0, 101) * np.nanstd(weave)  # m/s
    stable = in_parts(
        lambda p: jnp.all(jnp.real(eigenvalues(*linear_matrices(fixed | p), speeds)) < 0, axis=1), drawn
    ).mean(axis=0)
    yield figure(
        "seconds for eigenvalues at 101 speeds and weave speeds of as many samples",
        BICYCLE,
        time.perf_counter() - began,
    )
    yield figure("largest share of samples that is stable at one speed", BICYCLE, float(stable.max()))
    yield figure("deviation of the weave speed, m/s", BICYCLE, float(np.nanstd(weave)))
    order = np.argsort(-indices.total)[:10]
    for k in order[:3]:
        yield figure(
            f"total Sobol' index of the weave speed, {indices.names[k]}", BICYCLE, float(indices.total[k])
        )
    yield figure(
        "largest half-width of these indices, at 95 %",
        BICYCLE,
        float(indices.total_half_width[order[:3]].max()),
    )

    shape, axes = plt.subplots(1, 2, figsize=(11, 4), layout="constrained", width_ratios=(1, 1.25))
    axes[0].fill_between(speeds, stable, color=BLUE, alpha=0.25)
    axes[0].plot(speeds, stable, color=BLUE)
    axes[0].set(
        xlabel="speed (m/s)",
        ylabel="share of samples that is self-stable",
        ylim=(0, 1.02),
        xlim=(speeds[0], speeds[-1]),
    )
    axes[0].set_title(f"{BICYCLE} bicycle, {samples:,} samples", fontsize=10)
    place = np.arange(len(order))[::-1]
    axes[1].barh(
        place, indices.total[order], xerr=indices.total_half_width[order], color=ORANGE, capsize=2, height=0.7
    )
    axes[1].set_yticks(
        place, [f"{PARAMETERS[indices.names[k]]['about']} ({indices.names[k]})" for k in order], fontsize=8
    )
    axes[1].set(xlabel="total Sobol' index of the weave speed")
    axes[1].set_title("what deserves a better measurement", fontsize=10)
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    shape.savefig(out / "bicycle_stability.png", dpi=110)
    plt.close(shape)


def rides(quick: bool, out: Path) -> Figures:
    """Where a bicycle falls, over the speed and the lean at the start."""
    samples = 10_000 if quick else 1_000_000
    bicycle = measured_bicycle(BICYCLE)
    radius = bicycle.values["rR"]
    start = {
        "rear_spin_rate": Uniform(1.0 / radius, 10.0 / radius),
        "lean": Uniform(-0.6, 0.6),
        "lean_rate": Normal(0.0, 0.2),
        "steer_rate": Normal(0.0, 0.2),
    }
    study = jj.Study(bicycle.scene, start=start, sampler="sobol", samples=samples, seed=7)
    outputs = {"fell": Happened("fallen"), "fall time": EventTime("fallen")}
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        result = study.run(f"{folder}/rides.zarr", t1=5.0, rtol=1e-6, atol=1e-6, outputs=outputs)
        seconds = time.perf_counter() - began
        arrays = result.to_xarray().load()
        yield figure(
            "rides per second of wall time, storage and compilation included", BICYCLE, samples / seconds
        )
        yield figure("rides that failed, of all", BICYCLE, result.failed.size / samples)
        yield figure("rides that ended in a fall, of all", BICYCLE, float(result.mean("fell")))

    speed, lean, fell = (
        arrays["rear_spin_rate_at_start"].values * radius,
        arrays["lean_at_start"].values,
        arrays["fell"].values,
    )
    edges, known = (np.linspace(1.0, 10.0, 181), np.linspace(-0.6, 0.6, 121)), np.isfinite(fell)
    counts, *_ = np.histogram2d(speed[known], lean[known], edges)
    with np.errstate(invalid="ignore"):
        share = np.histogram2d(speed[known], lean[known], edges, weights=fell[known])[0] / counts
    shape, axis = plt.subplots(figsize=(8, 4.4), layout="constrained")
    mesh = axis.pcolormesh(*edges, share.T, cmap="cividis_r", vmin=0, vmax=1, rasterized=True)
    shape.colorbar(mesh, ax=axis, label="share that fell within 5 s")
    axis.set(xlabel="speed at the start (m/s)", ylabel="lean at the start (rad)")
    axis.set_title(f"{BICYCLE} bicycle without a hand on it, {samples:,} rides", fontsize=10)
    shape.savefig(out / "bicycle_rides.png", dpi=110)
    plt.close(shape)


if __name__ == "__main__":
    main(__doc__, (stability, rides), out=HERE.parent / "docs")
