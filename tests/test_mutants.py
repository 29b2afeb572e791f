"""Deliberate errors of one line in what a motion runs through by default: each must be caught by a check that passes without it.

The checks know nothing of the code that they judge: they compare with closed forms, with dense matrices, and with differences. The scalar program is
also compared with dense matrices where it is built; a program that is wrong is then not used, which counts as caught.
"""

import inspect
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

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
from jourdain_jax.build.trace import named_values
from jourdain_jax.dynamics.power import power
from jourdain_jax.equations.projection import project_positions, project_speeds
from jourdain_jax.lowering import appell, kept_rows, lower
from jourdain_jax.models import MODELS
from jourdain_jax.motion.integrators import crossings, erk_loop, erk_step, event_search, recorded_adjoint, step_adjoint
from jourdain_jax.motion.integrators.explicit_steps import method_of
from jourdain_jax.program.evaluate import Probes
from jourdain_jax.program.graph import Graph


def rewritten(function: Callable, right: str, wrong: str) -> Callable:
    """The function with one piece of its text replaced, without its decorators; that piece must occur once."""
    text = textwrap.dedent(inspect.getsource(inspect.unwrap(function)))
    assert text.count(right) == 1, f"`{right}` occurs {text.count(right)} times in `{function.__name__}`: this mutant must follow the code"
    made: dict = {}
    text = text[text.index("def ") :] if text.startswith("@") else text
    exec(compile(text.replace(right, wrong), f"a mutant of {function.__name__}", "exec"), inspect.unwrap(function).__globals__, made)
    return made[function.__name__]


# The scalar program


def program_of(name: str) -> tuple[jj.Scene, Lowered]:
    """A scene with its program, which must have been built and found to agree with dense matrices."""
    scene = MODELS[name]()
    found = lower.lowered(scene)
    assert isinstance(found, Lowered), str(found)
    return scene, found


def values(scene: jj.Scene, program: Lowered, t, q, u) -> Probes:
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
    assert_allclose(values(scene, program, t, off, u)(program.projected_q).T, expected, atol=tolerance("round_off"), err_msg="coordinates")


def a_snakeboard_is_put_back_onto_its_rows():
    scene, program = program_of("snakeboard")
    t, q, u = (np.asarray(x) for x in jj.sample_states(scene, 2))
    off = u + 0.3 * np.cos(np.arange(u.size)).reshape(u.shape)
    expected = [project_speeds(scene, *map(jnp.asarray, state)) for state in zip(t, q, off, strict=True)]
    assert_allclose(values(scene, program, t, q, off)(program.projected_u).T, expected, atol=tolerance("ill_conditioned"), err_msg="speeds")


def a_program_knows_where_rows_are_parallel():
    scene, program = program_of("snakeboard")
    q = np.array(scene.coordinates.reference())
    q[scene.coordinate_names.entries.index("steer")] = np.pi / 2
    probes = values(scene, program, np.zeros(1), q[None], np.zeros((1, len(scene.speed_names))))
    margins = probes(program.guards)
    assert np.min(margins) <= 0, f"margins {margins}"


# Steps


def loop(
    kind: str, rates: Callable, *, rtol: float, project=None, events=None, knots=None, solver=None, dt0: float = 1.0, longest=np.inf, relations=None
) -> Callable:
    """`(y0, t0, goals, args)` -> saved states and the loop's own account."""

    def run(y0, t0, goals, args):
        one = jnp.ones(())
        problem = erk_step.Problem(
            rates=rates,
            args=args,
            project=project,
            events=events,
            norm=lambda y: jnp.sqrt(jnp.mean(y**2, axis=0)),
            rtol=rtol * one,
            atol=rtol * one,
            shortest=1e-14 * one,
            longest=longest * one,
            max_steps=2000,
            knots=None if knots is None else jnp.asarray(knots),
            relations=relations,
            relation_count=0 if relations is None else 2,
            span=2.0 * one,
        )
        ys, _, end = erk_loop.integrate(problem, method_of(solver or diffrax.Dopri8()), y0, t0, goals, dt0, kind)
        return ys, end

    return run


def steps_follow_a_closed_form():
    goals = jnp.array([0.5, 1.1, 2.0])
    ys, end = jax.jit(loop("forward", lambda t, y, args: -2 * t * y, rtol=1e-10))(jnp.ones(1), jnp.array(0.0), goals, None)
    assert int(end.accepted + end.rejected) < 60, f"{end.accepted} steps and {end.rejected} rejected ones, too many for the order of the method"
    assert_allclose(ys[:, 0], np.exp(-(np.asarray(goals) ** 2)), atol=1e-8, err_msg="closed form")
    assert int(end.rejected) > 0, "no step was rejected, as this check needs it"


def projected_steps_stay_on_a_circle():
    def turning(t, y, args):
        return (1 + t) * jnp.stack([-y[1], y[0]])

    run = loop("forward", turning, rtol=1e-4, project=lambda t, y, args: y / jnp.sqrt(jnp.sum(y**2)), dt0=0.1)
    ys, _ = jax.jit(run)(jnp.array([1.0, 0.0]), jnp.array(0.0), jnp.array([1.0, 2.0]), None)
    assert_allclose(np.sum(np.asarray(ys) ** 2, axis=1), 1.0, atol=1e-14, err_msg="circle")


def steps_end_at_knots():
    run = loop("forward", lambda t, y, args: 2 * jnp.abs(t - 0.3)[None], rtol=1e-3, knots=[0.3, np.inf])
    ys, _ = jax.jit(run)(jnp.zeros(1), jnp.array(0.0), jnp.array([1.0]), None)
    assert_allclose(ys[0, 0], 0.3**2 + 0.7**2, atol=1e-14, err_msg="knot")


def an_event_within_a_step_ends_the_motion():
    run = loop("forward", lambda t, y, args: jnp.ones(1), rtol=1e-3, events=lambda t, y, args: (y - 0.52) ** 2 - 1e-4)
    _, end = jax.jit(run)(jnp.zeros(1), jnp.array(0.0), jnp.array([2.0]), None)
    assert end.code == results.EVENT, "an event was passed over"
    assert_allclose(end.t, 0.51, atol=1e-10, err_msg="event")


def steps_are_no_longer_than_allowed():
    run = loop("forward", lambda t, y, args: jnp.ones(1), rtol=1e-3, longest=0.25)
    _, end = jax.jit(run)(jnp.zeros(1), jnp.array(0.0), jnp.array([2.0]), None)
    assert end.accepted == 8, "the longest step"


def a_motion_leaves_an_event_at_which_it_starts():
    run = jax.jit(loop("forward", lambda t, y, args: jnp.array([1.0 - t]), rtol=1e-8, dt0=1e-3, events=lambda t, y, args: y))
    for start, expected in ((0.0, 2.0), (-1e-5, 0.0)):
        _, end = run(jnp.full(1, start), jnp.array(0.0), jnp.array([4.0]), None)
        assert_allclose(end.t, expected, atol=1e-8, err_msg="leaves")


def a_pulse_is_met():
    def within(t):
        return (jnp.abs(t - 0.7) < 0.01) * 1.0

    def watched(args, t, y):
        return jnp.stack([t - 0.7, 0.01 - jnp.abs(t - 0.7)])

    run = loop("forward", lambda t, y, args: within(t)[None], rtol=1e-6, longest=0.5, relations=watched)
    _, end = jax.jit(run)(jnp.zeros(1), jnp.array(0.0), jnp.array([2.0]), None)
    assert end.crossings.count == 3, "crossings"
    assert_allclose(end.y, 0.02, atol=1e-4, err_msg="pulse")
    assert int(end.rejected) < 80, f"too many refused steps, {end.rejected}"
    assert int(end.accepted) < 100, "too many steps"


def a_pulse_within_a_step_is_named():
    run = loop("forward", lambda t, y, args: 0 * y, rtol=1e-6, longest=0.5, relations=lambda args, t, y: jnp.stack([t - 0.7, 1e-5 - jnp.abs(t - 0.7)]))
    _, end = jax.jit(run)(jnp.zeros(1), jnp.array(0.0), jnp.array([2.0]), None)
    assert abs(end.crossings.together - 0.7) < 3e-3, "not named"


# Their derivatives in reverse mode


def driven(t, y, k):
    """A point on a circle drives a damped number."""
    return jnp.stack([*(k * (1 + 0.5 * jnp.cos(t)) * jnp.stack([-y[1], y[0]])), -k * y[2] + jnp.sin(2 * t) * y[0]])


def onto_circle(t, y, k):
    return jnp.concatenate([y[:2] / jnp.sqrt(jnp.sum(y[:2] ** 2)), y[2:]])


def falls(t, y, k):
    return (0.3 + y[0] + 0.05 * k + 0.02 * t)[None]


# each saved time is one step, of whatever error, so that the states are a smooth function of all arguments, also off the circle; and a precise motion
CASES = {"saved times": {"project": onto_circle, "rtol": 1e3, "dt0": 100.0}, "an event": {"events": falls, "rtol": 1e-12, "dt0": 0.1}}
GOALS = {"saved times": 0.3 + 0.2 * np.arange(24.0), "an event": np.array([0.5, 1.5, 4.0])}


def arguments(case: str) -> dict:
    return {"y0": jnp.array([0.8, 0.6, 0.4]), "t0": jnp.array(0.1), "goals": jnp.asarray(GOALS[case]), "k": jnp.array(1.1)}


def weighed(kind: str, case: str) -> Callable:
    """One number of all that a motion gives, by its arguments."""
    run = loop(kind, driven, **CASES[case])

    def value(x):
        ys, end = run(x["y0"], x["t0"], x["goals"], x["k"])
        return jnp.sum(jnp.cos(1.0 + jnp.arange(float(ys.size))).reshape(ys.shape) * ys) + jnp.sum(
            jnp.sin(2.0 + jnp.arange(3.0)) * end.y
        ) + 0.7 * end.t, end.code

    return value


@lru_cache
def differences(case: str) -> dict:
    """Its derivatives by central differences of fourth order."""
    flat, unravel = jax.flatten_util.ravel_pytree(arguments(case))
    h = 1e-3
    points = jnp.stack([flat + step * h * jnp.eye(len(flat)) for step in (-2, -1, 1, 2)])
    found, codes = jax.jit(jax.vmap(jax.vmap(lambda x: weighed("forward", case)(unravel(x)))))(points)
    assert np.all((np.asarray(codes) == results.EVENT) == (case == "an event"))
    return unravel((found[0] - 8 * found[1] + 8 * found[2] - found[3]) / (12 * h))


def reverse_mode_agrees_with_differences(case: str) -> None:
    found, _ = jax.jit(jax.grad(weighed("reverse", case), has_aux=True))(arguments(case))
    for name, expected in differences(case).items():
        assert_allclose(found[name], expected, atol=1e-7, err_msg=f"derivative by {name}")


def reverse_mode_through_saved_times():
    reverse_mode_agrees_with_differences("saved times")


def reverse_mode_to_an_event():
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

    def bring(self, monkeypatch) -> None:
        """Put it in the place of the right code."""
        monkeypatch.setattr(self.owner, self.name, rewritten(getattr(self.owner, self.name), self.right, self.wrong))


DENSE = "differs from the dense path"
BUILD, KINEMATICS, VJP = appell.AppellOnGraph, appell._Kinematics, recorded_adjoint._motion
DISC, BOARD = a_tilting_disc_accelerates_as_by_dense_matrices, a_snakeboard_accelerates_as_by_dense_matrices
LONGEST, LEAVES = steps_are_no_longer_than_allowed, a_motion_leaves_an_event_at_which_it_starts
STEPS, TIMES, EVENT = steps_follow_a_closed_form, reverse_mode_through_saved_times, reverse_mode_to_an_event
DIVISORS = rates_of_coordinates_have_their_divisors
MUTANTS = [
    Mutant("no divisors of rates", lower, "_divisors", '== "div"]', '== "none"]', DIVISORS, "differs"),
    Mutant("no tangents among rates", lower, "_divisors", '== "tan"]', '== "none"]', DIVISORS, "differs"),
    Mutant("no gyroscopic torque", BUILD, "_inertia_resultants", "g.add(g.dot(row, alpha), w)", "g.dot(row, alpha)", DISC, DENSE),
    Mutant("no a_0", BUILD, "_inertia_resultants", "g.mul(int(at.mass[b]), x) for x in a", "g.zero for x in a", DISC, DENSE),
    Mutant(
        "one mass twice", BUILD, "_equations", "g.mul(mass, g.dot(beta[i], beta[j]))", "g.mul(g.mul(g.const(2.0), mass), g.dot(beta[i], beta[j]))", DISC, DENSE
    ),
    Mutant("sign of the drift of rows", KINEMATICS, "_implicitly", "[[g.neg(d)] for d in drift]", "[[d] for d in drift]", DISC, DENSE),
    Mutant("no phi_0", KINEMATICS, "_solve", "g.neg(rest)]", "g.mul(g.zero, rest)]", a_ball_on_a_turntable_is_given_the_power_of_its_contact, DENSE),
    Mutant(
        "no inertia in the power of contacts",
        BUILD,
        "_power",
        "g.sub(torque[i], int(at.torque[b][i]))",
        "g.neg(int(at.torque[b][i]))",
        a_ball_on_a_turntable_is_given_the_power_of_its_contact,
        "power",
    ),
    Mutant("a square root left out", BUILD, "projection", 'g.div(part, g.call("sqrt", n))', "g.div(part, n)", a_quaternion_is_put_back_to_length_one, "norm"),
    Mutant("multipliers without drift", kept_rows, "accelerations_by_multipliers", "graph.add(d, graph.dot(row, free))", "graph.dot(row, free)", BOARD, DENSE),
    Mutant("sign of multipliers", kept_rows, "accelerations_by_multipliers", "graph.add(w, graph.dot(", "graph.sub(w, graph.dot(", BOARD, DENSE),
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
        kept_rows,
        "projected_speeds",
        "impulses = solve_symmetric(graph, M, A).solution",
        "impulses = A",
        a_snakeboard_is_put_back_onto_its_rows,
        "speeds",
    ),
    Mutant(
        "no least angle between rows",
        kept_rows,
        "accelerations_by_multipliers",
        "graph.mul(least,",
        "graph.mul(graph.const(-1.0),",
        a_program_knows_where_rows_are_parallel,
        "margins",
    ),
    Mutant("a wrong weight", erk_step, "stages", "method.A[1:count], method.b]", "method.A[1:count], method.b * (1 + 1e-6)]", STEPS, "closed form"),
    Mutant("rows of the tableau too small", erk_step, "stages", "method.A[1:count], method.b]", "0.999 * method.A[1:count], method.b]", STEPS, "closed form"),
    Mutant("the whole step for its error", erk_step, "_tried", "weighted(method.b_error, k)", "weighted(method.b, k)", STEPS, "too many for the order"),
    Mutant("stages at the first time", erk_step, "stages", "t + c * h, treedef", "t + 0 * c * h, treedef", STEPS, "closed form"),
    Mutant("every step accepted", erk_step, "judged", "(error <= 1.0)", "(error <= 1e30)", STEPS, "closed form"),
    Mutant("a rejected step takes time", erk_step, "taken", 'w.where(accept, aim.t_1, p["t"])', "aim.t_1", STEPS, "closed form"),
    Mutant("the state of the time before", erk_loop, "_motion", "(ys, k, y), ys, p.y)", "(ys, k, y), ys, carry[0].y)", STEPS, "closed form"),
    Mutant("no projection", erk_step, "_tried", "problem.project(t1, y1, problem.args)", "y1", projected_steps_stay_on_a_circle, "circle"),
    Mutant(
        "no step ends at a knot",
        erk_step,
        "_tried",
        "target = jnp.where((knot - goal) * direction < 0, knot, goal)",
        "target = goal",
        steps_end_at_knots,
        "knot",
    ),
    Mutant("no dips", event_search, "decided", "((share < 1.0) | again)", "again", an_event_within_a_step_ends_the_motion, "passed over"),
    Mutant("the first step without a bound", erk_loop, "begun", "jnp.minimum(jnp.abs(dt0), problem.longest)", "jnp.abs(dt0)", LONGEST, "the longest step"),
    Mutant("no bound of steps", erk_step, "judged", ', p["longest"])', ", math.inf)", LONGEST, "the longest step"),
    Mutant("no start at an event", event_search, "at_start", "rises = (rate > 0.0)", "rises = (rate > 1e9)", LEAVES, "leaves"),
    Mutant("every start at an event", event_search, "at_start", "reach_of_noise(w, span) * rate", "rate", LEAVES, "leaves"),
    Mutant("no step refused", crossings, "watched", "(fits & (count > 0.0) & (", "(fits & (count < 0.0) & (", a_pulse_is_met, "pulse"),
    Mutant("steps as long as the way that is left", crossings, "reach", "w.larger(0.5 * (", "w.larger(1.0 * (", a_pulse_is_met, "too many|crossings"),
    Mutant("signs of the first state", crossings, "noted", "w.where(counts, new, old)", "old", a_pulse_is_met, "crossings"),
    Mutant("a change never behind", crossings, "noted", "passed = counts & (", "passed = ~counts & counts & (", a_pulse_is_met, "too many|crossings"),
    Mutant("only the ends of a step", crossings, "watched", "2.0, 0.0)", "0.0, 0.0)", a_pulse_within_a_step_is_named, "not named"),
    Mutant("no cotangents of later stages", step_adjoint, "step_vjp", "as_in(b, g) * g + weighted(column, G)", "as_in(b, g) * g", TIMES, "derivative"),
    Mutant(
        "one stage without parameters",
        step_adjoint,
        "step_vjp",
        "jnp.add, by_shared, more)",
        "lambda x, y: x + jnp.where(i == 2, 0, y), by_shared, more)",
        TIMES,
        "by k",
    ),
    Mutant("no c tau", step_adjoint, "step_vjp", "+ c * tau", "", TIMES, "by goals"),
    Mutant("the first time forgotten", step_adjoint, "step_vjp", "StepCotangents(by_t - by_h,", "StepCotangents(-by_h,", TIMES, "derivative"),
    Mutant("a projection not gone back over", step_adjoint, "step_vjp", "by_t_1, g, by_shared = jax.vjp", "by_t_1, _, by_shared = jax.vjp", TIMES, "by y0"),
    Mutant("saved times forgotten", VJP, "fn_bwd", "jnp.where(asked, at_end, 0))", "0 * at_end)", TIMES, "by goals"),
    Mutant("saved states forgotten", VJP, "fn_bwd", "y + jnp.where(k > first,", "y + 0 * jnp.where(k > first,", TIMES, "derivative"),
    Mutant(
        "an earlier window left out",
        VJP,
        "fn_bwd",
        "return number - 1, window, replace(g,",
        "return jnp.full_like(number, -1), window, replace(g,",
        TIMES,
        "derivative",
    ),
    Mutant("time of an event forgotten", recorded_adjoint, "_back_from_event", "= g.t + step_adjoint", "= 0 * g.t + step_adjoint", EVENT, "derivative"),
    Mutant(
        "an event by parameters forgotten",
        recorded_adjoint,
        "_back_from_event",
        "jnp.add, g.shared, by_shared)",
        "lambda x, y: x, g.shared, by_shared)",
        EVENT,
        "by k",
    ),
]
CHECKS = list(dict.fromkeys(mutant.check for mutant in MUTANTS))


@pytest.fixture(autouse=True)
def _nothing_kept(monkeypatch):
    """Programs are built in each test, and none of them afterwards; short windows, so that a motion has several."""
    monkeypatch.setattr(recorded_adjoint, "STEPS_ALONE", 16)
    lower._lowered.cache_clear()
    yield
    lower._lowered.cache_clear()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_without_a_mutant(check):
    check()


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.says)
def test_a_mutant_is_caught(mutant, monkeypatch):
    mutant.bring(monkeypatch)
    with pytest.raises(AssertionError, match=mutant.shown_by):
        mutant.check()


def test_a_derivative_is_no_number_where_memory_does_not_hold_the_motion(monkeypatch):
    monkeypatch.setattr(recorded_adjoint, "_SHARES", (32, 2**62))
    for windows, held in ((1, False), (40, True)):
        monkeypatch.setattr(recorded_adjoint, "_FEWEST", (16, windows))
        found, _ = jax.jit(jax.grad(weighed("reverse", "saved times"), has_aux=True))(arguments("saved times"))
        assert bool(np.isfinite(found["k"])) == held


def test_a_mutant_of_a_line_that_is_gone_is_no_mutant():
    with pytest.raises(AssertionError, match="must follow the code"):
        rewritten(erk_step.weighted, "a line that is not there", "")
