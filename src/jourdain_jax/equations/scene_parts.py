"""Names of the parts of a scene, found by tracing it once, without evaluation at a state."""

from typing import NamedTuple

from jourdain_jax.equations.kinematics import shapes_along_motion
from jourdain_jax.equations.rows import position_rows, row_names, velocity_rows
from jourdain_jax.scene.identity import once_per_class
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import events_of, invariants_of, loads_of


class _Listed(NamedTuple):
    bodies: tuple[str, ...]
    rows: tuple[str, ...]
    position_rows: tuple[str, ...]
    events: tuple[str, ...]
    stops: tuple[bool, ...]  # whether each event stops the motion
    has_load_without_potential: bool


def names_of_bodies(scene: Scene) -> tuple[str, ...]:
    """Return names of the bodies, sorted."""
    return _listed(scene).bodies


def names_of_rows(scene: Scene) -> tuple[str, ...]:
    """Return names of all constraint rows, in order."""
    return _listed(scene).rows


def names_of_position_rows(scene: Scene) -> tuple[str, ...]:
    """Return names of the geometric constraint rows, in order; they come first."""
    return _listed(scene).position_rows


def names_of_events(scene: Scene) -> tuple[str, ...]:
    """Return names of the events, sorted."""
    return _listed(scene).events


def stops(scene: Scene) -> tuple[bool, ...]:
    """Return whether each event stops the motion, in the order of their names."""
    return _listed(scene).stops


def has_load_without_potential(scene: Scene) -> bool:
    """Return whether some load has no potential."""
    return _listed(scene).has_load_without_potential


@once_per_class
def names_of_invariants(scene: Scene) -> tuple[str, ...]:
    """Return the sorted names of the scene's invariants. Motions do not call this, so errors in `invariants`
    appear only when invariants are used.
    """
    return tuple(shapes_along_motion(invariants_of, scene))  # JAX returns dictionaries sorted by name


@once_per_class
def _listed(scene: Scene) -> _Listed:
    """Return the names. They are recorded during the trace, because JAX returns only arrays and sorts
    dictionaries by name.
    """
    noted: list[_Listed] = []

    def look(scene: Scene, motion: Motion) -> None:
        rows = row_names(velocity_rows(scene, motion))
        first = row_names(position_rows(scene, motion.pose()))
        without = any(load.potential is None for load in loads_of(scene, motion))
        without = without or bool(scene.switching.contacts)
        stop = {name: event.stop for name, event in events_of(scene, motion).items()}
        stop |= dict.fromkeys(scene.switching.events, False)
        events, ends = zip(*sorted(stop.items()), strict=True) if stop else ((), ())
        noted.append(_Listed(tuple(motion.bodies), rows, first, events, ends, without))

    shapes_along_motion(look, scene)
    return noted[0]
