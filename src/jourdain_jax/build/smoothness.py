"""Whether bodies move smoothly: a pose whose velocity jumps loses its force of inertia, which is a second derivative.

    r(t, q), R(t, q), g(t, q)      once continuously differentiable, or mass times a jump of velocity is lost in silence
    qdot(t, q, u)                  continuous, for the same reason
    phi(t, q, 0)                   of velocity rows, continuous in time: where it jumps and A does not, speeds would have to jump

A piecewise linear interpolation has a second derivative of zero wherever one looks. What is decided by a comparison or an index on the way from t and q to
these quantities is therefore looked at along lines in t and q: intervals at whose ends the rate differs are halved until the difference has gone, or is a jump.
"""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.build.trace import jaxpr_of_scene
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
SOME, ALL = 24, 48  # halvings after which a smooth motion shows no jump that counts, and after which an interval has no width
MANY = 3  # kinks along coordinates that make a look-up: a single one may lie where no motion comes
_SMOOTH_FUNCTIONS = (smooth_through_samples.__name__,)


class _Poses(eqx.Module):
    """What must be smooth, as vectors."""

    poses: Float[Array, "*points entries"]  # positions and orientations, body by body
    rows: Float[Array, "*points geometric_rows"]
    rates: Float[Array, "*points coordinates"]  # only continuous
    drifts: Float[Array, "*points velocity_rows"]  # only continuous


def _poses(scene: Scene, t, q, u) -> _Poses:
    bodies = [body.body for body in pose_at(scene, t, q).bodies.values()]
    parts = [jnp.concatenate([b.position, b.orientation.reshape(-1) if isinstance(b, RigidBody) else jnp.zeros(9, q.dtype)]) for b in bodies]
    g = position_residual(scene, t, q)
    drifts = velocity_residual(scene, t, q, jnp.zeros_like(u))[g.shape[0] :]
    return _Poses(jnp.concatenate(parts), g, coordinate_rates(scene, t, q, u), drifts)


def check_smoothness(scene: Scene, q: np.ndarray, u: np.ndarray) -> None:
    """A ValueError that names a body, a row or a coordinate that jumps, or whose velocity jumps; `q`, `u`: some states."""
    if not _may_bend(scene):
        return
    search, names = _Search(scene, u[0]), _names(scene)
    for k, t in search.kinks(*_in_time(scene, q)):
        if k < len(names):
            raise ValueError(_said(scene, names[k], f"at t = {t:.6g} s"))
        if not _sets_in(scene, t, q[0], u[0]):
            raise ValueError(_said_of_speeds(scene, names_of_rows(scene)[len(names_of_position_rows(scene)) + k - len(names)], t))
    found = [names[k] for k, _ in search.kinks(*_across(q)) if k < len(names)]
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
    closed = jax.make_jaxpr(lambda leaves, t, q, u: _poses(jax.tree.unflatten(treedef, leaves), t, q, u))(numbers, *state)
    return any(may_bend(closed, variables, _SMOOTH_FUNCTIONS))


@eval_numpy
def _along(scene, t, q, u, dt, dq) -> tuple[_Poses, _Poses]:
    """Values and their rates along directions, at many points."""

    def one(t, q, dt, dq):
        return jax.jvp(lambda t, q: _poses(scene, t, q, u), (t, q), (dt, dq))

    return jax.vmap(one)(t, q, dt, dq)


class _Search:
    """Finds kinks by halving intervals between points."""

    def __init__(self, scene: Scene, u: np.ndarray):
        self.scene, self.u = scene, u
        single = jnp.result_type(float) == jnp.float32
        self.least, self.floor = (1e-2, 1e-3) if single else (1e-6, 1e-9)

    def kinks(self, a, b, direction) -> Iterator[tuple[int, float]]:
        """Which entry has a kink, and at which time, for every interval with one between the states `a` and `b`, of times and coordinates."""
        dt, dq = direction
        at_a, at_b = (self._entries(t, q, dt, dq) for t, q in (a, b))
        largest = np.nanmax(np.abs(np.concatenate([at_a, at_b])), axis=0, initial=0.0)
        size = np.maximum(largest, self.floor * np.max(largest, axis=-1, keepdims=True)) + np.finfo(largest.dtype).tiny
        for turn in range(ALL):
            t_m, q_m = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2
            at_m = self._entries(t_m, q_m, dt, dq)
            left, right = _off(at_a, at_m, size), _off(at_m, at_b, size)
            first = np.max(left, axis=1, initial=0.0) >= np.max(right, axis=1, initial=0.0)
            off = np.where(first[:, None], left, right)
            if turn >= SOME and not np.any(off > self.least):
                return
            a = (np.where(first, a[0], t_m), np.where(first[:, None], a[1], q_m))
            b = (np.where(first, t_m, b[0]), np.where(first[:, None], q_m, b[1]))
            at_a, at_b = np.where(first[:, None, None], at_a, at_m), np.where(first[:, None, None], at_m, at_b)
        for k in np.flatnonzero(np.max(off, axis=1, initial=0.0) > self.least):
            yield int(np.argmax(off[k])), float(b[0][k])

    def _entries(self, t, q, dt, dq) -> np.ndarray:
        """Values, and rates of what must be differentiable; shape (points, 2, entries)."""
        values, rates = _along(self.scene, t, q, self.u, dt, dq)
        still = np.zeros_like(rates.rates)
        first = np.concatenate([values.poses, values.rows, values.rates, values.drifts], axis=1)
        return np.stack([first, np.concatenate([rates.poses, rates.rows, still, np.zeros_like(rates.drifts)], axis=1)], axis=1)


def _off(a: np.ndarray, b: np.ndarray, size: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", over="ignore"):
        difference = np.max(np.abs(b - a) / size, axis=1)
    return np.where(np.isfinite(difference), difference, 0.0)


def _in_time(scene: Scene, q: np.ndarray) -> tuple[tuple, tuple, tuple]:
    """Intervals of time, and their direction: the usual span, and around all numbers in arrays of the scene, which may be knots."""
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
    return (low, here), (high, here), (np.ones_like(low), np.zeros_like(here))


def _across(q: np.ndarray) -> tuple[tuple, tuple, tuple]:
    """Intervals on lines across the coordinates, at random times, and their directions."""
    generator = np.random.default_rng(3)
    ends = generator.uniform(q.min(axis=0), q.max(axis=0), (2, LINES, q.shape[1]))
    points = ends[0] + np.linspace(0.0, 1.0, ACROSS + 1)[:, None, None] * (ends[1] - ends[0])
    t = np.tile(generator.uniform(0.0, 1.0, LINES), ACROSS)
    along = np.tile(ends[1] - ends[0], (ACROSS, 1))
    return (t, points[:-1].reshape(along.shape)), (t, points[1:].reshape(along.shape)), (np.zeros_like(t), along)


def _names(scene: Scene) -> list[str]:
    """What each entry belongs to."""
    names = [f"the pose of body `{name}`" for name in names_of_bodies(scene) for _ in range(12)] + [f"row `{name}`" for name in names_of_position_rows(scene)]
    return names + [f"the rate of coordinate `{name}`" for name in scene.coordinate_names.entries]


def _sets_in(scene: Scene, t: float, q: np.ndarray, u: np.ndarray) -> bool:
    """Whether rows become others at this time: a state may meet both."""
    before, after = (constraint_rows(scene, at, q, u).A for at in (np.nextafter(t, -np.inf), t))
    return not np.allclose(before, after, rtol=1e-6, atol=1e-9)


def _said_of_speeds(scene: Scene, row: str, t: float) -> str:
    return (
        f"row `{row}` of `{type(scene).__name__}` jumps at t = {t:.6g} s: speeds would have to jump there, by an impulse that no acceleration holds. Let it "
        "change within a short time, as by a `jj.Sampled` input, or end the motion there and start another with the speeds after the jump"
    )


def _said(scene: Scene, what: str, where: str) -> str:
    return (
        f"{what} of `{type(scene).__name__}` is not smooth: it jumps, or its velocity does, {where}, as by a piecewise linear interpolation, a look-up or a "
        "branch. What jumps exerts no force of inertia, for the second derivative is zero on either side. Give samples as `jj.Spline(ts, values)`, and let "
        "pieces meet with equal slopes"
    )
