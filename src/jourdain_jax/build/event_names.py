"""Names of a scene's stop events and invariants, without evaluating them."""

from jourdain_jax.equations.kinematics import shapes_along_motion
from jourdain_jax.scene.once_per_class import once_per_class
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.validated import events_of, invariants_of


@once_per_class
def names_of_events(scene: Scene) -> tuple[str, ...]:
    """Names of the stop events, sorted, as JAX returns dictionaries."""
    return tuple(shapes_along_motion(events_of, scene))


@once_per_class
def names_of_invariants(scene: Scene) -> tuple[str, ...]:
    """Names of the invariants that the scene states, sorted."""
    return tuple(shapes_along_motion(invariants_of, scene))
