"""Reverse mode of our loop: the steps that a motion took are recorded, and gone back over.

    y_(i+1) = step(t_i, t_(i+1), y_i, args)       g_i = (dstep/dy_i)' g_(i+1),   g_args += (dstep/dargs)' g_(i+1)

The times t_i are data: step-size control, rejected steps and error estimates are no part of it. Only times that were asked for, knots, the first time, and
the time of an event have cotangents. The search for an event is no part of it either: from the last state before the event one step leads to it, and what lies
beyond, where derivatives may not exist, is never met.

Memory holds a window of steps with their states; when it is full, the state and step size there are kept and the next window begins. Going back, the
last window is there already. An earlier one is integrated again, from the state at its beginning to end exactly where the next begins: whatever steps
round-off makes it take then, they are steps of the motion. Where that does not succeed, or there were more windows than memory allows, the derivative
is NaN. What lanes in lockstep have in common, numbers of steps and windows, stays common under `vmap`; how many goals
they have reached differs.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from jourdain_jax.calculus.reals import with_usual_promotion
from jourdain_jax.motion.integrators import step_adjoint
from jourdain_jax.motion.integrators.erk_step import Progress
from jourdain_jax.motion.integrators.event_search import LOCATING, MOST_STEPS, OnArrays, chosen, is_flat
from jourdain_jax.motion.integrators.explicit_steps import Method
from jourdain_jax.motion.integrators.implicit_steps import ImplicitMethod
from jourdain_jax.motion.integrators.problem import Problem, in_lanes
from jourdain_jax.motion.trajectories import results

STEPS_ALONE, STEPS_TOGETHER = 2048, 512  # of a window: for one motion, for lanes in lockstep
SPARE = 4  # this part of a window is left free, for the steps that it takes when it is integrated again
_SHARES = 32, 4  # these parts of the memory take a window and the beginnings of all, at most where lanes are many,
_FEWEST = 16, 256  # but so many steps and windows


class _Window(eqx.Module):
    """States in a row, and how many goals were reached until each."""

    t: Float[Array, "states *lanes"]
    y: PyTree
    goal: Int[Array, "states *lanes"]
    last: Int[Array, ""]  # number of the last state

    def added(self, p: "Progress | _Beginnings", goal, restart=False) -> "_Window":
        """The window with the state after a try of a step, which is a new one where time has passed for any lane; the first one at a `restart`."""
        i = jnp.where(restart, 0, self.last + self.passed(p)).astype(jnp.int32)
        t, y, goals = _put((self.t, self.y, self.goal), i, (p.t, p.y, goal))
        return _Window(t, y, goals, i)

    def passed(self, p: "Progress | _Beginnings") -> Bool[Array, ""]:
        """Whether time has passed since the last state."""
        return eqxi.unvmap_any(p.t != _at(self.t, self.last))


class _Beginnings(eqx.Module):
    """Where a window begins, or all do; then one more place than there are windows takes what is not kept."""

    t: Float[Array, "..."]
    y: PyTree
    h: Float[Array, "..."]
    goal: Int[Array, "..."]


class _Record(eqx.Module):
    """The last window, its number, and where all windows begin."""

    window: _Window
    beginnings: _Beginnings
    number: Int[Array, ""]


class _Cotangents(eqx.Module):
    """Cotangents of a state, of its time, and of what all steps share."""

    t: Float[Array, "*lanes"]
    y: PyTree
    shared: PyTree  # rates, projection, args
    goals: Float[Array, "times *lanes"]
    knots: Float[Array, "knots *lanes"] | None


def motion(forward: Callable, problem: Problem, method: Method | ImplicitMethod, y0: PyTree, t0, goals, dt0):
    """`forward` of the other arguments; in reverse mode it has derivatives with respect to `y0`, `t0`, `goals` and all that the functions of `problem` read."""
    like = (t0, y0, problem.args)
    rates, project, events = (f if f is None else eqx.filter_closure_convert(f, *like) for f in (problem.rates, problem.project, problem.events))
    moving = (rates, project, problem.args), events, problem.knots, y0, t0, goals
    fixed = eqx.tree_at(_moving, problem, [None] * 5, is_leaf=lambda x: x is None), jnp.asarray(dt0)
    return _motion(moving, jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, fixed), forward, method)


def _moving(problem: Problem) -> list:
    return [problem.rates, problem.project, problem.args, problem.events, problem.knots]


def _problem(moving, control) -> Problem:
    functions, events, knots, *_ = moving
    return eqx.tree_at(_moving, control[0], [*functions, events, knots], is_leaf=lambda x: x is None)


@eqx.filter_custom_vjp
def _motion(moving, control, forward, method):
    *_, y0, t0, goals = moving
    ys, reached, end, _ = forward(_problem(moving, control), method, y0, t0, goals, control[1])
    return ys, reached, replace(end, search=None)


@_motion.def_fwd
@with_usual_promotion
def _recorded(perturbed, moving, control, forward, method):
    *_, y0, t0, goals = moving
    problem = _problem(moving, control)

    def noted(carry, p, goal):
        kept, record = carry
        # lanes that are searching for an event are still at the last state before it
        t, y = _where(p.code == LOCATING, (kept.t, kept.y), (p.t, p.y))
        kept, window = replace(p, t=t, y=y), record.window
        ended = window.last + window.passed(kept) == len(window.t) - 1 - len(window.t) // SPARE
        spare = len(record.beginnings.t) - 1
        number = jnp.minimum(record.number + ended, spare)
        beginnings = _put(record.beginnings, jnp.where(ended, number, spare), _Beginnings(t, y, p.h, goal))
        return kept, _Record(window.added(kept, goal, restart=ended), beginnings, number)

    begin = partial(_begun, problem)
    ys, reached, end, (_, record) = forward(problem, method, y0, t0, goals, control[1], begin, noted)
    slope = None if end.search is None else chosen(OnArrays(end.t), end.event, end.search.slope)
    end = replace(end, search=None)
    return (ys, reached, end), (record, end, slope)


@_motion.def_bwd
@with_usual_promotion
def _vjp(residuals, cotangents, perturbed, moving, control, forward, method):
    record, end, slope = residuals
    shared, events, knots, y0, t0, goals = moving
    problem, direction = _problem(moving, control), jnp.sign(goals[-1] - t0)
    g_ys, _, g_end = cotangents
    g_ys, g_t, g_y = (_filled(g, x) for g, x in ((g_ys, _room(len(goals), y0)), (g_end.t, end.t), (g_end.y, end.y)))
    # from the end on, all goals have the state there
    behind = (goals - end.t) * direction < 0
    g_y = jax.tree.map(lambda y, g: y + jnp.sum(_on_states(~behind, g), axis=0), g_y, g_ys)
    g_ys = jax.tree.map(partial(_on_states, behind), g_ys)
    differentiable, fixed = eqx.partition(shared, perturbed[0])
    by_events, fixed_events = eqx.partition(events, perturbed[1])
    g_events = jax.tree.map(jnp.zeros_like, by_events)
    g = _Cotangents(g_t, g_y, jax.tree.map(jnp.zeros_like, differentiable), jnp.zeros_like(goals), None if knots is None else jnp.zeros_like(knots))
    located = (end.code == results.EVENT) & (end.accepted > 0)
    if events is not None:
        g, g_events = _back_from_event(end, located, slope, g, (differentiable, by_events), (fixed, fixed_events))

    def problem_of(differentiable):
        rates, project, args = eqx.combine(differentiable, fixed)
        return replace(problem, rates=rates, project=project, args=args)

    def past_goals(g: _Cotangents, first, count) -> _Cotangents:
        """Cotangents at a state where the goals number `first` to `count - 1` were reached."""

        def add(carry):
            y, k = carry
            y = jax.tree.map(lambda y, g: y + jnp.where(k > first, in_lanes(g, k - 1), 0), y, g_ys)
            return y, k - 1

        some = lambda carry: eqxi.unvmap_any(carry[1] > first)  # noqa: E731
        return replace(g, y=jax.lax.while_loop(some, add, (g.y, count))[0])

    def step_back(carry):
        i, window, g = carry
        t_0, y, k = _at((window.t, window.y, window.goal), i - 1)
        t_1, count = _at((window.t, window.goal), i)
        g = past_goals(g, k, count)
        idle = t_0 == t_1
        moving = jax.tree.map(lambda y: jnp.where(idle, 0.0, y), g.y)
        gone = step_adjoint.step_vjp(problem_of, differentiable, method, t_0, t_1, y, moving)
        at_end = jnp.where(idle, g.t, g.t + gone.t_1)
        # the end of a step is a number, but where it is a time that was asked for, or a knot
        not_event = ~(located & (t_1 == end.t))
        asked = (t_1 == in_lanes(goals, k)) & not_event
        by_goals = _added(g.goals, k, jnp.where(asked, at_end, 0))
        t, by_knots = jnp.where(idle, jnp.where(asked, 0, at_end), gone.t_0), g.knots
        if by_knots is not None:
            last = jnp.maximum(problem.knots_passed(t_1, direction) - 1, 0)
            at_knot = (in_lanes(knots, last) == t_1) & not_event & ~asked & ~idle
            by_knots = _added(by_knots, last, jnp.where(at_knot, at_end, 0))
        return i - 1, window, _Cotangents(t, _where(idle, g.y, gone.y), jax.tree.map(jnp.add, g.shared, gone.shared), by_goals, by_knots)

    def window_back(carry):
        number, window, g = carry
        _, _, g = jax.lax.while_loop(lambda carry: carry[0] > 0, step_back, (window.last, window, g))
        # the window before, if there is one, to where this one begins
        first, until = _at(record.beginnings, jnp.maximum(number - 1, 0)), _at(record.beginnings, number)
        ahead = jnp.where((goals - until.t) * direction > 0, until.t, goals)
        begin = lambda *_: window.added(first, first.goal, restart=True)  # noqa: E731
        noted = lambda window, p, k: window.added(p, jnp.minimum(k, until.goal))  # noqa: E731
        without = replace(problem, events=None)
        *_, p, window = forward(without, method, first.y, first.t, ahead, first.h, begin, noted)
        arrived = (p.t == until.t) & (window.last < len(window.t))
        return number - 1, window, replace(g, y=jax.tree.map(lambda y: jnp.where(arrived, y, jnp.nan), g.y))

    lost = record.number == len(record.beginnings.t) - 1
    g = replace(g, y=jax.tree.map(lambda y: jnp.where(lost, jnp.nan, y), g.y))
    number = jnp.where(lost, 0, record.number)
    _, _, g = jax.lax.while_loop(lambda carry: carry[0] >= 0, window_back, (number, record.window, g))
    g = past_goals(g, jnp.zeros_like(end.accepted), record.beginnings.goal[0])
    return g.shared, g_events, g.knots, g.y, g.t, g.goals


def _back_from_event(end: Progress, located, slope, g: _Cotangents, differentiable, fixed) -> tuple[_Cotangents, PyTree]:
    """Cotangents of the state at the event at a number for a time, and of the functions of events.

    t = t_e - c(t_e, y)/cdot,   y_e = y - f c(t_e, y)/cdot      zero in value, t_e a number;  NaN where c has no slope there
    """
    (rates, _, args), events = eqx.combine(differentiable, fixed)
    w, f = OnArrays(end.t), rates(end.t, end.y, args)
    _, rate = jax.jvp(lambda t, y: chosen(w, end.event, events(t, y, args)), (end.t, end.y), (jnp.ones_like(end.t), f))
    usable = located & (rate != 0) & jnp.isfinite(rate)
    asked = g.t + step_adjoint.product(g.y, f, end.t.ndim)
    by_value = jnp.where(usable, -asked / jnp.where(usable, rate, 1.0), 0.0)
    flat = located & is_flat(w, rate, slope)
    by_value = jnp.where(flat & (asked != 0), jnp.nan, by_value)

    def value(y, differentiable):
        (_, _, args), events = eqx.combine(differentiable, fixed)
        return chosen(w, end.event, events(end.t, y, args))

    _, pull = jax.vjp(value, end.y, differentiable)
    by_y, (by_shared, by_events) = pull(jnp.asarray(by_value, rate.dtype))
    y = jax.tree.map(lambda y, more: y + jnp.where(located, more, 0), g.y, by_y)
    return replace(g, t=jnp.where(located, 0, g.t), y=y, shared=jax.tree.map(jnp.add, g.shared, by_shared)), by_events


def _begun(problem: Problem, start: Progress, goal: Int[Array, "*lanes"]) -> tuple[Progress, _Record]:
    """The start, and a record with it as its only state; `goal`: how many were reached there."""
    state = start.t, start.y, goal
    state_bytes = sum(x.nbytes for x in jax.tree.leaves(state))
    fitting = [problem.memory // (share * state_bytes) for share in _SHARES]
    most = problem.max_steps + MOST_STEPS
    length = max(_FEWEST[0], min(STEPS_TOGETHER if start.t.ndim else STEPS_ALONE, fitting[0], most + 2))
    windows = -(-most // (length - length // SPARE)) + 1
    windows = min(windows, max(_FEWEST[1], fitting[1]))

    zero = jnp.zeros((), jnp.int32)
    t, y, goals = _room(length, state)
    window = _Window(t, y, goals, zero).added(start, goal, restart=True)
    beginning = _Beginnings(start.t, start.y, start.h, goal)
    return start, _Record(window, _put(_room(windows + 1, beginning), zero, beginning), zero)


def _at(tree, i):
    return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, i, keepdims=False), tree)


def _put(tree, i, values):
    return jax.tree.map(lambda x, value: jax.lax.dynamic_update_index_in_dim(x, jnp.asarray(value, x.dtype), i, 0), tree, values)


def _added(x, k, more):
    """x with more at its number k, which each lane has."""
    return x + jax.vmap(lambda i: jnp.where(i == k, more, 0))(jnp.arange(len(x)))


def _on_states(chosen: Bool[Array, "times *lanes"], x: Float[Array, "times *shape"]):
    """x of those that are chosen, zero elsewhere."""
    return jax.vmap(jnp.where, (0, 0, None))(chosen, x, 0.0)


def _where(chosen, a, b):
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), a, b)


def _room(count: int, tree):
    """Zeros for so many of these."""
    return jax.tree.map(lambda x: jnp.zeros((count, *jnp.shape(x)), jnp.result_type(x)), tree)


def _filled(cotangents, like):
    """Zeros in place of what is missing."""
    return jax.tree.map(lambda x, g: jnp.zeros(x.shape, x.dtype) if g is None else g, like, cotangents)
