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
# # From pendulums to limits on the weave speed
#
# The parts of twelve bicycles were weighed, hung up, swung about an axle and twisted on a rod. The 26
# parameters of the Whipple bicycle follow from these readings. Parameter files contain their standard
# deviations, but not the correlations due to common readings: every moment of inertia depends on the
# stiffness of the same rod. We start from the readings, differentiate the parameters with respect to them,
# and compute the effect of the covariance on the limits of the weave speed.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jourdain_jax.bicycle import (
    PARAMETER_NAMES,
    benchmark_from_measurements,
    interval,
    linear_matrices,
    measured_bicycle,
    read_readings,
    sample_parameters,
    shipped_measurements,
)
from jourdain_jax.bicycle import stability_speeds as speeds_of_matrices

# %% [markdown]
# ## Readings
#
# For the rear frame, a compound pendulum about the rear axle gives $I_{yy}$, since $T = 2\pi\sqrt{(I_{yy} + m
# l^2)/(m g l)}$. Clamped to a rod in three orientations, the frame twists with $T_i = 2\pi\sqrt{n_i^\top I
# n_i/k}$, which gives the three moments in its plane. The line of the rod passes through the mass centre.
# Both pendulums are scenes with computed periods. The parameters are chosen so that these equal the measured
# periods, and their derivatives with respect to the readings follow from the implicit function theorem.

# %%
readings = read_readings(shipped_measurements()["Browser"])
for name in ("mB", "TcB1", "alphaB1", "aB1", "TtB1", "TtP1"):
    print(f"{name:<8} {readings.means[name]:.6g} +- {readings.sigmas[name]:.2g}")

# %% [markdown]
# ## Against the published parameters
#
# Values and sigmas of 20 of the 26 parameters agree with the published ones to all published digits. The
# others depend on the intersection of the lines through a mass centre: the published value is the mean over
# all pairs of lines, ours minimises the sum of squared distances to the lines. They differ by up to 1.5 of
# the stated sigmas.

# %%
ABOUT_CENTRES = ("xB", "zB", "xH", "zH", "IByy", "IHyy")
for bicycle_name in ("Browser", "Browserins", "Crescendo", "Fisher", "Pista", "Yellow", "Yellowrev"):
    found, published = benchmark_from_measurements(bicycle_name), measured_bicycle(bicycle_name)
    apart = {n: (found.values[n] - published.values[n]) / published.sigmas[n] for n in PARAMETER_NAMES}
    ratio = {n: found.sigmas[n] / published.sigmas[n] for n in PARAMETER_NAMES}
    print(f"{bicycle_name:<11}" + "".join(f"  {n} {apart[n]:+.2f} ({ratio[n]:.2f})" for n in ABOUT_CENTRES))
    assert all(
        abs(apart[n]) < 1e-6 and abs(ratio[n] - 1) < 1e-6 for n in PARAMETER_NAMES if n not in ABOUT_CENTRES
    )
    assert all(abs(apart[n]) < 1.5 for n in ABOUT_CENTRES)
print("apart by so many published sigmas (our sigma over theirs)")

# %% [markdown]
# Two of the three lines of the Pista's frame are almost parallel. Their intersection is hardly known, but has
# the same weight in the mean as the other two. The ellipse contains 95 %.


# %%
def draw_lines(axis, name, part="B"):
    raw, ours, theirs = (
        read_readings(shipped_measurements()[name]),
        benchmark_from_measurements(name),
        measured_bicycle(name),
    )
    angles = np.linspace(0, 2 * np.pi, 100)
    i, j = PARAMETER_NAMES.index(f"x{part}"), PARAMETER_NAMES.index(f"z{part}")
    square = ours.covariance[np.ix_([i, j], [i, j])]
    ellipse = np.linalg.cholesky(square) @ np.stack([np.cos(angles), np.sin(angles)]) * np.sqrt(5.991)
    x, z = ours.values[f"x{part}"], ours.values[f"z{part}"]
    for k in raw.hangings[part]:
        tilt = np.deg2rad(raw.means[f"alpha{part}{k}"]) - ours.values["lam"] - np.pi / 2
        normal, along = np.array([np.cos(tilt), np.sin(tilt)]), np.array([-np.sin(tilt), np.cos(tilt)])
        foot = np.array([0.0, -ours.values["rR"]]) + raw.means[f"a{part}{k}"] * normal
        middle = foot + along * (along @ (np.array([x, z]) - foot))
        ends = middle[:, None] + along[:, None] * np.array([-0.06, 0.06])
        axis.plot(ends[0], -ends[1], color="0.6", lw=1)
    axis.plot(x + ellipse[0], -(z + ellipse[1]), color="tab:blue", label="least squares, 95 %")
    axis.plot(x, -z, "o", color="tab:blue")
    axis.plot(
        theirs.values[f"x{part}"], -theirs.values[f"z{part}"], "s", color="tab:orange", label="published"
    )
    axis.set(title=f"{name}, rear frame", xlabel="forward in m", ylabel="up in m", aspect="equal")


fig, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axis, name in zip(axes, ("Browser", "Pista"), strict=True):
    draw_lines(axis, name)
axes[0].legend()
plt.show()

# %% [markdown]
# ## How parameters correlate


# %%
browser = benchmark_from_measurements("Browser")
sigma = np.array([browser.sigmas[n] for n in PARAMETER_NAMES])
correlation = browser.covariance / np.outer(sigma, sigma)
fig, axis = plt.subplots(figsize=(6.2, 5.4), layout="constrained")
image = axis.imshow(correlation, vmin=-1, vmax=1, cmap="RdBu_r")
axis.set_xticks(range(len(PARAMETER_NAMES)), PARAMETER_NAMES, rotation=90, fontsize=8)
axis.set_yticks(range(len(PARAMETER_NAMES)), PARAMETER_NAMES, fontsize=8)
axis.set_title("Browser: correlation of parameters that come of the same readings")
fig.colorbar(image, shrink=0.8)
plt.show()
of = dict(zip(PARAMETER_NAMES, correlation, strict=True))
print(
    f"IRxx and IFxx {of['IRxx'][PARAMETER_NAMES.index('IFxx')]:.3f}, mF and IFyy"
    f" {of['mF'][PARAMETER_NAMES.index('IFyy')]:.2f}"
)
assert of["IRxx"][PARAMETER_NAMES.index("IFxx")] > 0.99

# %% [markdown]
# ## What the covariance does to the limits
#
# The same parameters are drawn 500 times: independently, and with their covariance. Grey shows the published
# file, as in the notebook on measured bicycles.


# %%
def weave_speeds_of(values):
    return jax.vmap(lambda one: speeds_of_matrices(*linear_matrices(one)).weave_speed)(values)


# compilation dominates, since it runs only a few times
weave_speeds = jax.jit(
    weave_speeds_of,
    compiler_options={"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 0},
)


def limits(bicycle):
    samples = sample_parameters(bicycle, jax.random.key(1), 500)
    nominal = jnp.array([[bicycle.values[n]] for n in PARAMETER_NAMES])
    values = jnp.concatenate([nominal, jnp.where(samples.physical, samples.values.T, nominal)], axis=1)
    speeds = weave_speeds(dict(zip(PARAMETER_NAMES, values, strict=True)))
    return interval(speeds[1:], nominal=speeds[0], counted=samples.physical)


names, rows = ["Browser", "Crescendo", "Fisher", "Pista", "Yellow", "Stratos"], []
for name in names:
    with_covariance = benchmark_from_measurements(name)
    independent = with_covariance.with_independent_errors
    rows.append(
        (
            limits(independent),
            limits(with_covariance),
            limits(measured_bicycle(name)) if name != "Stratos" else None,
        )
    )
    alone, together = rows[-1][:2]
    narrower = 100 * (1 - float((together.high - together.low) / (alone.high - alone.low)))
    print(
        f"{name:<10} weave {together.value:.3f} m/s, independent [{alone.low:.3f}, {alone.high:.3f}], "
        f"with covariance [{together.low:.3f}, {together.high:.3f}], {narrower:.0f} % narrower"
    )
    assert 5 < narrower < 45

# %%
fig, axis = plt.subplots(figsize=(8, 3.8), layout="constrained")
for i, row in enumerate(rows):
    for limit, colour, label, up in zip(
        row,
        ("tab:blue", "tab:green", "0.6"),
        ("sigmas independent", "with covariance", "published, independent"),
        (0.0, 0.2, -0.2),
        strict=True,
    ):
        if limit is not None:
            axis.plot(
                [limit.low, limit.high], [i + up, i + up], color=colour, lw=3, label=label if i == 0 else None
            )
            axis.plot(limit.value, i + up, "o", color=colour, ms=5)
axis.set_yticks(range(len(names)), names)
axis.set(xlabel="weave speed in m/s", title="95 % limits on the weave speed, by what is known of the errors")
axis.grid(alpha=0.3)
axis.legend()
plt.show()
