"""Inputs given by samples: steps end at their knots, so that no feature is passed over, however short it is and at whatever tolerance."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from small_scenes import OnLine

import jourdain_jax as jj


class Struck(OnLine):
    """A mass without other forces that an input strikes."""

    mass: object = jj.parameter(2.0, positive=True)
    inputs = jj.inputs("force push")

    def loads(self, motion):
        return (jj.generalized_force(motion, x_rate=motion.inputs.force + motion.inputs.push),)


BLOW = jj.Sampled([0.0, 2.0137, 2.0142, 2.0147, 10.0], [0.0, 0.0, 2000.0, 0.0, 0.0])  # 1 N s about 2.0142 s
LOOPS = {
    "lean": {},
    "diffrax": {"solver": diffrax.Bosh3(), "rtol": 1e-6, "atol": 1e-6},
    "implicit": {"solver": jj.RadauIIA()},
    "equal steps": {"solver": jj.ImplicitMidpoint(step=1.0)},
    "dense matrices": {"backend": "dense"},
}


@pytest.mark.parametrize("options", LOOPS.values(), ids=LOOPS)
def test_a_hammer_blow_of_a_millisecond_is_felt_in_every_loop(options):
    motion = jj.simulate(Struck(), t1=10.0, inputs={"force": BLOW}, work=False, **({"ts": [10.0]} | options)).raise_if_failed()
    if not isinstance(options.get("solver"), jj.ImplicitMidpoint):
        assert_allclose(motion.q_end[0], 0.5 * (10 - 2.0142), rtol=1e-9)
    assert_allclose(motion.u_end[0], 0.5, rtol=1e-9)


def test_a_hammer_blow_is_felt_at_every_tolerance_and_whenever_it_comes():
    random = np.random.default_rng(7)
    for tolerance in (0.3, 1e-2, 1e-5, 1e-11):
        at, long, high = random.uniform(0.1, 9.0), 10 ** random.uniform(-6, -1), 10 ** random.uniform(-3, 4)
        ts, values = at + long * np.array([-1.0, -0.5, 0.0, 0.2, 0.7]), high * np.array([0.0, 1.0, -1.0, 0.5, 0.0])  # to and fro
        inputs = {"force": jj.Sampled([0.0, *ts], [0.0, *values]), "push": jj.Sampled([0.0, 10.0], [-1.0, 1.0])}
        motion = jj.simulate(Struck(), ts=[10.0], inputs=inputs, rtol=tolerance, atol=tolerance, work=False)
        grid = np.concatenate([[0.0], ts, [10.0]])
        impulse = np.trapezoid(np.concatenate([[0.0], values, [0.0]]), grid)  # that of the push is zero
        assert_allclose(motion.u_end[0], impulse / 2, rtol=0, atol=1e-9 + 1e-9 * abs(impulse))


def test_a_blow_within_thousands_of_samples_is_felt():
    ts = np.linspace(0.0, 10.0, 10_001)
    values = np.where((ts > 2.0135) & (ts < 2.0165), 1000.0, 0.0)
    motion = jj.simulate(Struck(), ts=[10.0], inputs={"force": jj.Sampled(ts, values)}, rtol=1e-3, atol=1e-3, work=False)
    assert_allclose(motion.u_end[0], np.trapezoid(values, ts) / 2, rtol=1e-9)
    assert int(motion.accepted) < 100  # the straight parts have no knots


def test_lanes_feel_blows_of_their_own_and_forwards_and_backwards():
    at = jnp.array([0.7, 3.0, 8.5])

    def end(at, t0, t1, **options):
        ts = jnp.stack([jnp.zeros(()), at - 5e-4, at, at + 5e-4])
        inputs = {"force": jj.Sampled(ts, jnp.array([0.0, 0.0, 2000.0, 0.0]))}
        motion = jj.simulate(Struck(), {}, t0=t0, ts=jnp.stack([t1]), inputs=inputs, work=False, **options)
        return motion.q_end[0]

    assert_allclose(jax.vmap(lambda at: end(at, 0.0, jnp.asarray(10.0)))(at), 0.5 * (10 - at), rtol=1e-9)
    assert_allclose(jax.vmap(lambda at: end(at, 10.0, jnp.asarray(0.0)))(at), 0.5 * at, rtol=1e-9)
    assert_allclose(jax.grad(lambda at: end(at, 0.0, jnp.asarray(10.0), backend="xla"))(3.0), -0.5, rtol=1e-6)
    forward = jax.jacfwd(lambda at: end(at, 0.0, jnp.asarray(10.0), backend="xla"))
    assert_allclose(forward(3.0), -0.5, rtol=1e-6)


def test_lanes_of_a_rollout_feel_a_blow_that_they_share():
    lanes = jj.rollout(Struck(), parameters={"mass": np.array([1.0, 2.0, 4.0])}, ts=[10.0], inputs={"force": BLOW}, work=False, progress=False).lanes
    assert_allclose(lanes.u_end[:, 0], [1.0, 0.5, 0.25], rtol=1e-9)


CLOCK, FORCE, PUSH = np.linspace(0.0, 2.0, 6), np.array([0.3, -1.0, 0.8, 0.5, -0.7, 0.2]), np.array([-0.4, 0.6, 0.1, -0.9, 0.7, 0.5])
MODES = {
    "reverse": ({}, jax.grad),
    "forward": ({}, jax.jacfwd),
    "diffrax": ({"solver": diffrax.Tsit5()}, jax.grad),
}


def rate_of_late(values, t0, t1):
    """-int (t1 - t) dF/dt dt: what a delay of the force F on a mass of 1 kg does to its place at t1."""
    knots, slopes = CLOCK, np.diff(values) / np.diff(CLOCK)
    a, b = (np.clip(knots[:-1], *sorted((t0, t1))), np.clip(knots[1:], *sorted((t0, t1))))
    return -np.sign(t1 - t0) * np.sum(slopes * (b - a) * (t1 - (a + b) / 2))


@pytest.mark.parametrize(("options", "slope"), MODES.values(), ids=MODES)
@pytest.mark.parametrize(("t0", "t1"), [(0.0, 2.0), (1.6, 0.0)])
@pytest.mark.parametrize("times", [11, 2], ids=["saved at the knots", "two inputs by one clock"])
def test_a_delay_of_one_input_has_its_derivative_where_knots_meet_each_other_and_saved_times(options, slope, t0, t1, times):
    def end(late):
        inputs = {"force": jj.Sampled(CLOCK + late, FORCE), "push": jj.Sampled(CLOCK, PUSH)}
        asked = {"inputs": inputs, "rtol": 1e-5, "atol": 1e-5, "work": False, "backend": "xla"} | options
        motion = jj.simulate(Struck(mass=1.0), {}, t0=t0, ts=np.linspace(t0, t1, times), **asked)
        return motion["x"][-1]

    assert_allclose(slope(end)(0.0), rate_of_late(FORCE, t0, t1), rtol=1e-9)


@pytest.mark.parametrize("backend", ["auto", "xla"])
def test_a_saved_time_at_a_knot_moves_its_own_state_alone(backend):
    def states(ts):
        inputs = {"force": jj.Sampled(CLOCK, FORCE)}
        return jj.simulate(Struck(mass=1.0), {}, t0=0.0, ts=ts, inputs=inputs, rtol=1e-5, atol=1e-5, work=False, backend=backend)["x"]

    speeds = np.concatenate([[0.0], np.cumsum(np.diff(CLOCK) * (FORCE[1:] + FORCE[:-1]) / 2)])
    assert_allclose(jax.jacrev(states)(jnp.asarray(CLOCK)), np.diag(speeds), atol=1e-9)
