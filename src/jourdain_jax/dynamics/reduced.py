"""The reduced Appell equations (42): which coordinates they keep, and their accelerations (row S9).

Cyclic and ignorable coordinates need not be known for the privileged accelerations: they are held at the reference, and the system
is integrated in the others, the *kept* coordinates k, alone:

    dk/dt = B_k(t, k) y + b_k(t, k),     dy/dt = yddot(t, k, y)

The dropped coordinates d would follow by quadrature along the known motion, `d(t) = d_0 + int B_d y + b_d dt`, in groups: a group may need
those recovered before it (the disc's x and y need its yaw); `simulate` integrates them with the others. An ignorable coordinate is kept where a kept
rate needs it, or where its own rate does (quaternions, the sleigh's heading): then no quadrature gives it.
Source: Wang and Pao (2003), eq. (42).
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.build.structure import structure_of
from jourdain_jax.dynamics.accelerations import bare_accelerations
from jourdain_jax.dynamics.cyclic import dependence
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.equations.reductions import Partition, Privileged
from jourdain_jax.equations.rows import velocity_residual
from jourdain_jax.equations.scaling import row_scale
from jourdain_jax.scene.scene import Scene


class AdmissibleRates(eqx.Module):
    """Speeds `u = C y + c` and coordinate rates `qdot = B y + b` in the privileged velocities y."""

    C: Float[Array, "speeds freedoms"]
    c: Float[Array, "speeds"]
    B: Float[Array, "coordinates freedoms"]
    b: Float[Array, "coordinates"]


@dataclass(frozen=True)
class ReducedCoordinates:
    """Which coordinates the reduced equations keep, and in which groups the dropped ones are recovered."""

    kept: tuple[str, ...]
    dropped: tuple[tuple[str, ...], ...]  # groups, in the order of their recovery
    privileged: tuple[str, ...]  # the speeds y

    @property
    def recovered(self) -> tuple[str, ...]:
        """All dropped coordinates in the order of their recovery."""
        return tuple(name for group in self.dropped for name in group)


def admissible_rates(scene: Scene, t, q, u) -> AdmissibleRates:
    """C, c, B and b at one state; u matters for rows nonlinear in the speeds only, which are linearised there."""
    A = jax.jacfwd(lambda u: velocity_residual(scene, t, q, u))(u)
    scale = row_scale(A)
    split = Partition(scale[:, None] * A, structure_of(scene).independent)
    C, c = split.C, split.particular(scale * (A @ u - velocity_residual(scene, t, q, u)))
    nu = coordinate_rates(scene, t, q, jnp.zeros_like(u))
    N = jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(u)
    return AdmissibleRates(C, c, N @ C, N @ c + nu)


def reduced_coordinates(scene: Scene) -> ReducedCoordinates:
    """What to keep and what to drop; a ValueError for rows nonlinear in the speeds, which have no linear B and b."""
    structure = structure_of(scene)
    if not structure.affine:
        raise ValueError(f"`{type(scene).__name__}` has rows nonlinear in the speeds, and so no reduced equations; integrate all coordinates and speeds")
    found, names = dependence(scene), scene.coordinate_names.entries
    cyclic_or_ignorable = (~found.cyclic_quantities & ~found.privileged) | ~found.accelerations
    groups = _groups(set(np.flatnonzero(cyclic_or_ignorable).tolist()), found.rates)
    dropped = {i for group in groups for i in group}
    return ReducedCoordinates(
        tuple(name for i, name in enumerate(names) if i not in dropped),
        tuple(tuple(names[i] for i in group) for group in groups),
        tuple(scene.speed_names.entries[i] for i in structure.independent),
    )


def _groups(droppable: set[int], needs) -> list[list[int]]:
    """Groups of coordinates that quadrature recovers one after another; `needs[i, j]`: the rate of i depends on j."""
    while True:
        groups, known = [], set(range(len(needs))) - droppable
        needed_by_kept = {j for j in droppable if any(needs[i, j] for i in known)}
        while ready := [i for i in sorted(droppable - known) if set(np.flatnonzero(needs[i]).tolist()) <= known]:
            groups.append(ready)
            known |= set(ready)
        in_circles = droppable - known  # rates that need themselves or one another
        if not needed_by_kept | in_circles:
            return groups
        droppable = droppable - needed_by_kept - in_circles


def reduced_accelerations(scene: Scene, t, kept: Float[Array, "kept"], y, inputs=None) -> Float[Array, "freedoms"]:
    """Privileged accelerations of the reduced equations (42) from time, kept coordinates and privileged speeds alone."""
    independent = structure_of(scene).independent
    places = [scene.coordinate_names.index(name, "coordinate") for name in reduced_coordinates(scene).kept]
    q = jnp.asarray(scene.coordinates.reference()).at[jnp.array(places, jnp.int32)].set(kept)  # the dropped ones at the reference
    rates = admissible_rates(scene, t, q, jnp.zeros(len(scene.speed_names)))
    found = bare_accelerations(scene, t, q, rates.C @ y + rates.c, inputs, reduction=Privileged(independent))
    return found.udot[jnp.array(independent, jnp.int32)]
