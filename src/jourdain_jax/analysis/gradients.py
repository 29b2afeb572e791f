"""Derivatives of accelerations and constraint forces: whether they exist, forward against reverse mode, against central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.verification import DIFFERENCE_STEP, Check, central_difference, check
from jourdain_jax.build.structure import plain_row_lengths, usual_rows
from jourdain_jax.calculus.pseudo_inverse import pseudo_inverse, rank_cutoff
from jourdain_jax.calculus.reals import as_real, described
from jourdain_jax.dynamics.accelerations import reductions
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.gibbs_appell import GibbsAppell
from jourdain_jax.equations.instant import constraint_rows
from jourdain_jax.equations.kinematics import coordinate_rates
from jourdain_jax.equations.reductions import reduce
from jourdain_jax.equations.scaling import row_scale
from jourdain_jax.equations.virtual_power import equations_and_rows
from jourdain_jax.scene.scene import Scene


def derivative_exists(scene: Scene, t, q, u, direction: Scene, dq, inputs=None) -> bool:
    """Whether accelerations have a derivative along a change of the parameters and coordinates.

    They have none where the change splits rows that are dependent: `(1 - A A+) dA (1 - A+ A)` is not zero.

    **Arguments**
    - `direction`: the change of every parameter, as a scene like `scene` (zeros for what stays); `dq`: that of the coordinates.
    - `inputs`: values of the scene's inputs (default: zero).

    Needs numbers: not under jit or vmap.
    """
    if jax.tree.structure(direction) != jax.tree.structure(scene):
        raise ValueError(f"`direction` is {described(direction)}, expected a change of every parameter, as a scene like `scene`: a `{type(scene).__name__}`")
    A, dA, size = _row_change(scene, t, as_real(q), as_real(u), direction, as_real(dq), inputs, plain_row_lengths(scene))
    if A.size == 0:
        return True
    P = np.asarray(pseudo_inverse(jnp.asarray(A)))
    split = (np.eye(len(A)) - A @ P) @ dA @ (np.eye(A.shape[1]) - P @ A)
    return bool(np.max(np.abs(split)) <= 1e3 * rank_cutoff(A.dtype) * (size + np.max(np.abs(dA))))


@eval_numpy
def _row_change(scene, t, q, u, direction, dq, inputs, typical):
    moving, fixed = eqx.partition(scene, eqx.is_inexact_array)

    def A(parameters, q):
        rows = constraint_rows(eqx.combine(parameters, fixed), t, q, u, inputs)
        return jax.lax.stop_gradient(row_scale(rows.A, typical))[:, None] * rows.A

    value, change = jax.jvp(A, (moving, q), (eqx.filter(direction, eqx.is_inexact_array), dq))
    return value, change, jnp.max(jnp.abs(value), initial=1.0)


def gradient_checks(scene: Scene, t, q, u, inputs, Z: Float[Array, "speeds columns"], names: tuple[str, ...], seed: int) -> list[Check]:
    """Along one random direction: admissible (`Z`) in the coordinates, free in the speeds, relative in the parameters; for every reduction.

    None where no reduction applies.
    """
    names = tuple(name for name in names if name != "gibbs-appell")  # its Hessian of a Hessian costs more than all others together
    if not names:
        return []
    generator = np.random.default_rng(seed)
    moving, fixed = eqx.partition(scene, eqx.is_inexact_array)
    relative = jax.tree.map(lambda x: jnp.asarray(generator.normal(size=x.shape) * np.where(x == 0, 1.0, x), x.dtype), moving)
    weights = jnp.asarray(generator.normal(size=2 * u.shape[0]), u.dtype)
    du = jnp.asarray(generator.normal(size=u.shape), u.dtype)
    dq = coordinate_rates(scene, t, q, Z @ du) - coordinate_rates(scene, t, q, jnp.zeros_like(u))
    note = ""
    if not derivative_exists(scene, t, q, u, eqx.combine(relative, fixed), dq, inputs):
        relative = jax.tree.map(jnp.zeros_like, relative)
        if not derivative_exists(scene, t, q, u, eqx.combine(relative, fixed), dq, inputs):
            note = "left out: the rows lose rank at this very state, and accelerations have no derivative there"
            return [check(name, {}, u.dtype, note) for name in ("jvp against vjp", "differences")]
        note = "parameters left out: a change of them splits rows that are dependent, and accelerations have no derivative there"
    arguments = (names, weights, t, inputs, fixed, usual_rows(scene))
    point, direction = (moving, q, u), (relative, dq, du)
    forward, size = _forward(arguments, point, direction)
    reverse = _reverse(arguments, point, direction)
    # fourth-order central difference, every point through the same program
    h = DIFFERENCE_STEP[u.dtype.name] / (1 + float(jnp.max(jnp.abs(u), initial=0.0)))
    along = [_outcome_of_numbers(arguments, jax.tree.map(lambda x, d, k=k: x + k * h * d, point, direction)) for k in (-2, -1, 1, 2)]
    difference = central_difference(along, h)
    by_way = lambda error: {f"reduction `{name}`": float(e) for name, e in zip(names, np.asarray(error / size), strict=True)}  # noqa: E731
    return [
        check("jvp against vjp", by_way(jnp.abs(forward - reverse)), u.dtype, note),
        check("differences", by_way(jnp.abs(forward - difference)), u.dtype, note),
    ]


def _outcome(arguments, point) -> Float[Array, "reductions"]:
    """A random combination of accelerations and constraint forces, by every reduction."""
    names, weights, t, inputs, fixed, usual = arguments
    parameters, q, u = point
    scene = eqx.combine(parameters, fixed)
    equations, rows = equations_and_rows(scene, t, q, u, inputs)
    rows = rows.judged_by(usual)
    found = [by_reduction(reductions(scene)[way], scene, t, q, u, equations, rows) for way in names]
    return jnp.stack([weights @ jnp.concatenate([a.udot, a.constraint_force]) for a in found])


_outcome_of_numbers = eval_numpy(_outcome)


def by_reduction(way, scene, t, q, u, equations, rows):
    """One reduction of equations and rows that all share."""
    return way.accelerations(scene, t, q, u, equations, rows) if isinstance(way, GibbsAppell) else reduce(way, equations, rows)


@eval_numpy
def _forward(arguments, point, direction):
    value, change = jax.jvp(lambda point: _outcome(arguments, point), (point,), (direction,))
    return change, jnp.abs(value) + jnp.abs(change) + jnp.sum(jnp.abs(arguments[1])) * 1e-3


@eval_numpy
def _reverse(arguments, point, direction):
    value, pull = jax.vjp(lambda point: _outcome(arguments, point), point)
    return jax.vmap(lambda way: _dot(pull(way)[0], direction))(jnp.eye(value.size, dtype=value.dtype))


def _dot(a, b):
    return sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
