"""What is looked at of a scene at each probed state."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from jourdain_jax.build.plausibility import PoseNumbers
from jourdain_jax.calculus.reals import Entries
from jourdain_jax.scene.scene import Scene

TIMED = ("rows", "poses", "inertias", "coordinate rates", "loads", "potential")


class Probed(eqx.Module):
    """What is found at one state, or with a leading axis at all; trees have arrays as leaves."""

    q: Float[Entries, "*states coordinates"]  # on the geometric rows
    position_error: Float[Entries, "*states"]  # of these rows, as the next two from `Assembled`
    error: Float[Entries, "*states"]  # of the coordinates
    outside: Float[Entries, "*states"]  # of the domain
    A: Float[Entries, "*states rows speeds"]
    A_other: Float[Entries, "*states rows speeds"]  # at other speeds
    A_beyond: Float[Entries, "*states rows speeds"]  # at the coordinates as they were before they were put on the geometric rows
    M: Float[Entries, "*states speeds speeds"]
    phi_at_rest: Float[Entries, "*states rows"]  # at u = 0
    motion_at_rest: PyTree  # velocities and coordinate rates at u = 0
    timed: dict[str, PyTree]  # rates in time by `TIMED`, while coordinates, speeds and inputs are held (for loads and potentials: the motion)
    inertia_rates: PyTree  # along the motion
    potential_rates: Float[Entries, "*states loads"]  # of each load's potential, along a generic change of the inputs
    row_rates_of_inputs: Float[Entries, "*states rows"]  # along the same change
    numbers: PoseNumbers
    unproved: frozenset[str] = eqx.field(static=True, default=frozenset())  # what may be other than zero where no probe lies
    in_calls: frozenset[str] = eqx.field(static=True, default=frozenset())  # what calls of JAX compute of poses and rows


def generic_inputs(scene: Scene) -> np.ndarray:
    """Values of inputs at which no term passes for absent."""
    return np.linspace(0.5, 1.0, len(scene.inputs))
