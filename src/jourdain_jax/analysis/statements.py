"""Check each body, load, potential and constraint that a scene defines. A failed check names the wrong one.

inertia        m >= 0,  I = I' >= 0,  I_3 <= I_1 + I_2,  R'R = 1      per body
               e.e = 1                                                per gravity
potentials     Z' (Q_i + N' dV_i/dq) = 0                              per load i with a potential V_i
derivatives    d/ds of each quantity along one direction in (parameters, t, q, u): autodiff agrees with
               central differences, and there is no kink

Derivatives of accelerations and constraint forces are checked, too: whether they exist, whether forward and
reverse mode agree, and whether they agree with central differences.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.verification import Check, check
from jourdain_jax.calculus.matrices import pseudo_inverse
from jourdain_jax.calculus.reals import (
    Number,
    Numbers,
    Scalar,
    as_real,
    described,
    largest,
    rank_cutoff,
    tiny_of,
)
from jourdain_jax.dynamics.accelerations import by_reduction, reductions
from jourdain_jax.equations.instant import constraint_rows
from jourdain_jax.equations.kinematics import (
    coordinate_rates,
    motion_at,
    of_bodies,
    partial_velocities,
    pose_at,
)
from jourdain_jax.equations.reductions import row_scale
from jourdain_jax.equations.rows import position_rows, velocity_rows
from jourdain_jax.equations.virtual_power import equations_and_rows, on_speeds, resultants
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.arguments import InputLike
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.loads import Load
from jourdain_jax.scene.motion_state import Motion
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.user_methods import loads_of, potential_of
from jourdain_jax.structure.scene_numbers import stated_of
from jourdain_jax.structure.structure import plain_row_lengths, usual_rows


def along(f: Callable, arguments, point, direction, u) -> tuple:
    """Return the value and the directional derivative of `f(arguments, point)`, its values at increments -2h,
    -h, h and 2h along the direction, and h. The increment h depends on the speeds `u`.
    """
    h = (2e-2 if u.dtype == jnp.float32 else 1e-3) / (1 + float(largest(u)))
    ends = [
        _value(f, arguments, jax.tree.map(lambda x, d, k=k: x + k * h * d, point, direction))
        for k in (-2, -1, 1, 2)
    ]
    return *_pushed(f, arguments, point, direction), ends, h


@eval_numpy
def _value(f: Callable, arguments, point):
    return f(arguments, point)


@eval_numpy
def _pushed(f: Callable, arguments, point, direction):
    return jax.jvp(lambda point: f(arguments, point), (point,), (direction,))


def central_difference(along: list, h: float):
    """Return the fourth-order central difference for values at -2h, -h, h, 2h."""
    return (along[0] - 8 * along[1] + 8 * along[2] - along[3]) / (12 * h)


def derivative_exists(
    scene: Scene, t: Number, q: Numbers, u: Numbers, direction: Scene, dq: Numbers, inputs: InputLike = None
) -> bool:
    """Return whether accelerations have a derivative along a change of the parameters and coordinates.

    They have none if the change makes dependent constraints independent, that is, if
    `(1 - A A+) dA (1 - A+ A)` is not zero.

    **Arguments**

    - `direction`: an object of the scene's class whose fields hold the change of each parameter (zero for
      constant ones); `dq`: the change of the coordinates.
    - `inputs`: values of the scene's inputs (default: zero).

    Numbers must be concrete: not under jit or vmap.
    """
    if jax.tree.structure(direction) != jax.tree.structure(scene):
        raise ValueError(
            f"`direction` is {described(direction)}, expected a `{type(scene).__name__}` whose "
            "fields hold the change of each parameter"
        )
    A, dA, size = _row_change(
        scene, t, as_real(q), as_real(u), direction, as_real(dq), inputs, plain_row_lengths(scene)
    )
    if A.size == 0:
        return True
    P = np.asarray(pseudo_inverse(jnp.asarray(A)))
    split = (np.eye(len(A)) - A @ P) @ dA @ (np.eye(A.shape[1]) - P @ A)
    return bool(largest(split) <= 1e3 * rank_cutoff(A.dtype) * (size + largest(dA)))


@eval_numpy
def _row_change(scene, t, q, u, direction, dq, inputs, typical):
    moving, fixed = eqx.partition(scene, eqx.is_inexact_array)

    def A(parameters, q):
        rows = constraint_rows(eqx.combine(parameters, fixed), t, q, u, inputs)
        return jax.lax.stop_gradient(row_scale(rows.A, typical))[:, None] * rows.A

    value, change = jax.jvp(A, (moving, q), (eqx.filter(direction, eqx.is_inexact_array), dq))
    return value, change, jnp.max(jnp.abs(value), initial=1.0)


def gradient_checks(
    scene: Scene, t, q, u, inputs, Z: Float[Array, "speeds columns"], names: Labels, seed: int
) -> list[Check]:
    """Check derivatives along one random direction, for each reduction in `names`. In the coordinates the
    direction is admissible (in the span of `Z`), in the speeds arbitrary, and in the parameters proportional
    to their values.

    Returns an empty list if no reduction applies.
    """
    # a Hessian of a Hessian would cost more than all other reductions together
    names = tuple(name for name in names if name != "gibbs-appell")
    if not names:
        return []
    generator = np.random.default_rng(seed)
    moving, fixed = eqx.partition(scene, eqx.is_inexact_array)
    relative = jax.tree.map(
        lambda x: jnp.asarray(generator.normal(size=x.shape) * np.where(x == 0, 1.0, x), x.dtype), moving
    )
    weights = jnp.asarray(generator.normal(size=2 * u.shape[0]), u.dtype)
    du = jnp.asarray(generator.normal(size=u.shape), u.dtype)
    dq = coordinate_rates(scene, t, q, Z @ du) - coordinate_rates(scene, t, q, jnp.zeros_like(u))
    left_out = (
        "parameters omitted: changing them makes redundant constraints independent, so accelerations have no"
        " derivative there"
    )
    cases = (relative, ""), (jax.tree.map(jnp.zeros_like, relative), left_out)
    exists = lambda change: derivative_exists(scene, t, q, u, eqx.combine(change, fixed), dq, inputs)
    case = next((case for case in cases if exists(case[0])), None)
    if case is None:
        note = "omitted: the constraints lose rank at this state, so accelerations have no derivative there"
        return [check(name, {}, u.dtype, note) for name in ("jvp against vjp", "differences")]
    change, note = case
    arguments = (names, weights, t, inputs, fixed, usual_rows(scene))
    point = (moving, q, u)
    direction = (change, dq, du)
    value, forward, ends, h = along(_outcome, arguments, point, direction, u)
    size = np.abs(value) + np.abs(forward) + 1e-3 * np.sum(np.abs(weights))
    found = []
    reverse, differences = _reverse(arguments, point, direction), central_difference(ends, h)
    for name, other in (("jvp against vjp", reverse), ("differences", differences)):
        errors = np.abs(forward - other) / size
        by_way = {f"reduction `{way}`": e for way, e in zip(names, errors, strict=True)}
        found.append(check(name, by_way, u.dtype, note))
    return found


def _outcome(arguments, point) -> Float[Array, "reductions"]:
    """Return a random linear combination of accelerations and constraint forces, for each reduction."""
    names, weights, t, inputs, fixed, usual = arguments
    parameters, q, u = point
    scene = eqx.combine(parameters, fixed)
    equations, rows = equations_and_rows(scene, t, q, u, inputs)
    rows = rows.judged_by(usual)
    found = [by_reduction(reductions(scene)[way], scene, t, q, u, equations, rows) for way in names]
    return jnp.stack([weights @ jnp.concatenate([a.udot, a.constraint_force]) for a in found])


@eval_numpy
def _reverse(arguments, point, direction):
    value, pull = jax.vjp(lambda point: _outcome(arguments, point), point)
    return jax.vmap(lambda way: _dot(pull(way)[0], direction))(jnp.eye(value.size, dtype=value.dtype))


def _dot(a, b):
    return sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def statement_checks(
    scene: Scene, t, q, u, inputs, Z: Float[Array, "speeds columns"], seed: int
) -> list[Check]:
    """Return the checks of inertia, potentials and derivatives. `Z` spans the admissible speeds."""
    inertia, potentials = _evaluate(scene, t, q, u, inputs, Z)
    return [
        check("inertia", inertia, q.dtype),
        check("potentials", potentials, q.dtype),
        _derivatives(scene, t, q, u, inputs, seed),
    ]


@eval_numpy
def _evaluate(scene: Scene, t, q, u, inputs, Z) -> tuple[dict, dict]:
    motion = motion_at(scene, t, q, u, inputs)
    return _inertia(scene, motion), _potentials(scene, motion, Z)


def _inertia(scene: Scene, motion: Motion) -> dict[str, Scalar]:
    stated, values = stated_of(scene, motion.pose(), loads_of(scene, motion)), {}
    for name, mass in stated["mass"].items():
        values[f"{name}: its mass is negative"] = jnp.maximum(-mass, 0.0) / jnp.maximum(
            jnp.abs(mass), tiny_of(mass)
        )
    for name, rows in stated["inertia"].items():
        inertia, R = rows[:3], stated["orientation"][name]
        size, (low, middle, high) = largest(inertia) + tiny_of(inertia), jnp.linalg.eigvalsh(inertia)
        excess = jnp.where(low >= 0, jnp.maximum(high - low - middle, 0.0), 0.0)
        values |= {
            f"{name}: its inertia is not symmetric": largest(inertia - inertia.T) / size,
            f"{name}: a principal moment of inertia is negative": jnp.maximum(-low, 0.0) / size,
            f"{name}: a principal moment of inertia exceeds the sum of the other two": excess / size,
            f"{name}: its orientation is not a rotation matrix": largest(R.T @ R - jnp.eye(3)),
        }
    off = {name: jnp.abs(jnp.sqrt(square) - 1) for name, square in stated["gravity"].items()}
    return values | {f"{name} is not a unit vector": size for name, size in off.items()}


def _potentials(scene: Scene, motion: Motion, Z) -> dict[str, Scalar]:
    t, q, u, inputs = motion.t, motion.q.array, motion.u.array, motion.inputs.array
    loads = loads_of(scene, motion)
    stated = [i for i, load in enumerate(loads) if load.potential is not None]
    if not stated:
        return {}

    def V(q):
        at = loads_of(scene, motion_at(scene, t, q, u, inputs))
        return jnp.stack([at[i].potential for i in stated])

    dV = jax.jacfwd(V)(q) @ jax.jacfwd(lambda u: coordinate_rates(scene, t, q, u))(u)
    partial, turned = partial_velocities(scene, t, q, u), of_bodies(motion, "orientation")
    values = {}
    for i, slope in zip(stated, dV, strict=True):
        total = resultants(scene, motion, loads=(loads[i],))
        # Q = beta' F + gamma' L + Q_direct
        torque = jnp.einsum("bji,bj->bi", turned, total.torque)
        Q = on_speeds(partial, total.force, torque) + total.direct
        size = largest(Q) + largest(slope) + tiny_of(q)
        values[f"{_name(i, loads[i])}: its potential does not give its force"] = (
            largest(Z.T @ (Q + slope)) / size
        )
    return values


def _name(i: int, load: Load) -> str:
    on = dict.fromkeys([*load.forces, *load.torques, *load.generalized])
    return f"load {i + 1}" + (f" (on {', '.join(f'`{name}`' for name in on)})" if on else "")


def _pieces(scene: Scene, t, q, u, inputs) -> dict[str, Array]:
    """Return all quantities that the scene defines at (t, q, u), by subject."""
    # `pose_at`, because poses in a motion are differentiated already, which may bypass a custom rule
    motion, pose = motion_at(scene, t, q, u, inputs), pose_at(scene, t, q)
    pieces = {"the coordinate rates": coordinate_rates(scene, t, q, u)}
    for name, placed in pose.bodies.items():
        body = placed.body
        pieces |= {f"body `{name}`: its mass": body.mass, f"body `{name}`: its position": body.position}
        if isinstance(body, RigidBody):
            pieces |= {
                f"body `{name}`: its inertia": body.inertia,
                f"body `{name}`: its orientation": body.orientation,
            }
    for i, load in enumerate(loads_of(scene, motion)):
        for kind, part in (("force", load.forces), ("torque", load.torques), ("force", load.generalized)):
            pieces |= {f"{_name(i, load)}: its {kind} on `{name}`": value for name, value in part.items()}
        if load.potential is not None:
            pieces[f"{_name(i, load)}: its potential"] = load.potential
    potential = potential_of(scene, pose)
    if potential is not None:
        pieces["the scene's `potential`"] = jnp.asarray(potential)
    pieces |= {f"constraint `{name}`": value for name, value in velocity_rows(scene, motion).items()}
    return pieces | {
        f"position of constraint `{name}`": value for name, value in position_rows(scene, pose).items()
    }


def _derivatives(scene: Scene, t, q, u, inputs, seed: int) -> Check:
    generator = np.random.default_rng(seed)
    # in SI units; for smaller quantities, round-off dominates the differences
    floor = 1e-2 if q.dtype == jnp.float32 else 1e-4
    moving, fixed = eqx.partition(scene, eqx.is_inexact_array)
    draw = lambda x: jnp.asarray(generator.normal(size=x.shape), x.dtype)
    direction = (
        jax.tree.map(lambda x: draw(x) * jnp.where(x == 0, 1.0, x), moving),
        jnp.ones_like(t),
        draw(q),
        draw(u),
    )
    point = (moving, t, q, u)
    value, change, around, h = along(_at, (fixed, inputs), point, direction, u)
    values = {}
    for name in value:
        f = np.asarray(value[name])
        slope = np.asarray(change[name])
        ends = [np.asarray(x[name]) for x in around]
        # 2 s(h) - s(2h) with s(h) = (f(h) - 2 f(0) + f(-h))/h: of third order if f is smooth; at a kink, the
        # jump of the slope
        kink = (2 * (ends[1] + ends[2]) - 4 * f) / h - (ends[0] + ends[3] - 2 * f) / (2 * h)
        size = largest(f) + largest(slope) + floor
        # weight 1e-3: the jump at a kink is of order one, and its estimate is inaccurate
        error = np.maximum(np.abs(slope - central_difference(ends, h)), 1e-3 * np.abs(kink))
        values[f"{name}: its derivative"] = np.max(error, initial=0.0) / size
    return check("derivatives", values, q.dtype)


def _at(arguments, point) -> dict[str, Array]:
    (fixed, inputs), (parameters, t, q, u) = arguments, point
    return _pieces(eqx.combine(parameters, fixed), t, q, u, inputs)
