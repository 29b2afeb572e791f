"""Nodes between the pieces of a run: whole states, which the motion of a piece begins from and ends at.

A node is all coordinates, all speeds, and what the low-pass of each sensor with a lag gives, s = (q, u, y). A piece begins at the nearest state on the
constraints, and continuity is asked of all numbers of s: it fixes what the constraints leave out, so that no chart of the constraint manifold has to be chosen,
and none can be singular.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.motion.start import State
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.scene.scene import Scene

NODE, LAST = "node of a piece", "time of the next node"  # in the start of a run that is a piece
END = "~end of a piece"  # among its residuals, after all channels


def begin(scene: Scene, start: dict, t0):
    """What `simulate` begins from: the start of a run; of a later piece its node, which `simulate` puts onto the constraints."""
    if NODE in start:
        count, nothing = len(scene.coordinate_names), jnp.zeros(())
        names = scene.coordinate_names, scene.speed_names
        return State(jnp.asarray(t0), *jnp.split(start[NODE], [count, count + len(scene.speed_names)])[:2], nothing, nothing, nothing, names)
    return {name: value for name, value in start.items() if name != LAST}


def ended(motion: Trajectory, filters: Sequence[Float[Array, "times entries"]], start: dict, ts: Float[Array, "times"]) -> dict[str, Float[Array, "states"]]:
    """What a piece of a motion with these times ends at, beside its residuals; nothing for a whole run."""
    if LAST not in start:
        return {}
    last = jnp.argmin(jnp.abs(ts - start[LAST]))
    return {END: jnp.concatenate([x[last] for x in (motion.q, motion.u, *filters)])}
