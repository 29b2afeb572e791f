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
# # A first scene: the Chaplygin sleigh, from description to gradient
#
# A sleigh stands on two smooth feet and one blade. The blade can slide along itself and can turn, but it
# cannot slip sideways. This condition is a *nonholonomic* constraint: it limits the velocities of the sleigh,
# but not the places that it can reach.
#
# We describe the sleigh in a dozen lines, let the engine derive its equations of motion by Jourdain's
# principle, compare the motion with Chaplygin's closed form, and differentiate the whole simulation.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jourdain_jax as jj

# %% [markdown]
# ## Describe it
#
# A scene is a class. Its fields are physical parameters; its methods return poses of bodies, loads and
# constraints. Automatic differentiation provides velocities, the mass matrix and the Jacobian of the
# constraint.


# %%
class Sleigh(jj.Scene):
    """A body on a blade; the mass centre lies `offset` ahead of the blade."""

    mass: float = jj.parameter(1.3, unit="kg", positive=True)
    inertia: float = jj.parameter(0.4, unit="kg m^2", positive=True)
    offset: float = jj.parameter(0.25, unit="m")

    coordinates = jj.coordinates("x y heading")  # x, y of the mass centre

    def bodies(self, t, q):
        position = jj.vec(q.x, q.y, 0)
        return {"sleigh": jj.RigidBody(self.mass, self.inertia * jnp.ones(3), position, jj.rot_z(q.heading))}

    def velocity_constraints(self, motion):
        sleigh = motion["sleigh"]
        blade = sleigh.place(jnp.stack([-self.offset, 0.0, 0.0]))
        sideways = sleigh.orientation[:, 1]
        return {"blade": jj.knife_edge(sleigh, blade, sideways)}


sleigh = Sleigh()

# %% [markdown]
# ## What kind of system is it?
#
# A report shows it before the first simulation. Three speeds with one constraint leave two degrees of
# freedom. The constraint is not integrable: by the growth vector (2, 3), motions along two admissible
# velocities reach all three coordinates.

# %%
print(jj.report(sleigh))

# %% [markdown]
# ## Let it go
#
# We set the forward speed of the mass centre and the turn rate. The sideways speed follows from the
# constraint of the blade.

# %%
v0, w0 = -0.6, 0.9
start = jj.start(sleigh, x_rate=v0, heading_rate=w0)
motion = jj.simulate(sleigh, start, t1=12.0, rtol=1e-11, atol=1e-11)
print(motion)

# %% [markdown]
# ## Compare with the closed form
#
# With $k^2 = (I + m a^2)/m$, Chaplygin found that $v^2 + k^2\omega^2 = V^2$ stays constant, and with $\tau =
# a V (t - t_0)/k^2$
#
# $$ v = V \tanh\tau, \qquad \omega = \frac{V}{k}\,\mathrm{sech}\,\tau . $$
#
# From any start, the sleigh ends up going straight ahead, with the blade behind the mass centre. Its
# equations are reversible and its energy is conserved, and yet it behaves as if it were damped.

# %%
m, inertia, a = (float(x) for x in (sleigh.mass, sleigh.inertia, sleigh.offset))
k = np.sqrt((inertia + m * a**2) / m)
V = np.hypot(v0, k * w0)
tau = a * V * np.asarray(motion.ts) / k**2 + np.arctanh(v0 / V)
heading = np.asarray(motion["heading"])
forward = np.asarray(motion["x_rate"]) * np.cos(heading) + np.asarray(motion["y_rate"]) * np.sin(heading)

error = max(
    np.max(np.abs(forward - V * np.tanh(tau))),
    np.max(np.abs(np.asarray(motion["heading_rate"]) - V / k / np.cosh(tau))),
)
print(f"largest difference from the closed form: {error:.1e}")
assert error < 1e-8

fig, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6))
left.plot(motion["x"], motion["y"], label="mass centre")
left.plot(*np.asarray(motion.point("sleigh", (-a, 0.0, 0.0)))[:, :2].T, "--", label="blade")
left.set(
    xlabel="x in m",
    ylabel="y in m",
    aspect="equal",
    title="the blade's path has a cusp, the centre's has none",
)
left.legend()
right.plot(motion.ts, forward, label="forward speed in m/s")
right.plot(motion.ts, motion["heading_rate"], label="turning rate in rad/s")
right.plot(motion.ts, V * np.tanh(tau), "k:", lw=1, label="closed form")
right.plot(motion.ts, V / k / np.cosh(tau), "k:", lw=1)
right.set(xlabel="t in s", title="turning turns into going straight")
right.legend()
fig.tight_layout()

# %% [markdown]
# ## Differentiate the simulation
#
# How does the final heading depend on the position of the mass centre? The simulation is a JAX function,
# which `jax.grad` differentiates. From $t = -\infty$ to $\infty$ the sleigh turns by $\pi k/a$, so more
# offset must mean less turning.


# %%
def final_heading(offset):
    scene = sleigh.replace(offset=offset)
    return jj.simulate(
        scene, jj.start(scene, x_rate=v0, heading_rate=w0), t1=12.0, rtol=1e-10, atol=1e-10
    ).q_end[2]


slope = jax.grad(final_heading)(0.25)
h = 1e-5
difference = (final_heading(0.25 + h) - final_heading(0.25 - h)) / (2 * h)
print(f"d heading / d offset = {slope:.8f} rad/m by gradient, {difference:.8f} by differences")
assert abs(slope - difference) < 1e-5 * abs(slope)
