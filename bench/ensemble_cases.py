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

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from figures import HERE, figure, main
from scipy.stats import binned_statistic_2d

import jourdain_jax as jj
from jourdain_jax.bicycle import PARAMETERS, eigenvalues, linear_matrices, measured_bicycle, stability_speeds
from jourdain_jax.studies import Design, EventTime, Happened, Normal, Uniform, sobol_indices

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BICYCLE = "Browser"
BLUE, ORANGE = "#1f5fa8", "#b3470f"


def in_parts(function, columns):
    """`function` of one sample, over all samples, some at a time."""
    return np.asarray(jax.jit(lambda columns: jax.lax.map(function, columns, batch_size=4096))(columns))


def stability(quick, out):
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
    of_speeds = lambda p: jnp.real(eigenvalues(*linear_matrices(fixed | p), speeds))
    stable = in_parts(lambda p: jnp.all(of_speeds(p) < 0, axis=1), drawn).mean(axis=0)
    what = "seconds for eigenvalues at 101 speeds and weave speeds of as many samples"
    yield figure(what, BICYCLE, time.perf_counter() - began)
    yield figure("largest share of samples that is stable at one speed", BICYCLE, stable.max())
    yield figure("deviation of the weave speed, m/s", BICYCLE, np.nanstd(weave))
    order = np.argsort(-indices.total)[:10]
    names, total, half = np.array(indices.names)[order], indices.total[order], indices.total_half_width[order]
    for name, index in zip(names[:3], total, strict=False):
        yield figure(f"total Sobol' index of the weave speed, {name}", BICYCLE, index)
    yield figure("largest half-width of these indices, at 95 %", BICYCLE, half[:3].max())

    shape, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained", width_ratios=(1, 1.25))
    left.fill_between(speeds, stable, color=BLUE, alpha=0.25)
    left.plot(speeds, stable, color=BLUE)
    left.set(xlabel="speed (m/s)", ylabel="share of samples that is self-stable", ylim=(0, 1.02))
    left.set_xlim(speeds[0], speeds[-1])
    left.set_title(f"{BICYCLE} bicycle, {samples:,} samples", fontsize=10)
    labels = [f"{PARAMETERS[name]['about']} ({name})" for name in names]
    right.barh(labels, total, xerr=half, color=ORANGE, capsize=2, height=0.7)
    right.invert_yaxis()
    right.tick_params(axis="y", labelsize=8)
    right.set_xlabel("total Sobol' index of the weave speed")
    right.set_title("what deserves a better measurement", fontsize=10)
    for axis in (left, right):
        axis.spines[["top", "right"]].set_visible(False)
    shape.savefig(out / "bicycle_stability.png", dpi=110)
    plt.close(shape)


def rides(quick, out):
    """Where a bicycle falls, over the speed and the lean at the start."""
    samples = 10_000 if quick else 1_000_000
    bicycle = measured_bicycle(BICYCLE)
    radius = bicycle.values["rR"]
    start = {"rear_spin_rate": Uniform(1.0 / radius, 10.0 / radius), "lean": Uniform(-0.6, 0.6)}
    start |= {"lean_rate": Normal(0.0, 0.2), "steer_rate": Normal(0.0, 0.2)}
    study = jj.Study(bicycle.scene, start=start, sampler="sobol", samples=samples, seed=7)
    outputs = {"fell": Happened("fallen"), "fall time": EventTime("fallen")}
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        result = study.run(f"{folder}/rides.zarr", t1=5.0, rtol=1e-6, atol=1e-6, outputs=outputs)
        seconds = time.perf_counter() - began
        arrays = result.to_xarray().load()
        what = "rides per second of wall time, storage and compilation included"
        yield figure(what, BICYCLE, samples / seconds)
        yield figure("rides that failed, of all", BICYCLE, result.failed.size / samples)
        yield figure("rides that ended in a fall, of all", BICYCLE, result.mean("fell"))

    fell, edges = arrays["fell"].values, (np.linspace(1.0, 10.0, 181), np.linspace(-0.6, 0.6, 121))
    known = np.isfinite(fell)
    starts = arrays["rear_spin_rate_at_start"].values * radius, arrays["lean_at_start"].values
    share = binned_statistic_2d(*(x[known] for x in starts), fell[known], "mean", edges).statistic
    shape, axis = plt.subplots(figsize=(8, 4.4), layout="constrained")
    mesh = axis.pcolormesh(*edges, share.T, cmap="cividis_r", vmin=0, vmax=1, rasterized=True)
    shape.colorbar(mesh, ax=axis, label="share that fell within 5 s")
    axis.set(xlabel="speed at the start (m/s)", ylabel="lean at the start (rad)")
    axis.set_title(f"{BICYCLE} bicycle without a hand on it, {samples:,} rides", fontsize=10)
    shape.savefig(out / "bicycle_rides.png", dpi=110)
    plt.close(shape)


if __name__ == "__main__":
    main(__doc__, (stability, rides), out=HERE.parent / "docs")
