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
# # Measured bicycles: at which speeds do they stay upright by themselves?
#
# Ten bicycles were taken apart, weighed, balanced and swung, and the 26 parameters of the Whipple model were
# published with their standard deviations. We build the *nonlinear* bicycle (two rolling wheels, front
# contact found from geometry), linearise it about upright running, find the speeds at which it becomes stable
# and unstable, and compute the uncertainty of these speeds from the measured standard deviations.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

from jourdain_jax.bicycle import (
    interval,
    linear_matrices,
    read_bicycle,
    sample_parameters,
    shipped_bicycles,
    stability_speeds,
)

# %% [markdown]
# ## One bicycle
#
# The benchmark bicycle of Meijaard, Papadopoulos, Ruina and Schwab (2007) has exact parameters. Its published
# stable range is 4.29238253634111 to 6.02426201538837 m/s. The linear matrices below come from the nonlinear
# model by automatic differentiation, not from the published formulas.


# %%
@jax.jit
def speeds_of(parameters):
    return stability_speeds(*linear_matrices(parameters))


benchmark = read_bicycle(shipped_bicycles()["Benchmark"])
found = speeds_of({name: jnp.asarray(value) for name, value in benchmark.values.items()})
print(f"weave   {found.weave_speed:.14f} m/s")
print(f"capsize {found.capsize_speed:.14f} m/s")
assert abs(found.weave_speed - 4.29238253634111) < 1e-10
assert abs(found.capsize_speed - 6.02426201538837) < 1e-10

# %% [markdown]
# ## Measured ones, with their uncertainty
#
# For each measured bicycle, 500 bicycles are drawn with independent errors (the files contain no covariance),
# and their speeds are computed in one batch. A bar contains 95 % of the samples for which the speed exists.

# %%
batch = jax.jit(jax.vmap(speeds_of))
names = ["Rigid", "Fisher", "Pista", "Crescendo", "Browser", "Yellow"]
rows = []
for name in names:
    bicycle = read_bicycle(shipped_bicycles()[name])
    samples = sample_parameters(bicycle, jax.random.key(1), 500)
    speeds = batch(samples.by_name())
    nominal = speeds_of({key: jnp.asarray(value) for key, value in bicycle.values.items()})
    limits = [
        interval(getattr(speeds, speed), nominal=getattr(nominal, speed), counted=samples.physical)
        for speed in ("weave_speed", "capsize_speed")
    ]
    rows.append(limits)
    weave, capsize = limits
    print(
        f"{name:<10} weave {weave.value:.3f} [{weave.low:.3f}, {weave.high:.3f}]   capsize"
        f" {capsize.value:.3f} [{capsize.low:.3f}, {capsize.high:.3f}] m/s"
    )

# %%
fig, axis = plt.subplots(figsize=(8, 3.6), layout="constrained")
for i, (weave, capsize) in enumerate(rows):
    axis.plot(
        [weave.value, capsize.value], [i, i], color="tab:green", lw=6, alpha=0.25, solid_capstyle="butt"
    )
    for limit, colour in ((weave, "tab:blue"), (capsize, "tab:orange")):
        axis.plot([limit.low, limit.high], [i, i], color=colour, lw=2)
        axis.plot(limit.value, i, "o", color=colour)
axis.set_yticks(range(len(names)), names)
axis.set_xlabel("forward speed in m/s")
axis.set_title("stable range (green), weave speed (blue) and capsize speed (orange) with 95 % limits")
axis.grid(alpha=0.3)
plt.show()

rigid = rows[0][0]
assert abs(rigid.value - 5.0083877167528) < 1e-9  # the published formulas give the same
assert rigid.low < rigid.value < rigid.high
