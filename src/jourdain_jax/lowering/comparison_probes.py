"""Make the probes, that is, states and parameters, at which candidates for a scalar program are compared."""

import jax
import numpy as np
from jaxtyping import Float

from jourdain_jax.calculus.reals import all_finite
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.scene.identity import varied
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import random_states
from jourdain_jax.structure.structure import Structure
from jourdain_jax.structure.trace import TracedScene, named_values


def comparison_probes(scene: Scene, structure: Structure, traced: TracedScene) -> Probes:
    """Return probes at random and symmetric configurations on the geometric constraints, with random speeds.

    Parameters are up to a tenth larger than given, so that equality by coincidence is not taken for an
    identity. If the scene is undefined for these parameters, or its moments of inertia are impossible, they
    are closer to the given ones.
    """
    generator = np.random.default_rng(1)
    # at most 56 probes
    t, q = structure.times[:56], np.array(structure.coordinates[:56], np.float64)
    # in single precision, norms of quaternions equal one only to seven digits
    for first, _ in scene.coordinates.quaternions:
        q[:, first : first + 4] /= np.linalg.norm(q[:, first : first + 4], axis=1, keepdims=True)
    u = random_states(scene, len(t), generator)[2]
    given = [np.asarray(x) for x in jax.tree.leaves(scene)]
    away = [varied(x, 0.1 * generator.uniform(size=(len(t), *x.shape)), 0.05) - x for x in given]
    inputs = generator.normal(size=(len(t), len(scene.inputs)))
    for column, (_, values) in enumerate(scene.modes.pairs, len(scene.inputs) - len(scene.modes.pairs)):
        inputs[:, column] = generator.integers(len(values), size=len(t))
    values = named_values(scene, t, q, u, inputs)

    def probes(share) -> Probes:
        columns = [
            np.reshape(x + np.reshape(share, (-1, *[1] * x.ndim)) * dx, (len(t), -1)).T
            for x, dx in zip(given, away, strict=True)
        ]
        parameters = {
            f"p{k}_{i}": column for k, of_leaf in enumerate(columns) for i, column in enumerate(of_leaf)
        }
        return Probes(
            traced.graph, values | {name: np.asarray(value, np.float64) for name, value in parameters.items()}
        )

    share, possible, least = np.zeros(len(t)), False, _least_moments(traced, probes(np.zeros(len(t)))) / 2
    # try shrinking shares of the parameter variation until the scene is valid
    for tried in (1.0, -1.0, *(0.1**k for k in range(1, 9))):
        share = np.where(possible, share, tried)
        here = probes(share)
        finite = all_finite(here([n for part in traced.motion for n in part.ravel().tolist()]), axis=0)
        possible = finite & ~np.any(_least_moments(traced, here) < least, axis=1)
        if possible.all():
            break
    return here


def _least_moments(traced: TracedScene, probes: Probes) -> Float[np.ndarray, "probes bodies"]:
    """Return the smallest principal moment of each body at each probe; NaN if undefined."""
    I = np.moveaxis(probes(traced.at.inertia.ravel().tolist()).reshape(-1, 3, 3, probes.count), -1, 0)
    known = all_finite(I, axis=(2, 3))
    return np.where(known, np.linalg.eigvalsh(np.where(known[..., None, None], I, 0.0))[..., 0], np.nan)
