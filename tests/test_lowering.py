"""What lowering does to a scene, what it says where it does not, and derivatives through the program."""

import ctypes
import shutil
import subprocess
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from baselines.hand_derived import HAND_DERIVED, operations
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from small_scenes import OnLine, OnPlane, Upright
from test_load_jumps import JUMPS, KINKS, Pushed

import jourdain_jax as jj
from jourdain_jax.lowering import lower as module
from jourdain_jax.lowering.sides import may_jump
from jourdain_jax.models import MODELS
from jourdain_jax.program import numpy_backend
from jourdain_jax.program.emit import fused

# What lowering does to a scene, what it says where it does not, and derivatives through the program.


@pytest.mark.parametrize("name", HAND_DERIVED)
def test_the_program_is_nearly_as_short_as_the_equations_by_hand(name):
    assert jj.lower(MODELS[name]()).operations <= 1.5 * operations(name)


def test_scenes_without_rows_and_with_multipliers_are_shortened_too():
    assert jj.lower(MODELS["double-pendulum-angles"]()).operations <= 33
    assert "multipliers" not in str(jj.lower(MODELS["double-pendulum-angles"]()))
    skate = jj.lower(MODELS["skate"]())
    assert skate.operations <= 11
    assert "constraints enforced by multipliers" in str(skate)


def test_the_summary_says_what_was_dropped_and_chosen():
    text = str(jj.lower(MODELS["tilting-disc"]()))
    for part in (
        "independent speeds: yaw_rate, lean_rate, spin_rate",
        "eliminated: x_rate, y_rate",
        "x, y, yaw, spin",
        "operations",
    ):
        assert part in text


class Rough(jj.Scene):
    """A bead on a rough wire, pushed while it is slow or far: signs, sizes, choices, and names that a program
    might use itself.
    """

    mass: float = jj.parameter(1.3, unit="kg", positive=True)
    k1: float = jj.parameter(2.0, unit="N/m")
    double: float = jj.parameter(0.7, unit="N")
    coordinates = jj.coordinates("s0 rates")  # a length, and an angle

    def bodies(self, t, q):
        return {"bead": jj.RigidBody(self.mass, jnp.ones(3), [q.s0, 0.0, 0.0], jj.rot_x(q.rates))}

    def loads(self, motion):
        x, v = motion.q.s0, motion.u.s0_rate
        push = jnp.where((jnp.abs(v) < 0.5) | ~(x < 1.0), jnp.maximum(x, 0.1), 0.0)
        return jj.generalized_force(
            motion,
            s0_rate=push - self.k1 * x - self.double * jnp.sign(v),
            rates_rate=-self.double * jnp.sin(motion.t),
        )


PRINTED = {
    name: MODELS[name]()
    for name in ("skate", "tilting-disc", "two-wheel-axle-coordinates", "whipple-bicycle")
} | {"rough": Rough()}


@cache
def printed_states(name):
    """Times, states and inputs at which printed sources are evaluated, and the rates of the program there."""
    scene, program = PRINTED[name], jj.lower(PRINTED[name])
    t, q, u = jj.sample_states(scene, 3)
    y, inputs = u[:, np.array(program.independent, int)], np.linspace(0.3, 0.7, len(scene.inputs))
    fixed, found = program.fixed_values(scene), []
    for state in zip(np.asarray(t), np.asarray(q), np.asarray(y), strict=True):
        qdot, ydot, _ = program.rates(fixed, state[0], tuple(state[1]), tuple(state[2]), jnp.asarray(inputs))
        found.append(((*state, inputs), np.array([*qdot, *ydot], float)))
    return found


@pytest.mark.parametrize("name", PRINTED)
def test_the_readable_source_computes_the_rates(name):
    program = jj.lower(PRINTED[name])
    scope: dict = {}
    exec(program.python_source(), scope)
    fixed = scope["fixed"](*(float(x) for leaf in jax.tree.leaves(PRINTED[name]) for x in np.ravel(leaf)))
    for (t, q, y, inputs), expected in printed_states(name):
        assert_allclose(scope["rates"](fixed, t, *q, *y, *inputs), expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("name", PRINTED)
def test_the_source_in_c_compiles_without_warnings_and_computes_the_rates(name, tmp_path):
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler `cc` on this machine")
    program = jj.lower(PRINTED[name])
    (tmp_path / "rates.c").write_text(program.c_source())
    command = [
        compiler,
        *["-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "rates.c", "-o", "rates.so", "-lm"],
    ]
    made = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    rates = ctypes.CDLL(str(tmp_path / "rates.so")).rates
    vector = lambda values: (ctypes.c_double * max(1, len(values)))(*map(float, values))
    parameters = vector([x for leaf in jax.tree.leaves(PRINTED[name]) for x in np.ravel(leaf)])
    for (t, q, y, inputs), expected in printed_states(name):
        out = vector(np.zeros(len(expected)))
        rates(parameters, ctypes.c_double(t), vector(q), vector(y), vector(inputs), out)
        assert_allclose(list(out), expected, rtol=1e-11, atol=1e-11)


def test_expressions_and_latex_are_there_for_small_scenes():
    pytest.importorskip("sympy")
    program = jj.lower(MODELS["two-wheel-axle-coordinates"]())
    found = program.expressions()
    assert found["d_phi_rate"] == 0
    assert {"phi", "gravity", "slope"} <= {str(s) for s in found["d_psi1_rate"].free_symbols}
    lines = program.latex().split(" \\\\\n")
    assert r"\dot{\psi_{2}} &= - \frac{\mathrm{length} \dot{\phi}}{\mathrm{radius}} + \dot{\psi_{1}}" in lines
    assert r"\ddot{\phi} &= 0" in lines
    assert not any(line.startswith(r"\dot{\phi}") for line in lines)  # what a dot means needs no equation


def test_latex_rounds_long_numbers_only():
    pytest.importorskip("sympy")
    program = jj.lower(Sloped())
    assert program.latex() == r"\ddot{x} &= 2.89905"
    assert_allclose(float(program.expressions()["d_x_rate"]), 9.81 * np.sin(0.3), rtol=1e-14)
    assert jj.lower(PushedByHalf()).latex() == r"\ddot{x} &= \frac{1}{2}"


def test_a_notebook_shows_short_equations_and_the_summary_of_long_ones():
    pytest.importorskip("sympy")
    short, long = jj.lower(jj.models.TiltingDisc()), jj.lower(MODELS["rattleback"]())
    shown = short._repr_latex_()
    assert shown.startswith("$$\\begin{aligned}\n")
    assert short.latex() in shown
    assert long.operations > 100
    assert long._repr_latex_() is None


class Sloped(OnLine):
    """A point that a number, no parameter, pushes along x."""

    push = 9.81 * np.sin(0.3)

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=self.push)


class PushedByHalf(Sloped):
    push = 0.5


class Mistaken(jj.Scene):
    """A point on a line whose own derivative rule is wrong."""

    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        return {"point": jj.Particle(1.0, [_half_believed(q.x), 0.0, 0.0])}


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


class MistakenRow(jj.models.ChaplyginSleigh):
    """A sleigh whose blade is stated with a derivative rule that is wrong."""

    def velocity_constraints(self, motion):
        (row,) = super().velocity_constraints(motion).values()
        return {"blade": row + 0.1 * _wrong_slope(motion.q.heading)}


@pytest.mark.parametrize("scene", [Mistaken(), MistakenRow()], ids=["pose", "row"])
def test_a_derivative_rule_is_believed_as_jax_believes_it(scene):
    """Whatever it says: the program and dense matrices move in the same way."""
    assert "has a custom derivative" in jj.lower(scene).calls[0]
    program, dense = (
        jj.simulate(scene, t1=0.5, rtol=1e-10, atol=1e-10, backend=backend).raise_if_failed()
        for backend in ("auto", "dense")
    )
    assert_allclose(program.q_end, dense.q_end, rtol=1e-8, atol=1e-9)


def test_a_program_that_grows_past_the_budget_is_not_lowered_and_the_dense_path_is_taken_with_a_note(
    monkeypatch,
):
    class Disc(MODELS["tilting-disc"]):
        """One that nothing was built for."""

    scene = Disc()
    monkeypatch.setattr(module, "MOST_OPERATIONS", 9)
    monkeypatch.setattr(module, "MOST_IN_MACHINE_CODE", 9)
    module._lowered.cache_clear()
    try:
        with pytest.raises(jj.NotLowered, match="more than 9"):
            jj.lower(scene)
        assert "more than 9" in jj.report(scene).lowering
        assert jj.build(scene).way.startswith("dense matrices")
    finally:
        module._lowered.cache_clear()


class Walled(MODELS["chaplygin-sleigh"]):
    """A sleigh that is held back beyond 10 m, where no probe is."""

    def loads(self, motion):
        return (
            *super().loads(motion),
            jj.generalized_force(motion, x_rate=jnp.where(motion.q.x > 10.0, -1.0, 0.0)),
        )


def test_a_coordinate_that_chooses_a_branch_is_not_ignorable_where_no_probe_takes_the_other_one():
    assert jj.lower(MODELS["chaplygin-sleigh"]()).held == ("x", "y")
    assert jj.lower(Walled()).held == ("y",)


def test_what_a_scene_has_not_costs_nothing():
    free = jj.lower(Falling())
    assert free.operations == 0  # no row, no rotation, no force that changes, no time
    assert free.pivots == free.guards == ()
    assert not {"sin", "cos", "sqrt"} & {
        free.graph.op[n] for n in free.graph.reachable([*free.qdot, *free.ydot])
    }
    assert int(free.traced.t) not in free.graph.reachable([*free.qdot, *free.ydot])
    assert jj.lower(MODELS["rosenberg-particle"]()).operations <= 6  # particles have no rotation


class Falling(Upright):
    """A stone."""

    mass: float = jj.parameter(1.3, unit="kg", positive=True)
    gravity: float = jj.parameter(9.81, unit="m/s^2")

    def loads(self, motion):
        return jj.gravity(motion, self.gravity)


def test_values_computed_together_are_the_same_and_have_the_same_derivatives():
    both = lambda x: fused((jnp.sin(x) * 2.0, jnp.sin(x) + x))
    x = jnp.linspace(-2.0, 2.0, 7)
    assert_array_equal(jax.jit(both)(x)[1], jnp.sin(x) + x)
    assert_array_equal(jax.vmap(both)(x)[0], jnp.sin(x) * 2.0)
    slope = jax.jit(jax.grad(lambda x: jnp.sum(both(x)[0] + both(x)[1])))(x)
    assert_allclose(slope, 3 * jnp.cos(x) + 1, rtol=1e-14)
    assert_allclose(jax.jit(jax.hessian(lambda x: both(x)[0]))(0.7), -2 * np.sin(0.7), rtol=1e-14)


def test_loops_over_steps_are_compiled_into_one_function():
    """Ten times the time per step hangs on it, and on it the number of lanes in lockstep."""
    x = jnp.zeros(512)
    loop = jax.jit(
        lambda x: jax.lax.while_loop(lambda s: s[0] < 9, lambda s: (s[0] + 1, jnp.sin(s[1]) + x), (0, x))
    )
    assert "xla_cpu_small_call" in loop.lower(x).compile().as_text()


class OnNarrowEllipse(jj.Scene):
    """A bead on an ellipse whose eccentricity is near one: a tenth more, and it has no minor axis."""

    eccentricity: float = jj.parameter(0.97)
    coordinates = jj.coordinates("angle")

    def bodies(self, t, q):
        return {
            "bead": jj.Particle(
                1.0, [jnp.cos(q.angle), jnp.sqrt(1 - self.eccentricity**2) * jnp.sin(q.angle), 0.0]
            )
        }


def test_a_parameter_near_the_end_of_its_range_does_not_keep_a_scene_from_its_program():
    assert jj.lower(OnNarrowEllipse()).operations < 20
    s, c, b = np.sin(0.3), np.cos(0.3), 1 - 0.97**2
    motion = jj.simulate(
        OnNarrowEllipse(), {"angle": 0.3, "angle_rate": 2.0}, ts=[1.0], rtol=1e-11, atol=1e-11
    )
    angle, rate = float(motion.q_end[0]), float(motion.u_end[0])
    assert_allclose(
        rate**2 * (np.sin(angle) ** 2 + b * np.cos(angle) ** 2), 4.0 * (s**2 + b * c**2), rtol=1e-9
    )  # its speed is constant


# A loop of the user's that does not end is named while a scene is probed, in whatever method it stands; and
# reasons for not lowering are true.


def endless(x):
    return jax.lax.while_loop(lambda c: jnp.abs(c - x) >= 0.0, lambda c: 0.5 * (c + x), 0.0 * x)


def endless_where_negative(x):
    """A root by Newton's method, which does not arrive where there is none."""
    return jax.lax.while_loop(
        lambda c: jnp.abs(c * c - x) > 1e-12, lambda c: 0.5 * (c + x / c), 1.0 + 0.0 * x
    )


class Looped(jj.Scene):
    """A mass on a line; the loop stands in one of its methods."""

    coordinates = jj.coordinates("x y")
    where = ""
    loop = staticmethod(endless)

    def asked(self, where, x):
        return type(self).loop(x) if where == self.where else x

    def bodies(self, t, q):
        return {"mass": jj.Particle(1.0, [q.x, self.asked("bodies", q.y), 0.0])}

    def loads(self, motion):
        return jj.Load(generalized={"x_rate": self.asked("loads", -motion.q.x)})

    def velocity_constraints(self, motion):
        return {"row": motion.u.y_rate - self.asked("rows", motion.q.x)}


@pytest.mark.usefixtures("lines_are_noted")
@pytest.mark.parametrize("where", ["bodies", "loads", "rows"])
def test_a_loop_that_does_not_end_is_named(where, monkeypatch):
    monkeypatch.setattr(Looped, "where", where)
    refused(r"a `while_loop` in `endless` \(line \d+ of test_lowering.py\) does not end", jj.lower, Looped())


def test_a_loop_that_ends_at_some_states_only_is_no_reason_to_refuse_the_scene(monkeypatch):
    monkeypatch.setattr(Looped, "where", "rows")
    monkeypatch.setattr(Looped, "loop", staticmethod(endless_where_negative))
    monkeypatch.setattr(numpy_backend, "MOST_TURNS", 300)
    assert jj.structure_of(Looped()).rank == 1


class Kinked(OnPlane):
    """A row with a magnitude, at whose kink a probe lies."""

    def velocity_constraints(self, motion):
        return {"row": motion.u.y_rate - jnp.abs(motion.q.x) * motion.u.x_rate}


def test_no_scene_is_said_to_have_derivatives_of_its_own_that_has_none():
    for scene in (Kinked(), jj.models.TwoWheelAxleRedundant()):
        said = (
            jj.report(scene).lowering
            if isinstance(scene, Kinked)
            else jj.lower(scene, every_speed=True).summary()
        )
        assert "custom derivative" not in said


@pytest.mark.parametrize("name", JUMPS)
def test_jumps_are_seen(name):
    assert may_jump(Pushed(push=JUMPS[name]), True, False)


@pytest.mark.parametrize("name", KINKS)
def test_kinks_are_no_jumps(name):
    assert not may_jump(Pushed(push=KINKS[name]), False, False)
