"""A value that leaves zero without a rate after its event and falls through it again within one step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hunting.contacts import Thrown
from numpy.testing import assert_allclose
from test_friction import Coin

import jourdain_jax as jj


class Hopper(jj.Scene):
    """A point that a plate catches at t = 0. The plate falls away and comes back after the time `hop`: their
    gap is hop^2 (x - y)/(1 + y) with x = (t/hop)^2, y = (t/hop)^power, until they meet.
    """

    hop: float = jj.parameter(0.03)
    power: float = jj.parameter(3.0)
    rate: float = jj.parameter(0.0)  # round-off of the speed after the first event
    coordinates = jj.coordinates("z")

    def bodies(self, t, q):
        return {"point": jj.Particle(1.0, [0.0, 0.0, q.z])}

    def events(self, motion):
        x = (motion.t / self.hop) ** 2
        fallen = self.hop**2 * (x - x ** (self.power / 2)) / (1 + x ** (self.power / 2))
        return {"meets": jj.Event(motion.q.z + fallen, jump={"z_rate": 100.0 * motion.t + self.rate})}


@pytest.mark.parametrize("backend", ["native", "xla"])
def test_a_short_hop_ends_at_the_plate(backend):
    """It ends after `hop` at z = 0, and the state at t = 1 is z = 100 hop (1 - hop)."""
    powers, hops = jnp.array([2.5, 3.0, 4.0, 6.0, 3.0]), jnp.array([0.03, 0.03, 0.03, 0.03, 0.003])

    def last(power, hop, rate):
        scene = Hopper(power=power, hop=hop, rate=rate)
        how = {"backend": backend, "rtol": 1e-9, "atol": 1e-9}
        motion = jj.simulate(scene, {"z": 0.01, "z_rate": -1.0}, t0=-0.01, ts=[1.0], **how)
        return motion.phases.ts[:2], motion.q[0, 0]

    rates = jnp.array([-1e-16, 0.0, 1e-16])
    lanes = [x.ravel() for x in (*(jnp.tile(x, (3, 1)) for x in (powers, hops)), jnp.repeat(rates, 5))]
    times, z = jax.jit(jax.vmap(last))(*lanes)
    assert_allclose(times[:, 0], 0.0, atol=1e-12)
    assert_allclose(times[:, 1], lanes[1], rtol=1e-9)
    assert_allclose(z, 100 * lanes[1] * (1 - lanes[1]), rtol=1e-8)


def test_coins_that_do_not_rebound_stay_above_their_table():
    """After an impact without rebound, the rim of a turning coin leaves the table at once, often for less
    than one step.
    """
    count, draw = 64, np.random.default_rng(3)
    attitude = draw.normal(size=(count, 4))
    attitude /= np.linalg.norm(attitude, axis=1)[:, None]
    start = {"z": np.full(count, 0.03), "attitude": attitude}
    start |= {
        "attitude_omega": draw.uniform(-40.0, 40.0, (count, 3)),
        "x_rate": draw.uniform(-0.3, 0.3, count),
    }
    scene = Coin(bounce=0.0, friction=0.1)
    coins = jj.rollout(scene, start, ts=np.linspace(0.01, 0.25, 25), rtol=1e-6, atol=1e-6)
    leans = jax.vmap(jax.vmap(jj.quaternion_to_matrix))(coins["attitude"])[..., 2, 1]
    gaps = np.asarray(coins["z"] - 0.012 * jnp.sqrt(1.0 - leans**2))
    assert (np.asarray(coins.result) == 0).all()
    assert np.nanmin(gaps) > -1e-8


class OnSphere(jj.Scene):
    """A ball without friction on a sphere of radius 1, with its centre at a distance of 1.1 from the
    sphere's.
    """

    coordinates = jj.coordinates("x y z", jj.quaternion("attitude"))

    def bodies(self, t, q):
        R = jj.quaternion_to_matrix(q.attitude)
        return {"ball": jj.RigidBody(1.0, 0.004 * jnp.ones(3), jnp.stack([q.x, q.y, q.z]), R)}

    def loads(self, motion):
        return (jj.gravity(motion, 9.81),)

    def contacts(self, pose):
        ground = jj.Sphere(1.0, side="outside")
        return {"c": jj.ball_contact(pose["ball"], 0.1, ground=ground, height="row", friction=0.0)}


def test_balls_that_slide_off_a_sphere_fly_on():
    """From the top at the speed v they leave it at the angle a, cos a = (2 + v^2/gR)/3, with a gap that grows
    as the third power of time, and fly along a parabola.
    """
    v, R, g = np.linspace(0.5, 3.0, 48), 1.1, 9.81
    start = {"x_rate": v, "z": np.full(48, R)}
    balls = jj.rollout(OnSphere(), start, ts=[0.2, 0.8, 1.0], rtol=1e-10, atol=1e-10)
    assert (np.asarray(balls.result) == 0).all()
    cos, phases = (2 + v**2 / (g * R)) / 3, jax.vmap(lambda lane: lane.phases.ts[0])(balls.lanes)
    sin, flight = np.sqrt(1 - cos**2), 1.0 - np.asarray(phases)
    speed = np.sqrt(g * R * cos)
    assert_allclose(balls["x"][:, -1], R * sin + speed * cos * flight, rtol=1e-8)
    assert_allclose(balls["z"][:, -1], R * cos - speed * sin * flight - g * flight**2 / 2, atol=1e-7)


class Wheel(Thrown):
    shape = "wheel"


def _wheels(seed):
    """Parameters and starts of 400 wheels."""
    count, draw = 400, np.random.default_rng(seed)
    among = {
        "i_x i_y i_z": (0.002, 0.0035),
        "a b": (0.07, 0.15),
        "friction": (0.05, 0.8),
        "slope": (-0.3, 0.3),
    }
    among |= {"c_x": (-0.02, 0.02), "heave bounce": (0.0, 0.04)}
    found = {name: draw.uniform(*ends, count) for names, ends in among.items() for name in names.split()}
    found["bounce"] *= 20.0 * draw.integers(0, 2, count)
    attitude = draw.normal(size=(count, 4))
    start = {"attitude": attitude / np.linalg.norm(attitude, axis=1)[:, None], "z": np.full(count, 0.3)}
    start |= {"attitude_omega": draw.uniform(-20.0, 20.0, (count, 3)), "x_rate": draw.uniform(-1, 1, count)}
    return found, start


def test_impacts_of_tumbling_wheels_do_not_depend_on_the_longest_step():
    """Small impacts fall within one step of a flight, and flights that end a series of impacts are far
    shorter than a step, or too low to be told from round-off.
    """
    found, start = (
        {name: np.concatenate([drawn[name] for drawn in parts]) for name in parts[0]}
        for parts in zip(*map(_wheels, (2, 3, 4)), strict=True)
    )
    how = {"parameters": found, "ts": [0.7], "rtol": 1e-8, "atol": 1e-8}
    free, short = (jj.rollout(Wheel(), start, **how, max_step=x) for x in (None, 0.004))
    for wheels in (free, short):
        assert not np.isin(wheels.result, [2, 3]).any()
    right = (np.asarray(free.result) == 0) & (np.asarray(short.result) == 0)
    assert right.sum() > 1170
    assert_allclose(free["x"][right, -1], short["x"][right, -1], atol=1e-5)


class Ellipsoid(Thrown):
    shape = "ellipsoid"


def test_ellipsoids_that_rebound_slowly_strike_again_soon():
    """One leaves the ground at 0.04 m/s and strikes 1.7 ms later, within a step at whose end it is 2 cm
    high.
    """
    names = "i_x i_y i_z a b c c_y c_z friction slope"
    values = 0.00328, 0.00265, 0.00233, 0.14722, 0.07316, 0.07877, 0.00751, 0.01829, 0.0, 0.21031
    attitude, omega = [0.62684, -0.46479, 0.45673, 0.42714], [18.62102, -2.82109, -17.57805]
    start = {"z": 0.44615, "y_rate": -0.42697, "z_rate": -0.12449, "attitude_omega": omega}
    start |= {"attitude": np.divide(attitude, np.linalg.norm(attitude))}
    scene = Ellipsoid(**dict(zip(names.split(), values, strict=True)))
    how = {"ts": [0.5], "rtol": 1e-8, "atol": 1e-8}
    free, short = (
        jj.rollout(scene, start, parameters={"bounce": np.linspace(0.45, 0.5, 400)}, max_step=x, **how)
        for x in (None, 0.004)
    )
    for ellipsoids in (free, short):
        assert (np.asarray(ellipsoids.result) == 0).all()
    assert_allclose(free["x"], short["x"], atol=1e-5)
