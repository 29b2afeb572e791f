"""Kinematics of all bodies by automatic differentiation of their poses.

    qdot = N u + nu          v = d r/dt,  omega = vee(Rdot R')          along (1, qdot)
    v = beta u + v_t,        omega_body = gamma u + omega_t             partial velocities (26)-(31), (49)
    a = beta udot + a_0,     alpha_body = gamma udot + alpha_0          a_0, alpha_0: at udot = 0

r, R: position and orientation of a body; v, a, omega, alpha: its velocities and accelerations. Source: Wang
and Pao (2003), sections III and V.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Number, Numbers, PerCoordinate, Scalar, Vector3, as_real, real_type
from jourdain_jax.calculus.rotations import vee
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.arguments import (
    ChangingInputs,
    InputLike,
    as_coordinates,
    as_input_vector,
    as_scene,
    as_speeds,
    as_time,
)
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.motion_state import BodyMotion, BodyPose, Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import bodies_of, coordinate_rates_of


class Velocities(eqx.Module):
    """Velocities of the mass centres (inertial frame) and angular velocities (body axes; zero rows for
    particles).
    """

    linear: Float[Array, "bodies 3"]  # m/s
    angular: Float[Array, "bodies 3"]  # rad/s


class Inertias(eqx.Module):
    """Masses and central inertias (body axes; zero for particles) of all bodies."""

    mass: Float[Array, "bodies"]  # kg
    inertia: Float[Array, "bodies 3 3"]  # kg m^2


def coordinate_rates(scene: Scene, t: Number, q: Numbers, u: Numbers) -> PerCoordinate:
    """Return `qdot = N(q,t) u + nu(q,t)`, shape (coordinates,), per s; eq. (53)."""
    t, q, u = as_time(t), as_coordinates(scene, q), as_speeds(scene, u)
    return coordinate_rates_of(scene, t, scene.coordinate_names.view(q), scene.speed_names.view(u))


def rates_by_own_speeds(scene: Scene, t, q: Numbers) -> Float[Array, "speeds coordinates"]:
    """Return `N'` of `qdot = N u + nu`, one row for each user-defined speed; without such speeds it
    has no rows.
    """
    if scene.speeds is None:
        return jnp.zeros((0, len(scene.coordinate_names)))
    return jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(jnp.zeros(len(scene.speed_names))).T


def pose_at(scene: Scene, t: Number, q: Numbers) -> Pose:
    """Return poses of all bodies (m, inertial frame), sorted by name as in JAX's dictionaries."""
    t, q = as_time(t), as_coordinates(scene, q)
    named = scene.coordinate_names.view(q)
    bodies = sorted(bodies_of(scene, t, named).items())
    return Pose(t, named, {name: BodyPose(name, body) for name, body in bodies})


def motion_at(scene: Scene, t: Number, q: Numbers, u: Numbers, inputs: InputLike = None) -> Motion:
    """Return poses and velocities (inertial frame) of all bodies at one instant.

    `inputs`: values of the scene's inputs (default: zero), or `ChangingInputs`.
    """
    t, q, u = as_time(t), as_coordinates(scene, q), as_speeds(scene, u)
    inputs = as_input_vector(scene, inputs(t) if isinstance(inputs, ChangingInputs) else inputs, q.dtype)
    qdot = coordinate_rates(scene, t, q, u)
    poses, rates = jax.jvp(lambda t, q: pose_at(scene, t, q).bodies, (t, q), (jnp.ones_like(t), qdot))
    bodies = {
        name: BodyMotion(
            name, pose.body, rates[name].body.position, _space_angular_velocity(pose.body, rates[name].body)
        )
        for name, pose in poses.items()
    }
    return Motion(
        t,
        scene.coordinate_names.view(q),
        scene.speed_names.view(u),
        scene.coordinate_names.view(qdot),
        scene.inputs.view(inputs),
        bodies,
    )


def shapes_along_motion(look: Callable[[Scene, Motion], Any], scene: Scene):
    """Return the shapes of the values of `look(scene, motion)` by tracing: an evaluation would compile each
    operation of JAX.
    """
    numbers = [
        jax.ShapeDtypeStruct(shape, real_type())
        for shape in ((), (len(scene.coordinate_names),), (len(scene.speed_names),))
    ]
    return jax.eval_shape(lambda scene, t, q, u: look(scene, motion_at(scene, t, q, u)), scene, *numbers)


def _space_angular_velocity(body, rate) -> Vector3:
    if isinstance(body, RigidBody):
        return vee(rate.orientation @ body.orientation.T)  # omega = vee(Rdot R')
    return jnp.zeros_like(body.position)


def velocities(scene: Scene, t, q, u) -> Velocities:
    """Return velocities of the mass centres and body angular velocities, affine in u."""
    return _velocities(scene, as_time(t), as_real(q), as_real(u))


@eqx.filter_jit  # traced once for all derivatives
def _velocities(scene: Scene, t: Scalar, q, u) -> Velocities:
    return velocities_of(motion_at(scene, t, q, u))


def of_bodies(motion: Motion, what: str) -> Float[Array, "bodies *shape"]:
    """Return one quantity of all bodies, such as their `velocity`."""
    return jnp.stack([getattr(body, what) for body in motion.bodies.values()])


def velocities_of(motion: Motion) -> Velocities:
    """Return velocities of the mass centres and body angular velocities, from a known motion."""
    return Velocities(of_bodies(motion, "velocity"), of_bodies(motion, "angular_velocity_body"))


@eager_if_concrete
def partial_velocities(scene: Scene, t: Number, q: Numbers, u: Numbers) -> Velocities:
    """Return `beta = dv/du` (inertial frame) and `gamma = d omega/du` (body axes), shape (bodies, 3, speeds),
    bodies sorted by name; eqs. (26)-(31), (49).
    """
    return jax.jacfwd(lambda u: velocities(scene, t, q, u))(as_speeds(scene, u))


def bias_accelerations(scene: Scene, t, q, u) -> tuple[Velocities, Velocities]:
    """Return velocities, and accelerations at `udot = 0`: the derivative of the velocities along
    `(1, qdot, 0)`.
    """
    t, q, u = as_time(t), as_coordinates(scene, q), as_speeds(scene, u)
    qdot = coordinate_rates(scene, t, q, u)
    return jax.jvp(lambda t, q: velocities(scene, t, q, u), (t, q), (jnp.ones_like(t), qdot))


def inertias(scene: Scene, t, q) -> Inertias:
    """Return masses and inertias of all bodies."""
    return inertias_of(pose_at(scene, t, q))


def inertias_of(pose: Pose | Motion) -> Inertias:
    """Return masses and inertias of all bodies, from known poses. Inertias are symmetrised, since `w . I w`
    depends only on the symmetric part.
    """
    bodies = [body.body for body in pose.bodies.values()]
    zero = jnp.zeros((3, 3), pose.q.array.dtype)
    inertia = jnp.stack([b.inertia if isinstance(b, RigidBody) else zero for b in bodies])
    return Inertias(jnp.stack([b.mass for b in bodies]), (inertia + inertia.mT) / 2)


def speeds_are_rates(scene: Scene) -> bool:
    """Return whether the speeds are the coordinates' own rates (no quaternions, no quasi-velocities)."""
    scene = as_scene(scene)
    return (
        not scene.coordinates.quaternions
        and scene.speeds is None
        and type(scene).coordinate_rates is Scene.coordinate_rates
    )
