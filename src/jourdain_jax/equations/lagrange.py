"""Lagrange's equations in energy-derivative form, for scenes whose speeds are the coordinate rates (S2 of
docs/paper_by_example.md).

    d/dt dT/dqdot - dT/dq = Q - dV/dq + A' lambda          (11)

They give M, h and Q independently of Jourdain's principle: `M = d2T/dqdot2`, and h is `d/dt(dT/dqdot) -
dT/dq` at qddot = 0. Source: Wang and Pao (2003), eq. (11).
"""

import jax
import jax.numpy as jnp

from jourdain_jax.equations.virtual_power import UnconstrainedEquations, generalized_forces, kinetic_energy
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.arguments import as_coordinates, as_scene, as_speeds, as_time
from jourdain_jax.scene.scene import Scene


@eager_if_concrete
def lagrange_equations(scene: Scene, t, q, u, inputs=None) -> UnconstrainedEquations:
    """Return M, h and Q of `M udot + h = Q` from derivatives of the kinetic energy: `d/dt dT/dqdot - dT/dq =
    Q`; eq. (11).

    `inputs`: values of the scene's inputs (default: zero). Raises ValueError if the speeds are not the
    coordinate rates.
    """
    if not speeds_are_rates(as_scene(scene)):
        raise ValueError(
            f"Lagrange's equations hold for coordinate rates, and the speeds of `{type(scene).__name__}` are "
            "quasi-velocities; use Appell's equations"
        )
    t, q, u = as_time(t), as_coordinates(scene, q), as_speeds(scene, u)

    def momentum(t, q, u):
        return jax.grad(kinetic_energy, argnums=3)(scene, t, q, u)

    M = jax.jacfwd(momentum, argnums=2)(t, q, u)
    _, momentum_rate = jax.jvp(lambda t, q: momentum(t, q, u), (t, q), (jnp.ones_like(t), u))
    # h = d/dt (dT/dqdot) at qddot = 0, minus dT/dq
    h = momentum_rate - jax.grad(kinetic_energy, argnums=2)(scene, t, q, u)
    return UnconstrainedEquations(M, h, generalized_forces(scene, t, q, u, inputs))


def speeds_are_rates(scene: Scene) -> bool:
    """Return whether the speeds are the coordinates' own rates (no quaternions, no quasi-velocities)."""
    return (
        not scene.coordinates.quaternions
        and scene.speeds is None
        and type(scene).coordinate_rates is Scene.coordinate_rates
    )
