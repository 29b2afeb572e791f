"""Names of a scene's stop events and invariants, without evaluating them."""

import jax

from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.scene.once_per_class import once_per_class
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.validated import events_of, invariants_of


@once_per_class
def names_of_events(scene: Scene) -> tuple[str, ...]:
    """Names of the stop events, sorted, as JAX returns dictionaries."""
    q, u, _ = scene.named()
    return tuple(jax.eval_shape(lambda s: events_of(s, motion_at(s, 0.0, q, u)), scene))


@once_per_class
def names_of_invariants(scene: Scene) -> tuple[str, ...]:
    """Names of the invariants that the scene states, sorted."""
    q, u, _ = scene.named()
    return tuple(jax.eval_shape(lambda s: invariants_of(s, motion_at(s, 0.0, q, u)), scene))
