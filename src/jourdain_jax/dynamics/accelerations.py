"""Accelerations of a scene at one state.

kinematics -> virtual power (M, h, Q) -> constraints (A, drift) -> reduction -> udot, lambda

Normal forces of contacts that are built into the coordinates follow from Newton's equations of the supported
bodies:

    sum_i N_i n_i              = sum_j f_j                            f_j = m_j a_j - F_j - R_j
    sum_i N_i (p_i - o) x n_i  = sum_j (r_j - o) x f_j + T_j

j: the carried bodies, i: the contacts that touch them, o: any point. F_j: impressed forces, R_j: constraint
forces, T_j: moments of inertia, loads and constraints.

Coordinates may impose motions that contacts alone cannot enforce, like a guide that keeps a disc upright.
Therefore the N_i satisfy first the balance of forces, by least squares, then, with the remaining freedom, the
balance of moments. If the N_i are still not unique, they have minimum norm. On a plane the normal forces thus
always sum to the total load of the bodies.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.matrices import numerical_rank, pseudo_inverse, singular_values
from jourdain_jax.calculus.reals import (
    ContactFlags,
    Count,
    Flag,
    Indices,
    Number,
    Numbers,
    PerRow,
    Scalar,
    Speeds,
    check_kind,
    checked_real,
    eps_of,
    largest,
    rank_cutoff,
    tiny_of,
)
from jourdain_jax.equations.gibbs_appell import GibbsAppell
from jourdain_jax.equations.reductions import (
    Multipliers,
    NullSpaceQR,
    NullSpaceSVD,
    Privileged,
    Reduced,
    Reduction,
    ScaledProblem,
    UdwadiaKalaba,
    reduce,
    scaled,
    smallest_that_counts,
)
from jourdain_jax.equations.rows import ConstraintRows, UsualRows, position_residual
from jourdain_jax.equations.virtual_power import UnconstrainedEquations, equations_and_rows
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
from jourdain_jax.scene.contact.contacts import Contact
from jourdain_jax.scene.coordinates import Labels, check_name, check_names
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import check_bodies, structure_of, usual_rows


class Baumgarte(eqx.Module):
    """Stabilisation terms of constraints, with `alpha` a and `beta` b in 1/s:

        geometric constraints   A udot = -drift - 2 a phi - b^2 g
        velocity constraints    A udot = -drift - a phi

    Source: J. Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1. Projection (the default of `simulate`)
    is more accurate.
    """

    alpha: Scalar = eqx.field(converter=lambda x: checked_real(x, "`alpha` of `Baumgarte`", ()), default=5.0)
    beta: Scalar = eqx.field(converter=lambda x: checked_real(x, "`beta` of `Baumgarte`", ()), default=5.0)


class Accelerations(eqx.Module):
    """Accelerations of one state with diagnostics: `M udot + h = Q + A' lambda`, `A udot = -drift`.

    `udot` has the units of the speeds per s; a `constraint_force` acts on a speed, in N or N m.
    """

    udot: Speeds
    # lambda of minimum norm: the constraint force on the speeds is A' lambda
    multipliers: PerRow
    # columns of multipliers with A' lambda = 0, which do not affect the motion; the row of a unique
    # multiplier is zero
    spare: Float[Array, "rows rows"]
    constraint_force: Speeds  # A' lambda = M udot + h - Q
    rank: Count  # of A at this state
    # the last singular value of scaled A within its usual rank (1 without constraints), or the reduction's
    # pivot if that is smaller
    smallest_singular_value: Scalar
    residual: Scalar  # |A udot + drift| in scaled rows; large if constraints contradict each other
    applicable: Flag  # whether this reduction works at this state


_SHORT_NAMES = "privileged", "qr", "svd", "kkt", "udwadia-kalaba", "gibbs-appell"


def reductions(scene: Scene) -> dict[str, "Reduction | GibbsAppell"]:
    """Return all reductions by short name: "privileged", "qr", "svd", "kkt", "udwadia-kalaba",
    "gibbs-appell".

    "privileged" and "gibbs-appell" use the scene's independent speeds.
    """
    independent = structure_of(as_scene(scene)).independent
    by_name = Privileged(independent), NullSpaceQR(), NullSpaceSVD(), Multipliers(), UdwadiaKalaba()
    return dict(zip(_SHORT_NAMES, (*by_name, GibbsAppell(independent)), strict=True))


def as_reduction(scene: Scene, reduction) -> "Reduction | GibbsAppell":
    """Return a reduction from its short name, or the object itself; `NullSpaceQR()` for None."""
    if reduction is None:
        return NullSpaceQR()
    if isinstance(reduction, str):
        known = reductions(scene)
        check_name(reduction, known, f"unknown reduction `{reduction}`")
        return known[reduction]
    check_kind(
        reduction,
        Reduction | GibbsAppell,
        "`reduction`",
        f"a name ({', '.join(_SHORT_NAMES)}) or an object such as `jj.equations.NullSpaceQR()`",
    )
    chosen = reduction.independent if isinstance(reduction, Privileged | GibbsAppell) else ()
    count = len(scene.speed_names)
    valid = all(isinstance(i, int | np.integer) and 0 <= i < count for i in chosen)
    if not valid or len(set(chosen)) != len(chosen):
        where = f"speeds of `{type(scene).__name__}`, 0 to {count - 1}"
        raise ValueError(
            f"`independent` is {chosen}, expected indices of {where}, each at most once; or give the "
            "reduction by its name"
        )
    return reduction


def as_stabilisation(stabilisation) -> Baumgarte | None:
    """Return the Baumgarte terms, or None. Raises ValueError for any other value."""
    check_kind(stabilisation, Baumgarte | None, "`stabilisation`", "`jj.Baumgarte(alpha, beta)` or None")
    return stabilisation


def accelerations(
    scene: Scene,
    t: Number,
    q: Numbers,
    u: Numbers,
    inputs: InputLike = None,
    *,
    reduction: Any = None,
    stabilisation: Baumgarte | None = None,
    usual: UsualRows | None = None,
) -> Accelerations:
    """Return accelerations, multipliers and diagnostics of a scene at (t, q, u).

        M udot + h = Q + A' lambda,   A udot = -drift

    - `inputs`: values of the scene's inputs (default: zero), assumed constant.
    - `reduction`: a strategy object or one of the names "privileged", "qr" (default), "svd", "kkt",
      "udwadia-kalaba", "gibbs-appell".
    - `stabilisation`: Baumgarte terms (default: none).
    - `usual`: typical lengths of the constraint rows; a row that is mere round-off relative to its typical
      length counts as zero (default: the scene's typical lengths).

    The function works under any nesting of jit, vmap, jvp and vjp, with exact derivatives at constant rank.
    Check `applicable` and `residual`, since a reduction that does not apply raises no error. Raises
    ValueError for an unknown reduction, and for known parameters that give impossible bodies, loads or
    planes. Eqs. (41), (68)-(70).
    """
    f = inputs if inputs is None or isinstance(inputs, ChangingInputs) else as_input_vector(scene, inputs)
    arguments = as_time(t), as_coordinates(scene, q), as_speeds(scene, u), f
    if usual is None:
        check_bodies(scene)
        usual = usual_rows(scene)
    return _accelerations(
        scene, *arguments, as_reduction(scene, reduction), as_stabilisation(stabilisation), usual
    )


@eager_if_concrete
def _accelerations(scene: Scene, t, q, u, inputs, reduction, stabilisation, usual) -> Accelerations:
    return diagnosed(*reduced_at(scene, t, q, u, inputs, reduction, stabilisation, usual))


def diagnosed(found: Reduced, equations: UnconstrainedEquations, rows: ConstraintRows) -> Accelerations:
    """Return accelerations with multipliers of minimum norm, rank, conditioning and residual."""
    problem = scaled(equations, rows)
    sigma = singular_values(problem.A)
    return Accelerations(
        udot=found.udot,
        multipliers=pseudo_inverse(rows.A).T @ found.constraint_force,
        spare=_spare_multipliers(problem),
        constraint_force=found.constraint_force,
        rank=numerical_rank(sigma),
        smallest_singular_value=jax.lax.stop_gradient(
            jnp.minimum(found.pivot, smallest_that_counts(sigma, rows.usual))
        ),
        residual=largest(problem.d * (rows.A @ found.udot + rows.drift)),
        applicable=found.applicable & jnp.all(jnp.isfinite(found.udot)),
    )


def _spare_multipliers(problem: ScaledProblem) -> Float[Array, "rows rows"]:
    A = jax.lax.stop_gradient(problem.A)
    spare = jnp.eye(A.shape[0], dtype=A.dtype) - A @ pseudo_inverse(A)
    return problem.d[:, None] * jnp.where(jnp.abs(spare) > jnp.sqrt(eps_of(A)), spare, 0.0)


def bare_accelerations(scene: Scene, t, q, u, inputs, reduction=None) -> Reduced:
    """Return only accelerations and constraint force, for use inside the integration. Arguments as in
    `accelerations`.
    """
    return reduced_at(scene, t, q, u, inputs, reduction, None, usual_rows(scene))[0]


def reduced_at(
    scene: Scene, t, q, u, inputs, reduction, stabilisation, usual
) -> tuple[Reduced, UnconstrainedEquations, ConstraintRows]:
    """Return accelerations with the equations and constraint rows that they solve. Arguments as in
    `accelerations`, with `usual` required.
    """
    q, u = as_coordinates(scene, q), as_speeds(scene, u)
    reduction = as_reduction(scene, reduction)
    equations, rows = equations_and_rows(scene, t, q, u, inputs)
    rows = rows.judged_by(usual)
    if as_stabilisation(stabilisation) is not None:
        rows = _stabilised(scene, t, q, rows, stabilisation)
    return by_reduction(reduction, scene, t, q, u, equations, rows), equations, rows


def by_reduction(way: Reduction | GibbsAppell, scene: Scene, t, q, u, equations, rows) -> Reduced:
    """Apply one reduction to known equations and constraints."""
    if isinstance(way, GibbsAppell):
        return way.accelerations(scene, t, q, u, equations, rows)
    return reduce(way, equations, rows)


def _stabilised(scene: Scene, t, q, rows: ConstraintRows, terms: Baumgarte) -> ConstraintRows:
    g = position_residual(scene, t, q)
    count = g.shape[0]
    geometric = 2 * terms.alpha * rows.phi[:count] + terms.beta**2 * g
    extra = jnp.concatenate([geometric, terms.alpha * rows.phi[count:]])
    return ConstraintRows(rows.phi, rows.A, rows.drift + extra, rows.names, rows.usual)


class Wrenches(eqx.Module):
    """A force on every body and a torque about its mass centre, inertial frame."""

    force: Float[Array, "*rows bodies 3"]  # N
    torque: Float[Array, "*rows bodies 3"]  # N m


def normal_forces(
    contacts: dict[str, Contact],
    bodies: Labels,
    positions: Float[Array, "bodies 3"],
    hidden: Wrenches,
    spare: Wrenches,
    size,
):
    """Return the normal force (N) of every contact with `height="coordinates"`, by name, and whether it
    is determined.

    - `bodies`, `positions`: names and mass centres (m) of all bodies.
    - `hidden`: forces on the bodies that are neither loads nor constraint forces.
    - `spare`: forces of multipliers that do not affect the motion, with a leading axis of multipliers; zero
      for independent constraints.
    - `size`: the magnitude of the forces, N.
    """
    carried = {
        name: _carried(contact, name, bodies)
        for name, contact in contacts.items()
        if contact.height == "coordinates"
    }
    found: dict[str, tuple] = {}
    for names in _supports(carried):
        found |= _of_support(names, contacts, carried, bodies, positions, hidden, spare, size)
    return found


def _supports(carried: dict[str, Indices]) -> list[list[str]]:
    """Return groups of contacts that share carried bodies, directly or through other contacts."""
    groups: list[list[str]] = []
    for name, own in carried.items():
        together = [group for group in groups if any(set(own) & set(carried[other]) for other in group)]
        groups = [group for group in groups if group not in together]
        groups.append([*(other for group in together for other in group), name])
    return groups


def _of_support(
    names: list[str], contacts, carried, bodies, positions, hidden: Wrenches, spare: Wrenches, size
) -> dict[str, tuple]:
    # sets of bodies whose equations these contacts share
    sets = tuple(dict.fromkeys(carried[name] for name in names))
    points = jnp.stack([contacts[name].point for name in names])
    normals = jnp.stack([contacts[name].plane.normal for name in names])
    here = jnp.mean(points, axis=0)
    wrenches = [_resultant(wrench, positions, sets, here) for wrench in (hidden, spare)]
    forces, moments = wrenches[0]
    tolerance = jnp.sqrt(eps_of(forces))
    if len(names) == 1:
        normal = normals[0] @ forces
        return {names[0]: (normal, _unmoved(wrenches[1][0] @ normals.T, spare, tolerance)[0])}

    touches = [
        [bodies.index(contacts[name].body) in own or carried[name] == own for name in names] for own in sets
    ]
    by_set = jnp.asarray(touches, normals.dtype)[:, None, :]
    levers = points - here
    length = jnp.maximum(jnp.sqrt(jnp.max(jnp.sum(levers * levers, axis=1))), tiny_of(levers))
    by_force = (by_set * normals.T).reshape(-1, len(points))  # f = by_force N
    by_moment = by_set * jnp.cross(levers, normals).T
    by_moment = by_moment.reshape(-1, len(points)) / length  # moment/length = by_moment N

    first = pseudo_inverse(by_force)
    left = jnp.eye(len(points)) - first @ by_force  # freedom left by the forces
    turning = by_moment @ left
    turning = jnp.where(largest(turning) > rank_cutoff(turning.dtype), turning, 0.0)
    second = pseudo_inverse(turning)
    open_still = left - second @ turning

    def solved(f, m):
        N = first @ f
        return N + second @ (m / length - by_moment @ N)

    N = solved(forces, moments)
    missed = largest(by_force @ N - forces), largest(by_moment @ N - moments / length)
    size_of_moments = size + largest(hidden.torque) / length
    met = (missed[0] <= tolerance * size) & (missed[1] <= tolerance * size_of_moments)
    by_forces_alone = jnp.abs(jnp.diagonal(left)) <= tolerance
    by_both = jnp.abs(jnp.diagonal(open_still)) <= tolerance
    unmoved = _unmoved(jax.vmap(solved)(*wrenches[1]), spare, tolerance)
    determined = jax.lax.stop_gradient((by_forces_alone | (by_both & met)) & unmoved)
    return {name: (N[i], determined[i]) for i, name in enumerate(names)}


def _resultant(wrench: Wrenches, positions, sets: tuple[Indices, ...], here):
    """Return force and moment about a point `here` for each set of bodies."""
    moment = wrench.torque + jnp.cross(positions - here, wrench.force)
    summed = [
        [jnp.sum(part[..., jnp.array(own), :], axis=-2) for own in sets] for part in (wrench.force, moment)
    ]
    return tuple(jnp.concatenate(parts, axis=-1) for parts in summed)


def _unmoved(changes: Float[Array, "rows contacts"], spare: Wrenches, tolerance) -> ContactFlags:
    """Return which normal forces are independent of multipliers that the motion does not determine."""
    size = jnp.maximum(largest(spare.force), largest(spare.torque))
    return largest(changes, 0) <= tolerance * size


def _carried(contact: Contact, name: str, bodies: Labels) -> Indices:
    """Return indices of the bodies that a contact supports."""
    check_names(contact.carried or (), bodies, f"contact `{name}` carries unknown body `{{}}`")
    if contact.carried is None:
        return tuple(range(len(bodies)))
    return tuple(sorted({bodies.index(body) for body in contact.carried}))
