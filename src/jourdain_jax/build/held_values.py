"""Whether rows can be met while some coordinates and speeds keep the values that they are given.

    rank G_f = rank G,   rank A_f = rank A,      G = dg/dq, A = dphi/du, f: their columns of what is free

Then the values cannot contradict each other, but for single configurations.
"""

import numpy as np
from jaxtyping import Bool

from jourdain_jax.build.structure import Structure
from jourdain_jax.equations.listed import names_of_position_rows
from jourdain_jax.scene.scene import Scene


def may_contradict(scene: Scene, known: Structure, free_q: Bool[np.ndarray, "coordinates"], free_u: Bool[np.ndarray, "speeds"]) -> bool:
    """Whether values that are held, where entries are not free, may contradict each other; `known`: of the scene."""
    of_speeds = not all(free or k in known.independent for k, free in enumerate(free_u))  # otherwise rows determine the dependent ones
    of_coordinates = not free_q.all() and bool(names_of_position_rows(scene) or scene.coordinates.quaternions)
    if of_speeds and not known.affine:
        return True
    return (of_coordinates and _loses_rank(known.closure_slopes, free_q)) or (of_speeds and _loses_rank(known.row_slopes, free_u))


def _loses_rank(matrices, free) -> bool:
    return any(np.linalg.matrix_rank(one[:, free]) < np.linalg.matrix_rank(one) for one in matrices)
