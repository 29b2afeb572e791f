"""Accelerations of a scene at given and at random admissible states, uncompiled: each is worked out once."""

import jax
import jax.numpy as jnp

import jourdain_jax as jj
from jourdain_jax.eager.eager import eval_numpy


@eval_numpy
def _solve(scene, t, q, u):
    return jax.vmap(lambda t, q, u: jj.accelerations(scene, t, q, u))(t, q, u)


@eval_numpy
def _solve_by_every_reduction(scene, reductions, q, u):
    return {name: jj.accelerations(scene, 0.0, q, u, reduction=reduction) for name, reduction in reductions.items()}


def solved_at_random_states(scene: jj.Scene, count: int = 20):
    """Coordinates, speeds and accelerations by name, each an array over the states, and the whole result."""
    t, q, u = (jnp.asarray(x) for x in jj.sample_states(scene, count))
    solved = jax.tree.map(jnp.asarray, _solve(scene, t, q, u))
    return scene.coordinate_names.view(q), scene.speed_names.view(u), scene.speed_names.view(solved.udot), solved


def solved_by_every_reduction(scene: jj.Scene, q, u) -> dict[str, jj.Accelerations]:
    """The result of each reduction at one state, by the reduction's short name."""
    return jax.tree.map(jnp.asarray, _solve_by_every_reduction(scene, jj.reductions(scene), q, u))
