"""Solvers of diffrax in `simulate`, and the rates of a scene for `diffrax.diffeqsolve`."""

import diffrax
import jax
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose

import jourdain_jax as jj

DISC = jj.models.TiltingDisc()
START = {"lean": 0.3, "spin_rate": -3.0}


def test_rates_for_diffeqsolve_give_the_motion_and_its_derivative_by_any_adjoint():
    control = diffrax.PIDController(rtol=1e-9, atol=1e-9)

    def end(radius, adjoint):
        scene = DISC.replace(radius=radius)
        start = jj.start(scene, START)
        options = {"stepsize_controller": control, "adjoint": adjoint}
        return diffrax.diffeqsolve(jj.diffrax_term(scene), diffrax.Tsit5(), 0.0, 0.5, None, (start.q, start.u), **options).ys[0][0, 0]

    def expected(radius):
        return jj.simulate(DISC.replace(radius=radius), START, ts=[0.5]).q_end[0]

    assert_allclose(end(0.5, diffrax.ForwardMode()), expected(0.5), rtol=1e-7)
    slope = jax.grad(expected)(0.5)
    assert_allclose(jax.jacfwd(lambda radius: end(radius, diffrax.ForwardMode()))(0.5), slope, rtol=1e-6)
    assert_allclose(jax.grad(lambda radius: end(radius, diffrax.RecursiveCheckpointAdjoint()))(0.5), slope, rtol=1e-6)


def test_lanes_by_a_solver_of_diffrax_are_those_of_our_own():
    lean = np.array([0.2, 0.3])
    by_own, by_diffrax = (
        jj.rollout(DISC, START | {"lean": lean}, ts=[0.2, 0.5], solver=solver, rtol=1e-7, atol=1e-7).lanes for solver in (None, diffrax.Bosh3())
    )
    assert_allclose(by_diffrax.q, by_own.q, atol=1e-5)


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd])
def test_a_solver_of_diffrax_has_derivatives_in_both_modes_up_to_an_event(derivative):
    def end(lean, **options):
        return jj.simulate(DISC, {"lean": lean, "spin_rate": -0.1}, t1=5.0, ts=[0.1], **options).t_end

    by_diffrax = derivative(lambda lean: end(lean, solver=diffrax.Bosh3(), rtol=1e-7, atol=1e-7))(0.6)
    assert_allclose(by_diffrax, jax.grad(end)(0.6), rtol=1e-5)


def test_a_fit_takes_a_solver_of_diffrax():
    ts = np.linspace(0.0, 0.5, 11)
    lean = np.asarray(jj.simulate(DISC, START, ts=ts)["lean"])
    run = jj.Experiment(ts, {"lean": lean}, 1e-4, start=START)
    found = jj.fit(DISC.replace(radius=0.45), run, free="radius", solver=diffrax.Bosh3(), rtol=1e-6, atol=1e-6)
    assert_allclose(found.scene.radius, DISC.radius, rtol=1e-4)


def test_a_state_that_leaves_its_constraints_by_more_than_errors_of_its_steps_is_a_result_code(monkeypatch):
    monkeypatch.setattr("jourdain_jax.motion.integration.MOST_STEP_ERRORS", 0.0)
    found = jj.simulate(jj.models.DoublePendulumRods(), t1=1.0, solver=diffrax.Heun(), rtol=1e-3, atol=1e-3, max_steps=1234)
    assert int(found.result) == results.OFF_CONSTRAINTS


def test_work_is_refused_with_what_integrates_it():
    class Dragged(jj.models.FreeRigidBody):
        def loads(self, motion):
            return (jj.generalized_force(motion, x_rate=-motion.u.x_rate),)

    with pytest.raises(ValueError, match=r"diffrax.Heun\(\) does not integrate the work .* of `Dragged` .* give work=False, or omit `solver`"):
        jj.simulate(Dragged(), t1=1.0, solver=diffrax.Heun())
