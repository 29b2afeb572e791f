"""Structure-preserving solvers: what each keeps, their order, their derivatives, and what is said where one
does not apply.
"""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from long_runs_scenes import ContactOscillator
from numpy.testing import assert_allclose
from oracles import chaplygin_sleigh, skate
from slopes import slope
from small_scenes import DrivenPendulum, Oscillator
from tolerances import ROUND_OFF, tolerance

import jourdain_jax as jj
from jourdain_jax.models import MODELS

MIDPOINT, DLA, GRADIENT = jj.ImplicitMidpoint, jj.DiscreteLagrangeDAlembert, jj.DiscreteGradient
TRAPEZOIDAL = partial(DLA, "trapezoidal")


def named(method):
    solver = method(step=0.1)
    return f"{solver.name} {getattr(solver, 'rule', '')}".strip()


def run(scene, start, method, *, t1, step, t0=0.0):
    """The end of a motion; always the same shapes, so that a method and a scene are compiled once."""
    motion = jj.simulate(scene, start, t0=t0, t1=t1, ts=[t1], solver=method(step=step))
    return motion.raise_if_failed() if not isinstance(motion.result, jax.core.Tracer) else motion


def order(errors):
    """Measured from the last halving of the step."""
    return float(np.log2(errors[-2] / errors[-1]))


# Order. -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [MIDPOINT, DLA, GRADIENT], ids=named)
def test_the_chaplygin_sleigh_is_followed_to_second_order(solver):
    data = chaplygin_sleigh.RUN | {"t_end": 4.0}
    exact = chaplygin_sleigh.motion(np.linspace(0.0, 4.0, 5), **data)
    right = np.array([exact[name][-1] for name in ("x", "y", "th")])
    sleigh = MODELS["chaplygin-sleigh"](mass=data["mass"], inertia=data["inertia"], offset=data["a"])
    start = jj.start(sleigh, x_rate=data["v0"], heading_rate=data["w0"])
    ends = [run(sleigh, start, solver, t1=4.0, step=step) for step in (0.05, 0.025)]
    errors = [np.max(np.abs(end.q_end - right)) for end in ends]
    assert errors[-1] < 1e-3
    assert 1.9 < order(errors) < 2.1


def test_discrete_forces_and_prescribed_coordinates_are_of_second_order_too():
    pendulum = DrivenPendulum()  # damped, sprung to a moving point, its pivot driven
    start = jj.start(pendulum, angle=0.3)
    exact = jj.simulate(pendulum, start, ts=[1.0], rtol=1e-11, atol=1e-11)
    ends = [run(pendulum, start, TRAPEZOIDAL, t1=1.0, step=step) for step in (0.02, 0.01)]
    for part in ("q_end", "u_end", "work"):
        errors = [np.max(np.abs(getattr(end, part) - getattr(exact, part))) for end in ends]
        assert 1.9 < order(errors) < 2.1, part
    assert_allclose(ends[-1].q_end[0], 0.3 * np.sin(2.0), atol=ROUND_OFF)  # the prescribed pivot


def test_rows_that_depend_on_each_other_are_left_out():
    class TwoEdges(MODELS["skate"]):
        """A skate with its row stated twice."""

        def velocity_constraints(self, motion):
            (row,) = super().velocity_constraints(motion).values()
            return {"blade": row, "blade again": 2.0 * row}

    data = skate.RUN | {"t_end": 1.0}
    edges = TwoEdges(slope=data["slope"], mass=data["mass"], inertia=data["inertia"])
    exact = skate.motion(np.array([0.0, 1.0]), **data)["x"][-1]
    start = jj.start(edges, heading_rate=data["th_rate"])
    ends = [run(edges, start, DLA, t1=1.0, step=step) for step in (0.05, 0.025)]
    errors = [np.abs(end.q_end[0] - exact) for end in ends]
    assert errors[-1] < 1e-3
    assert 1.9 < order(errors) < 2.1


# What is kept. ----------------------------------------------------------------------------------------------


def change(scene, solver, quantity, step):
    """Largest relative change of `quantity(q, u)` after 300, 700 and 1000 steps."""
    start = jj.start(scene, **scene.example)
    ends = [run(scene, start, solver, t1=steps * step, step=jnp.array(step)) for steps in (300, 700, 1000)]
    assert ends[-1].accepted == 1000
    first = quantity(start.q, start.u)
    return max(float(jnp.abs(quantity(end.q_end, end.u_end) / first - 1)) for end in ends)


def energy_of(scene):
    return lambda q, u: jj.energy(scene, 0.0, q, u).total


def driver(q, u):
    return (q[1] ** 2 + u[1] ** 2) / 2  # of the contact oscillator


def test_the_discrete_gradient_keeps_the_energy():
    oscillator = ContactOscillator()
    assert change(oscillator, GRADIENT, energy_of(oscillator), 0.2) < ROUND_OFF
    assert 1e-6 < change(oscillator, GRADIENT, driver, 0.2) < 0.1  # which it does not keep


@pytest.mark.parametrize("solver", [MIDPOINT, DLA], ids=named)
def test_midpoint_rules_keep_a_quadratic_integral(solver):
    oscillator = ContactOscillator()
    assert change(oscillator, solver, driver, 0.2) < ROUND_OFF
    assert 1e-6 < change(oscillator, solver, energy_of(oscillator), 0.2) < 0.1  # which they do not keep


def test_geometric_rows_hold_at_every_node():
    rods = MODELS["double-pendulum-rods"]()
    motion = run(rods, jj.start(rods, **rods.example), DLA, t1=1.0, step=0.02)
    assert jnp.max(jnp.abs(motion.residuals()[0])) < ROUND_OFF
    assert jnp.max(jnp.abs(motion.residuals()[1])) < ROUND_OFF


# Derivatives and batches. -----------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", [MIDPOINT, DLA, GRADIENT], ids=named)
def test_derivatives_through_fifty_steps_are_right_in_both_modes(solver):
    scene = ContactOscillator()
    start = jj.start(scene, **scene.example)

    def end(strength):
        motion = jj.simulate(scene.replace(strength=strength), start, ts=[5.0], solver=solver(step=0.1))
        return jnp.sum(jnp.sin(jnp.arange(1.0, 4.0) * motion.q_end)) + motion.u_end[-1]

    at = jnp.asarray(0.3)
    difference = float(slope(end, at, 1e-4))
    assert abs(difference) > 1e-2
    forward = jax.jvp(end, (at,), (jnp.ones_like(at),))[1]
    backward = jax.grad(end)(at)
    assert_allclose(forward, difference, rtol=tolerance("gradient_fd"))
    assert_allclose(backward, forward, rtol=1e-9)


def test_a_rollout_solves_every_lane_and_names_those_whose_step_was_not_solved():
    oscillator = ContactOscillator()
    strengths = jnp.array([0.0, 0.3, 0.6, 1e8])  # at the last, a step of 0.2 s is thousands of periods
    start = {"x": 1.0, "y": 1.0, "z": 0.5, "y_rate": 0.3}
    options = {"parameters": {"strength": strengths}, "ts": [0.0, 2.0, 4.0], "solver": DLA(step=0.2)}
    rolled = jj.rollout(oscillator, start, **options)
    assert rolled.result.tolist() == [results.SUCCESS] * 3 + [results.UNSOLVED_STEP]
    assert "equations of an implicit step were not solved" in str(rolled)
    assert not np.isfinite(rolled.lanes.q[3, -1]).any()
    assert np.isfinite(rolled.lanes.q_end).all()
    alone = run(oscillator.replace(strength=0.6), jj.start(oscillator, **start), DLA, t1=4.0, step=0.2)
    assert_allclose(rolled.lanes.q_end[2], alone.q_end, rtol=0, atol=ROUND_OFF)


# Steps, time and errors. ------------------------------------------------------------------------------------


def test_steps_between_saved_times_are_equal_and_no_longer_than_asked():
    for end, step, count in ((4.0, 0.3, 4 + 2 + 9), (3.0, 0.1, 30)):
        motion = jj.simulate(Oscillator(), {"x": 0.3}, ts=[0.0, 1.0, 1.5, end], solver=MIDPOINT(step=step))
        assert motion.raise_if_failed().accepted == count


def test_reversed_time_is_what_projections_and_events_are_given():
    class Watched(DrivenPendulum):
        """Stops where the clock falls through 0.5 s."""

        def events(self, motion):
            return {"clock": motion.t - 0.5}

    start = jj.start(Watched(), t0=1.0, angle=0.3)
    options = {"solver": diffrax.Bosh3(), "work": False}
    back = jj.simulate(Watched(), start, ts=[1.0, 0.0], **options)
    assert back.result == results.EVENT
    assert_allclose(back.t_end, 0.5, rtol=1e-12)
    assert_allclose(back.q_end[0], 0.3 * np.sin(1.0), rtol=0, atol=1e-9)  # the prescribed pivot
