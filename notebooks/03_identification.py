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
# # Identification with uncertainty: parameters of a sleigh from its track
#
# A Chaplygin sleigh is pushed and filmed. From its noisy track we estimate its inertia and the position of
# its mass centre, with intervals. Then we also free the mass, which the track does not determine, and see how
# the fit reports this.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jourdain_jax as jj

# %% [markdown]
# ## A noisy measurement
#
# The data are twenty-five positions and headings in six seconds, with noise of 5 mm and 0.01 rad. They are
# simulated, so that we can compare the estimates with the true values.

# %%
truth = jj.models.ChaplyginSleigh(mass=1.3, inertia=0.4, offset=0.25)
push = {"x_rate": -0.6, "heading_rate": 0.9}
ts = jnp.linspace(0.0, 6.0, 25)
motion = jj.simulate(truth, push, ts=ts)

noise = np.random.default_rng(3)
sigma = {"x": 0.005, "y": 0.005, "heading": 0.01}
values = {name: np.asarray(motion[name]) + noise.normal(0.0, s, len(ts)) for name, s in sigma.items()}
data = jj.Experiment(ts, values, sigma, start=push)

# %% [markdown]
# ## Estimate inertia and offset with known mass
#
# The fit uses the method of Levenberg and Marquardt, with Jacobians by forward-mode differentiation of the
# simulation.

# %%
guess = jj.models.ChaplyginSleigh(mass=1.3, inertia=0.2, offset=0.4)
found = jj.fit(guess, data, free=("inertia", "offset"))
print(found)
for name in ("inertia", "offset"):
    estimate = found[name]
    assert abs(estimate.value - getattr(truth, name)) < 4 * estimate.standard_error

# %%
fitted = jj.simulate(found.scene, push, ts=jnp.linspace(0.0, 6.0, 200))
fig, (track, residuals) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
track.plot(values["x"], values["y"], "k.", label="measured")
track.plot(fitted["x"], fitted["y"], label="fitted")
track.set(xlabel="x in m", ylabel="y in m", aspect="equal", title="track of the mass centre")
track.legend()
for name, r in found.residuals[0].items():
    residuals.plot(ts, r, ".-", lw=0.6, label=name)
residuals.axhspan(-1.96, 1.96, color="0.9")
residuals.set(
    xlabel="t in s",
    ylabel="residual / sigma",
    title=f"reduced chi-square {float(found.reduced_chi_square):.2f}",
)
residuals.legend()
plt.show()

# %% [markdown]
# ## Free too much
#
# A track shows lengths and times, but no forces, and determines only $(I + m a^2)/m$ and $a$. If the mass is
# also free, one combination of mass and inertia is not determined. The fit names this combination and gives
# no interval for mass and inertia; the interval of the offset remains.

# %%
asked = jj.fit(guess, data, free=("mass", "inertia", "offset"))
print(asked)
assert len(asked.not_identifiable) == 1
assert np.isnan(asked["mass"].standard_error)
assert np.isnan(asked["inertia"].standard_error)
assert np.isfinite(asked["offset"].standard_error)
