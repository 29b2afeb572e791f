"""The domain in which a scene's states are drawn: what the scene states by name, defaults for the rest."""

import numpy as np

from jourdain_jax.scene.scene import Scene

# Where a scene states no domain: wide enough that an angle meets every direction, so that no partition passes by luck.
COORDINATE_DOMAIN = (-3.2, 3.2)
SPEED_DOMAIN = (-1.0, 1.0)


def coordinate_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bound of every coordinate; -1 and 1 for the entries of quaternions."""
    low, high = _bounds(scene, scene.coordinate_names.entries, COORDINATE_DOMAIN)
    for first, _ in scene.coordinates.quaternions:
        low[first : first + 4], high[first : first + 4] = -1.0, 1.0
    return low, high


def speed_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bound of every speed."""
    return _bounds(scene, scene.speed_names.entries, SPEED_DOMAIN)


def _bounds(scene: Scene, names, default) -> tuple[np.ndarray, np.ndarray]:
    pairs = [scene.domain.get(name, default) for name in names]
    return np.array([p[0] for p in pairs], float), np.array([p[1] for p in pairs], float)
