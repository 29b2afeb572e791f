"""Constraint forces by constraint and by body, and the forces in rolling contacts (S1 and S4 of
docs/paper_by_example.md).

    force    R_j^s = lambda_s d phi_s/d v_j          on body j
    torque   T_j^s = lambda_s d phi_s/d omega_j      about its mass centre
    direct   lambda_s d phi_s/d u at fixed v, omega  on the speeds themselves

The constraints are functions of the velocities in a `Motion`, so one reverse pass per row gives the forces on
all bodies. All vectors are in the inertial frame. Source: Wang and Pao (2003), eqs. (1)-(3), (68)-(73).

`power` and the functions after it give the power that changes the energy T + V of a scene:

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

The residuals of the equations of Newton and Euler for a body are the constraint force R and torque T on it:

    R = m a - F,   T = I alpha + omega x I omega - L

A potential stated for the whole scene gives the forces `-dV/dr` and torques `-dV/dtheta` on its bodies.
Source: Wang and Pao (2003), eqs. (1)-(3).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jourdain_jax.calculus.reals import Flag, Indices, Number, Numbers, Scalar, largest, rank_cutoff, static
from jourdain_jax.calculus.rotations import skew
from jourdain_jax.dynamics.accelerations import Accelerations, Wrenches, normal_forces
from jourdain_jax.equations.kinematics import (
    Velocities,
    bias_accelerations,
    coordinate_rates,
    inertias,
    motion_at,
    of_bodies,
    partial_velocities,
    velocities_of,
)
from jourdain_jax.equations.reductions import Reduced
from jourdain_jax.equations.rows import flatten_rows, has_load_without_potential, names_of_rows, velocity_rows
from jourdain_jax.equations.virtual_power import (
    Resultants,
    contact_response,
    inertia_resultants,
    potential_energy,
    resultants,
    switching_forces,
)
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.arguments import InputLike, as_coordinates, as_speeds
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.coordinates import Labels, Named, UnknownNameError, check_name
from jourdain_jax.scene.motion_state import BodyMotion, BodyPose, Motion, Pose
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import contacts_of, potential_of
from jourdain_jax.structure.load_power import explicit_rate, forces_for_potentials, power_of_loads
from jourdain_jax.structure.structure import Structure, structure_of


@eager_if_concrete
def newton_residual(
    scene: Scene, t: Number, q: Numbers, u: Numbers, udot: Numbers, inputs: InputLike = None
) -> Velocities:
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
    """Return the forces of the scene's own potential: `-dV/dr` and `-dV/dtheta` on the bodies, and
    `-N' dV/dq` at fixed poses on the speeds.
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


class RowReactions(eqx.Module):
    """Force of every constraint on every body, and its direct part on the speeds. For a motion the first axis
    is time.
    """

    multipliers: Float[Array, "*times rows"]
    force: Float[Array, "*times rows bodies 3"]  # N
    torque: Float[Array, "*times rows bodies 3"]  # N m, about the mass centre; zero for particles
    # on speeds, from constraints written in coordinates, rates or speeds
    direct: Float[Array, "*times rows speeds"]
    determined: Bool[Array, "*times rows"]  # False for a dependent row, whose multiplier is not unique
    row_names: Labels = static()
    body_names: Labels = static()

    def forces_on(self, body: str) -> dict[str, Float[Array, "*times 3"]]:
        """Return the forces on one body (N), by constraint row."""
        return self._by_row(self.force, body)

    def torques_on(self, body: str) -> dict[str, Float[Array, "*times 3"]]:
        """Return the torques on one body about its mass centre (N m), by constraint row."""
        return self._by_row(self.torque, body)

    def _by_row(self, values, body):
        check_name(body, self.body_names, f"no body `{body}` in this scene", UnknownNameError)
        return {row: values[..., s, self.body_names.index(body), :] for s, row in enumerate(self.row_names)}


class ContactForce(eqx.Module):
    """The force of the ground on the body at one rolling contact."""

    normal: Scalar  # N, along the plane's normal; negative if the contact pulls
    tangential: Float[Array, "2"]  # N, along the plane's tangents
    friction_needed: Scalar  # |tangential| / normal; infinite if the contact pulls, zero without load
    pulls: Flag  # whether the normal force is negative beyond round-off: the body would lift off
    determined: Flag  # whether the constraints determine both forces
    normal_determined: Flag  # whether they determine the normal force


@eager_if_concrete
def row_reactions(scene: Scene, t, q, u, accelerations: Accelerations, inputs=None) -> RowReactions:
    """Return constraint forces per row and per body at (t, q, u), from the multipliers of `accelerations`.

    Their generalized forces `sum_s beta' R^s + gamma' T^s + direct^s` sum to `A' lambda`.
    """
    motion = motion_at(scene, t, q, u, inputs)
    return _reactions(scene, motion, _per_multiplier(scene, motion), accelerations)


def _reactions(scene: Scene, motion: Motion, unit: tuple, found: Accelerations) -> RowReactions:
    (on_bodies, direct), multipliers = unit, found.multipliers
    force, torque = (multipliers[:, None, None] * part for part in (on_bodies.force, on_bodies.torque))
    # a multiplier is unique if its row is not a combination of the others
    determined = jnp.diagonal(found.spare) == 0
    return RowReactions(
        multipliers,
        force,
        torque,
        multipliers[:, None] * direct,
        determined,
        names_of_rows(scene),
        tuple(motion.bodies),
    )


def _per_multiplier(scene: Scene, motion: Motion) -> tuple[Wrenches, Array]:
    """Return forces on bodies and on speeds for a unit multiplier of each row (first axis)."""
    bodies, u = motion.bodies.values(), motion.u.array
    if not names_of_rows(scene):
        nothing = jnp.zeros((0, len(bodies), 3), u.dtype)
        return Wrenches(nothing, nothing), jnp.zeros((0, u.shape[0]), u.dtype)

    def rows(v, omega, u):
        return flatten_rows(velocity_rows(scene, _moving(scene, motion, v, omega, u)), u.dtype)

    v, omega = of_bodies(motion, "velocity"), of_bodies(motion, "angular_velocity")
    force, torque, direct = jax.jacrev(rows, argnums=(0, 1, 2))(v, omega, u)
    rigid = jnp.array([isinstance(body.body, RigidBody) for body in bodies])
    torque = jnp.where(rigid[:, None], torque, 0.0)  # a particle takes no torque
    return Wrenches(force, torque), direct


def _moving(scene: Scene, motion: Motion, v, omega, u) -> Motion:
    """Return the motion with the given velocities of bodies and speeds, which need not be consistent."""
    bodies = {
        name: BodyMotion(name, body.body, v[j], omega[j])
        for j, (name, body) in enumerate(motion.bodies.items())
    }
    qdot = coordinate_rates(scene, motion.t, motion.q.array, u)
    return Motion(
        motion.t, motion.q, Named(u, motion.u.slots), Named(qdot, motion.qdot.slots), motion.inputs, bodies
    )


@eager_if_concrete
def contact_forces(
    scene: Scene, t, q, u, accelerations: Accelerations, inputs=None
) -> dict[str, ContactForce]:
    """Return the normal and tangential force of every rolling contact, and the friction coefficient needed to
    roll without slip.

    The tangential force is the multiplier of the no-slip constraints. With `height="row"` the normal force is
    the multiplier of the height constraint. With `height="coordinates"` it follows from the balance of forces
    and moments of the bodies that the contact carries. The balance of forces is
    `sum N n = sum (m a - F - R)`, with sums over all contacts of these bodies, and over the bodies.

    If the balance does not determine the normal force (four wheels on a plane), the force has minimum norm,
    and `determined` is False. `determined` is also False if a moment remains that no contact can exert, such
    as the moment of a guide that keeps a robot level. Forces on speeds (`generalized_force`) are assumed to
    have no resultant force or moment on these bodies.
    """
    motion = motion_at(scene, t, q, u, inputs)
    contacts = contacts_of(scene, motion.pose())
    if not contacts:
        return {}
    unit = _per_multiplier(scene, motion)
    rows = _reactions(scene, motion, unit, accelerations)
    total = newton_residual(scene, t, q, u, accelerations.udot, inputs)
    size = _size_of_forces(scene, motion, total.linear)
    margin = rank_cutoff(size.dtype) * size
    # forces and torques that the choice of coordinates imposes
    held = Wrenches(total.linear - jnp.sum(rows.force, axis=0), total.angular - jnp.sum(rows.torque, axis=0))
    spare = jax.tree.map(lambda part: jnp.einsum("sr,sbi->rbi", accelerations.spare, part), unit[0])
    positions = of_bodies(motion, "position")
    built_in = normal_forces(contacts, rows.body_names, positions, held, spare, size)
    forces = {}
    if scene.switching.contacts:
        found = switching_forces(scene, motion, contact_response(scene, motion))
        sure = jnp.array(True)
        for name, L in zip(scene.switching.contacts, found.reshape(-1, 3), strict=True):
            if name in contacts:
                forces[name] = _contact_force(L[0], L[1:], sure, sure, margin)
    for name, contact in contacts.items():
        if name in forces:
            continue
        slip = jnp.array([rows.row_names.index(f"{name} slip[{i}]") for i in range(2)])
        tangential, determined = rows.multipliers[slip], jnp.all(rows.determined[slip])
        if contact.height == "row":
            height = rows.row_names.index(f"{name} height")
            normal, known = rows.multipliers[height], rows.determined[height]
        else:
            normal, known = built_in[name]
        forces[name] = _contact_force(normal, tangential, determined & known, known, margin)
    return forces


def _size_of_forces(scene: Scene, motion: Motion, total) -> Scalar:
    """Return a reference size of forces (N): of `m a - F`, of F and of `m |v| |omega|` on the bodies."""
    size = largest(total) + largest(resultants(scene, motion).force)
    for body in motion.bodies.values():
        size = size + body.mass * largest(body.velocity) * largest(body.angular_velocity)
    return jax.lax.stop_gradient(size)


def _contact_force(normal, tangential, determined, normal_determined, margin) -> ContactForce:
    squared = tangential @ tangential
    sliding = squared > 0
    size = jnp.where(sliding, jnp.sqrt(jnp.where(sliding, squared, 1.0)), 0.0)
    pushes, idle = normal > margin, (jnp.abs(normal) <= margin) & (size <= margin)
    friction = jnp.where(pushes, size / jnp.where(pushes, normal, 1.0), jnp.where(idle, 0.0, jnp.inf))
    return ContactForce(normal, tangential, friction, normal < -margin, determined, normal_determined)


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
    """Return the integrand of the work W in this module's docstring, in watts.

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
