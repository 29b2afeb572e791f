"""The power that changes the energy T + V of a scene.

    d(T + V)/dt = sum F.v + L.omega + Q_k u_k                loads without a potential
                + (A' lambda).u                              constraints that do work
                + sum R.v_0 + T.omega_0                      poses driven in time
                + dV/dt at fixed poses                       potentials that depend on time
                + sum mdot v.v/2 + omega.(dI/dt omega)/2     masses and inertias that change

Constraints that do work are prescribed, nonhomogeneous or nonlinear. R, T: constraint force and torque on a
body; v_0, omega_0: its velocities at u = 0. Matter that joins a body is assumed to have the velocity of the
body. Terms that are zero at every state by the scene's structure are not computed.

Inputs f count as constant here; their rates enter constraints through the accelerations. If the potential V_i
of a load depends on inputs, the inputs also do the work dV_i/df . df/dt. Since inputs may jump, this work is
computed without df/dt (`rate_of_work`, `stored_by_inputs`):

    W = int (power - dV_i/dt at fixed poses + F_i.v + L_i.omega + Q_i u) dt + V_i(t) - V_i(t0)

Source: Wang and Pao (2003), eqs. (71)-(73).
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from jourdain_jax.calculus.reals import Indices, Scalar
from jourdain_jax.dynamics.accelerations import Accelerations
from jourdain_jax.dynamics.newton_euler import newton_residual
from jourdain_jax.equations.kinematics import inertias, motion_at, of_bodies, velocities_of
from jourdain_jax.equations.reductions import Reduced
from jourdain_jax.equations.scene_parts import has_load_without_potential
from jourdain_jax.equations.virtual_power import potential_energy
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.load_power import explicit_rate, forces_for_potentials, power_of_loads
from jourdain_jax.structure.structure import Structure, structure_of


class Power(eqx.Module):
    """Power in W by origin; positive if it increases T + V."""

    loads: Scalar  # of loads without a potential
    rows: Scalar  # of constraints that do real work
    driven: Scalar  # of drives that move poses as functions of time
    potential: Scalar  # explicit rate of potentials that depend on time
    inertia: Scalar  # of changing masses and inertias

    @property
    def total(self) -> Scalar:
        """Return `d(T + V)/dt`."""
        return sum(jax.tree.leaves(self))


def needs_work(scene: Scene, structure: Structure) -> bool:
    """Return whether a term of d(T + V)/dt may be nonzero, so that the work must be integrated with the
    motion.
    """
    moved = structure.driven or structure.varying_inertia or _rows_work(structure)
    by_potentials = "potential" in structure.timed or bool(structure.potentials_of_inputs)
    return moved or by_potentials or has_load_without_potential(scene)


def _rows_work(structure: Structure) -> bool:
    return not (structure.affine and structure.homogeneous)


def power(scene: Scene, motion: Motion, accelerations: Accelerations | Reduced) -> Power:
    """Return the power that changes T + V, in W, by origin."""
    structure = structure_of(scene)
    zero = jnp.zeros_like(motion.t)
    explicit = structure.driven or "potential" in structure.timed
    return Power(
        loads=power_of_loads(scene, motion, conservative=False),
        # lambda . (A u), which is lambda . phi = 0 for constraints homogeneous and linear in u
        rows=accelerations.constraint_force @ motion.u.array if _rows_work(structure) else zero,
        driven=_power_of_drives(scene, motion, accelerations.udot) if structure.driven else zero,
        potential=explicit_rate(scene, motion, potential_energy) if explicit else zero,
        inertia=_power_of_changing_inertia(scene, motion) if structure.varying_inertia else zero,
    )


def rate_of_work(
    scene: Scene, motion: Motion, accelerations: Accelerations | Reduced, of_inputs: Indices
) -> Scalar:
    """Return the integrand of W, the work in the last formula of this module, in watts.

    `of_inputs`: indices of the loads whose potential depends on inputs. They contribute by their forces.
    Their stored energy (`stored_by_inputs`) is added to the integral.
    """
    return power(scene, motion, accelerations).total + forces_for_potentials(scene, motion, of_inputs)


def _power_of_drives(scene: Scene, motion: Motion, udot) -> Scalar:
    """Return the power of constraint forces on bodies that move while all speeds are zero."""
    t, q, u, inputs = motion.t, motion.q.array, motion.u.array, motion.inputs.array
    total = newton_residual(scene, t, q, u, udot, inputs)
    at_rest = motion_at(scene, t, q, jnp.zeros_like(u), inputs)
    v, omega = of_bodies(at_rest, "velocity"), of_bodies(at_rest, "angular_velocity")
    return jnp.sum(total.linear * v) + jnp.sum(total.angular * omega)


def _power_of_changing_inertia(scene: Scene, motion: Motion) -> Scalar:
    """Return `sum mdot v.v/2 + omega.(dI/dt omega)/2`, with dI/dt in body axes."""
    t, q, now = motion.t, motion.q.array, velocities_of(motion)
    _, rate = jax.jvp(lambda t, q: inertias(scene, t, q), (t, q), (jnp.ones_like(t), motion.qdot.array))
    return 0.5 * (
        rate.mass @ jnp.sum(now.linear**2, axis=1)
        + jnp.einsum("bi,bij,bj->", now.angular, rate.inertia, now.angular)
    )
