"""Accelerations of a scene at given and at random admissible states, each worked out once."""

import jax
import numpy as np

import jourdain_jax as jj


def over_states(f, *states):
    """What `f` finds at each of some states, stacked."""
    return jax.tree.map(lambda *found: np.stack(found), *(f(*state) for state in zip(*states, strict=True)))


def solved_at_random_states(scene: jj.Scene, count=20):
    """Coordinates, speeds and accelerations by name, each an array over the states, and the whole result."""
    t, q, u = jj.sample_states(scene, count)
    solved = over_states(lambda *state: jj.accelerations(scene, *state), t, q, u)
    return (
        scene.coordinate_names.view(q),
        scene.speed_names.view(u),
        scene.speed_names.view(solved.udot),
        solved,
    )


def solved_by_every_reduction(scene: jj.Scene, q, u) -> dict[str, jj.Accelerations]:
    """The result of each reduction at one state, by the reduction's short name."""
    return {
        name: jj.accelerations(scene, 0.0, q, u, reduction=reduction)
        for name, reduction in jj.reductions(scene).items()
    }
