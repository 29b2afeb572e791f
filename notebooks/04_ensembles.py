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
# A disc that rolls fast enough stays up; a slow one falls over. Where the border lies depends on how it is let go. One simulation answers for one
# start; here we run tens of thousands, keep what matters of each in a folder that survives a crash, and ask which start value matters most.

# %%
import os
import tempfile

import matplotlib.pyplot as plt
import numpy as np

import jourdain_jax as jj

os.chdir(tempfile.mkdtemp())
disc = jj.models.TiltingDisc()

# %% [markdown]
# ## Say what varies
#
# Lean, lean rate and spin are drawn by a Sobol sequence, which fills the space more evenly than random numbers do. Sample k follows from the seed
# and k alone: the study may be cut into any pieces, stopped and continued, and every number keeps its bits.

# %%
start = {"lean": jj.Uniform(-0.6, 0.6), "lean_rate": jj.Normal(0.0, 0.3), "spin_rate": jj.Uniform(-1.5, 0.0)}
study = jj.Study(disc, start=start, sampler="sobol", samples=2**15, seed=7)
study

# %% [markdown]
# ## Run it
#
# Of each motion we keep whether the disc fell within two seconds, when, and its largest lean. A fallen disc ends its lane at once, and another takes its place.

# %%
outputs = {"fell": jj.Happened("fallen"), "fall time": jj.EventTime("fallen"), "largest lean": jj.LargestMagnitude("lean", "rad")}
asked = {"t1": 2.0, "ts": np.linspace(0.0, 2.0, 41), "rtol": 1e-6, "atol": 1e-6, "outputs": outputs, "progress": False}
result = study.run("discs.zarr", **asked)
result

# %% [markdown]
# The folder is a Zarr store. The same call again computes nothing: all chunks are there, and their checksums hold.

# %%
study.run("discs.zarr", **asked)
arrays = result.to_xarray()  # as xarray.open_zarr("discs.zarr") gives them
arrays.data_vars

# %% [markdown]
# ## Where discs fall
#
# The share of discs that fell, over the lean and the spin with which they were let go.

# %%
spin, lean = -arrays["spin_rate_at_start"].values, arrays["lean_at_start"].values
edges = np.linspace(0.0, 1.5, 31), np.linspace(-0.6, 0.6, 31)
fallen, *_ = np.histogram2d(spin, lean, edges, weights=arrays["fell"].values)
share = fallen / np.histogram2d(spin, lean, edges)[0]

figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
mesh = axes[0].pcolormesh(*edges, share.T, cmap="cividis", vmin=0, vmax=1)
axes[0].set(xlabel="spin at the start (rad/s)", ylabel="lean at the start (rad)")
figure.colorbar(mesh, ax=axes[0], label="share that fell within 2 s")
counts, cells = result.histogram("fall time")
axes[1].stairs(counts, cells, fill=True, color="#1f5fa8", alpha=0.8)
axes[1].set(xlabel="time of the fall (s)", ylabel="discs")
axes[1].spines[["top", "right"]].set_visible(False)

# %% [markdown]
# Slow discs fall, and the more a disc leans, the more spin it needs. The one that fell first, alone, with all there is to know of its motion:

# %%
first = int(np.nanargmin(arrays["fall time"].values))
lane = result.lane(first)
print(lane)
print(lane.simulate())

# %% [markdown]
# ## What matters most
#
# Sobol' indices share out the variance of the largest lean: of first order, what each start value does alone; in total, with all that it does together with
# others. They need a design of their own, after Saltelli.

# %%
indices = jj.Study(disc, start=start, sampler="saltelli", samples=5 * 2**12, seed=7).run("indices.zarr", **asked).sensitivity("largest lean")
indices

# %%
figure, axis = plt.subplots(figsize=(6, 3), layout="constrained")
place = np.arange(3)
axis.bar(place - 0.2, indices.first, 0.4, yerr=indices.first_half_width, capsize=3, color="#1f5fa8", label="first order")
axis.bar(place + 0.2, indices.total, 0.4, yerr=indices.total_half_width, capsize=3, color="#b3470f", label="total")
axis.set_xticks(place, [name.removesuffix("_at_start").replace("_", " ") for name in indices.names])
axis.set_ylabel("share of variance")
axis.legend(frameon=False)
axis.spines[["top", "right"]].set_visible(False)

# %% [markdown]
# The checks that hold this notebook to its numbers: every lane has a result, none failed, fast discs stay up, and the repeated lane is the stored one.

# %%
assert result.complete
assert not result.failed.size
assert share[edges[0][:-1] >= 1.2].mean() < 0.01 < result.mean("fell")
assert abs(float(lane.simulate().t_end) - lane.kept["fall time"]) < 1e-9
assert np.all(indices.total >= indices.first - indices.total_half_width)
