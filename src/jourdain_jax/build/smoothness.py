"""Whether bodies move smoothly: a pose whose velocity jumps loses its force of inertia, which is a second derivative.

    r(t, q), R(t, q), g(t, q)      once continuously differentiable, or mass times a jump of velocity is lost in silence
    qdot(t, q, u)                  continuous, for the same reason
    phi(t, q, 0)                   of velocity rows, continuous in time: where it jumps and A does not, speeds would have to jump

A piecewise linear interpolation has a second derivative of zero wherever one looks. What is decided by a comparison or an index on the way from t and q to
these quantities is therefore looked at along lines in t and q, where it or its rate may jump.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.build.trace import jaxpr_of_scene
from jourdain_jax.calculus.jumps import jumps
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.instant import constraint_rows
from jourdain_jax.equations.kinematics import coordinate_rates, pose_at
from jourdain_jax.equations.listed import names_of_bodies, names_of_position_rows, names_of_rows
from jourdain_jax.equations.rows import position_residual, velocity_residual
from jourdain_jax.program.roughness import may_bend
from jourdain_jax.scene.bodies import RigidBody
from jourdain_jax.scene.once_per_class import once_per_class
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.spline import smooth_through_samples

EVENLY, KNOTS, ACROSS, LINES = 192, 128, 48, 6  # intervals of time within the usual span, around numbers that may be knots, on each line across q; such lines
MANY = 3  # kinks along coordinates that make a look-up: a single one may lie where no motion comes
SPEEDS_WOULD_JUMP = (
    "speeds would have to jump there, by an impulse that no acceleration holds. Let it change within a short time, as by a `jj.Sampled` input, or end the "
    "motion there and start another with the speeds after the jump"
)
_SMOOTH_FUNCTIONS = (smooth_through_samples.__name__,)


def check_smoothness(scene: Scene, q: np.ndarray, u: np.ndarray) -> None:
    """A ValueError that names a body, a row or a coordinate that jumps, or whose velocity jumps; `q`, `u`: some states."""
    if not _may_bend(scene):
        return
    names, velocity_rows = _names(scene), names_of_rows(scene)[len(names_of_position_rows(scene)) :]
    for k, before, behind in _kinks(scene, u[0], *in_time(scene, q)):
        if k < len(names):
            raise ValueError(_said(scene, names[k], f"at t = {behind[0]:.6g} s"))
        if not _sets_in(scene, before[0], behind[0], q[0], u[0]):
            row = velocity_rows[k - len(names)]
            raise ValueError(f"row `{row}` of `{type(scene).__name__}` jumps at t = {behind[0]:.6g} s: {SPEEDS_WOULD_JUMP}")
    found = [names[k] for k, *_ in _kinks(scene, u[0], *across(q)) if k < len(names)]
    for name in dict.fromkeys(found):
        if found.count(name) >= MANY:
            raise ValueError(_said(scene, name, "at several places on its way"))


@once_per_class
def _may_bend(scene: Scene) -> bool:
    """Whether anything decides between branches on the way from t and q."""
    parameters, size = len(jax.tree.leaves(scene)), (len(scene.coordinate_names), len(scene.speed_names))
    variables = (parameters, parameters + 1)
    closed, shape = jaxpr_of_scene(scene, ())
    at = shape[0]
    wanted = jax.tree.leaves(jax.tree.map(lambda x: any(x is y for y in (at.position, at.orientation, at.closure, at.qdot, at.phi)), shape))
    if not any(bent and asked for bent, asked in zip(may_bend(closed, variables), wanted, strict=True)):
        return False
    leaves, treedef = jax.tree.flatten(scene)
    real = jnp.result_type(float)
    numbers = [jax.ShapeDtypeStruct(np.shape(x), real) for x in leaves]
    state = [jax.ShapeDtypeStruct(shape, real) for shape in ((), (size[0],), (size[1],))]
    closed = jax.make_jaxpr(lambda leaves, t, q, u: _quantities(jax.tree.unflatten(treedef, leaves), t, q, u))(numbers, *state)
    return any(may_bend(closed, variables, _SMOOTH_FUNCTIONS))


def _quantities(scene: Scene, t, q, u) -> tuple[Float[Array, "differentiable"], Float[Array, "continuous"]]:
    """What must be differentiable: poses, body by body, and geometric rows; what must be continuous: rates of coordinates, and velocity rows at rest."""
    bodies = [body.body for body in pose_at(scene, t, q).bodies.values()]
    poses = [jnp.concatenate([b.position, b.orientation.reshape(-1) if isinstance(b, RigidBody) else jnp.zeros(9, q.dtype)]) for b in bodies]
    g = position_residual(scene, t, q)
    phi = velocity_residual(scene, t, q, jnp.zeros_like(u))[g.shape[0] :]
    return jnp.concatenate([*poses, g]), jnp.concatenate([coordinate_rates(scene, t, q, u), phi])


@eval_numpy
def _along(scene, u, points, along) -> Float[np.ndarray, "points 2 entries"]:
    """All quantities at many points (t, q), and the rates along a direction of those that must be differentiable."""

    def one(point, direction):
        (smooth, continuous), (rates, _) = jax.jvp(lambda x: _quantities(scene, x[0], x[1:], u), (point,), (direction,))
        return jnp.stack([jnp.concatenate([smooth, continuous]), jnp.concatenate([rates, jnp.zeros_like(continuous)])])

    return jax.vmap(one)(points, along)


def _kinks(scene: Scene, u: np.ndarray, a: np.ndarray, b: np.ndarray, along: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Which quantity has a kink, and the points before and behind it, for every interval with one between the points `a` and `b`."""
    return jumps(lambda points: _along(scene, u, points, along), a, b)


def in_time(scene: Scene, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intervals of time at one of some states `q`, and their direction: the usual span, and around all numbers in arrays of the scene, which may be knots."""
    span = float(scene.example_span)
    t = np.linspace(1e-6 * span, span, EVENLY + 1)
    low, high = [t[:-1]], [t[1:]]
    for leaf in jax.tree.leaves(scene):
        knots = np.unique(np.asarray(leaf, float)) if np.ndim(leaf) == 1 else np.zeros(0)
        knots = knots[np.isfinite(knots)]
        if knots.size >= 2:
            middle = (knots[:-1] + knots[1:]) / 2
            chosen = np.unique(np.linspace(0, max(knots.size - 3, 0), min(KNOTS, max(knots.size - 2, 1))).astype(int))
            low.append(middle[chosen] if knots.size > 2 else knots[:1])
            high.append(middle[chosen + 1] if knots.size > 2 else middle)
    low, high = np.concatenate(low), np.concatenate(high)
    here = q[np.arange(len(low)) % len(q)]
    return np.column_stack([low, here]), np.column_stack([high, here]), np.column_stack([np.ones_like(low), np.zeros_like(here)])


def across(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intervals on lines across the box that holds some states `q`, at random times, and their directions."""
    generator = np.random.default_rng(3)
    ends = generator.uniform(q.min(axis=0), q.max(axis=0), (2, LINES, q.shape[1]))
    points = ends[0] + np.linspace(0.0, 1.0, ACROSS + 1)[:, None, None] * (ends[1] - ends[0])
    t = np.tile(generator.uniform(0.0, 1.0, LINES), ACROSS)
    a, b, along = (x.reshape(len(t), -1) for x in (points[:-1], points[1:], np.tile(ends[1] - ends[0], (ACROSS, 1))))
    return np.column_stack([t, a]), np.column_stack([t, b]), np.column_stack([np.zeros_like(t), along])


def _names(scene: Scene) -> list[str]:
    """What each of the quantities before the velocity rows belongs to."""
    names = [f"the pose of body `{name}`" for name in names_of_bodies(scene) for _ in range(12)] + [f"row `{name}`" for name in names_of_position_rows(scene)]
    return names + [f"the rate of coordinate `{name}`" for name in scene.coordinate_names.entries]


def _sets_in(scene: Scene, before: float, behind: float, q: np.ndarray, u: np.ndarray) -> bool:
    """Whether rows become others between these times: a state may meet both."""
    A, B = (constraint_rows(scene, t, q, u).A for t in (before, behind))
    return not np.allclose(A, B, rtol=1e-6, atol=1e-9)


def _said(scene: Scene, what: str, where: str) -> str:
    return (
        f"{what} of `{type(scene).__name__}` is not smooth: it jumps, or its velocity does, {where}, as by a piecewise linear interpolation, a look-up or a "
        "branch. What jumps exerts no force of inertia, for the second derivative is zero on either side. Give samples as `jj.Spline(ts, values)`, and let "
        "pieces meet with equal slopes"
    )
