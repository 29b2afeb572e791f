"""Check derivatives of accelerations and constraint forces: whether they exist, whether forward and reverse
mode agree, and whether they agree with central differences.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.verification import Check, check
from jourdain_jax.calculus.matrices import pseudo_inverse
from jourdain_jax.calculus.reals import as_real, described, largest, rank_cutoff
from jourdain_jax.dynamics.accelerations import reductions
from jourdain_jax.equations.gibbs_appell import GibbsAppell
from jourdain_jax.equations.instant import constraint_rows
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.equations.reductions import reduce
from jourdain_jax.equations.scaling import row_scale
from jourdain_jax.equations.virtual_power import equations_and_rows
from jourdain_jax.program.eager import eval_numpy
from jourdain_jax.scene.names import Labels
from jourdain_jax.scene.scene import Scene
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


def derivative_exists(scene: Scene, t, q, u, direction: Scene, dq, inputs=None) -> bool:
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


def by_reduction(way, scene, t, q, u, equations, rows):
    """Apply one reduction to shared equations and constraints."""
    if isinstance(way, GibbsAppell):
        return way.accelerations(scene, t, q, u, equations, rows)
    return reduce(way, equations, rows)


@eval_numpy
def _reverse(arguments, point, direction):
    value, pull = jax.vjp(lambda point: _outcome(arguments, point), point)
    return jax.vmap(lambda way: _dot(pull(way)[0], direction))(jnp.eye(value.size, dtype=value.dtype))


def _dot(a, b):
    return sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
