"""The loop over steps of an explicit Runge-Kutta method with an embedded error estimate, with little besides: for the default options.

    k_i = f(t + c_i h, y + h sum_j a_ij k_j),   y_1 = y + h sum b_i k_i,   e = h sum b^err_i k_i
    |e| = rms(e / (atol + rtol max(|y|, |y_1|))) <= 1 accepts;   h <- h clip(0.9 |e|^(-1/order), 0.2, 10)

The state is any tree of arrays. A batch of lanes runs in lockstep: all arrays, times and step sizes among them, then have a last axis of lanes,
which keeps neighbours in memory neighbours. A step ends at every time asked for; the step size found before such a shortened step is remembered.
Every lane carries its own result code, and a lane that has ended stands still. A lane whose step ended beyond a stop event goes back to it in further
steps of the same loop, so that there is one copy of the rates to compile (`event_search`). `diffrax` serves all other solvers, controllers and ways
of saving.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.motion import event_search, results
from jourdain_jax.motion.event_search import Search

RUNNING, LOCATING = -1, -2
SAFETY, LEAST_FACTOR, LARGEST_FACTOR = 0.9, 0.2, 10.0
_SHRANK = 0.01  # of the average step: a singularity is near
_CHECKPOINTS = 4096  # states kept for reverse mode, of all lanes together


@dataclass(frozen=True)
class Method:
    """A tableau. Its stages run as a loop: one copy of the vector field to compile."""

    A: np.ndarray
    b: np.ndarray
    b_error: np.ndarray
    c: np.ndarray
    order: int

    @property
    def last_is_next_first(self) -> bool:
        """Whether the last stage is taken at y_1."""
        return bool(np.array_equal(self.A[-1], self.b) and self.c[-1] == 1.0)


def method_of(solver: diffrax.AbstractERK) -> Method:
    """The tableau of a diffrax solver."""
    tableau = solver.tableau
    stages = len(tableau.b_sol)
    A = np.zeros((stages, stages))
    for i, row in enumerate(tableau.a_lower):
        A[i + 1, : i + 1] = row
    return Method(A, np.asarray(tableau.b_sol), np.asarray(tableau.b_error), np.concatenate([[0.0], tableau.c]), solver.order(None))


class Progress(eqx.Module):
    """Where a motion is, or each of several lanes."""

    t: Float[Array, "*lanes"]
    y: PyTree
    h: Float[Array, "*lanes"]  # the next step, positive
    code: Int[Array, "*lanes"]  # RUNNING, LOCATING, or the result
    accepted: Int[Array, "*lanes"]
    rejected: Int[Array, "*lanes"]
    event: Int[Array, "*lanes"]  # index of the event that ended the motion, or -1
    search: Search | None  # for that event
    unseen: Float[Array, "*lanes"] | None = None  # largest error so far of what does not decide the step size, 1: as much as it lets pass


class Problem(eqx.Module):
    """What is integrated and how well."""

    rates: Callable  # (t, y, args) -> dy/dt
    args: PyTree
    project: Callable | None  # (t, y, args) -> y
    events: Callable | None  # (t, y, args) -> values, (events, *lanes)
    norm: Callable  # of a state, one number per lane
    rtol: Float[Array, "*lanes"]
    atol: Float[Array, "*lanes"]
    shortest: Float[Array, "*lanes"]
    max_steps: int = eqx.field(static=True)
    unseen: Callable | None = None  # of an error, relative to what step-size control lets pass: how large the part is that it does not see


def integrate(
    problem: Problem, method: Method, y0: PyTree, t0, goals: Float[Array, "times *lanes"], dt0, kind: Literal["lax", "checkpointed"]
) -> tuple[PyTree, Bool[Array, "times *lanes"], Progress]:
    """States at the goals (monotonic; what was not reached repeats the last state), which were reached, and where the lane ended.

    `kind`: "lax" (no reverse mode), "checkpointed" (reverse mode), as in `equinox.internal.while_loop`.
    """
    direction = jnp.sign(goals[-1] - t0)
    zero = jnp.zeros(jnp.shape(t0), jnp.int32)
    unseen = None if problem.unseen is None else jnp.zeros(jnp.shape(t0))
    start = Progress(t0, y0, jnp.broadcast_to(jnp.abs(dt0), jnp.shape(t0)), zero + RUNNING, zero, zero, zero - 1, None, unseen)
    most_steps = problem.max_steps
    if problem.events is not None:
        start = _stopped_at_once(problem, start)
        most_steps += event_search.MOST_STEPS

    def to_goal(progress: Progress, goal):
        def running(p):
            return (p.code == LOCATING) | ((p.code == RUNNING) & (p.t != goal))

        def step(p):
            return jax.tree.map(lambda new, old: jnp.where(running(p), new, old), _step(problem, method, p, goal, goals[-1], direction), p)

        def any_running(p):
            return jnp.any(running(p))

        # what lies between two checkpoints is integrated again in reverse mode, by a program that rounds otherwise: where the error estimate is round-off,
        # other steps are then taken than forwards, and the derivative is wrong (a rattleback for 2 s at rtol 1e-13 with 512 checkpoints: by 26 %)
        lanes = max(1, goals[0].size)
        checkpoints = None if kind == "lax" else max(8, -(-(_CHECKPOINTS // lanes) // goals.shape[0]))
        end = eqxi.while_loop(any_running, step, progress, max_steps=None if kind == "lax" else most_steps, kind=kind, checkpoints=checkpoints)
        return end, (end.y, end.t == goal)

    end, (ys, reached) = jax.lax.scan(to_goal, start, goals)
    # the last steps against the average one
    shrank = (end.code == results.MAX_STEPS) & (end.h * end.accepted < _SHRANK * jnp.abs(end.t - t0))
    code = jnp.where(shrank, results.SHRANK, jnp.where(end.code == RUNNING, results.SUCCESS, end.code))
    return ys, reached, eqx.tree_at(lambda p: p.code, end, code)


def _step(problem: Problem, method: Method, p: Progress, goal, last_goal, direction) -> Progress:
    locating = jnp.array(False) if p.search is None else p.code == LOCATING
    rest = jnp.abs(goal - p.t)
    lands = ~locating & (p.h >= 0.999 * rest)
    size = jnp.where(lands, rest, jnp.where(2 * p.h > rest, 0.5 * rest, p.h))
    shortened = size < p.h
    h = direction * size if p.search is None else jnp.where(locating, p.search.shift, direction * size)
    t1 = jnp.where(lands, goal, p.t + h)
    y1, error, first_slope = _stages(problem, method, p, h)
    if problem.project is not None:
        y1 = problem.project(t1, y1, problem.args)
    scale = jax.tree.map(lambda a, b: problem.atol + problem.rtol * jnp.maximum(jnp.abs(a), jnp.abs(b)), p.y, y1)
    relative = jax.lax.stop_gradient(jax.tree.map(lambda e, s: e / s, error, scale))
    size_of_error = problem.norm(relative)
    accept = locating | (size_of_error <= 1)
    factor = SAFETY * jnp.where(size_of_error > 0, size_of_error, 1e-30) ** (-1 / method.order)
    factor = jnp.clip(jnp.where(jnp.isfinite(size_of_error), factor, 0.0), LEAST_FACTOR, jnp.where(accept, LARGEST_FACTOR, 1.0))
    proposed = size * factor
    next_h = jnp.where(accept & shortened, jnp.maximum(proposed, p.h), proposed)
    accepted, rejected = p.accepted + (accept & ~locating).astype(jnp.int32), p.rejected + (~accept).astype(jnp.int32)
    code = jnp.where(next_h < problem.shortest, results.STEP_TOO_SMALL, RUNNING)
    code = jnp.where((code == RUNNING) & (accepted + rejected >= problem.max_steps) & ~(accept & (t1 == last_goal)), results.MAX_STEPS, code).astype(jnp.int32)
    y = jax.tree.map(lambda new, old: jnp.where(accept, _as(new, old), old), y1, p.y)
    unseen = None if problem.unseen is None else jnp.where(accept & ~locating, jnp.maximum(p.unseen, problem.unseen(relative)), p.unseen)
    moved = Progress(jnp.where(accept, t1, p.t), y, jax.lax.stop_gradient(next_h), code, accepted, rejected, p.event, p.search, unseen)
    return moved if problem.events is None else _watched(problem, p, moved, h, first_slope, accept)


def _stages(problem: Problem, method: Method, p: Progress, h) -> tuple[PyTree, PyTree, PyTree]:
    """y_1, the error estimate, and the rates at the start."""
    leaves, treedef = jax.tree.flatten(p.y)

    def stage(carried, row):
        # k_i = f(y_i), then the next y_i: what is carried from stage to stage is computed once, whatever uses it
        at, slopes = carried
        c, i, next_A = row
        found = jax.tree.leaves(problem.rates(p.t + c * h, treedef.unflatten(at), problem.args))
        slopes = [jax.lax.dynamic_update_index_in_dim(k, _as(f, k), i, 0) for k, f in zip(slopes, found, strict=True)]
        return ([y + _as(h, y) * _weighted(next_A, k) for y, k in zip(leaves, slopes, strict=True)], slopes), None

    count = len(method.c) - (method.last_is_next_first and method.b_error[-1] == 0)  # a last stage that nothing else needs
    rows = (jnp.asarray(method.c[:count]), jnp.arange(count), jnp.asarray([*method.A[1:count], method.b]))
    slopes = [jnp.zeros((len(method.c), *y.shape), y.dtype) for y in leaves]
    (y1, slopes), _ = jax.lax.scan(stage, (leaves, slopes), rows)
    error = [_as(h, k) * _weighted(method.b_error, k) for k in slopes]
    return treedef.unflatten(y1), treedef.unflatten(error), treedef.unflatten([k[0] for k in slopes])


def _weighted(weights, slopes: Float[Array, "stages *shape"]) -> Float[Array, "*shape"]:
    """sum_j w_j k_j, element by element."""
    used = [j for j in range(len(slopes)) if isinstance(weights, jax.Array) or weights[j] != 0]
    return sum((_as(weights[j], slopes) * slopes[j] for j in used[1:]), start=_as(weights[used[0]], slopes) * slopes[used[0]])


def _as(x, like) -> Array:
    """In the precision of the state: time keeps its own."""
    return jnp.asarray(x, like.dtype)


def _stopped_at_once(problem: Problem, start: Progress) -> Progress:
    """A motion that starts beyond an event has no motion at all."""
    beyond = problem.events(start.t, start.y, problem.args) <= 0
    happened = jnp.any(beyond, axis=0)
    code = jnp.where(happened, results.EVENT, start.code).astype(jnp.int32)
    event = jnp.where(happened, jnp.argmax(beyond, axis=0), start.event).astype(jnp.int32)
    return Progress(start.t, start.y, start.h, code, start.accepted, start.rejected, event, event_search.none(start.t), start.unseen)


def _watched(problem: Problem, p: Progress, moved: Progress, h, first_slope, accept) -> Progress:
    """The step from `p` by `h` to `moved`, in which an event may have happened or is being located."""

    def events(t, y):
        return problem.events(t, y, problem.args)

    locating = p.code == LOCATING
    values = events(moved.t, moved.y)
    happened = accept & ~locating & (moved.code == RUNNING) & jnp.any(values <= 0, axis=0)
    event = jnp.where(happened, jnp.argmax(values <= 0, axis=0), p.event).astype(jnp.int32)
    first_values, first_rates = jax.jvp(events, (p.t, p.y), (jnp.ones_like(p.t), first_slope))
    c_0, c_dot_0, c_1 = (_chosen(event, x) for x in (first_values, first_rates, values))
    search = jax.tree.map(lambda new, old: jnp.where(happened, new, old), event_search.begun(p.t, moved.t), p.search)
    search = event_search.advanced(search, h, c_0, c_dot_0, moved.t, c_1)
    # the last, vanishing, shift is along the slope
    found = locating & (search.left == 0)
    t = jnp.where(found, moved.t + search.shift, moved.t)
    y = jax.tree.map(lambda y, f: jnp.where(found, y + _as(search.shift, y) * f, y), moved.y, first_slope)
    code = jnp.where(happened, LOCATING, jnp.where(found, results.EVENT, jnp.where(locating, LOCATING, moved.code))).astype(jnp.int32)
    return Progress(t, y, jnp.where(locating, p.h, moved.h), code, moved.accepted, moved.rejected, event, search, moved.unseen)


def _chosen(index, values: Float[Array, "events *lanes"]) -> Float[Array, "*lanes"]:
    """The value with this index, of the first one where there is none."""
    chosen = values[0]
    for i in range(1, len(values)):
        chosen = jnp.where(index == i, values[i], chosen)
    return chosen
