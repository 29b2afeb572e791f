"""One step of our loop: an explicit Runge-Kutta method with an embedded error estimate, an implicit method, or a step of the search for a stop event.

    k_i = f(t + c_i h, y + h sum_j a_ij k_j),   y_1 = y + h sum b_i k_i,   e = h sum b^err_i k_i
    |e| = rms(e / (atol + rtol max(|y|, |y_1|))) <= 1 accepts;   h <- min(h clip(0.9 |e|^(-1/order), 0.2, 10), longest)

The state is any tree of arrays; in a batch all arrays, times and step sizes among them, have a last axis of lanes, which keeps neighbours in memory
neighbours. A step ends at every time asked for and at every knot of the inputs; the step size found before such a shortened step is remembered. The state
advances by the difference of the times at the ends of a step, as they are after rounding.

Implicit methods (`implicit_steps.py`) give a state, and an error or none. A step whose equations are not solved has an infinite error. Methods of equal steps
cannot try one again: what would refuse it ends the motion with a code of its own. Trials of the search for an event are steps of the method too; its last
shifts, which are tiny, are steps of Tsit5, whose derivatives are those of the motion.

Where rows are about to lose rank, sigma being the sine between a row and those before it, round-off eps of a row is a velocity eps/sigma^2 across it, which
fills the error of short steps. In a step that starts at sigma < 0.1 the stages are put back onto the rows. Its error is the larger of two parts: the error
along the rows, less n^2, and the distance that the projection moves the state, less n. Here n = 16 eps/sigma^2, at most eps^0.4, for the smallest sigma of
the stages; a displacement n across the rows moves the state by n^2 along them. Whether a motion passes thus depends on the position, not on the tolerance.

In single precision the state is summed with compensation (Kahan): what rounding leaves off an increment is added to the next one. Otherwise a state whose
increments are smaller than its last digit stands still while time passes, and no error estimate sees it.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.equations.reductions import SMALLEST_PIVOT
from jourdain_jax.motion.integrators import crossings, event_search
from jourdain_jax.motion.integrators.event_search import LOCATING, RUNNING, OnArrays
from jourdain_jax.motion.integrators.explicit_steps import TSIT5, Method, aimed, judged, taken
from jourdain_jax.motion.integrators.implicit_steps import ImplicitMethod, Solution, even_step
from jourdain_jax.motion.integrators.problem import Problem, as_in
from jourdain_jax.motion.trajectories import results

NOISE = 0.6  # exponent of round-off: its power 0.6 counts as noise anywhere, and no more than its power 0.4
LEAST_SHARE = 0.5  # of the slope of a row nonlinear in the speeds, along what it was: a step in which less is left is tried again
NEAR_SINE, AMPLIFIED = 0.1, 16.0  # below it rows are about to lose rank; the number of round-offs over its square that count as noise


class Progress(eqx.Module):
    """Where a motion is, or each of several lanes."""

    t: Float[Array, "*lanes"]
    y: PyTree
    h: Float[Array, "*lanes"]  # the next step, positive
    code: Int[Array, "*lanes"]  # RUNNING, LOCATING, or the result
    knot: Int[Array, "*lanes"]  # index of the knot ahead
    accepted: Int[Array, "*lanes"]
    rejected: Int[Array, "*lanes"]
    event: Int[Array, "*lanes"]  # index of the event that ended the motion, or -1
    search: Any  # `event_search.Search` for that event; None where there are none
    pivot: Float[Array, "*lanes"]  # smallest magnitude so far of a pivot, at any stage of an accepted step
    rest: PyTree  # what rounding has left off `y`, to be added by the next step; None where that cannot add up to much
    crossings: Any  # `crossings.Crossings` of relations; None where there are none


def begun(problem: Problem, y0: PyTree, t0: Float[Array, "*lanes"], dt0, direction) -> Progress:
    """The start of a motion."""
    start = standing(problem, y0, t0, jnp.minimum(jnp.abs(dt0), problem.longest), direction)
    if problem.events is None:
        return start
    return replace(start, search=event_search.none(t0, problem.events(t0, y0, problem.args)))


def standing(problem: Problem, y: PyTree, t: Float[Array, "*lanes"], h: Float[Array, "*lanes"], direction) -> Progress:
    """Progress at a start: no step is behind, and no event is searched for."""
    zero = jnp.zeros(jnp.shape(t), jnp.int32)
    rest = jax.lax.stop_gradient(jax.tree.map(jnp.zeros_like, y)) if _rounding_adds_up(problem, y) else None
    no_pivot = jax.lax.stop_gradient(jnp.full_like(t, jnp.inf))
    watched = None if problem.relations is None else crossings.begun(problem.relations(problem.args, t, y), direction)
    return Progress(t, y, h, zero + RUNNING, problem.knots_passed(t, direction), zero, zero, zero - 1, None, no_pivot, rest, watched)


def _rounding_adds_up(problem: Problem, y: PyTree) -> bool:
    """Whether what is rounded off in so many steps may add up to more than half of the digits: in float32, not in float64."""
    eps = max(float(jnp.finfo(x.dtype).eps) for x in jax.tree.leaves(y))
    return problem.max_steps * eps > eps**0.5


def running(p: Progress, goal: Float[Array, "*lanes"]) -> Bool[Array, "*lanes"]:
    """Which lanes are on their way to this time."""
    return (p.code == LOCATING) | ((p.code == RUNNING) & (p.t != goal))


def advanced(problem: Problem, method: Method | ImplicitMethod, p: Progress, goal, last_goal, direction) -> Progress:
    """One step, tried by all lanes that are on their way to `goal`; the others stand still."""
    moving = running(p, goal)
    return jax.tree.map(lambda new, old: jnp.where(moving, new, old), _tried(problem, method, p, goal, last_goal, direction), p)


def _tried(problem: Problem, method: Method | ImplicitMethod, p: Progress, goal, last_goal, direction) -> Progress:
    w, events, watches = OnArrays(p.t), problem.events is not None, problem.relations is not None
    known = vars(p) | {"direction": direction, "last_goal": last_goal, "max_steps": problem.max_steps, "longest": problem.longest, "shortest": problem.shortest}
    knot = problem.knot_ahead(p.t, p.knot, direction)
    target = jnp.where((knot - goal) * direction < 0, knot, goal)
    reach = jnp.minimum(p.h, crossings.reach(w, p.crossings, p.t, direction, problem.span)) if watches else p.h
    reach = jnp.minimum(reach, even_step(problem.longest, jnp.abs(target - p.t))) if method.even else reach
    aim = aimed(w, known, target, reach, p.search.shift if events else None)
    t1, h, locating = aim.t_1, aim.h, aim.locating
    if isinstance(method, Method):
        y1, slopes, _, pivots, rank = stages(problem, method, p.t, p.y, h, monitored=True)
        increments = jax.tree.map(lambda k: as_in(h, k) * weighted(method.b, k), slopes)
        error = jax.tree.map(lambda k: as_in(h, k) * weighted(method.b_error, k), slopes)
        ends, solved = [jax.tree.map(lambda k, i=i: k[i], slopes) for i in (0, method.at_the_end)], True
    else:
        (increments, error, solved), ends, pivots = _by_equations(problem, method, p, h)
        rank = None
        y1 = jax.tree.map(jnp.add, p.y, increments)
    rest = p.rest
    if rest is not None:
        y1, rest = _compensated(p.y, rest, increments)
    fault = jnp.where(solved, RUNNING, results.UNSOLVED_STEP)  # of a step that cannot be tried again
    if problem.project is not None:
        free, y1 = y1, problem.project(t1, y1, problem.args)
        # the projection removes what the error estimate does not see; it must be no larger than an error
        if error is None:
            fault = jnp.where(solved & (_relative(free, p.y, y1) > results.MOST_PROJECTED), results.OFF_CONSTRAINTS, fault)
        else:
            error = _beside_rows(problem, rank, t1, y1, free, error)
    size_of_error = jnp.zeros_like(p.t)
    if error is not None:
        scale = jax.tree.map(lambda a, b: problem.atol + problem.rtol * jnp.maximum(jnp.abs(a), jnp.abs(b)), p.y, y1)
        size_of_error = problem.norm(jax.lax.stop_gradient(jax.tree.map(lambda e, s: e / s, error, scale)))
    if pivots is not None:
        # a step in which a pivot changes its sign passes over a singularity, which no error estimate need notice
        fault = jnp.where(solved & pivots.changed_sign, results.SINGULAR_PARTITION, fault)
    size_of_error = jnp.where((fault != RUNNING) & ~locating, jnp.inf, size_of_error)
    accept, next_h = judged(w, jnp.power, known, aim, size_of_error, method.order)
    if watches:
        fits = accept & ~locating & (not method.even)
        watched = _watched(w, problem, p, (t1, y1), fits, h)
        accept, next_h = accept & ~watched.refused, jnp.where(watched.refused, jnp.where(watched.falls, watched.to_event, p.h), next_h)
    new = taken(w, known, aim, accept, next_h)
    y = jax.tree.map(lambda new, old: jnp.where(accept, as_in(new, old), old), y1, p.y)
    rest = jax.tree.map(lambda new, old: jnp.where(accept & ~locating, new, old), rest, p.rest)
    moved = _with(replace(p, y=y, rest=rest, knot=p.knot + (accept & ~locating & (t1 == knot))), new)
    if events:
        moved = _monitored(w, problem, known, moved, h, ends, accept & ~locating & (moved.code == RUNNING))
    if not isinstance(method, Method):
        fails = ~accept if method.even else locating & (fault == results.UNSOLVED_STEP)
        moved = _with(moved, {"code": jnp.where(fails, fault, moved.code)})
    # what lies beyond an event does not count
    counts = accept & ~locating & (moved.code == RUNNING) & (moved.t == t1)
    if watches:
        noted = crossings.noted(w, p.crossings, watched, t1, direction, counts | (locating & (moved.code == results.EVENT)))
        moved = replace(moved, crossings=noted._replace(last=jnp.stack(noted.last), count=noted.count.astype(jnp.int32)))
    if pivots is None:
        return moved
    pivot = jnp.where(counts, jnp.minimum(p.pivot, pivots.smallest), p.pivot)
    return _with(moved, {"pivot": pivot, "code": jnp.where(counts & (pivot < SMALLEST_PIVOT), results.SINGULAR_PARTITION, moved.code)})


def _with(p: Progress, new: Mapping) -> Progress:
    """Return the progress with new numbers, whole ones as such; the next step has no derivative."""
    whole = {name: jnp.asarray(new[name], jnp.int32) for name in ("code", "accepted", "rejected", "event") if name in new}
    return replace(p, **(dict(new) | whole | ({"h": jax.lax.stop_gradient(new["h"])} if "h" in new else {})))


def _watched(w: OnArrays, problem: Problem, p: Progress, end: tuple, fits, h) -> crossings.Watched:
    """Return what a step to its `end` (t, y) crosses; `fits`: it would be accepted."""

    def between(once, share, now):
        state = jax.tree.map(lambda a, b: a + jnp.where(once, share, 0.0).astype(a.dtype) * (b - a), (p.t, p.y), end)
        there = lambda: jnp.stack(crossings.unless_zero(w, problem.relations(problem.args, *state), now))  # noqa: E731
        return jax.lax.cond(eqxi.unvmap_any(once), there, lambda: jnp.stack(now))

    values = problem.relations(problem.args, *end)
    return jax.lax.stop_gradient(crossings.watched(w, p.crossings, values, problem.relation_count, between, fits, h, problem.span))


def _by_equations(problem: Problem, method: ImplicitMethod, p: Progress, h) -> tuple[Solution, list[PyTree], "Pivots | None"]:
    """Take a step from `p` by an implicit method; return also slopes at both ends where events need them, and pivots, where there are any."""
    inside = problem.in_step(p.t, h)
    found = method.solve(inside, p.t, p.y, h)
    if p.search is not None:
        shifts = (p.code == LOCATING) & ~p.search.trying
        near = jax.tree.map(jnp.subtract, stages(problem, TSIT5, p.t, p.y, h).y_1, p.y)
        found = found._replace(change=jax.tree.map(lambda a, b: jnp.where(shifts, a, b), near, found.change), solved=found.solved | shifts)
    monitored = problem.rates_and_pivots is not None
    if not monitored and p.search is None:
        return found, [], None
    end = p.t + h, jax.tree.map(jnp.add, p.y, found.change)
    states = jax.tree.map(lambda a, b: jnp.stack([a, (a + b) / 2, b]), (p.t, p.y), end)
    watch = _watching(problem, monitored)
    slopes, seen, directions, _ = jax.lax.map(lambda at: tuple(watch(*at, inside.args)), states)
    ends = [jax.tree.map(lambda k, y, i=i: as_in(k[i], y), slopes, p.y) for i in (0, 2)]
    return found, ends, _pivots(seen, directions) if monitored else None


def _relative(free: PyTree, y_0: PyTree, y_1: PyTree) -> Float[Array, ""]:
    """Return how far a projection moved a state from `free` to `y_1`, relative to the change from `y_0`: the largest ratio of any part of the state."""
    ratios = []
    for given, before, after in zip(*map(jax.tree.leaves, (free, y_0, y_1)), strict=True):
        # 1e-6 of the size of the state: a step that changes less counts as one that changes so much
        change = jnp.max(jnp.abs(after - before), initial=0.0) + 1e-6 * (1 + jnp.max(jnp.abs(after), initial=0.0))
        ratios.append(jnp.max(jnp.abs(after - given), initial=0.0) / change)
    return jax.lax.stop_gradient(jnp.max(jnp.stack(ratios)))


def _compensated(y: PyTree, rest: PyTree, increments: PyTree) -> tuple[PyTree, PyTree]:
    """`y + increments`, and what rounding leaves off; `rest`: what it left off before."""
    whole = jax.tree.map(lambda k, r: k + r, increments, rest)
    y_1 = jax.tree.map(jnp.add, y, whole)
    return y_1, jax.lax.stop_gradient(jax.tree.map(lambda k, new, old: k - (new - old), whole, y_1, y))


class Rank(NamedTuple):
    """How near to a loss of rank the rows are in a step."""

    near: Bool[Array, "*lanes"]  # at its start
    sine: Float[Array, "*lanes"]  # the smallest between a row and those before it, of all stages


def onto_rows(problem: Problem, near: Bool[Array, "*lanes"], t, y: PyTree) -> PyTree:
    """Return the state of a stage, put back onto the rows in lanes that are `near` a loss of rank."""

    def put():
        return jax.tree.map(lambda new, old: jnp.where(near, new, old), problem.project(t, y, problem.args), y)

    return jax.lax.cond(eqxi.unvmap_any(near), put, lambda: y)


def _beside_rows(problem: Problem, rank: Rank | None, t, projected: PyTree, free: PyTree, error: PyTree) -> PyTree:
    """Return the error of a step beside rows: no smaller than how far the projection moved the state beyond noise."""
    lane_axes = jnp.ndim(t)
    projected, free, error, args = jax.lax.stop_gradient((projected, free, error, problem.args))
    amplified = 0.0
    if rank is not None:
        amplified = jnp.where(rank.near, AMPLIFIED / rank.sine**2, 0.0)

        def along_rows():
            along = jax.jvp(lambda y: problem.project(t, y, args), (projected,), (error,))[1]
            return jax.tree.map(lambda new, old: jnp.where(rank.near, new, old), along, error)

        error = jax.lax.cond(eqxi.unvmap_any(rank.near), along_rows, lambda: error)

    def size(y, y_free, e):
        eps, largest = jnp.finfo(y.dtype).eps, jnp.max(jnp.abs(y), axis=tuple(range(y.ndim - lane_axes)), initial=0.0)
        noise = jnp.minimum(amplified * eps, eps ** (1 - NOISE))
        return jnp.maximum(jnp.abs(e) - noise**2 * largest, jnp.maximum(jnp.abs(y - y_free) - jnp.maximum(eps**NOISE, noise) * largest, 0.0))

    return jax.tree.map(size, projected, free, error)


class Pivots(eqx.Module):
    """What the pivots were at the stages of a step."""

    smallest: Float[Array, "*lanes"]  # magnitude
    changed_sign: Bool[Array, "*lanes"]  # whether any did, or a row turned round


class Stages(NamedTuple):
    """The stages of one step; `slopes` and `states` have a leading axis of stages."""

    y_1: PyTree
    slopes: PyTree
    states: PyTree
    pivots: Pivots | None
    rank: Rank | None


def stages(problem: Problem, method: Method, t, y: PyTree, h, monitored: bool = False) -> Stages:
    """y_1; the slopes of all stages, and the states at which they were taken; what the pivots were, where they are `monitored`."""
    leaves, treedef = jax.tree.flatten(y)
    problem = problem.in_step(t, h)
    monitored = monitored and problem.rates_and_pivots is not None
    watch = _watching(problem, monitored or problem.near_rank_loss)

    def stage(carried, row):
        # k_i = f(y_i), then the next y_i: what is carried from stage to stage is computed once, whatever uses it
        at, slopes, rank = carried
        c, i, next_A = row
        time, there = t + c * h, treedef.unflatten(at)
        if rank is not None:
            there = onto_rows(problem, rank.near, time, there)
        found, *watched, sine = watch(time, there, problem.args)
        if rank is not None:
            sine = jax.lax.stop_gradient(sine)
            rank = Rank(jnp.where(i == 0, sine < NEAR_SINE, rank.near), jnp.fmin(rank.sine, sine))
        found = jax.tree.leaves(found)
        slopes = [jax.lax.dynamic_update_index_in_dim(k, as_in(f, k), i, 0) for k, f in zip(slopes, found, strict=True)]
        watched = watched if monitored else None
        return ([y + as_in(h, y) * weighted(next_A, k) for y, k in zip(leaves, slopes, strict=True)], slopes, rank), (at, watched)

    count = method.needed
    rows = (jnp.asarray(method.c[:count]), jnp.arange(count), jnp.asarray([*method.A[1:count], method.b]))
    slopes = [jnp.zeros((len(method.c), *y.shape), y.dtype) for y in leaves]
    rank = Rank(jnp.zeros(jnp.shape(t), bool), jnp.full(jnp.shape(t), jnp.inf, leaves[0].dtype)) if problem.near_rank_loss else None
    (y_1, slopes, rank), (at, watched) = jax.lax.scan(stage, (leaves, slopes, rank), rows)
    return Stages(treedef.unflatten(y_1), treedef.unflatten(slopes), treedef.unflatten(at), _pivots(*watched) if monitored else None, rank)


def _watching(problem: Problem, monitored: bool):
    """Return what rates are taken by: with what is watched where they are `monitored`, otherwise alone."""
    return problem.rates_and_pivots if monitored else lambda *given: (problem.rates(*given), None, None, None)


def _pivots(seen: Float[Array, "stages pivots *lanes"], directions: Float[Array, "stages rows speeds *lanes"]) -> Pivots:
    lowest, highest = jnp.min(seen, axis=0), jnp.max(seen, axis=0)
    along = jnp.sum(directions[0] * directions, axis=2)  # of those at the start
    turned = ~jnp.all(along > LEAST_SHARE * along[0], axis=(0, 1))
    return Pivots(jnp.min(jnp.minimum(jnp.abs(lowest), jnp.abs(highest)), axis=0, initial=jnp.inf), jnp.any((lowest < 0) & (highest > 0), axis=0) | turned)


def weighted(weights, slopes: Float[Array, "stages *shape"]) -> Float[Array, "*shape"]:
    """sum_j w_j k_j, element by element."""
    used = [j for j in range(len(slopes)) if isinstance(weights, jax.Array) or weights[j] != 0]
    return sum((as_in(weights[j], slopes) * slopes[j] for j in used[1:]), start=as_in(weights[used[0]], slopes) * slopes[used[0]])


def _monitored(w: OnArrays, problem: Problem, known: Mapping, moved: Progress, h, slopes, accept) -> Progress:
    """Return what becomes of a step by `h` to `moved` in which an event may have happened or is being located; `known`: the progress before it.

    `slopes`: at its ends; `accept`: it is a step of the motion.
    """
    t, y, so_far = known["t"], known["y"], known["search"]
    one, (first_slope, last_slope) = jnp.ones_like(t), slopes

    def events(t, y):
        return problem.events(t, y, problem.args)

    c_0, rate_0 = map(tuple, jax.jvp(events, (t, y), (one, first_slope)))
    c_1, rate_1 = map(tuple, jax.jvp(events, (moved.t, moved.y), (one, jax.lax.stop_gradient(last_slope))))

    def advance(begins, changes):
        def changed():
            new, first = event_search.advanced_arrays(w, so_far, begins, (t, c_0, rate_0), (moved.t, c_1))
            new = jax.tree.map(lambda new, old: jnp.where(changes, new, old), new, so_far)
            return new, jnp.broadcast_to(jnp.asarray(first, t.dtype), t.shape)

        return jax.lax.cond(eqxi.unvmap_any(changes), changed, lambda: (so_far, jnp.zeros_like(t)))

    numbers = [jnp.all(jnp.isfinite(x), axis=tuple(range(x.ndim - t.ndim))) for x in jax.tree.leaves(y)]
    sound = jnp.all(jnp.stack(numbers), axis=0)
    ends = jax.lax.stop_gradient((c_0, rate_0, c_1, rate_1))
    found = event_search.decided(w, known, vars(moved), h, ends, accept, sound, (so_far, advance))

    def state(after, before, slope):
        return jnp.where(found.found, after + as_in(found.search.shift, after) * slope, jnp.where(found.stays, before, after))

    y = jax.tree.map(state, moved.y, y, first_slope)
    knot, rest = jax.tree.map(lambda old, new: jnp.where(found.undone, old, new), (known["knot"], known["rest"]), (moved.knot, moved.rest))
    return _with(replace(moved, y=y, knot=knot, rest=rest, search=found.search), found.new)
