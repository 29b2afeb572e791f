"""The part of the power of the loads and of potentials that needs no accelerations and nothing that is found by probing.

sum F.v + L.omega + Q_k u_k           loads without a potential
dV/dt at fixed poses                  potentials that depend on time
F_i.v + L_i.omega + Q_i u - dV_i/dt   loads whose potential depends on inputs, in place of that potential
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, Float

from jourdain_jax.calculus.jaxprs import needed_only
from jourdain_jax.equations.kinematics import coordinate_rates, pose_at
from jourdain_jax.equations.virtual_power import potential_energy, resultants
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.validated import loads_of, potential_of


def stored_by_inputs(scene: Scene, motion: Motion, of_inputs: tuple[int, ...]) -> Float[Array, ""]:
    """Potential energy in J of the loads with the numbers `of_inputs`."""
    loads = tuple(loads_of(scene, motion))
    return sum((loads[k].potential for k in of_inputs), start=jnp.zeros_like(motion.t))


def explicit_power(scene: Scene, motion: Motion, of_inputs: tuple[int, ...], loads: tuple[Load, ...] | None = None) -> Float[Array, ""]:
    """The part of `rate_of_work` that needs no accelerations: of loads without a potential, of potentials that depend on time or on inputs; W.

    `loads`: of the scene at this motion, where they are known already.
    """
    by_time = power_of_loads(scene, motion, conservative=False, loads=loads) + explicit_rate(scene, motion, potential_energy)
    return by_time + _of_driven_poses(scene, motion) + forces_for_potentials(scene, motion, of_inputs)


def _of_driven_poses(scene: Scene, motion: Motion) -> Float[Array, ""]:
    """Rate of the scene's own potential as poses move at `u = 0`: its forces stand on the speeds, along which no such motion is."""
    if potential_of(scene, motion.pose()) is None:
        return jnp.zeros_like(motion.t)
    t, q = motion.t, motion.q.array
    nu = coordinate_rates(scene, t, q, jnp.zeros_like(motion.u.array))
    along = (t, q), (jnp.ones_like(t), nu)
    held = motion.pose().bodies
    whole = jax.jvp(lambda t, q: potential_of(scene, pose_at(scene, t, q)), *along)[1]
    return whole - jax.jvp(lambda t, q: potential_of(scene, Pose(t, scene.coordinate_names.view(q), held)), *along)[1]


def forces_for_potentials(scene: Scene, motion: Motion, of_inputs: tuple[int, ...]) -> Float[Array, ""]:
    """Power in W of the loads `of_inputs` less the explicit rate of what they store."""
    if not of_inputs:
        return jnp.zeros_like(motion.t)
    stored = explicit_rate(scene, motion, lambda scene, motion: stored_by_inputs(scene, motion, of_inputs))
    return power_of_loads(scene, motion, among=of_inputs) - stored


def power_of_loads(
    scene: Scene, motion: Motion, *, conservative: bool | None = None, among: tuple[int, ...] | None = None, loads: tuple[Load, ...] | None = None
) -> Float[Array, ""]:
    """`sum F.v + L.omega + Q_k u_k` in W; only loads with (`conservative=True`) or without a potential (`False`), or with the numbers `among`.

    `loads`: as in `explicit_power`.
    """
    total = resultants(scene, motion, conservative=conservative, among=among, loads=loads)
    v = jnp.stack([body.velocity for body in motion.bodies.values()])
    omega = jnp.stack([body.angular_velocity for body in motion.bodies.values()])
    return jnp.sum(total.force * v) + jnp.sum(total.torque * omega) + total.direct @ motion.u.array


def explicit_rate(scene: Scene, motion: Motion, potential: Callable) -> Float[Array, ""]:
    """`dV/dt` of a `potential` with all poses held, and with coordinates moving only as they do at `u = 0`."""
    q = motion.q.array
    nu = coordinate_rates(scene, motion.t, q, jnp.zeros_like(motion.u.array))

    def V(t, q):
        held = eqx.tree_at(lambda m: (m.t, m.q.array), motion, (t, q))
        return potential(scene, held)

    return jax.jvp(_only_what_is_needed(V, motion.t, q), (motion.t, q), (jnp.ones_like(motion.t), nu))[1]


def _only_what_is_needed(f: Callable, *like) -> Callable:
    """`f` without what its result does not depend on: forces that the same loads state need not have a derivative."""
    pruned = jaxpr_as_fun(needed_only(jax.make_jaxpr(f)(*like)))
    return lambda *given: pruned(*given)[0]
