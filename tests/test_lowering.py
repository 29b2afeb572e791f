"""What lowering does to a scene, what it says where it does not, and derivatives through the program.

That its numbers are those of the dense path, for every model, is tested in `test_every_model`.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from baselines.hand_derived import HAND_DERIVED, operations

import jourdain_jax as jj
from jourdain_jax.equations.minimal import speeds_from_privileged
from jourdain_jax.lowering import lower as module
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.trace import event_values
from jourdain_jax.models import MODELS
from jourdain_jax.motion import lockstep, results
from jourdain_jax.program.emit import run
from jourdain_jax.program.together import together


@pytest.mark.parametrize("name", HAND_DERIVED)
def test_the_program_is_nearly_as_short_as_the_equations_by_hand(name):
    assert jj.lower(MODELS[name]()).operations <= 1.5 * operations(name)


def test_the_bicycle_takes_no_more_than_2500_operations():
    assert jj.lower(MODELS["whipple-bicycle"]()).operations <= 2500


def test_scenes_without_rows_and_with_multipliers_are_shortened_too():
    assert jj.lower(MODELS["double-pendulum-angles"]()).operations <= 33
    assert "multipliers" not in str(jj.lower(MODELS["double-pendulum-angles"]()))
    skate = jj.lower(MODELS["skate"]())
    assert skate.operations <= 11
    assert "rows kept by multipliers, by elimination" in str(skate)


def test_the_summary_says_what_was_dropped_and_chosen():
    text = str(jj.lower(MODELS["tilting-disc"]()))
    for part in ("privileged speeds: yaw_rate, lean_rate, spin_rate", "eliminated: x_rate, y_rate", "x, y, yaw, spin", "operations"):
        assert part in text


def test_the_readable_source_computes_the_rates():
    scene = MODELS["tilting-disc"]()
    program = jj.lower(scene)
    scope: dict = {}
    exec(program.python_source(), scope)
    t, q, u = (x[0] for x in jj.sample_states(scene, 1))
    y = u[list(program.independent)]
    found = scope["rates"](scope["fixed"](*(float(x) for x in jax.tree.leaves(scene))), t, *q, *y)
    udot = jj.accelerations(scene, t, q, u).udot
    np.testing.assert_allclose(found, [*u, *udot[jnp.array(program.independent)]], rtol=1e-12, atol=1e-12)
    assert "void rates(" in program.c_source()


def test_expressions_and_latex_are_there_for_small_scenes():
    pytest.importorskip("sympy")
    program = jj.lower(MODELS["two-wheel-axle-coordinates"]())
    found = program.expressions()
    assert found["d_phi_rate"] == 0
    assert {"phi", "gravity", "slope"} <= {str(s) for s in found["d_psi1_rate"].free_symbols}
    assert r"\dot{" in program.latex()


class Steered(jj.Scene):
    """A point driven by a control law that iterates: no scalar form."""

    mass: jnp.ndarray = jj.parameter(1.0, positive=True)
    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        return {"point": jj.Particle(self.mass, jnp.stack([q.x, 0.0 * q.x, 0.0 * q.x]))}

    def loads(self, motion):
        newton = lambda v: v - (v**3 + v - motion.q.x) / (3 * v * v + 1)  # noqa: E731
        root = jax.lax.while_loop(lambda v: jnp.abs(newton(v) - v) > 1e-12, newton, jnp.zeros_like(motion.q.x))
        return (jj.generalized_force(motion, x_rate=-root),)


class Mistaken(Steered):
    """A spring force whose own derivative rule is wrong: the dense path believes the rule."""

    def bodies(self, t, q):
        return {"point": jj.Particle(self.mass, jnp.stack([_half_believed(q.x), 0.0 * q.x, 0.0 * q.x]))}

    def loads(self, motion):
        return ()


@jax.custom_jvp
def _half_believed(x):
    return jnp.sin(x)


@_half_believed.defjvp
def _half_believed_jvp(primals, tangents):
    return jnp.sin(primals[0]), _wrong_slope(primals[0]) * tangents[0]


@jax.custom_jvp
def _wrong_slope(x):
    return jnp.cos(x)


@_wrong_slope.defjvp
def _wrong_slope_jvp(primals, tangents):
    return jnp.cos(primals[0]), 3.0 * tangents[0]


def test_a_scene_without_scalar_form_runs_and_the_report_says_why():
    scene = Steered()
    with pytest.raises(jj.NotLowered, match="`Steered` is not lowered: the operation `while` has no scalar form"):
        jj.lower(scene)
    assert jj.report(scene).lowering.startswith("not lowered: the operation `while`")
    motion = jj.simulate(scene, {"x": 1.0}, t1=1.0)
    assert int(motion.result) == results.SUCCESS


def test_a_scene_whose_program_differs_from_the_dense_path_is_not_lowered_and_the_rate_is_named():
    with pytest.raises(jj.NotLowered, match=r"the rate of `x_rate` differs from the dense path by .*: a body, load or row has a derivative of its own"):
        jj.lower(Mistaken())


def test_a_program_that_grows_past_the_budget_is_not_lowered(monkeypatch):
    monkeypatch.setattr(module, "MOST_OPERATIONS", 50)
    module._lowered.cache_clear()
    found = lowered(MODELS["rattleback"]())
    module._lowered.cache_clear()
    assert isinstance(found, jj.NotLowered)
    assert "more than 50" in str(found)


def test_derivatives_through_the_program_agree_with_the_dense_path_in_first_and_second_order():
    scene = MODELS["tilting-disc"]()
    program = jj.lower(scene)
    t, q, u = (x[0] for x in jj.sample_states(scene, 1))
    independent = np.array(program.independent)

    def by_program(x):
        own = scene.replace(mass=x[0], radius=x[1], gravity=x[2])
        qdot, ydot, _ = program.rates(program.fixed_values(own), t, list(x[3:8]), list(x[8:]), jnp.zeros(0))
        return jnp.sin(jnp.stack([*qdot, *ydot])).sum()

    def dense(x):
        own = scene.replace(mass=x[0], radius=x[1], gravity=x[2])
        u = speeds_from_privileged(own, program.independent, t, x[3:8], x[8:])
        return jnp.sin(jnp.concatenate([jj.coordinate_rates(own, t, x[3:8], u), jj.accelerations(own, t, x[3:8], u).udot[independent]])).sum()

    x = jnp.concatenate([jnp.array([1.1, 0.4, 9.7]), q, u[independent]])
    direction = jnp.asarray(np.random.default_rng(0).normal(size=x.shape))
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(*(jax.jit(derivative(f))(x) for f in (by_program, dense)), rtol=1e-10, atol=1e-10)
    second = [jax.jit(lambda x, f=f: jax.jvp(jax.grad(f), (x,), (direction,))[1])(x) for f in (by_program, dense)]
    np.testing.assert_allclose(*second, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["tilting-disc", "ball-on-turntable", "skate", "snakeboard", "isokinetic-particle", "pendulum-chain"])
def test_the_lowered_motion_is_the_dense_one(name):
    scene = MODELS[name]()
    options = {"t1": 2.0, "rtol": 1e-10, "atol": 1e-10}
    program, dense = jj.simulate(scene, **options), jj.simulate(scene, lowering=False, **options)
    assert int(program.result) == int(dense.result) == results.SUCCESS
    np.testing.assert_allclose(program.q, dense.q, atol=1e-8)
    np.testing.assert_allclose(program.u, dense.u, atol=1e-7)
    if dense.work is not None:
        np.testing.assert_allclose(program.work, dense.work, atol=1e-8)


def test_a_batch_written_for_batches_is_the_same_motion():
    scene = MODELS["tilting-disc"]()
    leans = np.linspace(0.1, 0.4, 3)
    lanes = jj.rollout(scene, {"lean": leans, "spin_rate": -3.0}, t1=1.0, rtol=1e-10, atol=1e-10)
    alone = jj.simulate(scene, {"lean": leans[1], "spin_rate": -3.0}, t1=1.0, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(lanes.lanes.q[1], alone.q, atol=1e-9)


def disc_ends(x):
    """Final coordinates of discs whose starts and parameters are given, (lanes, 4)."""
    starts = dict(zip(("lean", "yaw_rate", "spin_rate"), x.T[:3], strict=True))
    options = {"ts": jnp.array([0.5, 1.0]), "events": False, "adjoint": diffrax.ForwardMode()}
    return jj.rollout(MODELS["tilting-disc"](), starts, parameters={"radius": x[:, 3]}, **options).lanes.q[:, -1]


def test_lanes_that_do_not_fill_a_block_move_as_they_do_alone_and_so_do_their_derivatives():
    lanes = lockstep.TOGETHER + 3  # the second block holds three lanes and copies
    x = jnp.asarray(np.array([0.3, 0.5, -3.0, 0.5]) * (1 + 0.1 * np.random.default_rng(1).normal(size=(lanes, 4))))
    along = jnp.ones_like(x)
    found, slope = jax.jit(lambda x: jax.jvp(disc_ends, (x,), (along,)))(x)
    alone, slope_alone = (np.concatenate(part) for part in zip(*(jax.jvp(disc_ends, (x[i : i + 1],), (along[:1],)) for i in (0, lanes - 1)), strict=True))
    np.testing.assert_allclose(found[np.array([0, lanes - 1])], alone, rtol=1e-9)
    np.testing.assert_allclose(slope[np.array([0, lanes - 1])], slope_alone, rtol=1e-9)


def test_values_computed_together_are_the_same_and_have_the_same_derivatives():
    both = lambda x: together((jnp.sin(x) * 2.0, jnp.sin(x) + x))  # noqa: E731
    x = jnp.linspace(-2.0, 2.0, 7)
    np.testing.assert_array_equal(jax.jit(both)(x)[1], jnp.sin(x) + x)
    np.testing.assert_array_equal(jax.vmap(both)(x)[0], jnp.sin(x) * 2.0)
    np.testing.assert_allclose(jax.grad(lambda x: jnp.sum(both(x)[0] + both(x)[1]))(x), 3 * jnp.cos(x) + 1, rtol=1e-14)
    np.testing.assert_allclose(jax.hessian(lambda x: both(x)[0])(0.7), -2 * np.sin(0.7), rtol=1e-14)


def test_rates_mapped_over_states_are_linearised_inside_jit():
    """A rate that is the same in all lanes (a skate has one) has no axis of lanes, by itself and in the rule of differentiation."""
    scene = MODELS["skate"]()
    program = jj.lower(scene)
    fixed, (_, q, u) = program.fixed_values(scene), jj.sample_states(scene, 3)
    y = u[:, np.array(program.independent)]

    def rates(y):
        return program.rates(fixed, 0.0, tuple(q[0]), tuple(y), jnp.zeros(0))[:2]

    values, slope = jax.linearize(jax.jit(jax.vmap(rates)), y)
    for along, (value, expected) in ((y, jax.jvp(jax.vmap(rates), (y,), (y,))), (2 * y, jax.jvp(jax.vmap(rates), (y,), (2 * y,)))):
        for a, b in zip(jax.tree.leaves((values, slope(along))), jax.tree.leaves((value, expected)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14)


def test_loops_over_steps_are_compiled_into_one_function():
    """Ten times the time per step hangs on it."""
    assert lockstep.loops_are_single_functions()


def test_derivatives_by_the_jacobian_on_the_graph_are_those_of_jax():
    scene = MODELS["tilting-disc"]()
    program = jj.lower(scene)
    fixed, (_, q, u) = program.fixed_values(scene), jj.sample_states(scene, 1)
    x = jnp.concatenate([jnp.stack(fixed), q[0], u[0, jnp.array(program.independent)]])

    def split(x):
        n, m = len(fixed), len(program.coordinates)
        return tuple(x[:n]), tuple(x[n : n + m]), tuple(x[n + m :])

    def by_rule(x):
        a, q, y = split(x)
        return jnp.stack([r for part in program.rates(a, 0.0, q, y, jnp.zeros(0))[:2] for r in part])

    def by_jax(x):
        a, q, y = split(x)
        known = dict(zip(program._variables, (*a, 0.0, *q, *y), strict=True))
        return jnp.stack([jnp.asarray(r) for r in run(program.graph, [*program.qdot, *program.ydot], known)])

    np.testing.assert_allclose(by_rule(x), by_jax(x), rtol=1e-15)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(by_rule)(x), derivative(by_jax)(x), rtol=1e-12, atol=1e-12)
    v = jnp.linspace(-1, 1, len(x))
    second = lambda f: jax.jvp(lambda x: jax.jvp(f, (x,), (v,))[1], (x,), (v,))[1]  # noqa: E731
    np.testing.assert_allclose(second(by_rule), second(by_jax), rtol=1e-11, atol=1e-11)
    pull = lambda f: jax.grad(lambda x: jnp.vdot(jax.grad(lambda x: jnp.sum(jnp.sin(f(x))))(x), v))(x)  # noqa: E731
    np.testing.assert_allclose(pull(by_rule), pull(by_jax), rtol=1e-11, atol=1e-11)


class WatchedDisc(jj.models.TiltingDisc):
    """Stops by a condition that has no scalar form."""

    def events(self, motion):
        return {"far": 0.5 - jnp.linalg.svd(jnp.stack([motion.q.x, motion.q.y])[None], compute_uv=False)[0]}


def test_stop_events_are_part_of_the_program_or_stay_dense_alone():
    scene = MODELS["tilting-disc"]()
    program = jj.lower(scene)
    (t,), (q,), (u,) = jj.sample_states(scene, 1)
    y = u[np.array(program.independent)]
    values = program.event_values(program.fixed_values(scene), t, tuple(q), tuple(y), jnp.zeros(0))
    np.testing.assert_allclose(values, event_values(scene, jj.motion_at(scene, t, q, u)), rtol=1e-14)
    watched = WatchedDisc()
    assert jj.lower(watched).events == ()
    assert jj.lower(watched).operations == program.operations
    found = jj.simulate(watched, {"lean": 0.1, "spin_rate": -3.0}, t1=2.0)
    assert found.result == results.EVENT
    np.testing.assert_allclose(jnp.hypot(found.q_end[0], found.q_end[1]), 0.5, rtol=1e-9)
    lanes = jj.rollout(watched, {"lean": np.full(3, 0.1), "spin_rate": -3.0}, t1=2.0)
    np.testing.assert_allclose(lanes.lanes.t_end, found.t_end, rtol=1e-7)
