"""Deliberate errors of one line in what a motion runs through by default: each must be caught by a check that
passes without it.

The checks know nothing of the code that they judge: they compare with closed forms, with dense matrices, and
with differences. The scalar program is also compared with dense matrices where it is built; a program that is
wrong is then not used, which counts as caught.
"""

import inspect
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace

import diffrax
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from tolerances import tolerance

import jourdain_jax as jj
from jourdain_jax import Lowered
from jourdain_jax.dynamics.reactions import power
from jourdain_jax.equations.projection import project_positions, project_speeds
from jourdain_jax.integrate import event_search
from jourdain_jax.integrate.arrays import array_functions
from jourdain_jax.integrate.arrays import array_loop as on_arrays
from jourdain_jax.integrate.arrays import array_motion as motions
from jourdain_jax.integrate.arrays.array_loop import Loop
from jourdain_jax.integrate.arrays.array_writer import ArrayWriter
from jourdain_jax.integrate.explicit_steps import method_of
from jourdain_jax.integrate.loop import step
from jourdain_jax.integrate.loop.loop_function import Start, solved
from jourdain_jax.integrate.vector_fields.field import Integrated
from jourdain_jax.lowering import appell, lower, multipliers, partial_velocities
from jourdain_jax.models import MODELS
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph
from jourdain_jax.structure.trace import named_values


def rewritten(function, right, wrong):
    """The function with one piece of its text, which must occur once, replaced, without its decorators."""
    text = textwrap.dedent(inspect.getsource(inspect.unwrap(function)))
    assert text.count(right) == 1, (
        f"`{right}` occurs {text.count(right)} times in `{function.__name__}`: this mutant must follow the"
        " code"
    )
    made: dict = {}
    text = text[text.index("def ") :] if text.startswith("@") else text
    exec(
        compile(text.replace(right, wrong), f"a mutant of {function.__name__}", "exec"),
        inspect.unwrap(function).__globals__,
        made,
    )
    return made[function.__name__]


# The scalar program


def program_of(name):
    """A scene with its program, which must have been built and found to agree with dense matrices."""
    scene = MODELS[name]()
    found = lower.lowered(scene)
    assert isinstance(found, Lowered), str(found)
    return scene, found


def values(scene, program, t, q, u):
    """The program's nodes at some states."""
    return Probes(program.graph, named_values(scene, t, q, u, np.zeros((len(t), len(scene.inputs)))))


def a_tilting_disc_accelerates_as_by_dense_matrices():
    program_of("tilting-disc")


def a_snakeboard_accelerates_as_by_dense_matrices():
    program_of("snakeboard")


def a_ball_on_a_turntable_is_given_the_power_of_its_contact():
    scene, program = program_of("ball-on-turntable")
    t, q, u = (np.asarray(x) for x in jj.sample_states(scene, 3))

    @jax.jit
    def dense(t, q, u):
        return power(scene, jj.motion_at(scene, t, q, u), jj.accelerations(scene, t, q, u)).total

    expected = np.array([dense(*state) for state in zip(t, q, u, strict=True)])
    assert np.min(np.abs(expected)) > 1e-3
    found = values(scene, program, t, q, u)([program.power])[0]
    assert_allclose(found, expected, rtol=tolerance("ill_conditioned"), err_msg="power")


def a_quaternion_is_put_back_to_length_one():
    scene, program = program_of("suslov")
    t, q, u = (np.asarray(x) for x in jj.sample_states(scene, 2))
    ((first, _),) = scene.coordinates.quaternions
    put = values(scene, program, t, 1.001 * q, u)(program.projected_q)[first : first + 4]
    assert_allclose(np.sum(put**2, axis=0), 1.0, atol=tolerance("round_off"), err_msg="norm")


def a_double_pendulum_of_rods_is_put_back_onto_them():
    scene, program = program_of("double-pendulum-rods")
    t, q, u = (np.asarray(x) for x in jj.sample_states(scene, 2))
    off = q + 1e-7 * np.cos(np.arange(q.size)).reshape(q.shape)
    expected = [project_positions(scene, *map(jnp.asarray, state)) for state in zip(t, off, strict=True)]
    assert_allclose(
        values(scene, program, t, off, u)(program.projected_q).T,
        expected,
        atol=tolerance("round_off"),
        err_msg="coordinates",
    )


def a_snakeboard_is_put_back_onto_its_rows():
    scene, program = program_of("snakeboard")
    t, q, u = (np.asarray(x) for x in jj.sample_states(scene, 2))
    off = u + 0.3 * np.cos(np.arange(u.size)).reshape(u.shape)
    expected = [project_speeds(scene, *map(jnp.asarray, state)) for state in zip(t, q, off, strict=True)]
    assert_allclose(
        values(scene, program, t, q, off)(program.projected_u).T,
        expected,
        atol=tolerance("ill_conditioned"),
        err_msg="speeds",
    )


def a_program_knows_where_rows_are_parallel():
    scene, program = program_of("snakeboard")
    q = np.array(scene.coordinates.reference())
    q[scene.coordinate_names.entries.index("steer")] = np.pi / 2
    probes = values(scene, program, np.zeros(1), q[None], np.zeros((1, len(scene.speed_names))))
    margins = probes(program.guards)
    assert np.min(margins) <= 0, f"margins {margins}"


# Steps


def loop(rates, *, rtol, project=None, events=None, knots=None, dt0=1.0, longest=np.inf):
    """`(y0, goals, k)` -> (loop on arrays, its start); functions are of (t, y, k), the state is one of
    coordinates.
    """
    state = lambda y: Integrated(y, jnp.zeros(0), None)
    given = SimpleNamespace(
        rates=lambda t, y, k: state(rates(t, y.q, k)),
        project=lambda t, y, k: state(project(t, y.q, k)),
        events=lambda t, y, k: events(t, y.q, k),
        within=lambda middle, k: k,
    )
    array_functions.integrands = given

    def run(y0, goals, k=1.0):
        known, rest = array_functions.split(jnp.asarray(k))
        form = array_functions.ArrayForm(
            None, False, bool(project), True, bool(events), 0, coordinates=len(y0), events=1 if events else 0
        )
        control = tuple(map(jnp.asarray, (rtol, rtol, longest, dt0, 2000.0)))
        start = Start(
            () if knots is None else (jnp.asarray(knots),), control, goals, jnp.zeros(()), (y0,), (known,)
        )
        return Loop(form, method_of(diffrax.Dopri8()), rest, 2000), start

    return run


def motion(run):
    """What a loop finds, by its arguments; states at all goals but the last."""

    @jax.jit
    def found(*arguments):
        of, start = run(*arguments)
        return solved(of.form, start.goals, motions.flow(of, 0)(start))

    return found


def steps_follow_a_closed_form():
    goals = np.array([0.5, 1.1, 2.0, 2.1])
    end = motion(loop(lambda t, y, k: -2 * t * y, rtol=1e-10))(jnp.ones(1), goals)
    assert int(end.accepted + end.rejected) < 60, (
        f"{end.accepted} steps and {end.rejected} rejected ones, too many for the order of the method"
    )
    assert_allclose(end.ys.q[:, 0], np.exp(-(goals[:-1] ** 2)), atol=1e-8, err_msg="closed form")
    assert int(end.rejected) > 0, "no step was rejected, as this check needs it"


def projected_steps_stay_on_a_circle():
    def turning(t, y, k):
        return (1 + t) * jnp.stack([-y[1], y[0]])

    run = loop(turning, rtol=1e-4, project=lambda t, y, k: y / jnp.sqrt(jnp.sum(y**2)), dt0=0.1)
    assert_allclose(
        np.sum(motion(run)(jnp.array([1.0, 0.0]), np.array([1.0, 2.0, 2.1])).ys.q ** 2, axis=1),
        1.0,
        atol=1e-14,
        err_msg="circle",
    )


def steps_end_at_knots():
    run = loop(lambda t, y, k: 2 * jnp.abs(t - 0.3)[None], rtol=1e-3, knots=[0.3, np.inf])
    assert_allclose(
        motion(run)(jnp.zeros(1), np.ones(1)).y_end.q[0], 0.3**2 + 0.7**2, atol=1e-14, err_msg="knot"
    )


def an_event_within_a_step_ends_the_motion():
    end = motion(loop(lambda t, y, k: jnp.ones(1), rtol=1e-3, events=lambda t, y, k: (y - 0.52) ** 2 - 1e-4))(
        jnp.zeros(1), np.full(1, 2.0)
    )
    assert end.code == results.EVENT, "an event was passed over"
    assert_allclose(end.t_end, 0.51, atol=1e-10, err_msg="event")


def steps_are_no_longer_than_allowed():
    assert (
        motion(loop(lambda t, y, k: jnp.ones(1), rtol=1e-3, longest=0.25))(
            jnp.zeros(1), np.full(1, 2.0)
        ).accepted
        == 8
    ), "the longest step"


def a_motion_leaves_an_event_at_which_it_starts():
    run = motion(loop(lambda t, y, k: jnp.array([1.0 - t]), rtol=1e-8, dt0=1e-3, events=lambda t, y, k: y))
    for start, expected in ((0.0, 2.0), (-1e-5, 0.0)):
        assert_allclose(run(jnp.full(1, start), np.full(1, 4.0)).t_end, expected, atol=1e-8, err_msg="leaves")


# Their derivatives in both modes


def driven(t, y, k):
    """A point on a circle drives a damped number."""
    return jnp.stack(
        [*(k * (1 + 0.5 * jnp.cos(t)) * jnp.stack([-y[1], y[0]])), -k * y[2] + jnp.sin(2 * t) * y[0]]
    )


def onto_circle(t, y, k):
    return jnp.concatenate([y[:2] / jnp.sqrt(jnp.sum(y[:2] ** 2)), y[2:]])


def falls(t, y, k):
    return (0.3 + y[0] + 0.05 * k + 0.02 * t)[None]


# each saved time is one step, of whatever error, so that the states are a smooth function of all arguments,
# also off the circle; and a precise motion
CASES = {
    "saved times": {"project": onto_circle, "rtol": 1e3, "dt0": 100.0},
    "an event": {"events": falls, "rtol": 1e-12, "dt0": 0.1},
}
GOALS = {"saved times": 0.2 * np.arange(25.0), "an event": np.array([0.0, 0.5, 1.5, 4.0])}
START = {"y0": np.array([0.8, 0.6, 0.4]), "k": np.array(1.1)}


def given(case, start=START):
    """What a loop is given."""
    return start["y0"], jnp.asarray(GOALS[case]), start["k"]


def weighed(end):
    """One number of all that a motion gives."""
    states = jnp.concatenate([jnp.ravel(end.ys.q), end.y_end.q])
    return jnp.sum(jnp.cos(1.0 + jnp.arange(float(states.size))) * states) + 0.7 * end.t_end


def backwards_through(of, start):
    """Its derivatives by the start and by k, in reverse mode."""
    found = jax.jit(motions.flow(of, 0))(start)
    g = jax.grad(lambda found: weighed(solved(of.form, start.goals, found)))(found)
    by_y0, (by_k,) = jax.jit(motions.flow_back(of, 0, (0,), 2**20))(start, g)
    return by_y0, by_k


@lru_cache
def differences(case):
    """Its derivatives by central differences of fourth order."""
    flat, unravel = jax.flatten_util.ravel_pytree(START)
    run, h = motion(loop(driven, **CASES[case])), 1e-3
    points = np.stack([flat + step * h * np.eye(len(flat)) for step in (-2, -1, 1, 2)])

    def at(x):
        end = run(*given(case, unravel(x)))
        return weighed(end), end.code

    found, codes = jax.jit(jax.vmap(jax.vmap(at)))(points)
    assert np.all((codes == results.EVENT) == (case == "an event"))
    return unravel((found[0] - 8 * found[1] + 8 * found[2] - found[3]) / (12 * h))


def forward_mode_agrees_with_differences(case):
    expected, found = differences(case), motion(loop(driven, **CASES[case]))
    along = jax.jvp(lambda x: weighed(found(*given(case, x))), (START,), (START,))[1]
    assert_allclose(
        along,
        sum(np.sum(expected[name] * START[name]) for name in START),
        atol=1e-6,
        err_msg="derivative forward",
    )


def reverse_mode_agrees_with_differences(case):
    expected, run, arguments = differences(case), loop(driven, **CASES[case]), given(case)
    for name, by in zip(START, backwards_through(*run(*arguments)), strict=True):
        assert_allclose(by, expected[name], atol=1e-7, err_msg=f"derivative by {name}")


def tangents_through_saved_times():
    forward_mode_agrees_with_differences("saved times")


def tangents_to_an_event():
    forward_mode_agrees_with_differences("an event")


def cotangents_through_saved_times():
    reverse_mode_agrees_with_differences("saved times")


def cotangents_to_an_event():
    reverse_mode_agrees_with_differences("an event")


# The mutants


def rates_of_coordinates_have_their_divisors():
    graph = Graph()
    a, w = graph.input("a", True), graph.input("w", True)
    sine, cosine = graph.call("sin", a), graph.call("cos", a)
    found = lower._divisors(graph, [graph.div(w, sine), graph.mul(w, graph.call("tan", a))])
    assert set(found) == {sine, cosine}, "what rates are divided by differs"


@dataclass
class Mutant:
    """One line made wrong, and the check that must show it, with a word of what it says then."""

    says: str
    owner: object
    name: str
    right: str
    wrong: str
    check: Callable[[], None]
    shown_by: str

    def bring(self, monkeypatch):
        """Put it in the place of the right code."""
        monkeypatch.setattr(
            self.owner, self.name, rewritten(getattr(self.owner, self.name), self.right, self.wrong)
        )


DENSE = "differs from dense matrices"
BUILD, KINEMATICS = appell.AppellOnGraph, partial_velocities.Kinematics
DISC, BOARD = a_tilting_disc_accelerates_as_by_dense_matrices, a_snakeboard_accelerates_as_by_dense_matrices
LONGEST, LEAVES = steps_are_no_longer_than_allowed, a_motion_leaves_an_event_at_which_it_starts
STEPS, TIMES, ALONG, EVENT = (
    steps_follow_a_closed_form,
    cotangents_through_saved_times,
    tangents_to_an_event,
    cotangents_to_an_event,
)
DIVISORS = rates_of_coordinates_have_their_divisors
MUTANTS = [
    Mutant("no divisors of rates", lower, "_divisors", '== "div"]', '== "none"]', DIVISORS, "differs"),
    Mutant("no tangents among rates", lower, "_divisors", '== "tan"]', '== "none"]', DIVISORS, "differs"),
    Mutant(
        "no gyroscopic torque",
        BUILD,
        "_inertia_resultants",
        "g.add(g.dot(row, alpha), w)",
        "g.dot(row, alpha)",
        DISC,
        DENSE,
    ),
    Mutant(
        "no a_0",
        BUILD,
        "_inertia_resultants",
        "g.mul(int(at.mass[b]), x) for x in a",
        "g.zero for x in a",
        DISC,
        DENSE,
    ),
    Mutant(
        "one mass twice",
        BUILD,
        "_equations",
        "g.mul(mass, g.dot(beta[i], beta[j]))",
        "g.mul(g.mul(g.const(2.0), mass), g.dot(beta[i], beta[j]))",
        DISC,
        DENSE,
    ),
    Mutant(
        "sign of the drift of rows",
        KINEMATICS,
        "_implicitly",
        "[[g.neg(d)] for d in drift]",
        "[[d] for d in drift]",
        DISC,
        DENSE,
    ),
    Mutant(
        "no phi_0",
        KINEMATICS,
        "_solve",
        "g.neg(rest)]",
        "g.mul(g.zero, rest)]",
        a_ball_on_a_turntable_is_given_the_power_of_its_contact,
        DENSE,
    ),
    Mutant(
        "no inertia in the power of contacts",
        BUILD,
        "_power",
        "g.sub(torque[i], int(at.torque[b][i]))",
        "g.neg(int(at.torque[b][i]))",
        a_ball_on_a_turntable_is_given_the_power_of_its_contact,
        "power",
    ),
    Mutant(
        "a square root left out",
        BUILD,
        "projection",
        'g.div(part, g.call("sqrt", n))',
        "g.div(part, n)",
        a_quaternion_is_put_back_to_length_one,
        "norm",
    ),
    Mutant(
        "multipliers without drift",
        multipliers,
        "accelerations_by_multipliers",
        "graph.add(d, graph.dot(row, free))",
        "graph.dot(row, free)",
        BOARD,
        DENSE,
    ),
    Mutant(
        "sign of multipliers",
        multipliers,
        "accelerations_by_multipliers",
        "graph.add(w, graph.dot(",
        "graph.sub(w, graph.dot(",
        BOARD,
        DENSE,
    ),
    Mutant(
        "sign of the correction",
        appell,
        "projected_coordinates",
        "_less(graph, q, G, correction)",
        "_less(graph, q, G, [graph.neg(c) for c in correction])",
        a_double_pendulum_of_rods_is_put_back_onto_them,
        "coordinates",
    ),
    Mutant(
        "nearest without masses",
        multipliers,
        "projected_speeds",
        "impulses = solve_symmetric(graph, M, A).solution",
        "impulses = A",
        a_snakeboard_is_put_back_onto_its_rows,
        "speeds",
    ),
    Mutant(
        "no least angle between rows",
        multipliers,
        "accelerations_by_multipliers",
        "graph.mul(least,",
        "graph.mul(graph.const(-1.0),",
        a_program_knows_where_rows_are_parallel,
        "margins",
    ),
    Mutant(
        "a wrong weight", step, "stages", "method.b[:n]]", "(1 + 1e-6) * method.b[:n]]", STEPS, "closed form"
    ),
    Mutant(
        "rows of the tableau too small",
        step,
        "stages",
        "*method.A[1:n, :n]",
        "*0.999 * method.A[1:n, :n]",
        STEPS,
        "closed form",
    ),
    Mutant(
        "the whole step for its error",
        on_arrays,
        "tried_by_stages",
        "method.b_error",
        "method.b",
        STEPS,
        "too many for the order",
    ),
    Mutant(
        "stages at the first time",
        step,
        "stages",
        "w.fma(step, c[i], t)",
        "w.fma(0 * step, c[i], t)",
        STEPS,
        "closed form",
    ),
    Mutant("every step accepted", step, "judged", "(error <= 1.0)", "(error <= 1e30)", STEPS, "closed form"),
    Mutant(
        "a rejected step takes time",
        step,
        "taken",
        'w.where(accept, aim.t_1, p["t"])',
        "aim.t_1",
        STEPS,
        "closed form",
    ),
    Mutant(
        "other states are saved",
        Loop,
        "saving",
        "update_index_in_dim(ys, y,",
        "update_index_in_dim(ys, 0.99 * y,",
        STEPS,
        "closed form",
    ),
    Mutant(
        "stages twice",
        ArrayWriter,
        "over_stages",
        "body(i, carry[1])",
        "body(i // 2, carry[1])",
        STEPS,
        "closed form|too many",
    ),
    Mutant(
        "no branch is taken",
        ArrayWriter,
        "if_any",
        "(rooms, arrays, body)[0]",
        "(rooms, arrays, lambda: None)[0]",
        EVENT,
        "derivative|assert",
    ),
    Mutant(
        "no projection",
        step,
        "project",
        'w.run("project", p.pointer, t1, y1)',
        "None",
        projected_steps_stay_on_a_circle,
        "circle",
    ),
    Mutant(
        "no step ends at a knot",
        Loop,
        "saving",
        "jnp.minimum(goal * direction, jnp.min(ahead, axis=0))",
        "goal * direction",
        steps_end_at_knots,
        "knot",
    ),
    Mutant(
        "no dips",
        step,
        "monitored",
        "((share < 1.0) | again)",
        "again",
        an_event_within_a_step_ends_the_motion,
        "passed over",
    ),
    Mutant(
        "the first step without a bound",
        Start,
        "numbers",
        "jnp.minimum(jnp.abs(first), longest)",
        "jnp.abs(first)",
        LONGEST,
        "the longest step",
    ),
    Mutant(
        "no bound of steps", step, "judged", ', p["longest"])', ", math.inf)", LONGEST, "the longest step"
    ),
    Mutant(
        "no start at an event",
        event_search,
        "at_start",
        "rises = ((rate > 0.0)",
        "rises = ((rate > 1e9)",
        LEAVES,
        "leaves",
    ),
    Mutant("every start at an event", event_search, "at_start", "noise * rate", "rate", LEAVES, "leaves"),
    Mutant(
        "no cotangents of later stages",
        on_arrays,
        "step_back",
        "columns[stage][j], total)",
        "0 * columns[stage][j], total)",
        TIMES,
        "derivative",
    ),
    Mutant(
        "one stage without parameters",
        on_arrays,
        "step_back",
        "at, v, of_stage, added)",
        "at, v, of_stage, w.room(max(asked, 1)))",
        TIMES,
        "by k",
    ),
    Mutant(
        "a projection not gone back over",
        on_arrays,
        "step_back",
        "at, g1, added)",
        "at, w.room(count), added)",
        TIMES,
        "by y0",
    ),
    Mutant(
        "saved states forgotten",
        motions,
        "cotangents",
        "(index < last), g_ys",
        "(index < last), 0 * g_ys",
        TIMES,
        "derivative",
    ),
    Mutant(
        "an earlier window left out",
        motions,
        "cotangents",
        "(x, number, 0, keepdims=False)",
        "(x, 0 * number, 0, keepdims=False)",
        TIMES,
        "derivative",
    ),
    Mutant(
        "tangents of times forgotten", event_search, "put_tangents", "-dc / slope", "0 * dc", ALONG, "forward"
    ),
    Mutant(
        "time of an event forgotten",
        on_arrays,
        "event_back",
        "total = w.load(g_t)",
        "total = 0 * w.load(g_t)",
        EVENT,
        "derivative",
    ),
    Mutant(
        "tangents of parameters forgotten",
        array_functions.Functions,
        "_parts",
        "part.get, of[0]",
        "lambda i: None if k else part[i], of[0]",
        ALONG,
        "forward",
    ),
    Mutant(
        "an event by parameters forgotten",
        on_arrays,
        "event_back",
        "with_event(w.load(by_known, i), w.load(added, i))",
        "w.load(by_known, i)",
        EVENT,
        "by k",
    ),
]
CHECKS = [*dict.fromkeys(mutant.check for mutant in MUTANTS), tangents_through_saved_times]


@pytest.fixture(autouse=True)
def _nothing_kept(monkeypatch):
    """Programs are built in each test, and none of them afterwards; short windows, so that a motion has
    several; functions of a test's own.
    """
    monkeypatch.setattr(on_arrays, "SLOTS", 8)
    monkeypatch.setattr(array_functions, "integrands", None)
    lower._lowered.cache_clear()
    lower._lowered_at.cache_clear()
    yield
    lower._lowered.cache_clear()
    lower._lowered_at.cache_clear()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_without_a_mutant(check):
    check()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.says)
def test_a_mutant_is_caught(mutant, monkeypatch):
    mutant.bring(monkeypatch)
    with pytest.raises(AssertionError, match=mutant.shown_by):
        mutant.check()


def test_a_record_goes_back_over_fewer_steps_than_it_has_room_for(monkeypatch):
    monkeypatch.setattr(on_arrays, "SLOTS", 48)
    run, arguments = loop(driven, **CASES["saved times"]), given("saved times")
    assert_allclose(backwards_through(*run(*arguments))[1], differences("saved times")["k"], atol=1e-7)


def test_a_mutant_of_a_line_that_is_gone_is_no_mutant():
    with pytest.raises(AssertionError, match="must follow the code"):
        rewritten(step.weighted, "a line that is not there", "")
