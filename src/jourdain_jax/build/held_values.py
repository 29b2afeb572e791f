"""Whether rows can be met while some coordinates and speeds keep the values that they are given.

    rank G_f = rank G,   rank A_f = rank A,      G = dg/dq, A = dphi/du, f: their columns of what is free

Then the values cannot contradict each other, but for single configurations.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jourdain_jax.build.reference_parameters import with_reference_parameters
from jourdain_jax.build.structure import Structure, structure_of
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.listed import names_of_position_rows
from jourdain_jax.equations.projection import BY_AUTODIFF
from jourdain_jax.scene.once_per_class import once_per_class
from jourdain_jax.scene.scene import Scene


def may_contradict(scene: Scene, known: Structure, free_q: Bool[np.ndarray, "coordinates"], free_u: Bool[np.ndarray, "speeds"]) -> bool:
    """Whether values that are held, where entries are not free, may contradict each other; `known`: of the scene."""
    of_speeds = not all(free or k in known.independent for k, free in enumerate(free_u))  # otherwise rows determine the dependent ones
    of_coordinates = not free_q.all() and bool(names_of_position_rows(scene) or scene.coordinates.quaternions)
    if not (of_speeds or of_coordinates):
        return False
    if of_speeds and not known.affine:
        return True
    return (of_coordinates and _loses_rank(_slopes(scene, "closures"), free_q)) or (of_speeds and _loses_rank(_slopes(scene, "rows"), free_u))


def _loses_rank(matrices, free) -> bool:
    return any(np.linalg.matrix_rank(one[:, free]) < np.linalg.matrix_rank(one) for one in matrices)


@once_per_class
def _slopes(scene: Scene, of: Literal["closures", "rows"]) -> Float[np.ndarray, "states rows columns"]:
    """G or A at some states of the domain."""
    known = structure_of(scene)
    states = slice(0, min(known.random, 4))
    return _evaluated(of, with_reference_parameters(scene), known.times[states], known.coordinates[states])


@eval_numpy
def _evaluated(of: str, scene: Scene, times, coordinates):
    u = jnp.zeros(len(scene.speed_names))
    slope = {"closures": lambda t, q: BY_AUTODIFF.closures(scene, t, q)[1], "rows": lambda t, q: BY_AUTODIFF.rows(scene, t, q, u, None)[1]}[of]
    return jax.vmap(slope)(times, coordinates)
