"""Solvers of diffrax in `simulate`, and the rates of a scene for `diffrax.diffeqsolve`."""

from functools import partial

import diffrax
import jax
import numpy as np
import result_codes as results
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import Oscillator

import jourdain_jax as jj

SLEIGH = jj.models.ChaplyginSleigh()
START = {"x_rate": 0.6, "heading_rate": 0.9}


def test_rates_for_diffeqsolve_give_the_motion_and_its_derivative_by_any_adjoint():
    """Of x = cos(w t) / 2, with w^2 = k / m, at 0.5 s."""
    ways = [diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()]

    def end(stiffness, adjoint):
        scene = Oscillator(damping=0.0, stiffness=stiffness)
        start = jj.start(scene, {"x": 0.5})
        options = {"stepsize_controller": diffrax.ConstantStepSize(), "adjoint": adjoint, "max_steps": 64}
        return diffrax.diffeqsolve(
            jj.diffrax_term(scene), diffrax.Tsit5(), 0.0, 0.5, 0.01, (start.q, start.u), **options
        ).ys[0][0, 0]

    forward, backward = (partial(end, adjoint=way) for way in ways)
    w = np.sqrt(5.0 / 2.0)
    slope = -0.125 * np.sin(0.5 * w) / (2 * 2.0 * w)
    assert_allclose(
        jax.jit(lambda k: jax.jvp(forward, (k,), (1.0,)))(5.0), (0.5 * np.cos(0.5 * w), 2 * slope), rtol=1e-6
    )
    assert_allclose(jax.jit(jax.grad(backward))(5.0), 2 * slope, rtol=1e-6)


def test_lanes_by_a_solver_of_diffrax_are_those_of_our_own():
    starts = START | {"x_rate": np.array([0.5, 0.6])}
    by_own, by_diffrax = (
        jj.rollout(SLEIGH, starts, ts=[0.2, 0.5], solver=solver, rtol=1e-7, atol=1e-7).lanes
        for solver in (None, diffrax.Bosh3())
    )
    assert_allclose(by_diffrax.q, by_own.q, atol=1e-5)


class Passing(Oscillator):
    """An oscillator that is stopped in the middle."""

    def events(self, motion):
        return {"passed": motion.q.x}


def test_a_solver_of_diffrax_has_derivatives_backwards_up_to_an_event():
    def end(stiffness):
        scene = Passing(damping=0.0, stiffness=stiffness)
        return jj.simulate(
            scene, {"x": 0.5}, t1=5.0, ts=[0.1], solver=diffrax.Bosh3(), rtol=1e-7, atol=1e-7, work=False
        ).t_end

    assert_allclose(
        jax.jit(jax.grad(end))(5.0), -np.pi / 4 * np.sqrt(2.0 / 5.0) / 5.0, rtol=1e-5
    )  # t = pi/2 sqrt(m/k)


def test_a_fit_takes_a_solver_of_diffrax():
    ts, truth = np.linspace(0.0, 1.0, 11), Oscillator()
    run = jj.Experiment(
        ts, {"x": np.asarray(jj.simulate(truth, {"x": 0.5}, ts=ts)["x"])}, 1e-4, start={"x": 0.5}
    )
    found = jj.fit(
        Oscillator(stiffness=4.5), run, free="stiffness", solver=diffrax.Bosh3(), rtol=1e-6, atol=1e-6
    )
    assert_allclose(found.scene.stiffness, truth.stiffness, rtol=1e-4)


def test_a_state_that_leaves_its_constraints_by_more_than_errors_of_its_steps_is_a_result_code(monkeypatch):
    monkeypatch.setattr("jourdain_jax.motion.integration.MOST_STEP_ERRORS", 0.0)
    found = jj.simulate(
        jj.models.DoublePendulumRods(), t1=1.0, solver=diffrax.Heun(), rtol=1e-3, atol=1e-3, max_steps=1234
    )
    assert found.result == results.OFF_CONSTRAINTS


def test_work_is_refused_with_what_integrates_it():
    refused(
        r"diffrax.Heun\(\) cannot integrate the work .* of `Oscillator` .* pass work=False or omit"
        r" `solver`",
        jj.simulate,
        Oscillator(),
        t1=1.0,
        solver=diffrax.Heun(),
    )
