"""Stiff motions, motions that end in a singularity, and derivatives through motions that amplify errors: what
the engine does, and what it says.
"""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import result_codes as results
from numpy.testing import assert_allclose
from small_scenes import OnLine, OnPlane

import jourdain_jax as jj

TS = np.linspace(0.0, 2.0, 5)


class Damped(OnLine):
    """A particle of 1 kg that a damper drags behind a carriage moving as sin(t):
    `xddot = -rate (xdot - cos t) - sin t`, so that x = sin t.
    """

    def loads(self, motion):
        return jj.generalized_force(
            motion, x_rate=-1e7 * (motion.u.x_rate - jnp.cos(motion.t)) - jnp.sin(motion.t)
        )


class OnALine(OnLine):
    """A particle of 1 kg on a line, V(x) given by its kind: falls towards an attracting centre, or off a
    ridge.
    """

    strength: object = jj.parameter(1.0)
    domain = {"x": (0.5, 1.5)}


class Centre(OnALine):
    """`xddot = -strength / x^2`: from rest at 1 m it arrives after pi / (2 sqrt(2 strength)) s, infinitely
    fast.
    """

    def potential(self, pose):
        return -self.strength / pose.q.x


class Ridge(OnALine):
    """`xddot = strength x`: errors grow as exp(sqrt(strength) t)."""

    def potential(self, pose):
        return -self.strength * pose.q.x**2 / 2


class Drawn(OnALine):
    """`xddot = -9.81 + strength sqrt(x + 0.02)`, which is no number a little below the floor at x = 0, where
    the motion stops.
    """

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=-9.81 + self.strength * jnp.sqrt(motion.q.x + 0.02))

    def events(self, motion):
        return {"floor": motion.q.x}


@pytest.fixture(scope="module")
def damped():
    return jj.simulate(Damped(), {"x_rate": 1.0}, ts=TS, retry=True)


def test_a_stiff_motion_is_run_again_by_an_implicit_solver_and_says_so(damped):
    assert damped.raise_if_failed().fallback == results.IMPLICIT
    assert damped.solver == "RadauIIA"
    assert "with an implicit solver: the motion is stiff" in str(damped)
    assert_allclose(damped["x"], np.sin(TS), rtol=0, atol=1e-8)  # as asked
    assert int(damped.accepted) < 1000  # an explicit method needs some 3e6 for stability


def test_a_solver_that_was_chosen_is_kept_and_a_motion_that_is_not_stiff_has_no_other_solver():
    chosen = jj.simulate(
        Damped(), {"x_rate": 1.0}, ts=TS, solver=diffrax.Dopri8(), max_steps=2000, retry=True
    )
    assert chosen.result == results.MAX_STEPS
    assert chosen.fallback == results.AS_ASKED
    slow = jj.simulate(Ridge(strength=0.0), {"x": 1.0, "x_rate": 1.0}, ts=TS, max_steps=2, retry=True)
    assert int(slow.result) in (results.MAX_STEPS, results.SHRANK)
    assert slow.fallback == results.AS_ASKED


def test_a_motion_too_stiff_for_its_number_of_steps_is_called_stiff():
    motion = jj.simulate(
        Damped(), {"x_rate": 0.0}, ts=TS, max_steps=30, retry=True
    )  # 3 for the implicit solver
    assert motion.result == results.STIFF
    assert motion.message.startswith("stiff: ran out of steps")
    assert motion.warnings[0] == motion.message


def test_the_method_of_radau_is_of_order_five():
    errors = []
    for longest in (0.2, 0.1):
        steps = {"rtol": 1e3, "atol": 1e3, "max_step": longest}
        motion = jj.simulate(Ridge(strength=-4.0), {"x": 1.0}, ts=[2.0], solver=jj.RadauIIA(), **steps)
        errors.append(abs(float(motion.q_end[0]) - np.cos(4.0)))
    assert 4.7 < np.log2(errors[0] / errors[1]) < 5.4


class TurnedSkate(jj.models.Skate):
    """A skate that a stiff damper turns at 1.3 rad/s, in a domain too narrow for that: a partition seems to
    serve which fails at a right angle.
    """

    damping: object = jj.parameter(0.0)
    domain = {"heading": (-0.5, 0.5)}

    def loads(self, motion):
        return (
            *super().loads(motion),
            jj.generalized_force(motion, heading_rate=-self.damping * (motion.u.heading_rate - 1.3)),
        )


TURNED = {"heading": 0.0, "heading_rate": 1.3}


def test_a_motion_that_left_its_domain_is_run_again_where_that_is_asked_for_and_its_code_says_how():
    ts = np.array([2.0])
    told = jj.simulate(TurnedSkate(), TURNED, ts=ts)
    assert told.result == results.SINGULAR_PARTITION
    assert "retry=True" in told.message
    again = jj.simulate(TurnedSkate(), TURNED, ts=ts, retry=True)
    assert again.raise_if_failed().fallback == results.FULL_STATE
    inside = jax.jit(
        lambda rate: jj.simulate(TurnedSkate(), TURNED | {"heading_rate": rate}, ts=ts, retry=True)
    )(1.3)
    assert (int(inside.result), int(inside.fallback)) == (results.SINGULAR_PARTITION, results.AS_ASKED)


def test_steps_that_shrink_towards_a_singularity_are_named():
    motion = jj.simulate(Centre(), {"x": 1.0}, ts=TS, max_steps=70)
    assert motion.result == results.SHRANK
    assert "shrunk" in motion.message
    assert 0 < motion.last_step < 1e-3
    assert_allclose(motion.t_end, np.pi / np.sqrt(8), rtol=1e-3)


def said(derivative, x):
    """What a derivative warns of."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        derivative(x)
    return [str(warning.message) for warning in given if warning.category is jj.SensitivityWarning]


def test_a_derivative_through_a_motion_that_amplifies_errors_warns_outside_of_jit():
    scene = Ridge(strength=16.0)

    def end(
        x, rtol, scene=scene
    ):  # exp(-8) m, on the way to rest on the ridge; the derivative is cosh(8) = 1490
        return jj.simulate(scene, {"x": x, "x_rate": -4.0}, ts=TS[[0, 2, -1]], rtol=rtol, atol=rtol).q_end[0]

    (text,) = said(jax.grad(lambda x: end(x, 1e-6)), 1.0)
    assert "amplifies errors" in text
    assert "with rtol = 1e-06 and" in text
    assert said(jax.grad(lambda x: end(x, 1e-10)), 1.0) == []
    assert said(jax.jit(jax.grad(lambda x: end(x, 1e-6))), 1.0) == []  # no call back to Python in a program

    (text,) = said(jax.jacfwd(lambda strength: end(1.0, 1e-6, Ridge(strength=strength))), 16.0)
    assert "amplifies errors" in text
    (text,) = said(lambda x: jax.jvp(lambda x: end(x, 1e-6), (x,), (1.0,)), 1.0)
    assert "with rtol = 1e-06 and" in text
    assert said(jax.jacfwd(jax.jacfwd(lambda x: end(x, 1e-10))), 1.0) == []


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_an_implicit_solver_that_tries_steps_beyond_an_event_has_the_derivative_of_the_closed_form(mode):
    def landing_speed(height):
        motion = jj.simulate(Drawn(), {"x": height}, t1=3.0, ts=[0.0], solver=jj.RadauIIA(), work=False)
        return motion.u_end[0], (motion.result, motion.rejected)

    # v^2/2 + 9.81 x - (2/3) (x + 0.02)^(3/2) is constant
    stored = lambda x: 9.81 * x - (x + 0.02) ** 1.5 * 2 / 3
    speed = -np.sqrt(2 * (stored(1.0) - stored(0.0)))
    if mode == "reverse":
        (found, (code, rejected)), slope = jax.value_and_grad(landing_speed, has_aux=True)(1.0)
    else:
        found, slope, (code, rejected) = jax.jvp(landing_speed, (1.0,), (1.0,), has_aux=True)
    assert (int(code), int(rejected) > 0) == (results.EVENT, True)
    assert_allclose(found, speed, rtol=1e-7)
    assert_allclose(slope, (9.81 - np.sqrt(1.02)) / speed, rtol=1e-6)


class Following(OnPlane):
    """x is drawn to sin y by a stiff spring and damper, in about 1e-6 s to a speed, in about 1 s to the
    place; y falls to the floor by 1 m/s^2.
    """

    def loads(self, motion):
        q, u = motion.q, motion.u
        return jj.generalized_force(
            motion, x_rate=-1e6 * (q.x - jnp.sin(q.y) + u.x_rate), y_rate=-1.0 + 0.0 * q.x
        )

    def events(self, motion):
        return {"floor": motion.q.y}


def followed(height, x):
    """x at the floor: xdot = sin y - x to within 1e-6, by quadrature of exp(t - t_e) sin(y(t))."""
    end = np.sqrt(2 * height)
    nodes, weights = np.polynomial.legendre.leggauss(60)
    t = end * (nodes + 1) / 2
    return x * np.exp(-end) + end / 2 * np.sum(weights * np.exp(t - end) * np.sin(height - t**2 / 2))


@pytest.mark.parametrize("options", [{"retry": True}, {"solver": jj.RadauIIA()}], ids=["default", "RadauIIA"])
def test_a_stiff_motion_is_right_at_its_event(options):
    """It is located by steps of the solver that followed the motion."""
    for height, x in ((7.3, 0.85), (0.4, -1.0)):
        motion = jj.simulate(Following(), {"y": height, "x": x}, ts=[6.0], max_steps=20_000, **options)
        assert motion.result == results.EVENT
        assert_allclose(motion.t_end, np.sqrt(2 * height), rtol=1e-10)
        expected = followed(height, x)
        assert_allclose(motion.q_end, [expected, 0.0], rtol=0, atol=5e-6)
        assert_allclose(motion.u_end, [-expected, -np.sqrt(2 * height)], rtol=0, atol=2e-5)


def test_zero_is_no_attitude():
    top = jj.models.FreeRigidBody()
    none = jj.consistent(top, 0.0, jnp.zeros(7), jnp.zeros(6))
    assert none.residual == 0.5
    assert jj.simulate(top, none, t1=1.0).result == results.INCONSISTENT_START


def test_a_start_that_is_not_finite_is_not_called_consistent():
    skate = jj.models.Skate()
    for value in (np.nan, np.inf):
        state = jj.consistent(skate, 0.0, jnp.array([0.0, value, 0.0]), jnp.zeros(3))
        assert state.residual == np.inf
        assert jj.simulate(skate, state, t1=1.0).result == results.BAD_START


def test_the_discrete_lagrange_dalembert_equations_are_named_as_such():
    solver = jj.DiscreteLagrangeDAlembert(step=0.05)
    motion = jax.eval_shape(lambda: jj.simulate(jj.models.Skate(), t1=0.1, solver=solver))
    assert motion.reduction == "none, discrete Lagrange-d'Alembert equations, midpoint rule"
