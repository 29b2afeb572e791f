"""Periodic motions: closed forms, references by SciPy, derivatives, multipliers side by side that are 22
powers of ten apart.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from scipy.integrate import solve_ivp
from small_scenes import DrivenSleigh, OnLine

import jourdain_jax as jj


def on_a_line(force):
    """A scene of one particle of 1 kg on a line, with the force as a function of the scene, its place, speed
    and the time, and `crossing` as an event.
    """

    class Line(OnLine):
        size: float = jj.parameter(1.0)

        def loads(self, motion):
            return jj.generalized_force(
                motion, x_rate=force(self.size, motion.q.x, motion.u.x_rate, motion.t)
            )

        def events(self, motion):
            return {"crossing": motion.q.x}

    return Line()


VAN_DER_POL = on_a_line(lambda size, x, v, t: size * (1 - x**2) * v - x)
INVERTED = on_a_line(lambda size, x, v, t: 16 * size * x + jnp.sin(t))


def test_a_driven_sleigh_has_its_orbit_and_multipliers():
    """Digits of an independent integration; the heading at the start is free, and shifts back within the
    period.
    """
    orbit = jj.periodic(DrivenSleigh(), {"x_rate": 0.4, "heading_rate": -0.6}, np.pi, held="heading")
    assert orbit.converged
    assert_allclose(
        [orbit["x_rate"], orbit["heading_rate"]], [0.412558059020941, -0.603149615333924], rtol=1e-12
    )
    assert_allclose(orbit.multipliers, [1.0, 0.687051124958722, 0.307594179012466], rtol=1e-10)
    assert orbit.stable
    assert set(orbit.shift) == {"x", "y"}
    again = jj.simulate(DrivenSleigh(), orbit.state, t1=float(orbit.period), rtol=1e-12, atol=1e-12)
    assert_allclose(again.u_end, orbit.state.u, atol=1e-11)
    assert_allclose(again.q_end[:2], [orbit.shift["x"], orbit.shift["y"]], atol=1e-10)
    assert "periodic motion of 3.14159" in str(orbit)


def test_a_limit_cycle_has_its_period_and_multiplier_with_their_derivatives_in_a_batch():
    """Also by a guess beside the event. The multiplier is exp of the integral of the divergence, here by
    SciPy.

    The period for a damping of one is 6.6632868593231 s.
    """

    def found(size, x, rate):
        orbit = jj.periodic(VAN_DER_POL.replace(size=size), {"x": x, "x_rate": rate}, 6.0, until="crossing")
        both = jnp.stack([orbit.period, orbit.multipliers[0].real])
        return both, (both, orbit["x_rate"])

    h = 1e-3
    sizes = 1.0 + h * jnp.array([0.0, 0.0, -2.0, -1.0, 1.0, 2.0])
    x, rate = jnp.zeros(6).at[1].set(0.5), jnp.full(6, -2.0).at[1].set(-1.5)
    slopes, (values, speeds) = jax.jit(jax.vmap(jax.jacfwd(found, has_aux=True)))(sizes, x, rate)
    rates = lambda t, y: [y[1], (1 - y[0] ** 2) * y[1] - y[0], 1 - y[0] ** 2]
    solved = solve_ivp(
        rates, (0, values[0, 0]), [0.0, speeds[0], 0.0], method="DOP853", rtol=1e-12, atol=1e-12
    )
    by_values = (values[2] - 8 * values[3] + 8 * values[4] - values[5]) / (12 * h)
    for lane in (0, 1):
        assert values[lane, 0] == pytest.approx(6.6632868593231301, abs=1e-12)
        assert_allclose(values[lane, 1], np.exp(solved.y[2, -1]), rtol=1e-9)
        assert_allclose(slopes[lane], by_values, rtol=1e-8)


def test_multipliers_far_apart_keep_their_digits():
    """`x = -sin(t)/17` from an unstable rest; multipliers exp(+-8 pi). It passes a stop event."""
    orbit = jj.periodic(INVERTED, {"x_rate": 0.0}, 2 * np.pi, pieces=8)
    assert orbit.residual < 1e-12
    assert str(orbit).startswith("no periodic motion found near the guess")
    assert orbit["x_rate"] == pytest.approx(-1 / 17, abs=1e-13)
    assert_allclose(orbit.multipliers, np.exp([8 * np.pi, -8 * np.pi]), rtol=1e-11)
    assert not orbit.stable


class Whirling(jj.Scene):
    """A rod of 1 m that hangs from a ball joint; a torque about y drives it round, against drag."""

    by_angle: bool = eqx.field(static=True, default=True)

    @property
    def coordinates(self):
        return jj.coordinates("angle") if self.by_angle else jj.coordinates(jj.quaternion("attitude"))

    def bodies(self, t, q):
        turn = jj.rot_y(q.angle) if self.by_angle else jj.quaternion_to_matrix(q.attitude)
        moments = jnp.array([0.09, 0.08, 0.01])
        return {
            "rod": jj.RigidBody(1.0, moments, position=turn @ jnp.array([0.0, 0.0, -0.5]), orientation=turn)
        }

    def loads(self, motion):
        moment = jnp.array([0.0, 12.0, 0.0]) - 1.5 * motion["rod"].angular_velocity
        return jj.gravity(motion, 9.81), jj.torque(motion, "rod", moment)

    def events(self, motion):
        return {"hanging": motion["rod"].position[0]}


def test_an_angle_goes_round_and_a_quaternion_changes_its_sign():
    """Both are the same motion, whose divergence is constant; the quaternion also has small motions out of
    the plane.
    """
    rate = 8.0
    plane = jj.periodic(
        Whirling(), {"angle_rate": rate}, 0.9, until="hanging", shift={"angle": 2 * np.pi}, pieces=1
    )
    space = jj.periodic(Whirling(by_angle=False), {"attitude_omega_y": rate}, 0.9, until="hanging", pieces=1)
    assert plane.converged
    assert space.converged
    assert_allclose(
        [space.period, space["attitude_omega_y"]], [plane.period, plane["angle_rate"]], rtol=1e-10
    )
    assert plane.shift["angle"] == pytest.approx(2 * np.pi, abs=1e-12)
    assert_allclose(plane.multipliers, [np.exp(-1.5 / (0.08 + 0.25) * float(plane.period))], rtol=1e-9)
    assert len(space.multipliers) == 5
    assert np.min(np.abs(space.multipliers - plane.multipliers[0])) < 1e-9


def test_orbits_side_by_side_have_multipliers_of_one():
    """An oscillator is back after one time, wherever it starts. It passes a stop event of the scene."""
    oscillator = on_a_line(lambda size, x, v, t: -4.0 * size * x)
    orbit = jj.periodic(oscillator, {"x": 0.3, "x_rate": 0.5}, np.pi, pieces=1)
    assert orbit.residual < 1e-12
    assert_allclose(np.abs(orbit.multipliers), 1.0, atol=1e-6)


WRONG = {
    "`until` names `crosing`.*crossing": {"until": "crosing"},
    "in `Line` loads do; omit `until`": {"until": "crossing"},
    "`period` is 0.0, expected a positive time": {"period": 0.0},
    "no `xx` to hold": {"held": "xx"},
    "`pieces` is 0": {"pieces": 0},
    r"periodic\(\) takes no `events`": {"events": False},
}


@pytest.mark.parametrize("said", WRONG)
def test_what_is_asked_wrongly_is_named(said):
    with pytest.raises((ValueError, TypeError), match=said):
        jj.periodic(INVERTED, {}, **{"period": 6.0, **WRONG[said]})


def test_a_motion_that_is_none_says_so():
    """A particle that is pushed along never comes back; a parameter that is NaN gives no result."""
    pushed = on_a_line(lambda size, x, v, t: size * (1 + v**2))
    found = jax.jit(
        jax.vmap(
            lambda size: jj.periodic(pushed.replace(size=size), {"x_rate": 0.5}, 0.5, pieces=1).converged
        )
    )
    assert not np.any(found(jnp.array([1.0, jnp.nan])))


class Swaying(OnLine):
    """A particle about the motion sin(t): y = x - sin(t) has y'' + drag y' + y^2 - push + wobble cos(t) (y -
    1/8) = 0.
    """

    push: float = jj.parameter(1 / 64)
    drag: float = jj.parameter(0.05)
    wobble: float = jj.parameter(0.0)

    def loads(self, motion):
        t = motion.t
        y, rate = motion.q.x - jnp.sin(t), motion.u.x_rate - jnp.cos(t)
        force = -self.drag * rate - y**2 + self.push - self.wobble * jnp.cos(t) * (y - 1 / 8) - jnp.sin(t)
        return jj.generalized_force(motion, x_rate=force)


@pytest.mark.parametrize(
    ("changed", "x", "vary", "until", "kind", "value"),
    [
        ({}, 1 / 8, "push", {"x": -0.1}, "multiplier 1", 0.0),
        ({"push": 1.0}, 1.0, "drag", {"drag": -0.05}, "pair on the unit circle", 0.0),
        ({}, 1 / 8, "wobble", {"wobble": 0.3}, "multiplier -1", 0.050027335537217),
    ],
)
def test_a_family_of_orbits_tells_how_each_of_them_loses_its_stability(changed, x, vary, until, kind, value):
    """The last one: where (1 + m1)(1 + m2) of y'' + 0.05 y' + (1/4 + wobble cos(t)) y = 0 vanishes, by
    SciPy's DOP853 at 1e-12 and `brentq`.
    """
    scene = Swaying(**changed)
    found = jj.family(
        scene, jj.periodic(scene, {"x": x, "x_rate": 1.0}, 2 * np.pi, pieces=2), vary=vary, until=until
    )
    (change,) = (point for point in found.changes if point.kind == kind)
    assert change[vary] == pytest.approx(value, abs=1e-8)
    assert found.stable[0]
    assert not found.stable[-1]
    assert [fold[vary] for fold in found.folds] == pytest.approx([0.0] * (vary == "push"), abs=1e-8)
    assert "periodic motions of Swaying" in str(found)
    refused("`critical` needs a family of steady motions", jj.critical, scene, found, kind)
