"""Jourdain's principle for rigid bodies: virtual power vanishes for every admissible virtual velocity.

    sum_j (m_j a_j - F_j) . beta_j^k + (I_j alpha_j + omega_j x I_j omega_j - L_j) . gamma_j^k
        =  M udot + h - Q                                                                         (50), (56)

    M = sum m beta' beta + gamma' I gamma
    h = sum m beta' a_0 + gamma' (I alpha_0 + omega x I omega)
    Q = sum beta' F + gamma' L + Q_direct - N' dV/dq

a_0, alpha_0 in h come from a second directional derivative, never from dM/dq. Angular quantities are in body
axes. Source: Wang and Pao (2003), eqs. (18), (50), (56).

Lagrange's equations in energy-derivative form hold for scenes whose speeds are the coordinate rates (S2 of
docs/paper_by_example.md):

    d/dt dT/dqdot - dT/dq = Q - dV/dq + A' lambda          (11)

They give M, h and Q independently of Jourdain's principle: `M = d2T/dqdot2`, and h is
`d/dt(dT/dqdot) - dT/dq` at qddot = 0. Source: Wang and Pao (2003), eq. (11).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import Entries, PerContact, PerCoordinate, PerRow, Scalar, Speeds, check_kind
from jourdain_jax.equations.contact_laws import SLOW, Modes, responses, solved
from jourdain_jax.equations.instant import Instant, instant_at, rows_of
from jourdain_jax.equations.kinematics import (
    Inertias,
    Velocities,
    coordinate_rates,
    inertias,
    inertias_of,
    motion_at,
    of_bodies,
    partial_velocities,
    pose_at,
    speeds_are_rates,
    velocities_of,
)
from jourdain_jax.equations.rows import (
    ConstraintRows,
    ContactRows,
    coefficients,
    contact_loads,
    contact_rows,
    in_whole_scene,
)
from jourdain_jax.program.eager import eager_if_concrete
from jourdain_jax.scene.arguments import InputLike, Number, Numbers, as_coordinates, as_speeds, as_time
from jourdain_jax.scene.coordinates import check_name
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.modes import FLIES, ROLLS, SLIPS
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import loads_of, potential_of


class UnconstrainedEquations(eqx.Module):
    """`M udot + h = Q`, the equations without constraint forces."""

    M: Float[Array, "speeds speeds"]  # mass matrix
    h: Speeds  # inertia forces at udot = 0
    Q: Speeds  # generalized impressed forces


class Resultants(eqx.Module):
    """Impressed forces on the mass centres and torques about them (inertial frame), and forces directly on
    the speeds.
    """

    force: Float[Array, "bodies 3"]  # N
    torque: Float[Array, "bodies 3"]  # N m
    direct: Speeds


def resultants(
    scene: Scene,
    motion: Motion,
    *,
    conservative: bool | None = None,
    among: tuple[int, ...] | None = None,
    loads: tuple[Load, ...] | None = None,
) -> Resultants:
    """Return the sum of the loads per body and per speed, restricted to loads with a potential
    (`conservative=True`), without one (`False`), or with the indices `among`.

    `loads`: the scene's loads at this motion, if already known.
    """
    force = {name: jnp.zeros_like(body.position) for name, body in motion.bodies.items()}
    torque = dict(force)
    direct = {name: jnp.zeros_like(motion.t) for name in scene.speed_names.entries}
    for number, load in enumerate(loads_at(scene, motion) if loads is None else loads):
        if conservative is not None and conservative != (load.potential is not None):
            continue
        if among is not None and number not in among:
            continue
        for total, part, kind in (
            (force, load.forces, "body"),
            (torque, load.torques, "body"),
            (direct, load.generalized, "speed"),
        ):
            for name, value in part.items():
                check_name(name, total, f"a load of `{type(scene).__name__}` acts on unknown {kind} `{name}`")
                total[name] = total[name] + value
    force, torque = (jnp.stack(list(of_bodies.values())) for of_bodies in (force, torque))
    return Resultants(force, torque, jnp.stack(list(direct.values())) if direct else jnp.zeros(0))


def potential_energy(scene: Scene, motion: Motion, loads: tuple[Load, ...] | None = None) -> Scalar:
    """Return V in J at a `motion`: the potentials of the loads and of the scene. `loads`: the scene's loads
    at this motion, if already known.
    """
    check_kind(motion, Motion, "`motion`", "a motion, such as `jj.motion_at(scene, t, q, u)`")
    V = jnp.zeros_like(motion.t)
    for load in loads_of(scene, motion) if loads is None else loads:
        if load.potential is not None:
            V = V + load.potential
    extra = potential_of(scene, motion.pose())
    return V if extra is None else V + extra


def kinetic_energy(scene: Scene, t: Number, q: Numbers, u: Numbers) -> Scalar:
    """Return `T = sum m v.v/2 + omega.I omega/2` in J."""
    return _kinetic_energy(motion_at(scene, t, as_coordinates(scene, q), as_speeds(scene, u)))


def energies_at(scene: Scene, motion: Motion, loads: tuple[Load, ...] | None = None) -> tuple[Scalar, Scalar]:
    """Return T and V in J at a `motion`. `loads`: the scene's loads at this motion, if already known."""
    return _kinetic_energy(motion), potential_energy(scene, motion, loads)


def _kinetic_energy(motion: Motion) -> Scalar:
    bodies, speeds = inertias_of(motion), velocities_of(motion)
    v, w = speeds.linear, speeds.angular
    return 0.5 * (jnp.sum(bodies.mass * jnp.sum(v * v, 1)) + jnp.einsum("bi,bij,bj->", w, bodies.inertia, w))


@eager_if_concrete
def unconstrained_equations(
    scene: Scene, t: Number, q: Numbers, u: Numbers, inputs: InputLike = None
) -> UnconstrainedEquations:
    """Return M, h and Q of `M udot + h = Q`, the equations without constraint forces; eqs. (50), (56).

    M: (speeds, speeds), kg or kg m^2; h, Q: (speeds,), N or N m. `inputs`: zero by default.
    """
    return equations_of(scene, instant_at(scene, t, q, u, inputs))


def equations_and_rows(scene: Scene, t, q, u, inputs=None) -> tuple[UnconstrainedEquations, ConstraintRows]:
    """Return M, h, Q and the constraint rows, from one evaluation of the poses."""
    instant = instant_at(scene, t, q, u, inputs)
    return equations_of(scene, instant), rows_of(scene, instant)


def equations_of(
    scene: Scene, instant: Instant, loads: tuple[Load, ...] | None = None
) -> UnconstrainedEquations:
    """Return M, h and Q of the equations without constraint forces, at a known instant; `loads`: as in
    `resultants`.
    """
    partial = instant.by_speeds.bodies
    force, torque = inertia_resultants(instant.weights, instant.value.bodies, instant.rate.bodies)
    h = on_speeds(partial, force, torque)
    M = mass_matrix(instant.weights.mass, instant.weights.inertia, partial.linear, partial.angular)
    return UnconstrainedEquations(M, h, _generalized_forces(scene, instant.motion, partial, loads))


def mass_matrix(
    mass: Float[Entries, "*states bodies"],
    inertia: Float[Entries, "*states bodies 3 3"],
    beta: Float[Entries, "*states bodies 3 speeds"],
    gamma: Float[Entries, "*states bodies 3 speeds"],
) -> Float[Entries, "*states speeds speeds"]:
    """Return `M = sum m beta' beta + gamma' I gamma` for arrays of JAX or NumPy, with any leading axes of
    states.
    """
    return _summed(beta, mass[..., None, None] * beta) + _summed(gamma, inertia @ gamma)


def _summed(x, y):
    """Return `sum x' y` over the bodies."""
    x, y = (z.reshape(*z.shape[:-3], -1, z.shape[-1]) for z in (x, y))
    return x.mT @ y


def mass_matrix_at(scene: Scene, t, q) -> Float[Array, "speeds speeds"]:
    """Return M at (t, q), which does not depend on u."""
    rest = jnp.zeros(len(scene.speed_names), q.dtype)
    weights, partial = inertias(scene, t, q), partial_velocities(scene, t, q, rest)
    return mass_matrix(weights.mass, weights.inertia, partial.linear, partial.angular)


def inertia_resultants(weights: Inertias, velocity: Velocities, acceleration: Velocities):
    """Return `m a` and `I alpha + omega x I omega` per body."""
    momentum = jnp.einsum("bij,bj->bi", weights.inertia, velocity.angular)
    torque = jnp.einsum("bij,bj->bi", weights.inertia, acceleration.angular) + jnp.cross(
        velocity.angular, momentum
    )
    return weights.mass[:, None] * acceleration.linear, torque


@eager_if_concrete
def generalized_forces(scene: Scene, t: Number, q: Numbers, u: Numbers, inputs: InputLike = None) -> Speeds:
    """Return `Q = sum beta' F + gamma' L + Q_direct - N' dV/dq`, shape (speeds,), in N or N m; eq. (41).

    `inputs`: values of the scene's inputs (default: zero).
    """
    q, u = as_coordinates(scene, q), as_speeds(scene, u)
    return _generalized_forces(scene, motion_at(scene, t, q, u, inputs), partial_velocities(scene, t, q, u))


def _generalized_forces(
    scene: Scene, motion: Motion, partial: Velocities, loads: tuple[Load, ...] | None = None
) -> Speeds:
    total = impressed(scene, motion, loads)
    return on_speeds(partial, total.force, total.torque) + total.direct


def on_speeds(
    partial: Velocities, force: Float[Array, "*more bodies 3"], torque: Float[Array, "*more bodies 3"]
) -> Float[Array, "*more speeds"]:
    """Return the generalized forces `sum beta' F + gamma' L` of forces and torques (body axes) on bodies."""
    return jnp.einsum("bik,...bi->...k", partial.linear, force) + jnp.einsum(
        "bik,...bi->...k", partial.angular, torque
    )


class ContactResponse(eqx.Module):
    """Response of switching contacts to their forces L at one state: `du/dt = free + impulses L`,
    `dw/dt = G L + b`.
    """

    rows: ContactRows
    impulses: Float[Array, "speeds rows"]  # M^-1 A', with the permanent constraints satisfied
    G: Float[Array, "rows rows"]
    b: PerRow
    size: PerRow  # sums of magnitudes of the terms of b


@eqx.filter_jit  # traced once
def contact_response(scene: Scene, motion: Motion) -> ContactResponse:
    """Return the response of switching contacts to their forces at the state of a motion.

        M (impulses, free) = (A', Q - h) + A_p' multipliers,   A_p impulses = 0,   A_p free = -drift_p

    A_p, drift_p: Jacobian and drift of the constraints that always hold.
    """
    instant = instant_at(scene, motion.t, motion.q.array, motion.u.array, motion.inputs.array)
    equations = equations_of(scene, instant, loads_of(scene, motion))
    held, rows = rows_of(scene, instant), contact_rows(scene, motion)
    count, kept = len(motion.u.array), len(held.phi)
    right = jnp.vstack([rows.A, equations.Q - equations.h, held.A]).T
    # in reverse order: the last speeds belong to the leaves of a tree of bodies, and eliminating them first
    # creates no fill-in
    moved = jnp.stack(solved(list(equations.M[::-1, ::-1]), list(right[::-1]), vanishes=False))[::-1]
    if kept:
        by_rows = moved[:, len(moved[0]) - kept :]
        drift = jnp.append(jnp.zeros((kept, len(rows.w))), held.drift[:, None], axis=1)
        moved = moved[:, : len(moved[0]) - kept]
        moved = moved - by_rows @ jnp.stack(solved(list(held.A @ by_rows), list(held.A @ moved + drift)))
    impulses, free = moved[:count, :-1], moved[:count, -1]
    # a constraint with a force limit has unit normal force, the solution of L_n - 1 = 0
    one = jnp.array([[x in scene.switching.rows, 0, 0] for x in scene.switching.contacts], free.dtype).ravel()
    G, b = rows.A @ impulses + jnp.diag(one), rows.A @ free + rows.drift - one
    return ContactResponse(rows, impulses, G, b, jnp.abs(rows.A) @ jnp.abs(free) + jnp.abs(rows.drift))


def numbers_and_slots(scene: Scene, motion: Motion) -> tuple[PerContact, Float[Array, "contacts 2"]]:
    """Return the number of the mode of each switching contact, and its two coordinates: its direction of
    slip, or when its bounces end (`equations/phases.py`).
    """
    count = len(scene.switching.contacts)
    return motion.inputs.array[-count:], motion.q.array[-2 * count :].reshape(-1, 2)


def contact_modes(scene: Scene, motion: Motion) -> Modes:
    """Return the modes of the switching contacts and their directions of slip, zero unless they slip."""
    number, slots = numbers_and_slots(scene, motion)
    one = jnp.ones_like(number)
    return Modes(
        jnp.where(number == FLIES, 0.0, one),
        jnp.where(number == ROLLS, one, 0.0),
        slots * (number == SLIPS)[:, None],
    )


def slip_turns(scene: Scene, motion: Motion, found: ContactResponse) -> Float[Array, "directions"]:
    """Return rates of the directions of slip e, 1/s; zero unless a contact slips.

    de/dt = n n.(dw_t/dt + k w_t/4v)/v,   v^4 = (e.w_t)^4 + s^4,   k = mu L_n n.G_tt n

    n: e turned by a right angle. Above s, v is |w_t|, and w_t stays along e. Below, friction takes e to the
    direction with n.dw_t/dt = 0 at the rate k/v, and the term with k, of critical damping, takes w_t to e.
    """
    e, L = contact_modes(scene, motion).direction, switching_forces(scene, motion, found)
    n = jnp.stack([-e[:, 1], e[:, 0]], axis=1)
    w, dw = (x.reshape(-1, 3)[:, 1:] for x in (found.rows.w, found.G @ L + found.b))
    own = [found.G[i : i + 2, i : i + 2] for i in range(1, len(L), 3)]
    k = coefficients(scene, motion)[0] * L[::3] * jnp.stack([n @ G @ n for n, G in zip(n, own, strict=True)])
    v = jnp.sqrt(jnp.sqrt(jnp.sum(e * w, axis=1) ** 4 + motion.inputs.slow_slip**4 + SLOW**4))[:, None]
    return (n * jnp.sum(n * (dw + k[:, None] * w / (4 * v)) / v, axis=1, keepdims=True)).ravel()


def coordinate_rates_in_modes(scene: Scene, motion: Motion) -> PerCoordinate:
    """Return rates of all coordinates, including directions of slip."""
    if not scene.switching.contacts:
        return motion.qdot.array
    turns = slip_turns(scene, motion, contact_response(scene, motion))
    return jnp.append(motion.qdot.array[: -len(turns)], turns)


def switching_forces(scene: Scene, motion: Motion, found: ContactResponse) -> PerRow:
    """Return the forces of contacts in their modes, N."""
    friction, _ = coefficients(scene, motion)
    return responses(found.G, found.b[:, None], contact_modes(scene, motion), friction)[:, 0]


def loads_at(scene: Scene, motion: Motion, found: ContactResponse | None = None) -> tuple[Load, ...]:
    """Return the loads of a scene and the forces of its switching contacts, which depend on the other loads.
    `found`: the contacts' response, if already known.
    """
    own = loads_of(scene, motion)
    scene, motion, shares = in_whole_scene(scene, motion)
    if not scene.switching.contacts:
        return own
    found = contact_response(scene, motion) if found is None else found
    forces = switching_forces(scene, motion, found) * shares
    return (*own, *contact_loads(scene, motion, found.rows.A, forces))


def impressed(scene: Scene, motion: Motion, loads: tuple[Load, ...] | None = None) -> Resultants:
    """Return all impressed forces, torques (body axes) and forces on the speeds, which include
    `-N' dV/dq` of the scene's own potential. `loads`: as in `resultants`.
    """
    total = resultants(scene, motion, loads=loads)
    orientation = of_bodies(motion, "orientation")
    torque = jnp.einsum("bji,bj->bi", orientation, total.torque)
    return Resultants(total.force, torque, total.direct - _potential_gradient(scene, motion))


def _potential_gradient(scene: Scene, motion: Motion) -> Speeds:
    """Return `N' dV/dq` of the scene's own potential."""
    t, q, u = motion.t, motion.q.array, motion.u.array
    if potential_of(scene, motion.pose()) is None:
        return jnp.zeros_like(u)
    dV = jax.grad(lambda q: potential_of(scene, pose_at(scene, t, q)))(q)
    N = jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(u)
    return dV @ N


def virtual_power(
    scene: Scene,
    t: Number,
    q: Numbers,
    u: Numbers,
    udot: Numbers,
    virtual_velocity: Numbers,
    inputs: InputLike = None,
) -> Scalar:
    """Return the residual of Jourdain's variational equation (18), in W:

        sum (m a - F) . delta_1 v = delta u . (M udot + h - Q)

    `udot`: the accelerations; `virtual_velocity`: any `delta u`, shape (speeds,). `inputs`: values of the
    scene's inputs (default: zero). The constrained accelerations, and no others, have a zero residual for
    every virtual velocity with `A delta u = 0`.
    """
    equations = unconstrained_equations(scene, t, q, u, inputs)
    udot = as_speeds(scene, udot, "udot")
    virtual_velocity = as_speeds(scene, virtual_velocity, "virtual_velocity")
    return virtual_velocity @ (equations.M @ udot + equations.h - equations.Q)


@eager_if_concrete
def lagrange_equations(
    scene: Scene, t: Number, q: Numbers, u: Numbers, inputs: InputLike = None
) -> UnconstrainedEquations:
    """Return M, h and Q of `M udot + h = Q` from derivatives of the kinetic energy:
    `d/dt dT/dqdot - dT/dq = Q`; eq. (11).

    `inputs`: zero by default. Raises ValueError if the speeds are not the coordinate rates.
    """
    if not speeds_are_rates(scene):
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
