"""State space models of small motions: outputs by name, minimal models, and controllers of python-control."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import whipple_bicycle
from refusals import refused

import jourdain_jax as jj


class Cart(jj.Scene):
    """A cart of 2 kg on a rail with two pendulums; `push` acts on it."""

    second: float = jj.parameter(0.5, unit="m")
    coordinates = jj.coordinates("x a b")
    inputs = jj.inputs("push")

    def bodies(self, t, q):
        bob = lambda angle, length: jj.vec(q.x + length * jnp.sin(angle), 0, -length * jnp.cos(angle))
        place = jj.vec(q.x, 0, 0)
        return {
            "cart": jj.Particle(2.0, place),
            "a": jj.Particle(1.0, bob(q.a, 0.5)),
            "b": jj.Particle(1.0, bob(q.b, self.second)),
        }

    def loads(self, motion):
        return jj.gravity(motion, 9.81), jj.generalized_force(motion, x_rate=motion.inputs.push)


@pytest.fixture(scope="module")
def hanging():
    return jj.linearize(Cart(), {})


def transfer(model, s):
    A, B, C, D = (np.asarray(x) for x in (model.A, model.B, model.C, model.D))
    return C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D


@pytest.mark.parametrize("outputs", ["a", "b x", "a_rate x_rate"])
def test_a_minimal_model_answers_inputs_as_the_whole_does(hanging, outputs):
    whole, small = hanging.state_space(outputs), hanging.minimal(outputs)
    assert whole.outputs == small.outputs == tuple(outputs.split())
    for s in (0.3, 1.0 + 2.0j):
        assert_allclose(transfer(small, s), transfer(whole, s), rtol=1e-11)


def test_equal_pendulums_are_one_state_and_different_ones_two(hanging):
    assert len(hanging.minimal().states) == 3  # x is ignorable; x_rate, an angle and its rate
    assert "x_rate" in hanging.minimal().states
    assert len(hanging.minimal("x").states) == 4
    both = jj.linearize(Cart(second=0.6), {}).minimal()
    assert both.states == ("a", "b", "x_rate", "a_rate", "b_rate")
    # with two equal pendulums of 1 kg on 2 kg, s^2 = -(1 + 2 m/M) g/l
    found = np.linalg.eigvals(hanging.minimal().A)
    assert_allclose(np.max(found.imag), np.sqrt(2 * 9.81 / 0.5), rtol=1e-12)


def test_outputs_may_be_functions_of_a_motion(hanging):
    model = hanging.state_space({"bob": lambda motion: motion["a"].position[0]})
    x, a = (model.states.index(name) for name in ("x", "a"))
    expected = np.zeros(6)
    expected[[x, a]] = 1.0, 0.5
    assert_allclose(model.C, expected[None], atol=1e-14)
    assert_allclose(model.D, 0.0, atol=1e-14)
    refused(
        r"output `bob` is .*expected a function of a motion",
        hanging.state_space,
        {"bob": lambda motion: motion["a"].position},
    )
    refused(r"`outputs` names `c`, .*valid names", hanging.state_space, "c")


class OnBelt(jj.Scene):
    """A particle of 1 kg whose speed along y is an input, and depends on that along x."""

    coordinates = jj.coordinates("x y")
    inputs = jj.inputs("belt pull")

    def bodies(self, t, q):
        return {"particle": jj.Particle(1.0, jj.vec(q.x, q.y, 0))}

    def velocity_constraints(self, motion):
        return {"belt": motion.u.y_rate - motion.inputs.belt - 0.3 * motion.u.x_rate}

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=motion.inputs.pull)


def test_an_input_of_a_constraint_passes_directly_to_a_dependent_speed():
    model = jj.linearize(OnBelt(), {}).state_space("y_rate")
    assert model.states == ("x", "y", "x_rate")
    assert_allclose(model.C, [[0.0, 0.0, 0.3]], atol=1e-15)
    assert_allclose(model.D, [[1.0, 0.0]], atol=1e-15)


def test_what_has_no_minimal_model_is_refused(hanging):
    refused(
        "no input moves `TiltingDisc` at this state",
        jj.linearize(jj.models.TiltingDisc(), {"spin_rate": -4.0}).minimal,
    )
    with pytest.raises(jj.DifferentiationModeError, match="`minimal` was called inside jit"):
        jax.jit(lambda x: eqx.tree_at(lambda found: found.A, hanging, x).minimal().A)(hanging.A)


def test_a_model_is_printed_with_its_names(hanging):
    text = str(hanging.minimal("a"))
    assert text.startswith("State space of Cart\n  A ")
    assert "push" in text


def test_a_bicycle_loses_its_place_its_yaw_and_its_speed_but_not_what_is_observed():
    bicycle = jj.models.WhippleBicycle()
    small = jj.linearize(bicycle, jj.start(bicycle, **bicycle.upright(5.0)), ("lean", "steer"))
    model = small.minimal()
    assert model.states == model.outputs == ("lean", "steer", "lean_rate", "steer_rate")
    assert_allclose(model.A, whipple_bicycle.state_matrix(5.0), rtol=1e-10, atol=1e-10)
    assert_allclose(model.B[2:], np.linalg.inv(whipple_bicycle.M), rtol=1e-10)
    assert small.minimal("yaw").states == ("yaw", "lean", "steer", "lean_rate", "steer_rate")
    # yaw to the left is positive here: yaw_rate = -(v steer + c steer_rate) cos(lam)/w
    expected = -np.cos(np.pi / 10) / 1.02 * np.array([0.0, 5.0, 0.0, 0.08])
    assert_allclose(small.minimal("yaw_rate").C[0], expected, atol=1e-12)


def test_python_control_has_the_same_model_with_its_names(hanging):
    control = pytest.importorskip("control")
    model = hanging.to_control("a x_rate")
    assert isinstance(model, control.StateSpace)
    assert tuple(model.state_labels) == hanging.states
    assert model.input_labels == ["push"]
    assert model.output_labels == ["a", "x_rate"]
    assert_allclose(model.A, hanging.A)
    same = hanging.state_space("a x_rate")
    assert_allclose(model(1.0 + 2.0j).reshape(2, 1), transfer(same, 1.0 + 2.0j), rtol=1e-12)
    refused(
        "`TiltingDisc` has no inputs", jj.linearize(jj.models.TiltingDisc(), {"spin_rate": -4.0}).to_control
    )


def test_without_python_control_an_error_says_what_to_install(hanging, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "control", None)
    with pytest.raises(ImportError, match=r"needs the package `control`, .* 'jourdain-jax\[interop\]'"):
        hanging.to_control()


def test_a_vector_has_numbers_and_traced_values():
    assert jj.vec(1, 2, 3).dtype == jnp.asarray(1.0).dtype
    assert_allclose(jax.jacfwd(lambda x: jj.vec(x, 0, 2 * x))(1.0), [1.0, 0.0, 2.0])
    assert_allclose(jj.vec(jnp.arange(2.0), 0, jnp.ones(2)), [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    assert jj.vec(jnp.float32(1.0), 0, 0).dtype == jnp.float32
