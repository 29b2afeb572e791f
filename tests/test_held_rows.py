"""Rows that hold until their force exceeds a limit: friction in joints, and blades that slip sideways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import with_value
from numpy.testing import assert_allclose
from refusals import refused
from scipy.integrate import solve_ivp

import jourdain_jax as jj

TIGHT = {"rtol": 1e-12, "atol": 1e-12}


class Oscillator(jj.Scene):
    """A mass on a spring that rubs: |x| falls by 2 F/k in each half swing of pi sqrt(m/k)."""

    mass: float = jj.parameter(1.3)
    stiffness: float = jj.parameter(20.0)
    friction: float = jj.parameter(0.9)
    coordinates = jj.coordinates("x")

    def bodies(self, t, q):
        return {"mass": jj.Particle(self.mass, jnp.stack([q.x, 0 * q.x, 0 * q.x]))}

    def loads(self, motion):
        spring = jj.generalized_force(motion, x_rate=-self.stiffness * motion.q.x)
        return spring, jj.joint_friction(motion, x_rate=self.friction)


def rest(x, friction, stiffness=20.0):
    """Where it stays, after how many half swings."""
    swings = 0
    while stiffness * abs(x) > friction:
        x = np.sign(-x) * (abs(x) - 2 * friction / stiffness)
        swings += 1
    return x, swings


def end(x, friction, backend="auto"):
    model = jj.build(Oscillator(friction=friction), backend=backend)
    return jj.simulate(model, {"x": x}, ts=[8.0], **TIGHT)["x"][0]


def test_an_oscillator_that_rubs_stops_where_the_spring_no_longer_moves_it():
    x, swings = rest(0.5, 0.9)
    assert swings == 6
    assert end(0.5, 0.9) == pytest.approx(x, abs=1e-11)
    slopes = jax.jit(jax.jacrev(lambda p: end(p[0], p[1])))(np.array([0.5, 0.9]))
    assert_allclose(slopes, [(-1.0) ** swings, -((-1.0) ** swings) * 2 * swings / 20.0], atol=1e-9)


def test_a_batch_of_oscillators_stops_after_different_numbers_of_swings():
    forces = np.linspace(0.4, 6.0, 12)
    motions = jj.rollout(
        Oscillator(), {"x": np.full(12, 0.5)}, parameters={"friction": forces}, ts=[12.0], **TIGHT
    )
    assert len({rest(0.5, force)[1] for force in forces}) > 5
    assert_allclose(motions["x"][:, 0], [rest(0.5, force)[0] for force in forces], atol=1e-10)


def test_arrays_of_jax_have_the_same_motion():
    assert end(0.5, 0.9, "xla") == pytest.approx(rest(0.5, 0.9)[0], abs=1e-11)


class Sled(jj.Scene):
    """A sled whose blade, along its axis under the mass centre, slips sideways above a force."""

    holds: float = jj.parameter(3.0)
    coordinates = jj.coordinates("x y yaw")

    def bodies(self, t, q):
        where = jnp.stack([q.x, q.y, 0 * q.x])
        return {"sled": jj.RigidBody(1.5, jnp.diag(jnp.array([0.1, 0.1, 0.2])), where, jj.rot_z(q.yaw))}

    def velocity_constraints(self, motion):
        sled = motion["sled"]
        return {"blade": jj.knife_edge(sled, sled.position, sled.orientation[:, 1], holds=self.holds)}


def closed_sled(holds, t):
    """Place at t of a sled that turns at 2 rad/s, begins at 1.5 m/s, slips until yaw is pi, then holds."""
    r = holds / 1.5 / 2.0  # F/(m w)
    slid = jnp.pi / 2
    place = jnp.stack([(1.5 - r) * slid, r])
    ahead, turned = 2 * r - 1.5, 2 * t
    return place + ahead / 2 * jnp.stack([jnp.sin(turned), -1 - jnp.cos(turned)])


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_a_blade_slips_where_a_turn_needs_more_than_it_holds(derivative):
    def place(holds):
        start = {"x_rate": 1.5, "yaw_rate": 2.0}
        motion = jj.simulate(Sled(holds=holds), start, t0=0.0, ts=[2.5], **TIGHT)
        return jnp.stack([motion["x"][0], motion["y"][0]])

    found = with_value(derivative, place)(3.0)
    right = with_value(jax.jacfwd, lambda holds: closed_sled(holds, 2.5))(3.0)
    for one, exact, error in zip(found, right, (1e-8, 1e-10), strict=True):
        assert_allclose(one, exact, atol=error)
    motion = jj.simulate(Sled(), {"x_rate": 1.5, "yaw_rate": 2.0}, t0=0.0, ts=[1.0, 2.5])
    assert motion.phase("blade").tolist() == [2, 1]
    assert "blade: holds" in str(motion.phases)


class Chain(jj.Scene):
    """Two rods that hang from one another, with friction in both joints."""

    coordinates = jj.coordinates("first second")

    def bodies(self, t, q):
        turn, place, found = jnp.zeros(()), jnp.zeros(3), {}
        for name, angle in (("upper", q.first), ("lower", q.second)):
            turn = turn + angle
            along = jnp.stack([jnp.sin(turn), 0 * turn, -jnp.cos(turn)])
            inertia = jnp.diag(jnp.array([0.02, 0.02, 0.001]))
            found[name] = jj.RigidBody(0.8, inertia, place + 0.25 * along, jj.rot_y(-turn))
            place = place + 0.5 * along
        return found

    def loads(self, motion):
        return jj.gravity(motion, 9.81), jj.joint_friction(motion, first_rate=0.3, second_rate=0.15)


def test_two_joints_stop_and_start_as_by_an_independent_integration():
    """Each interval without a change of modes by SciPy; the modes from the equations of each."""
    m, l, c, I, F = 0.8, 0.5, 0.25, 0.02, np.array([0.3, 0.15])

    def pushed(y, modes):
        """Forces that hold, and accelerations; modes: 0 holds, +1 and -1 slip."""
        (bend, u), whole = (y[1], y[2]), y[2] + y[3]
        across, pull = I + m * c * (c + l * np.cos(bend)), m * l * c * np.sin(bend)
        M = np.array([[2 * across + m * l * l, across], [across, I + m * c * c]])
        upper, lower = m * 9.81 * np.sin([y[0], y[0] + bend]) * [c + l, c]
        f = pull * np.array([whole**2 - u**2, -(u**2)]) - [upper + lower, lower] - F * modes
        held, G = modes == 0, np.linalg.inv(M)
        L = -np.linalg.pinv(held[:, None] * G * held) @ G @ f
        return L, G @ (f + L)

    def fits(y, modes):
        L, a = pushed(y, modes)
        at_rest = np.where(modes == 0, np.abs(L) <= F + 1e-13, a * modes > -1e-9)
        return np.all(np.where(np.abs(y[2:]) > 1e-12, modes == np.sign(y[2:]), at_rest))

    def left(t, y, modes):
        """What is left of each mode."""
        return np.where(modes == 0, F - np.abs(pushed(y, modes)[0]), modes * y[2:])

    def ends(t, y, modes):
        return np.min(left(t, y, modes))

    ends.terminal, ends.direction = True, -1
    t, y, begins, changes = 0.0, np.array([1.2, -0.9, 0.0, 0.0]), None, -1
    while t < 3.0:
        tried = [np.array(one) - 1 for one in np.ndindex(3, 3)]
        (modes,) = (one for one in tried if fits(y, one) and (begins is None or one[begins]))
        found = solve_ivp(
            lambda t, y, modes: np.append(y[2:], pushed(y, modes)[1]),
            (t, 3.0),
            y,
            "DOP853",
            args=(modes,),
            events=ends,
            rtol=1e-12,
            atol=1e-13,
            max_step=0.05,
        )
        t, y = found.t[-1], found.y[:, -1]
        changed = np.argmin(left(t, y, modes))
        begins = None if modes[changed] else changed
        y[2:][(modes == 0) | (np.arange(2) == changed)] = 0.0
        changes += 1
    motion = jj.simulate(Chain(), {"first": 1.2, "second": -0.9}, ts=[3.0], **TIGHT)
    assert changes >= 4
    assert_allclose([motion["first"][0], motion["second"][0]], y[:2], atol=1e-8)


def test_what_cannot_hold_is_refused():
    class Unknown(Oscillator):
        def loads(self, motion):
            return jj.joint_friction(motion, y_rate=1.0)

    refused("friction on unknown speed `y_rate`", Unknown)
    refused(
        r"the friction of `x_rate` of `Oscillator` is -0\.9",
        jj.simulate,
        Oscillator(friction=-0.9),
        {"x": 0.5},
        t1=1.0,
    )
    lanes = jj.rollout(
        Oscillator(), {"x": np.full(2, 0.5)}, parameters={"friction": np.array([0.9, -0.9])}, t1=1.0
    )
    assert lanes.lanes.succeeded.tolist() == [True, False]

    def elsewhere(motion):
        return (jj.joint_friction(motion, x_rate=1.0),)

    class Outside(jj.Scene):
        coordinates, bodies = Sled.coordinates, Sled.bodies

        def loads(self, motion):
            return elsewhere(motion)

    refused("`joint_friction` in `loads` itself, not in a function", jj.simulate, Outside(), {}, t1=1.0)
