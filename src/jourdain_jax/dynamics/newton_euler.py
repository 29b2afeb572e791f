"""The equations of Newton and Euler for each body. Their residuals are the constraint force R and torque T:

    R = m a - F,   T = I alpha + omega x I omega - L

A potential stated for the whole scene gives the forces `-dV/dr` and torques `-dV/dtheta` on its bodies.
Source: Wang and Pao (2003), eqs. (1)-(3).
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from jourdain_jax.calculus.rotations import skew
from jourdain_jax.equations.kinematics import (
    Velocities,
    bias_accelerations,
    coordinate_rates,
    inertias,
    motion_at,
    of_bodies,
    partial_velocities,
)
from jourdain_jax.equations.virtual_power import Resultants, inertia_resultants, resultants
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.arguments import as_coordinates, as_speeds
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.motion_state import BodyPose, Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import potential_of


@eager_if_concrete
def newton_residual(scene: Scene, t, q, u, udot, inputs=None) -> Velocities:
    """Return the constraint force `m a - F` (N) and torque `I alpha + omega x I omega - L` (N m, about the
    mass centre) on each body; (1)-(3).

    Shape (bodies, 3), inertial frame, bodies sorted by name. `udot`: the accelerations. `inputs`: values of
    the scene's inputs (default: zero). Impressed forces on speeds (`generalized_force`) count as constraint
    forces here.
    """
    q, u, udot = as_coordinates(scene, q), as_speeds(scene, u), as_speeds(scene, udot, "udot")
    partial, weights = partial_velocities(scene, t, q, u), inertias(scene, t, q)
    velocity, bias = bias_accelerations(scene, t, q, u)
    acceleration = Velocities(bias.linear + partial.linear @ udot, bias.angular + partial.angular @ udot)
    force, torque = inertia_resultants(weights, velocity, acceleration)
    motion = motion_at(scene, t, q, u, inputs)
    loads, potential = resultants(scene, motion), potential_resultants(scene, motion)
    orientation = of_bodies(motion, "orientation")
    return Velocities(
        force - loads.force - potential.force,
        jnp.einsum("bij,bj->bi", orientation, torque) - loads.torque - potential.torque,
    )


def potential_resultants(scene: Scene, motion: Motion) -> Resultants:
    """Return the forces of the scene's own potential: `-dV/dr` and `-dV/dtheta` on the bodies, and `-N'
    dV/dq` at fixed poses on the speeds.
    """
    t, q, u, pose = motion.t, motion.q.array, motion.u.array, motion.pose()
    zero = jnp.zeros((len(pose.bodies), 3), q.dtype)
    if potential_of(scene, pose) is None:
        return Resultants(zero, zero, jnp.zeros_like(u))

    def V(shift, turn, q):
        bodies = {
            name: _displaced(body, shift[j], turn[j]) for j, (name, body) in enumerate(pose.bodies.items())
        }
        return potential_of(scene, Pose(t, scene.coordinate_names.view(q), bodies))

    force, moment, direct = jax.grad(V, argnums=(0, 1, 2))(zero, zero, q)
    N = jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(u)
    return Resultants(-force, -moment, -direct @ N)


def _displaced(pose: BodyPose, shift, turn) -> BodyPose:
    """Return a pose displaced by `shift` and rotated by the small rotation vector `turn` (inertial frame), to
    first order.
    """
    moved = eqx.tree_at(lambda p: p.body.position, pose, pose.body.position + shift)
    if isinstance(pose.body, RigidBody):
        turned = pose.body.orientation + skew(turn) @ pose.body.orientation
        moved = eqx.tree_at(lambda p: p.body.orientation, moved, turned)
    return moved
