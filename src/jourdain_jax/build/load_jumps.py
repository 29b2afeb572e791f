"""Whether loads jump as time goes on or the state changes: a motion is right there, but its derivatives leave out how the time of the jump moves.

    y' = f_1 before and f_2 after the time s(p) of the jump:     dy/dp = (what JAX finds) + (f_1 - f_2) ds/dp

What is decided by a comparison or an index on the way to the loads is looked at along lines in t, and across coordinates, speeds and inputs. A branch that
these lines do not meet, a jump without a branch (x / sqrt(x^2)), and loads by a callback that has no form for lanes, are not seen.

At one state, as at rest with dry friction, loads may have no derivative at all; so has then no linearization.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.build.domain import speed_bounds
from jourdain_jax.build.reference_parameters import once_per_values
from jourdain_jax.build.smoothness import across, in_time
from jourdain_jax.build.structure import structure_whatever_its_faults
from jourdain_jax.build.trace import jaxpr_of_scene
from jourdain_jax.calculus.jumps import jumps
from jourdain_jax.eager.eager import eval_numpy
from jourdain_jax.equations.kinematics import inertias_of, motion_at
from jourdain_jax.equations.listed import names_of_bodies
from jourdain_jax.equations.virtual_power import impressed
from jourdain_jax.program.roughness import may_bend
from jourdain_jax.scene.once_per_class import once_per_class
from jourdain_jax.scene.scene import Scene

STATES = 64  # random ones, which the lines go through
NEAR, NEARER = 1e-7, 1e-8  # steps off a state, relative to entries larger than one
FLOOR = 1e-11  # what of a difference of loads may be round-off, relative to the largest of them
POLE = 1e3  # times what an entry is elsewhere: what differs by more on both sides has a pole there


@once_per_class
def loads_may_jump(scene: Scene) -> tuple[bool, bool]:
    """Whether loads pass a branch that parameters decide, and one that the state or inputs do. Where time alone decides, no derivative misses anything."""
    closed, shape = jaxpr_of_scene(scene, ())
    at, first = shape[0], len(jax.tree.leaves(scene)) + 1  # after the time
    wanted = jax.tree.leaves(jax.tree.map(lambda x: any(x is y for y in (at.force, at.torque, at.direct, at.mass, at.inertia)), shape))

    def decided_by(variables) -> bool:
        return any(bent and asked for bent, asked in zip(may_bend(closed, variables), wanted, strict=True))

    return decided_by(range(first - 1)), decided_by(range(first, first + 3))


@once_per_values
def jump_of_loads(scene: Scene) -> str:
    """What of the loads or masses jumps, in words; empty where nothing is seen to."""
    in_parameters, in_state = loads_may_jump(scene)
    q = structure_whatever_its_faults(scene).coordinates if in_parameters or in_state else np.zeros((0, 0))
    if not q.size:
        return ""
    with np.errstate(all="ignore"):  # what is no number on a line does not count there
        try:
            return _first_jump(scene, q, in_parameters, in_state)
        except NotImplementedError:  # callbacks that take one state at a time
            return ""


def _first_jump(scene: Scene, q: np.ndarray, in_parameters: bool, in_state: bool) -> str:
    """What jumps first on lines through configurations `q`, in words; empty where nothing does."""
    generator = np.random.default_rng(7)
    low, high = speed_bounds(scene)
    inputs = generator.uniform(-1.0, 1.0, (STATES, len(scene.inputs)))
    states = np.column_stack([q[np.arange(STATES) % len(q)], generator.uniform(low, high, (STATES, len(low))), inputs])
    for looked_at, where, (a, b, _) in ((in_parameters, "at t = {:.3g} s", in_time(scene, states)), (in_state, "as the state changes", across(states))):
        if looked_at and (found := _jump_between(scene, a, b)):
            k, t = found
            return f"{_names(scene)[k]} jumps {where.format(t)}"
    return ""


def loads_without_slope(scene: Scene, t, q, u, inputs) -> str:
    """Which of the loads or masses has no derivative with respect to the state at a state, in words; empty where none is seen.

    Differences on both sides, over steps h, agree to O(h) where there is a derivative; at a kink they do not, and where a load jumps they grow as 1/h.
    """
    if not loads_may_jump(scene)[1]:
        return ""
    at = np.concatenate([np.ravel(x).astype(float) for x in (t, q, u, inputs)])
    step = np.diag(np.maximum(1.0, np.abs(at)))[1:]
    with np.errstate(all="ignore"):
        try:
            near, nearer = (_differences(scene, at, step, size) for size in (NEAR, NEARER))
        except NotImplementedError:  # as of `jump_of_loads`
            return ""
        apart = nearer * NEARER > FLOOR * np.nanmax(np.abs(_loads(scene, at[None])), initial=1.0)
    rough = np.any((nearer > 0.5 * near) & apart, axis=0)
    return _names(scene)[int(np.argmax(rough))] if np.any(rough) else ""


def _differences(scene: Scene, at: np.ndarray, step: np.ndarray, size: float) -> np.ndarray:
    """How much slopes of every entry over steps of this size, and half of it, differ, (variables, entries)."""
    here = _loads(scene, at[None])[0, 0]
    ahead, halfway, back = ((_loads(scene, at + share * size * step)[:, 0] - here) / (share * size) for share in (1.0, 0.5, -1.0))
    return np.maximum(np.abs(ahead - halfway), np.abs(ahead - back))


def _jump_between(scene: Scene, a: np.ndarray, b: np.ndarray) -> tuple[int, float] | None:
    """The number of an entry that jumps between points `a` and `b`, and when."""
    usual = np.nanmax(np.abs(_loads(scene, a)), axis=(0, 1), initial=0.0)
    for k, before, behind in jumps(lambda points: _loads(scene, points), a, b):
        difference = np.diff(_loads(scene, np.stack([before, behind]))[:, 0, k])
        if abs(difference) < POLE * usual[k]:
            return k, float(behind[0])
    return None


@eval_numpy
def _loads(scene: Scene, points) -> Float[Array, "points 1 entries"]:
    """Forces, torques, masses and inertias at points (t, q, u, inputs)."""
    ends = np.cumsum([1, len(scene.coordinate_names), len(scene.speed_names)])

    def one(point):
        t, q, u, inputs = jnp.split(point, ends)
        motion = motion_at(scene, t[0], q, u, inputs)
        loads, weights = impressed(scene, motion), inertias_of(motion)
        return jnp.concatenate([jnp.ravel(x) for x in (loads.force, loads.torque, loads.direct, weights.mass, weights.inertia)])[None]

    return jax.vmap(one)(points)


def _names(scene: Scene) -> list[str]:
    """What each of the entries belongs to."""
    bodies = names_of_bodies(scene)

    def of_bodies(what: str, count: int) -> list[str]:
        return [f"the {what} body `{name}`" for name in bodies for _ in range(count)]

    speeds = [f"the force along `{name}`" for name in scene.speed_names.entries]
    return of_bodies("force on", 3) + of_bodies("torque on", 3) + speeds + of_bodies("mass of", 1) + of_bodies("inertia of", 9)
