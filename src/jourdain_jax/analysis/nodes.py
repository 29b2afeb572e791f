"""Nodes between the pieces of a run: whole states, which the motion of a piece begins from and ends at.

A node is all coordinates, all speeds, and what the low-pass of each sensor with a lag gives, s = (q, u, y). A piece begins at the nearest state on the
constraints, and continuity is asked of all numbers of s: it fixes what the constraints leave out, so that no chart of the constraint manifold has to be chosen,
and none can be singular.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.motion.start import State
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.scene import Scene

NODE, LAST = "node of a piece", "time of the next node"  # in the start of a run that is a piece
END = "~end of a piece"  # among its residuals, after all channels


def begin(scene: Scene, start: dict, t0):
    """What `simulate` begins from: the start of a run; of a later piece its node, which `simulate` puts onto the constraints."""
    if NODE in start:
        (q, u, _), nothing = jnp.split(start[NODE], np.cumsum([len(scene.coordinate_names), len(scene.speed_names)])), jnp.zeros(())
        return State(jnp.asarray(t0), q, u, nothing, nothing, nothing, (scene.coordinate_names, scene.speed_names))
    return {name: value for name, value in start.items() if name != LAST}


def ended(motion: Trajectory, filters: Sequence[Float[Array, "times entries"]], start: dict, ts: Float[Array, "times"]) -> dict[str, Float[Array, "states"]]:
    """What a piece of a motion with these times ends at, beside its residuals; nothing for a whole run."""
    if LAST not in start:
        return {}
    last = jnp.argmin(jnp.abs(ts - start[LAST]))
    return {END: jnp.concatenate([x[last] for x in (motion.q, motion.u, *filters)])}
