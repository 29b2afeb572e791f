"""Names of a scene's stop events, without evaluating them."""

import jax

from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.probing import described_once
from jourdain_jax.scene.answers import events_of
from jourdain_jax.scene.scene import Scene


@described_once
def names_of_events(scene: Scene) -> tuple[str, ...]:
    """Names of the stop events, sorted, as JAX returns dictionaries."""
    q, u, _ = scene.named()
    return tuple(jax.eval_shape(lambda s: events_of(s, motion_at(s, 0.0, q, u)), scene))
