"""Power of loads, and rates of potentials due to explicit time, to inputs, and to poses that
move at `u = 0`.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun

from jourdain_jax.calculus.jaxprs import needed_only
from jourdain_jax.calculus.reals import Indices, Scalar
from jourdain_jax.equations.kinematics import coordinate_rates, of_bodies, pose_at
from jourdain_jax.equations.virtual_power import potential_energy, resultants
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.motion_state import Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import loads_of, potential_of


def stored_by_inputs(scene: Scene, motion: Motion, of_inputs: Indices) -> Scalar:
    """Return the potential energy in J of the loads with the indices `of_inputs`."""
    loads = tuple(loads_of(scene, motion))
    return sum((loads[k].potential for k in of_inputs), start=jnp.zeros_like(motion.t))


def explicit_power(
    scene: Scene, motion: Motion, of_inputs: Indices, loads: tuple[Load, ...] | None
) -> Scalar:
    """Return the part of `rate_of_work` without accelerations, in W. Three kinds of loads contribute:

        without a potential                    sum F.v + L.omega + Q_k u_k
        with a potential V of time             dV/dt at fixed poses
        with a potential V_i of inputs         F_i.v + L_i.omega + Q_i u - dV_i/dt

    `loads`: the scene's loads at this motion, if already known.
    """
    by_time = power_of_loads(scene, motion, conservative=False, loads=loads) + explicit_rate(
        scene, motion, potential_energy
    )
    return by_time + _of_driven_poses(scene, motion) + forces_for_potentials(scene, motion, of_inputs)


def _of_driven_poses(scene: Scene, motion: Motion) -> Scalar:
    """Return the rate of the scene's own potential due to poses that move at `u = 0`. The forces of this
    potential act on the speeds only, so they do no work in this motion.
    """
    if potential_of(scene, motion.pose()) is None:
        return jnp.zeros_like(motion.t)
    t, q = motion.t, motion.q.array
    nu = coordinate_rates(scene, t, q, jnp.zeros_like(motion.u.array))
    along = (t, q), (jnp.ones_like(t), nu)
    held = motion.pose().bodies
    fixed = lambda t, q: potential_of(scene, Pose(t, scene.coordinate_names.view(q), held))
    whole = jax.jvp(lambda t, q: potential_of(scene, pose_at(scene, t, q)), *along)[1]
    return whole - jax.jvp(fixed, *along)[1]


def forces_for_potentials(scene: Scene, motion: Motion, of_inputs: Indices) -> Scalar:
    """Return the power in W of the loads `of_inputs` minus the explicit rate of their stored energy."""
    if not of_inputs:
        return jnp.zeros_like(motion.t)
    stored = explicit_rate(scene, motion, lambda scene, motion: stored_by_inputs(scene, motion, of_inputs))
    return power_of_loads(scene, motion, among=of_inputs) - stored


def power_of_loads(
    scene: Scene,
    motion: Motion,
    *,
    conservative: bool | None = None,
    among: Indices | None = None,
    loads: tuple[Load, ...] | None = None,
) -> Scalar:
    """Return `sum F.v + L.omega + Q_k u_k` in W, over the loads with a potential (`conservative=True`),
    without one (`False`), or with the indices `among`.

    `loads`: as in `explicit_power`.
    """
    total = resultants(scene, motion, conservative=conservative, among=among, loads=loads)
    v = of_bodies(motion, "velocity")
    omega = of_bodies(motion, "angular_velocity")
    return jnp.sum(total.force * v) + jnp.sum(total.torque * omega) + total.direct @ motion.u.array


def explicit_rate(scene: Scene, motion: Motion, potential: Callable) -> Scalar:
    """Return `dV/dt` of a `potential` at fixed poses, with coordinates that move as at `u = 0`."""
    q = motion.q.array
    nu = coordinate_rates(scene, motion.t, q, jnp.zeros_like(motion.u.array))

    def V(t, q):
        held = eqx.tree_at(lambda m: (m.t, m.q.array), motion, (t, q))
        return potential(scene, held)

    return jax.jvp(_only_what_is_needed(V, motion.t, q), (motion.t, q), (jnp.ones_like(motion.t), nu))[1]


def _only_what_is_needed(f: Callable, *like) -> Callable:
    """Return `f` without operations that its result does not need. These may lack a derivative, such as
    unused forces of the same loads.
    """
    pruned = jaxpr_as_fun(needed_only(jax.make_jaxpr(f)(*like)))
    return lambda *given: pruned(*given)[0]
