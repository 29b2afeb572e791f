# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Which discs fall? A study of many motions
#
# A disc that rolls fast enough stays up; a slow one falls over. The boundary depends on the start. Here we
# run a hundred thousand motions, store their main results in a folder that survives a crash, and compute
# which start value matters most. Then we compute where a measured bicycle falls, and which of its
# measurements should be repeated.

# %%
import os
import tempfile

import matplotlib.pyplot as plt
import numpy as np

import jourdain_jax as jj
from jourdain_jax.studies import Design, EventTime, Happened, LargestMagnitude, Normal, Uniform, sobol_indices

os.chdir(tempfile.mkdtemp())
disc = jj.models.TiltingDisc()

# %% [markdown]
# ## What varies
#
# A Sobol sequence, which fills the space more evenly than random numbers, gives lean, lean rate and spin.
# Sample k depends only on the seed and k: the study may be divided into any pieces, stopped and continued,
# and its results have the same bits.

# %%
start = {"lean": Uniform(-0.6, 0.6), "lean_rate": Normal(0.0, 0.3), "spin_rate": Uniform(-1.5, 0.0)}
study = jj.Study(disc, start=start, sampler="sobol", samples=100_000, seed=7)
study

# %% [markdown]
# ## Run it
#
# For each motion we store whether and when the disc fell within two seconds, and its largest lean. A motion
# stops when the disc has fallen, and the next one takes its place in the batch.

# %%
outputs = {
    "fell": Happened("fallen"),
    "fall time": EventTime("fallen"),
    "largest lean": LargestMagnitude("lean", "rad"),
}
asked = {
    "t1": 2.0,
    "ts": np.linspace(0.0, 2.0, 41),
    "rtol": 1e-6,
    "atol": 1e-6,
    "outputs": outputs,
    "progress": False,
}
result = study.run("discs.zarr", **asked)
result

# %% [markdown]
# The folder is a Zarr store. If the same call is repeated, nothing is computed, because all chunks exist and
# match their checksums.

# %%
study.run("discs.zarr", **asked)
arrays = result.to_xarray()  # as xarray.open_zarr("discs.zarr") gives them
arrays.data_vars

# %% [markdown]
# ## Where discs fall
#
# The picture shows the fraction of discs that fell, over lean and spin at the start.

# %%
spin, lean = -arrays["spin_rate_at_start"].values, arrays["lean_at_start"].values
edges = np.linspace(0.0, 1.5, 31), np.linspace(-0.6, 0.6, 31)
fallen, *_ = np.histogram2d(spin, lean, edges, weights=arrays["fell"].values)
share = fallen / np.histogram2d(spin, lean, edges)[0]

figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
mesh = axes[0].pcolormesh(*edges, share.T, cmap="cividis_r", vmin=0, vmax=1)
axes[0].set(xlabel="spin at the start (rad/s)", ylabel="lean at the start (rad)")
figure.colorbar(mesh, ax=axes[0], label="share that fell within 2 s")
counts, cells = result.histogram("fall time")
axes[1].stairs(counts, cells, fill=True, color="#1f5fa8", alpha=0.8)
axes[1].set(xlabel="time of the fall (s)", ylabel="discs")
axes[1].spines[["top", "right"]].set_visible(False)

# %% [markdown]
# Slow discs fall, and the more a disc leans, the more spin it needs. This is the complete motion of the disc
# that fell first:

# %%
first = int(np.nanargmin(arrays["fall time"].values))
lane = result.lane(first)
print(lane)
print(lane.simulate())

# %% [markdown]
# ## What matters most
#
# Sobol' indices divide the variance of the largest lean among the start values. The first-order index of a
# start value is the part due to this value alone; the total index includes its interactions with others. They
# need a special design (Saltelli's).

# %%
indices = (
    jj.Study(disc, start=start, sampler="saltelli", samples=5 * 2**12, seed=7)
    .run("indices.zarr", **asked)
    .sensitivity("largest lean")
)
indices

# %%
figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
place = np.arange(3)
axis.bar(
    place - 0.2,
    indices.first,
    0.4,
    yerr=indices.first_half_width,
    capsize=3,
    color="#1f5fa8",
    label="first order",
)
axis.bar(
    place + 0.2, indices.total, 0.4, yerr=indices.total_half_width, capsize=3, color="#b3470f", label="total"
)
axis.set_xticks(place, [name.removesuffix("_at_start").replace("_", " ") for name in indices.names])
axis.set_ylabel("share of variance")
axis.legend(frameon=False)
axis.spines[["top", "right"]].set_visible(False)

# %% [markdown]
# ## Where a bicycle falls
#
# The Browser is a Dutch city bicycle that was measured at TU Delft and UC Davis; `measured_bicycle` returns
# its 25 parameters with their standard deviations. Here it rides without hands for five seconds, from random
# speeds and leans. (`bench/ensemble_cases.py` does this with a million rides.)

# %%
from jourdain_jax.bicycle import linear_matrices, measured_bicycle, stability_speeds

bicycle = measured_bicycle("Browser")
radius = bicycle.values["rR"]
start = {
    "rear_spin_rate": Uniform(1.0 / radius, 10.0 / radius),
    "lean": Uniform(-0.6, 0.6),
    "lean_rate": Normal(0.0, 0.2),
}
rides = jj.Study(bicycle.scene, start=start, sampler="sobol", samples=2**17, seed=7)
asked = {"t1": 5.0, "rtol": 1e-6, "atol": 1e-6, "progress": False}
ridden = rides.run("rides.zarr", outputs={"fell": Happened("fallen")}, **asked)
ridden

# %%
arrays = ridden.to_xarray()
speed, lean = radius * arrays["rear_spin_rate_at_start"].values, arrays["lean_at_start"].values
grid = np.linspace(1.0, 10.0, 91), np.linspace(-0.6, 0.6, 61)
fallen, *_ = np.histogram2d(speed, lean, grid, weights=arrays["fell"].values)
share_of_rides = fallen / np.histogram2d(speed, lean, grid)[0]
figure, axis = plt.subplots(figsize=(7, 3.8), layout="constrained")
mesh = axis.pcolormesh(*grid, share_of_rides.T, cmap="cividis_r", vmin=0, vmax=1)
figure.colorbar(mesh, ax=axis, label="share that fell within 5 s")
axis.set(xlabel="speed at the start (m/s)", ylabel="lean at the start (rad)")

# %% [markdown]
# Below 3 m/s it falls from any start. Above, the lean from which it recovers grows with the speed. The
# boundary has steps: with each further swing of the weave a fall takes longer, and a bicycle that has not
# fallen after five seconds counts as upright.
#
# ## Which measurement should be repeated?
#
# Above its weave speed this bicycle rides by itself. How accurately do we know this speed, and which of the
# 25 measured numbers causes most of its uncertainty? No motion is needed: a design gives the samples, and
# `jj.studies.sobol_indices` accepts any quantity that was computed from them.

# %%
import jax

fixed = {name: value for name, value in bicycle.values.items() if name not in bicycle.prior}
design = Design(bicycle.prior, sampler="saltelli", samples=2**10 * (len(bicycle.prior) + 2), seed=7)


def weave_speed(numbers):
    return stability_speeds(*linear_matrices(fixed | numbers)).weave_speed


weave = np.asarray(jax.lax.map(weave_speed, design.values(), batch_size=1024))  # all at once would take 15 GB
of_weave = sobol_indices(weave, design.names)
print(f"weave speed {np.nanmean(weave):.2f} +- {np.nanstd(weave):.2f} m/s")
order = np.argsort(-of_weave.total)[:8]

# %%
from jourdain_jax.bicycle import PARAMETERS

figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
axis.barh(
    np.arange(8)[::-1],
    of_weave.total[order],
    xerr=of_weave.total_half_width[order],
    capsize=2,
    color="#b3470f",
)
axis.set_yticks(np.arange(8)[::-1], [PARAMETERS[of_weave.names[k]]["about"] for k in order])
axis.set_xlabel("total Sobol' index of the weave speed")
axis.spines[["top", "right"]].set_visible(False)

# %% [markdown]
# Half of the variance comes from the tilt of the steer axis, so this angle should be measured more accurately
# first.

# %% [markdown]
# The last cell checks the results of this notebook: every sample has a result, and none failed; fast discs
# stay up; the repeated motion equals the stored one; slow bicycles fall, fast upright ones do not; and the
# steer axis has the largest index.

# %%
assert result.complete
assert not result.failed.size
assert share[edges[0][:-1] >= 1.2].mean() < 0.01 < result.mean("fell")
assert abs(float(lane.simulate().t_end) - lane.kept["fall time"]) < 1e-9
assert np.all(indices.total >= indices.first - indices.total_half_width)
assert ridden.complete
assert not ridden.failed.size
assert share_of_rides[grid[0][1:] <= 2.5].min() > 0.95
assert share_of_rides[grid[0][:-1] >= 8.0][:, 28:32].max() < 0.05
assert of_weave.names[order[0]] == "lam"
assert 0.4 < of_weave.total[order[0]] < 0.6
