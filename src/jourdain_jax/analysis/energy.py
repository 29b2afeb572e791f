"""Compute the energy of a scene, and determine whether it is conserved.

E = T + V,   T = sum m v.v/2 + omega.I omega/2
    dE/dt = power of loads without a potential (`dynamics/reactions.py`)
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jourdain_jax.calculus.reals import Scalar, largest
from jourdain_jax.dynamics.accelerations import bare_accelerations
from jourdain_jax.dynamics.reactions import power
from jourdain_jax.equations.kinematics import motion_at
from jourdain_jax.equations.virtual_power import energies_at, unconstrained_equations
from jourdain_jax.scene.arguments import of_known_numbers
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.sampling import sample_states
from jourdain_jax.structure.structure import structure_of

_ORIGINS = {
    "loads": "loads without a potential",
    "rows": "constraints that do real work",
    "driven": "poses driven as functions of time",
    "potential": "potentials that depend on time",
    "inertia": "masses or inertias that change",
}


class Energy(eqx.Module):
    """Energy of one state, in J: `kinetic` T, `potential` V and their `total`."""

    kinetic: Scalar
    potential: Scalar  # of all loads and the scene; loads without a potential contribute nothing

    @property
    def total(self) -> Scalar:
        """Return T + V."""
        return self.kinetic + self.potential


@dataclass(frozen=True)
class EnergyBalance:
    """Whether T + V is conserved along every motion of a scene, and if not, the causes of its change."""

    conserved: bool
    changed_by: tuple[str, ...]

    def __str__(self) -> str:
        return (
            "T + V is conserved" if self.conserved else f"T + V is changed by {' and '.join(self.changed_by)}"
        )


def energy(scene: Scene, t, q, u, inputs=None) -> Energy:
    """Return the kinetic and potential energy (J) at (t, q, u). `inputs`: values of the scene's inputs
    (default: zero).
    """
    return Energy(*energies_at(scene, motion_at(scene, t, q, u, inputs)))


@of_known_numbers
def energy_balance(scene: Scene) -> EnergyBalance:
    """Report whether T + V is conserved, and the powers that change it, eqs. (71)-(73).

    Eight random admissible states with random inputs are examined. A power counts as zero if it is below 1e-9
    of the largest power (1e-4 in single precision). Raises DifferentiationModeError for traced numbers.
    """
    t, q, u = (jnp.asarray(x) for x in sample_states(scene, 8))
    inputs = jnp.asarray(np.random.default_rng(0).normal(size=(len(t), len(scene.inputs))))
    powers, size = _powers(scene, t, q, u, inputs)
    limit = (1e-9 if q.dtype == jnp.float64 else 1e-4) * float(jnp.max(size))
    changed_by = tuple(
        text for name, text in _ORIGINS.items() if float(largest(getattr(powers, name))) > limit
    )
    changed_by += ("potentials that depend on inputs",) if structure_of(scene).potentials_of_inputs else ()
    return EnergyBalance(not changed_by, changed_by)


@eqx.filter_jit
def _powers(scene: Scene, t, q, u, inputs):
    def one(t, q, u, inputs):
        found = bare_accelerations(scene, t, q, u, inputs)
        equations = unconstrained_equations(scene, t, q, u, inputs)
        forces = jnp.abs(equations.M) @ jnp.abs(found.udot) + jnp.abs(equations.h) + jnp.abs(equations.Q)
        return power(scene, motion_at(scene, t, q, u, inputs), found), jnp.abs(u) @ forces

    return jax.vmap(one)(t, q, u, inputs)
