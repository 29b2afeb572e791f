"""Steady motions: closed forms of the disc and the bicycle, derivatives through the root, and honest
residuals.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import rolling_disc
from slopes import slope
from small_scenes import OnLine

import jourdain_jax as jj
from jourdain_jax import steady
from jourdain_jax.models import DoublePendulumAngles, FreeRigidBody, TiltingDisc, VerticalDisc

DISC = {"mass": 1.0, "radius": 0.5, "gravity": 9.81}
GUESS = {"spin_rate": -3.0, "lean_rate": 0.3}
HELD = ("lean", "yaw_rate")


def _circle(lean, yaw_rate, **disc):
    """spin_rate in the disc's own convention."""
    return -rolling_disc.steady_circle(np.pi / 2 + lean, yaw_rate, **DISC | disc)["spin_rate"]


def _rolling(radius=0.5, lean=0.3, yaw_rate=2.0):
    guess = GUESS | {"lean": lean, "yaw_rate": yaw_rate}
    return steady(TiltingDisc(**DISC | {"radius": radius}), guess, held=HELD)


@pytest.mark.parametrize(("lean", "yaw_rate"), [(0.3, 2.0), (-0.6, 3.0), (1.0, 1.0)])
def test_a_disc_rolls_in_the_circle_of_the_closed_form(lean, yaw_rate):
    found = _rolling(lean=lean, yaw_rate=yaw_rate)
    assert found.converged
    assert found.residual < 1e-11  # rad/s^2, with spins up to 20 rad/s
    assert found["lean"] == lean
    assert found["yaw_rate"] == yaw_rate
    assert found["lean_rate"] == pytest.approx(0.0, abs=1e-12)
    assert_allclose(found["spin_rate"], _circle(lean, yaw_rate), rtol=1e-12)
    assert "steady motion" in str(found)


def _spin(radius, lean):
    return _rolling(radius, lean)["spin_rate"]


def test_derivatives_of_a_steady_motion_are_those_of_the_closed_form():
    """In a parameter and in a held value, forward and reverse."""
    closed = lambda radius, lean: _circle(lean, 2.0, radius=radius)
    expected = slope(lambda x: closed(x, 0.3), 0.5), slope(lambda x: closed(0.5, x), 0.3)
    reverse = jax.jit(jax.grad(_spin, (0, 1)))(0.5, 0.3)
    assert_allclose(reverse, expected, rtol=1e-6)
    assert_allclose(jax.jit(jax.jacfwd(_spin, (0, 1)))(0.5, 0.3), reverse, rtol=1e-12)


def test_second_derivatives_of_a_steady_motion_are_those_of_the_closed_form():
    second = slope(lambda x: slope(lambda radius: _circle(0.3, 2.0, radius=radius), x), 0.5)
    assert_allclose(jax.jit(jax.jacfwd(jax.jacfwd(_spin)))(0.5, 0.3), second, rtol=1e-5)


def test_steady_motions_are_found_in_batches():
    leans = jnp.array([0.2, 0.5, 0.8])
    found = jax.jit(jax.vmap(lambda lean: _rolling(lean=lean)))(leans)
    assert_allclose(found["spin_rate"], [_circle(float(lean), 2.0) for lean in leans], rtol=1e-11)
    assert found.converged.all()


def test_a_pendulum_comes_to_rest_at_an_equilibrium():
    pendulum = DoublePendulumAngles()
    found = steady(pendulum, {"theta1": 0.4, "theta2": -0.3, "theta1_rate": 0.5})
    assert_allclose(jnp.concatenate([found.state.q, found.state.u]), np.zeros(4), atol=1e-12)
    inverted = steady(pendulum, {"theta1": 3.0, "theta2": 0.1})
    assert_allclose(inverted.state.q, [np.pi, 0.0], atol=1e-12)


def test_a_free_body_spins_steadily_about_the_nearest_axis():
    found = steady(
        FreeRigidBody(), {"attitude_omega_z": 2.0, "attitude_omega_x": 0.1}, held=("attitude_omega_z",)
    )
    assert found.converged
    assert_allclose(found["attitude_omega"], [0.0, 0.0, 2.0], atol=1e-10)


def test_where_there_is_no_steady_motion_the_residual_says_so():
    """A disc that leans and neither yaws nor spins falls."""
    found = steady(TiltingDisc(**DISC), {"lean": 0.3}, held=("lean", "yaw_rate", "spin_rate", "lean_rate"))
    assert not found.converged
    assert_allclose(found.acceleration, 9.81 * 0.5 * np.sin(0.3) / (0.25 / 4 + 0.25), rtol=1e-9)
    assert "no steady motion found" in str(found)


def test_a_motion_forbidden_to_move_comes_to_rest():
    found = steady(TiltingDisc(**DISC), {"lean": 0.1, "yaw_rate": 1.0, "spin_rate": 1.0}, moving=())
    assert_allclose(found.state.u, np.zeros(5), atol=1e-10)
    assert found["lean"] == pytest.approx(0.0, abs=1e-10)


class Sprung(OnLine):
    """A particle on a stiffening spring, pushed by an input and by a load that depends on time."""

    inputs = jj.inputs("push")

    def loads(self, motion):
        return jj.generalized_force(
            motion, x_rate=motion.inputs.push + jnp.cos(motion.t) - 4.0 * motion.q.x - motion.q.x**3
        )


def test_an_equilibrium_is_that_of_the_inputs_and_of_the_time():
    # the load that depends on time is -1 N at pi s, and does not change there: 4 x + x^3 = 2.125
    found = steady(Sprung(), {"x": 0.1}, t0=np.pi, inputs={"push": 3.125})
    assert found.converged
    assert_allclose(found["x"], 0.5, rtol=1e-12)
    moving = steady(Sprung(), {"x": 0.1}, t0=1.0, inputs={"push": 3.125})
    assert not moving.converged
    assert_allclose(moving.residual, np.sin(1.0), rtol=1e-6)  # |d2y/dt2|


def test_what_is_steady_depends_on_the_speeds_that_are_to_be_constant():
    circle = {"heading_rate": 0.5, "roll_rate": 3.0}
    rolled = lambda *speeds: steady(VerticalDisc(), circle, held=tuple(circle), privileged=speeds)
    assert rolled("roll_rate", "heading_rate").converged
    found = rolled("x_rate", "heading_rate")  # the velocity along x turns with the heading
    assert not found.converged
    assert_allclose(
        found.residual, 0.5**2 * abs(float(found["x_rate"])), rtol=1e-6
    )  # |d2y/dt2|, where x_rate has its largest value


def test_a_search_of_one_step_says_that_it_did_not_arrive():
    found = steady(Sprung(), {"x": 10.0}, options=jj.Options(max_steps=1))
    assert not found.converged
    assert found.residual > 1e-4
