"""The hand-derived equations of the tilting disc on a flat array, as one would first hand them to diffrax.

The state of one lane is y = (x, y, yaw, lean, spin, yaw_rate, lean_rate, spin_rate); `dense.integrate` runs a
batch of them.
"""

import jax.numpy as jnp

from .hand_derived import tilting_disc


def disc_rates(p, t, y):
    """`dy/dt` of one lane."""
    qdot, vdot = tilting_disc(p, t, tuple(y[:5]), tuple(y[5:]))
    return jnp.stack([*qdot, *vdot])
