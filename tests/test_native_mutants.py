"""Deliberate errors of one line in what writes machine code: each must be caught by a check that passes
without it.

The checks know closed forms alone, of a bead on a spring that a growing force pushes, x'' = t - k x, and of
beads at constant speed; and differences.
"""

import functools

import jax
import jax.numpy as jnp
import machine_code
import numpy as np
import pytest
import result_codes as results
from derivatives import with_value
from numpy.testing import assert_allclose
from slopes import slope
from small_scenes import OnLine, OnPlane
from test_mutants import Mutant

import jourdain_jax as jj
from jourdain_jax.integrate import constraint_projection, event_search
from jourdain_jax.integrate.loop import (
    adjoint,
    event_adjoint,
    loop,
    loop_function,
    native_motion,
    projection_kernel,
    rate_functions,
    step,
    transitions,
)
from jourdain_jax.motion import integration
from jourdain_jax.motion.simulate import set_up

pytestmark = machine_code.needed
CLOSE = {"rtol": 0.0, "atol": 1e-8}


class Pushed(OnLine):
    """m x'' = t - k x; it stops at the level."""

    k: float = jj.parameter(4.0)
    level: float = jj.parameter(-0.1)

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=motion.t - self.k * motion.q.x)

    def events(self, motion):
        return {"low": motion.q.x - self.level}


class Round(OnPlane):
    """A bead on a circle of this radius, in coordinates of the plane."""

    radius: float = jj.parameter(1.0)

    def geometric_constraints(self, pose):
        return {"circle": pose.q.x**2 + pose.q.y**2 - self.radius**2}


class Dips(OnLine):
    """A bead at constant speed, and an event for a hundredth of a metre."""

    def events(self, motion):
        return {"dip": (motion.q.x - 0.52) ** 2 - 1e-4}


class Moving(OnLine):
    """A bead that a moving wall throws back, and that a force pulls afterwards."""

    kept: float = jj.parameter(0.8)
    pull: float = jj.parameter(0.5)
    level: float = jj.parameter(0.4)
    modes = jj.modes(bead=("goes", "comes"))

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=self.pull * motion.modes.bead)

    def events(self, motion):
        after = {"x_rate": -self.kept * motion.u.x_rate + 0.1 * motion.t}
        return {"wall": jj.Event(self.level + 0.05 * motion.t - motion.q.x, to={"bead": "comes"}, jump=after)}


class Strip(OnLine):
    """A bead that is braked within `width` of 0.7 m."""

    width: float = jj.parameter(0.02)

    def loads(self, motion):
        return jj.generalized_force(
            motion, x_rate=jnp.where(jnp.abs(motion.q.x - 0.7) < self.width, -3.0, 0.0)
        )

    def events(self, motion):
        return {"window": jnp.abs(motion.q.x - 1.2) - self.width + 0.02}


class Dry(OnLine):
    """A bead that dry friction stops."""

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=-jnp.sign(motion.u.x_rate))


def pushed_position(t, x, v, k):
    """x(t) where x(0) = x and x'(0) = v."""
    w = jnp.sqrt(k)
    return x * jnp.cos(w * t) + (v - 1 / k) / w * jnp.sin(w * t) + t / k


TIMES = np.array([0.2, 0.5, 0.55, 1.3, 1.9])
START = {"x": 0.7, "v": 0.4, "k": 4.0}


def motion(scene, values, *, first=None, **options):
    """What machine code returns of a motion, and its start as a state."""
    setup = jax.tree.map(
        lambda x: x if isinstance(x, bool) else jnp.asarray(x), set_up(scene, values, work=False, **options)
    )
    assert not setup.reason_against_machine_code, setup.reason_against_machine_code
    setup = setup if first is None else setup._replace(dt0=jnp.asarray(first) * jnp.sign(setup.t1 - setup.t0))
    return setup.integrator.solved(setup, integration._begin(setup, setup.timely))


def pushed(x, v, k, level=-0.1, events=False, **options):
    options = {"ts": TIMES, "rtol": 1e-10, "atol": 1e-10, "first": 1.0, "max_step": jnp.inf} | options
    return motion(Pushed(k, level), {"x": x, "x_rate": v}, events=events, **options)


def motions_follow_the_closed_form():
    found = jax.jit(lambda: pushed(**START))()
    assert_allclose(found.ys.q[:, 0], pushed_position(TIMES, **START), **CLOSE, err_msg="closed form")
    assert int(found.rejected) > 0, "no step was rejected, as this check needs it"
    assert int(found.accepted + found.rejected) < 30, (
        f"{found.accepted} and {found.rejected} steps: too many for the order"
    )


def lanes_of_a_batch_follow_their_own():
    x = jnp.linspace(0.1, 1.0, 21)
    spans = jnp.linspace(1.0, 0.5, 21)  # the first lanes end last
    found = jax.jit(jax.vmap(lambda x, span: pushed(**START | {"x": x}, ts=TIMES * span)))(x, spans)
    expected = jax.vmap(lambda x, span: pushed_position(TIMES * span, **START | {"x": x}))(x, spans)
    assert_allclose(found.ys.q[..., 0], expected, **CLOSE, err_msg="lanes")


def an_event_is_found():
    found = jax.jit(lambda: pushed(**START, events=True))()
    assert found.code == results.EVENT, "the event was passed over"
    assert abs(pushed_position(found.t_end, **START) + 0.1) < 1e-9, "time of the event"
    assert_allclose(found.y_end.q[0], -0.1, **CLOSE, err_msg="state of the event")


def an_event_within_a_step_is_found():
    found = jax.jit(
        lambda: motion(Dips(), {"x": 0.0, "x_rate": 1.0}, ts=[2.0], first=1.0, max_step=jnp.inf)
    )()
    assert found.code == results.EVENT, "the event was passed over"
    assert abs(found.t_end - 0.51) < 1e-9, "time of the event"


def steps_are_no_longer_than_allowed():
    found = jax.jit(lambda: motion(Dips(), {"x": 0.0, "x_rate": -1.0}, ts=[2.0], first=1.0, max_step=0.25))()
    assert found.accepted == 8, "the longest step"


def series_are_no_longer_than_allowed():
    found = jax.jit(
        lambda: motion(Dips(), {"x": 0.0, "x_rate": -1.0}, ts=[2.0], solver=jj.Taylor(), max_step=0.25)
    )()
    assert found.accepted == 8, "the longest step"


def strip(width, **options):
    options = {"ts": [2.0], "rtol": 1e-6, "atol": 1e-6, "max_steps": 400} | options
    return jax.jit(lambda: motion(Strip(width), {"x": 0.0, "x_rate": 1.0}, **options))()


def a_motion_leaves_an_event_at_which_it_starts():
    rising = jax.jit(lambda: motion(Pushed(4.0, 0.7), {"x": 0.7, "x_rate": 5.0}, ts=TIMES))()
    assert rising.code == results.EVENT, "leaves"
    assert 0.5 < rising.t_end < 1.5, "leaves"
    assert (
        float(jax.jit(lambda: motion(Pushed(4.0, 0.7), {"x": 0.7, "x_rate": -5.0}, ts=TIMES))().t_end) == 0.0
    ), "leaves"


def a_strip_is_met():
    found, v = strip(0.004, events=False), np.sqrt(1 - 6 * 0.008)
    assert found.crossings == 3, "crossings"
    assert_allclose(found.y_end.q, 0.704 + v * (2 - 0.696 - (1 - v) / 3), atol=1e-12, err_msg="strip")
    assert int(found.accepted + found.rejected) < 60, "too many steps"


def a_motion_below_an_event_has_none():
    below = jax.jit(lambda: motion(Pushed(4.0, 0.7), {"x": 0.699, "x_rate": 5.0}, ts=TIMES, first=0.01))()
    assert float(below.t_end) == 0.0, "starts below"


def friction_at_rest_sticks():
    found = jax.jit(lambda: motion(Dry(), {"x": 0.0, "x_rate": 1.0}, ts=[2.0]))()
    assert found.code == results.STICKS, "sticks"


def an_event_where_a_relation_changes_is_found():
    found = strip(0.02 + 1e-5)
    assert found.code == results.EVENT, "the event was passed over"
    assert abs(found.y_end.q[0] - 1.2 + 1e-5) < 1e-9, "place of the event"


def a_bead_stays_on_its_circle():
    found = jax.jit(
        lambda: motion(
            Round(), {"x": 1.0, "y": 0.0, "y_rate": 2.0}, ts=TIMES, rtol=1e-4, atol=1e-4, first=0.1
        )
    )()
    assert_allclose(jnp.sum(found.ys.q**2, axis=1), 1.0, atol=1e-13, err_msg="circle")
    assert int(found.accepted) < 60, "too many steps"


def a_start_is_put_onto_its_rows():
    scene = Round()
    usual = constraint_projection.usual_sizes(scene, False, True)
    assert usual.program is not None
    t, q, u = jnp.zeros(()), jnp.array([0.9, 0.7]), jnp.array([0.3, 1.1])
    q_near, _ = jax.jit(lambda q: constraint_projection.put_positions(scene, t, q, jnp.ones(2, bool), usual))(
        q
    )
    assert_allclose(q_near, q / jnp.linalg.norm(q), rtol=0, atol=1e-14, err_msg="coordinates")
    u_near, _ = jax.jit(
        lambda u: constraint_projection.put_speeds(
            scene, t, q_near, u, jnp.zeros(0), jnp.ones(2, bool), usual
        )
    )(u)
    assert_allclose(u_near, u - q_near * (q_near @ u), rtol=0, atol=1e-14, err_msg="speeds")


WEIGHTS = np.cos(1.0 + np.arange(5.0))
AT_TIMES = {"x": 0.7, "k": 4.0, "ts": TIMES}


def saved_by_closed_form(x):
    return WEIGHTS @ pushed_position(TIMES, **x)


def end_by_closed_form(x):
    """A number made of the time and the speed at which the bead comes down to the level."""
    step = lambda _, t: t - (pushed_position(t, **x) + 0.1) / jax.grad(pushed_position)(t, **x)
    t = jax.lax.fori_loop(
        0, 6, step, 1.125
    )  # steps of Newton's method: the last two have the first two derivatives of the root
    return t + 0.3 * jax.grad(pushed_position)(t, **x)


def seen_by_closed_form(x):
    position = lambda t: pushed_position(t, x["x"], 0.4, x["k"])
    return WEIGHTS @ (position(x["ts"]) + 0.3 * jax.vmap(jax.grad(position))(x["ts"]))


@functools.cache
def expected(derivative, closed):
    """Derivatives of a closed form, with which machine code has nothing to do."""
    return jax.jit(derivative(closed))(AT_TIMES if closed is seen_by_closed_form else START)


def _differentiated(mode, of, closed):
    derivative = jax.jacrev if mode == "reverse" else jax.jacfwd
    found = jax.jit(lambda x: derivative(of)(x))(START)
    for name, value in expected(jax.jacfwd, closed).items():
        assert_allclose(found[name], value, rtol=0, atol=1e-7, err_msg=f"derivative with respect to {name}")


def _at_saved_times(mode):
    _differentiated(mode, lambda x: WEIGHTS @ pushed(**x).ys.q[:, 0], saved_by_closed_form)


def _end(x):
    """What `end_by_closed_form` says, of a motion."""
    found = pushed(**x, events=True)
    return found.t_end + 0.3 * found.y_end.v[0]


def _at_an_event(mode):
    _differentiated(mode, _end, end_by_closed_form)


def reverse_mode_through_saved_times():
    _at_saved_times("reverse")


def forward_mode_through_saved_times():
    _at_saved_times("forward")


def reverse_mode_to_an_event():
    _at_an_event("reverse")


def forward_mode_to_an_event():
    _at_an_event("forward")


def _differentiated_twice(of, end, closed, at):
    found = jax.jit(of(end))(at)
    for name, row in expected(jax.hessian, closed).items():
        for other, value in row.items():
            assert_allclose(
                found[name][other],
                value,
                rtol=0,
                atol=1e-7,
                err_msg=f"derivative with respect to {name} and {other}",
            )


def forward_mode_to_an_event_twice():
    _differentiated_twice(lambda f: jax.jacfwd(jax.jacfwd(f)), _end, end_by_closed_form, START)


def a_hessian_to_an_event():
    _differentiated_twice(jax.hessian, _end, end_by_closed_form, START)


THROWN = {"x": 0.1, "v": 1.1, "kept": 0.8, "pull": 0.5, "level": 0.4}


def _thrown_back(x):
    """A number made of the position at 1 s and of the time of the event."""
    found = motion(
        Moving(x["kept"], x["pull"], x["level"]), {"x": x["x"], "x_rate": x["v"]}, ts=np.array([1.0])
    )
    return found.ys.q[0, 0] + 0.3 * found.passed.ts[0]


def thrown_back_by_closed_form(x):
    t = (x["level"] - x["x"]) / (x["v"] - 0.05)
    return (
        x["level"]
        + 0.05 * t
        + (0.1 * t - x["kept"] * x["v"]) * (1.0 - t)
        + 0.5 * x["pull"] * (1.0 - t) ** 2
        + 0.3 * t
    )


def _through_a_transition(derivative):
    (found, value), (right, right_value) = (
        with_value(derivative, f)(THROWN) for f in (_thrown_back, thrown_back_by_closed_form)
    )
    assert_allclose(value, right_value, **CLOSE, err_msg="state after an event")
    for of_found, of_right in zip(jax.tree.leaves(found), jax.tree.leaves(right), strict=True):
        assert_allclose(of_found, of_right, rtol=0, atol=1e-7, err_msg=WRONG)


def forward_mode_through_a_transition():
    _through_a_transition(jax.jacfwd)


def reverse_mode_through_a_transition():
    _through_a_transition(jax.grad)


def a_hessian_through_a_transition():
    _through_a_transition(jax.hessian)


def a_hessian_with_respect_to_times():
    def seen(x):
        found = pushed(x["x"], 0.4, x["k"], ts=x["ts"]).ys
        return WEIGHTS @ (found.q[:, 0] + 0.3 * found.v[:, 0])

    _differentiated_twice(jax.hessian, seen, seen_by_closed_form, AT_TIMES)


def reverse_mode_with_respect_to_times():
    found = jax.jit(jax.grad(lambda ts: WEIGHTS @ pushed(**START, ts=ts).ys.q[:, 0]))(TIMES)
    rates = jax.vmap(jax.grad(lambda t: pushed_position(t, **START)))(TIMES)
    assert_allclose(found, WEIGHTS * rates, rtol=0, atol=1e-7, err_msg="derivative with respect to times")


def reverse_mode_back_over_projections():
    """Of steps of whatever error, which projections move far; by central differences of fourth order."""

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def weighed(rate):
        found = motion(
            Round(),
            {"x": 1.0, "y": 0.0, "y_rate": rate},
            ts=[2.0, 4.0],
            rtol=1e3,
            atol=1e3,
            first=100.0,
            max_step=jnp.inf,
        )
        return jnp.sum(found.ys.q @ jnp.array([0.4, 0.9])) + found.y_end.v[0], found.accepted

    expected = slope(lambda rate: weighed(rate)[0][0], 1.3)
    (_, steps), found = weighed(1.3)
    assert steps == 2, "no long steps, as this check needs them"
    assert_allclose(found, expected, rtol=0, atol=1e-7, err_msg="derivative with respect to the rate")


TRIED, WRONG = "tried_by_stages", "derivative with respect to"
MUTANTS = [
    Mutant(
        "a wrong weight",
        step,
        "stages",
        "method.b[:n]])",
        "method.b[:n] * (1 + 1e-6)])",
        motions_follow_the_closed_form,
        "closed form",
    ),
    Mutant(
        "the whole step for its error",
        step,
        TRIED,
        "weighted(w, weights, k",
        "weighted(w, method.b, k",
        motions_follow_the_closed_form,
        "too many|closed form",
    ),
    Mutant(
        "every step accepted",
        step,
        "judged",
        "(error <= 1.0)",
        "(error <= 1e30)",
        motions_follow_the_closed_form,
        "closed form",
    ),
    Mutant(
        "rows of the tableau too small",
        step,
        "stages",
        "*method.A[1:n, :n],",
        "*(0.999 * method.A[1:n, :n]),",
        motions_follow_the_closed_form,
        "closed form|too many",
    ),
    Mutant(
        "stages at the first time",
        step,
        "stages",
        "w.fma(step, c[i], t)",
        "t",
        motions_follow_the_closed_form,
        "closed form|too many",
    ),
    Mutant(
        "a rejected step takes time",
        step,
        "taken",
        '"t": w.where(accept, aim.t_1, p["t"])',
        '"t": aim.t_1',
        motions_follow_the_closed_form,
        "closed form",
    ),
    Mutant(
        "a rejected step is taken",
        step,
        "take",
        "w.where(accept, w.load(y1, i), w.load(y, i))",
        "w.load(y1, i)",
        motions_follow_the_closed_form,
        "closed",
    ),
    Mutant(
        "a goal that stays",
        loop,
        "_save",
        "number, last)",
        "number, saved)",
        motions_follow_the_closed_form,
        "closed form",
    ),
    Mutant(
        "starts of another lane",
        loop,
        "_starts",
        "given, lane)",
        "given, 0 * lane)",
        lanes_of_a_batch_follow_their_own,
        "lanes",
    ),
    Mutant(
        "goals of another lane",
        loop,
        "goal_of",
        "lane).place(",
        "0 * lane).place(",
        lanes_of_a_batch_follow_their_own,
        "lanes",
    ),
    Mutant(
        "states of another lane",
        loop,
        "_save",
        "every, number)",
        "every, 0 * number)",
        lanes_of_a_batch_follow_their_own,
        "lanes",
    ),
    Mutant(
        "no bound of steps",
        step,
        "judged",
        ', p["longest"])',
        ", math.inf)",
        steps_are_no_longer_than_allowed,
        "the longest step",
    ),
    Mutant(
        "no bound of series",
        step,
        "_tried_by_series",
        'rows), p["longest"])',
        "rows), math.inf)",
        series_are_no_longer_than_allowed,
        "the longest step",
    ),
    Mutant(
        "no start at an event",
        event_search,
        "at_start",
        "rises = ((rate > 0.0)",
        "rises = ((rate > 1e9)",
        a_motion_leaves_an_event_at_which_it_starts,
        "leaves",
    ),
    Mutant(
        "every start at an event",
        event_search,
        "at_start",
        "& (w.magnitude(a) <= noise * rate)",
        "",
        a_motion_below_an_event_has_none,
        "below",
    ),
    Mutant(
        "another side at the start",
        step,
        "first_sides",
        "w.where(x < 0.0, -1.0",
        "w.where(x < 0.0, 1.0",
        a_strip_is_met,
        "strip|crossings",
    ),
    Mutant(
        "no side at the start",
        step,
        "first_sides",
        "w.where(fresh, side,",
        "w.where(fresh, 0.0,",
        an_event_where_a_relation_changes_is_found,
        "passed over|place",
    ),
    Mutant(
        "friction that is pushed back",
        event_search,
        "pass_event",
        "~rests & (rate < 0.0)",
        "~rests & (rate > 0.0)",
        friction_at_rest_sticks,
        "sticks",
    ),
    Mutant(
        "no projection",
        step,
        "project",
        'w.run("project", p.pointer, t1, y1)',
        "None",
        a_bead_stays_on_its_circle,
        "circle",
    ),
    Mutant("no events", step, "monitored", "~no_event(c_1)", "~no_event(c_0)", an_event_is_found, "event"),
    Mutant(
        "no dips",
        step,
        "monitored",
        "((share < 1.0) | again)",
        "again",
        an_event_within_a_step_is_found,
        "passed over",
    ),
    Mutant(
        "dips not looked at",
        event_search,
        "may_fall",
        ", a + third * slope_a, b - third * slope_b",
        "",
        an_event_within_a_step_is_found,
        "passed over",
    ),
    Mutant(
        "a bracket with the wrong end",
        event_search,
        "_follow",
        "w.where(same, old.t[1], old.t[0])",
        "old.t[0]",
        an_event_is_found,
        "event",
    ),
    Mutant(
        "rows by half",
        projection_kernel,
        "_write_moved",
        "- w.where(moves, change, 0.0)",
        "- 0.5 * w.where(moves, change, 0.0)",
        a_start_is_put_onto_its_rows,
        "coordinates|speeds",
    ),
    Mutant(
        "rows that are not scaled",
        projection_kernel,
        "_write_factored",
        "w.load(row, k) * scale, row",
        "w.load(row, k), row",
        a_start_is_put_onto_its_rows,
        "coordinates|speeds",
    ),
    Mutant(
        "rows that are never left",
        projection_kernel,
        "_write_settled",
        "* (8 * w.eps)",
        "* 8.0",
        a_start_is_put_onto_its_rows,
        "coordinates|speeds",
    ),
    Mutant(
        "weights of the first stage",
        adjoint,
        "step_back",
        "* b[stage]",
        "* b[0]",
        reverse_mode_through_saved_times,
        WRONG,
    ),
    Mutant(
        "no later stages",
        adjoint,
        "step_back",
        "columns[stage][j], total",
        "0.0, total",
        reverse_mode_through_saved_times,
        WRONG,
    ),
    Mutant(
        "cotangents not scaled by the step",
        adjoint,
        "step_back",
        "return h * total",
        "return total",
        reverse_mode_through_saved_times,
        WRONG,
    ),
    Mutant(
        "slopes of another stage",
        adjoint,
        "step_back",
        "total = w.fma(w.load(G, i + j * count)",
        "total = w.fma(w.load(G, i)",
        reverse_mode_through_saved_times,
        WRONG,
    ),
    Mutant(
        "parameters of the last step",
        adjoint,
        "step_back",
        "w.load(by_known, i) + w.where(took",
        "w.where(took",
        reverse_mode_through_saved_times,
        WRONG,
    ),
    Mutant(
        "saved states forgotten",
        adjoint,
        "_write_added",
        'w.load(place, type="double") + more',
        "more",
        reverse_mode_through_saved_times,
        WRONG,
    ),
    Mutant(
        "no projection on the way back",
        adjoint,
        "step_back",
        'w.run("project_back", state, t + h, at, g1, added)',
        "None",
        reverse_mode_back_over_projections,
        WRONG,
    ),
    Mutant(
        "an event at a number for a time",
        event_adjoint,
        "event_back",
        "-total / rate",
        "total / rate",
        reverse_mode_to_an_event,
        WRONG,
    ),
    Mutant(
        "the level of an event forgotten",
        event_adjoint,
        "event_back",
        "w.where(usable, more, 0.0)",
        "w.number(0.0)",
        reverse_mode_to_an_event,
        WRONG,
    ),
    Mutant(
        "tangents of states alone",
        rate_functions,
        "outputs_of",
        "| {len(y) + i: n for i, n in known[k].items()}",
        "",
        forward_mode_through_saved_times,
        WRONG,
    ),
    Mutant(
        "the time of an event fixed",
        event_search,
        "put_tangents",
        "-dc / slope",
        "0.0 * dc",
        forward_mode_to_an_event,
        WRONG,
    ),
    Mutant(
        "the wrong way from an event",
        event_search,
        "_move_rows",
        "w.fma(w.load(k, i + rates), dt, before)",
        "before",
        forward_mode_to_an_event,
        WRONG,
    ),
    Mutant(
        "tangents of an event by rates of before it moved",
        event_search,
        "put_tangents",
        "if part > 1:",
        "if part > 9:",
        forward_mode_to_an_event_twice,
        WRONG,
    ),
    Mutant(
        "the tangent at the time of an event",
        event_adjoint,
        "event_back",
        "dt * w.load(f, i)",
        "0.0 * dt",
        a_hessian_to_an_event,
        WRONG,
    ),
    Mutant(
        "the tangent of an event forgotten",
        event_adjoint,
        "_moved_back",
        "w.where(usable, w.load(out, i), 0.0)",
        "w.number(0.0)",
        a_hessian_to_an_event,
        WRONG,
    ),
    Mutant(
        "an event that stays while its tangent moves",
        event_adjoint,
        "_moved_back",
        "w.load(added, asked)",
        "0.0 * g_dt",
        a_hessian_to_an_event,
        WRONG,
    ),
    Mutant(
        "cotangents of states for those of tangents",
        native_motion,
        "flow_back",
        "jnp.concatenate([dg, g], axis=1)",
        "jnp.concatenate([dg, dg], axis=1)",
        a_hessian_with_respect_to_times,
        WRONG,
    ),
    Mutant(
        "a state that comes late to an event",
        transitions,
        "reset_program",
        "graph.add(along[n], graph.mul(rate, dt))",
        "along[n]",
        forward_mode_through_a_transition,
        WRONG,
    ),
    Mutant(
        "a state that leaves an event late",
        transitions,
        "reset_program",
        "graph.sub(dx, graph.mul(rate, dt))",
        "dx",
        forward_mode_through_a_transition,
        WRONG,
    ),
    Mutant(
        "a jump at a fixed time",
        transitions,
        "reset_program",
        "{t: dt}",
        "{t: graph.zero}",
        forward_mode_through_a_transition,
        WRONG,
    ),
    Mutant(
        "a mode that stays",
        event_search,
        "pass_event",
        'w.at(after, of["mode"].start), modes',
        "modes, modes",
        forward_mode_through_a_transition,
        "state after",
    ),
    Mutant(
        "rates after an event in the mode before",
        event_adjoint,
        "reset_back",
        'w.at(after, of["mode"].start), modes',
        "modes, modes",
        reverse_mode_through_a_transition,
        WRONG,
    ),
    Mutant(
        "rates after an event forgotten",
        event_adjoint,
        "reset_back",
        "w.load(g, i) * w.load(f_after, i)",
        "0.0 * w.load(g, i)",
        reverse_mode_through_a_transition,
        WRONG,
    ),
    Mutant(
        "what moves an event forgotten",
        event_adjoint,
        "reset_back",
        "w.load(out, i) + w.load(by_event, i)",
        "w.load(out, i)",
        reverse_mode_through_a_transition,
        WRONG,
    ),
    Mutant(
        "cotangents of another event's time",
        adjoint,
        "write_transition_back",
        '"passed", lane) - 1.0',
        '"passed", lane)',
        reverse_mode_through_a_transition,
        WRONG,
    ),
    Mutant(
        "a transition whose tangent leaves late",
        transitions,
        "reset_program",
        "graph.sub(dx, graph.mul(rate, dt))",
        "dx",
        a_hessian_through_a_transition,
        WRONG,
    ),
    Mutant(
        "goals that do not move cotangents",
        native_motion,
        "moved",
        "jax.vjp(partial(rates, plain), z)[1](g)[0]",
        "0 * g",
        a_hessian_with_respect_to_times,
        WRONG,
    ),
    Mutant(
        "goals that do not move states",
        native_motion,
        "moved",
        "jnp.sum(scaled(rates(plain, z), g))",
        "0 * jnp.sum(g)",
        reverse_mode_with_respect_to_times,
        WRONG,
    ),
]
CHECKS = list(dict.fromkeys(mutant.check for mutant in MUTANTS))
KEPT = (
    loop_function.kernel,
    adjoint.kernel_back,
    constraint_projection._kernel,
    rate_functions.reason_against_derivatives,
)


@pytest.fixture(autouse=True)
def _nothing_kept():
    """Machine code is written in each test, and none of it is used afterwards."""
    for kept in KEPT:
        kept.cache_clear()
    yield
    for kept in KEPT:
        kept.cache_clear()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_without_a_mutant(check):
    check()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.says)
def test_a_mutant_is_caught(mutant, monkeypatch):
    mutant.bring(monkeypatch)
    with pytest.raises(AssertionError, match=mutant.shown_by):
        mutant.check()
