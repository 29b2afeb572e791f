"""The likelihood of disturbed motions by an extended Kalman filter: against Kalman's filter for a linear
scene, and where nothing disturbs.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import Oscillator

import jourdain_jax as jj
from jourdain_jax.identification import Accelerometer, Sensor, filtered_log_likelihood, log_likelihood
from jourdain_jax.studies import Normal

TIGHT = {"rtol": 1e-12, "atol": 1e-13}
TS = np.array([0.0, 0.2, 0.45, 0.5, 0.9, 1.3, 1.7, 2.0])
NOISE = 0.04  # (m/s)^2 / s


def kalman(damping, stiffness, noise, run, spread, mass=2.0):
    """The textbook filter of x' = A x + w, discretised by C. F. Van Loan, IEEE Trans. Automatic Control 23
    (1978) 395.
    """
    A = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]])
    W = np.diag([0.0, noise])
    x, P, t, total = np.array([0.3, -0.1]), np.diag(spread) ** 2, 0.0, 0.0
    for k, t1 in enumerate(TS):
        block = scipy.linalg.expm(np.block([[-A, W], [np.zeros((2, 2)), A.T]]) * (t1 - t))
        F = block[2:, 2:].T
        x, P, t = F @ x, F @ P @ F.T + F @ block[:2, 2:], t1
        z = np.array([run["x"][k], run["speedometer"][k] - 0.1])
        seen = np.isfinite(z)
        H, z, R = np.diag([1.0, 2.0])[seen], z[seen], np.diag([0.02**2, 0.05**2])[np.ix_(seen, seen)]
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        r = z - H @ x
        total += -0.5 * r @ np.linalg.solve(S, r) - 0.5 * np.linalg.slogdet(2 * np.pi * S)[1]
        x, P = x + K @ r, (np.eye(2) - K @ H) @ P
    return total


def samples():
    draw = np.random.default_rng(5)
    x = 0.3 * np.cos(1.5 * TS) + 0.05 * draw.normal(size=8)
    v = 2.0 * (-0.45 * np.sin(1.5 * TS) + 0.05 * draw.normal(size=8)) + 0.1
    v[3] = np.nan
    return {"x": x, "speedometer": v}


def measured(unknown=(), values=None):
    values = samples() if values is None else values
    sensors = {"speedometer": Sensor("x_rate", gain=2.0, bias=0.1)}
    return jj.Experiment(
        TS,
        values,
        {"x": 0.02, "speedometer": 0.05},
        start={"x": 0.3, "x_rate": -0.1},
        unknown_start=unknown,
        sensors=sensors,
    )


@pytest.mark.parametrize("spread", [(0.0, 0.0), (0.1, 0.3)])
@pytest.mark.parametrize("noise", [0.0, NOISE])
def test_linear_scene_has_the_likelihood_of_kalmans_filter(spread, noise):
    unknown = {
        n: jj.Estimate(prior=Normal(m, s))
        for n, m, s in zip(("x", "x_rate"), (0.3, -0.1), spread, strict=True)
        if s
    }
    data = measured(unknown)
    found = jax.jit(
        lambda scene: filtered_log_likelihood(scene, data, process_noise={"x_rate": noise}, **TIGHT)
    )
    assert_allclose(found(Oscillator()), kalman(0.3, 5.0, noise, samples(), spread), rtol=1e-9)


def test_derivatives_are_those_of_kalmans_filter():
    run = measured()

    def of(theta):
        return filtered_log_likelihood(
            Oscillator(damping=theta[0], stiffness=theta[1]), run, process_noise={"x_rate": theta[2]}, **TIGHT
        )

    theta = jnp.array([0.3, 5.0, NOISE])
    found = jax.jit(jax.jacfwd(of))(theta)

    def differences(i, h=1e-5):
        up, down = (theta.at[i].add(s * h) for s in (1, -1))
        return (kalman(*up, samples(), (0.0, 0.0)) - kalman(*down, samples(), (0.0, 0.0))) / (2 * h)

    assert_allclose(found, [differences(i) for i in range(3)], rtol=1e-5)


def undisturbed():
    """Scenes with their runs: a sleigh with a sensor that is a vector, and two particles and a rod between
    them, some of whose coordinates follow.
    """
    ts = np.linspace(0.1, 1.6, 7)
    values = {"x": -0.5 * ts, "nose": np.stack([-0.5 * ts, 0.1 * ts, 0.0 * ts], axis=1)}
    asked = {
        "start": {"x_rate": -0.6, "heading_rate": 0.9},
        "sensors": {"nose": lambda motion: motion["sleigh"].place((0.3, 0.0, 0.0))},
    }
    yield (
        jj.models.ChaplyginSleigh(),
        [jj.Experiment(ts + t0, values, 0.05, t0=t0, **asked) for t0 in (0.0, 1.0)],
    )
    rods, ts = jj.models.SpringAndRod(), np.linspace(0.1, 0.6, 6)
    motion = jj.simulate(rods, rods.example, t0=0.0, ts=ts)
    yield (
        rods,
        jj.Experiment(
            ts,
            {name: np.asarray(motion[name]) + 0.01 for name in ("z1", "x2", "z2")},
            0.02,
            start=rods.example,
            t0=0.0,
        ),
    )


def test_undisturbed_motions_have_the_plain_likelihood():
    for scene, runs in undisturbed():
        assert_allclose(
            filtered_log_likelihood(scene, runs, process_noise={}), log_likelihood(scene, runs), rtol=1e-6
        )


@pytest.mark.parametrize(
    ("noise", "change", "message"),
    [
        ({"x": 0.1}, {}, "`process_noise` names `x`, which is not an independent speed of `Oscillator`"),
        ({"x_rate": -1.0}, {}, "process noise of `x_rate` is -1, expected zero or more"),
        ({}, {"sigma": None}, "sigma of channel `x` is None"),
        ({}, {"correlation_time": 0.1}, "has a correlation time"),
        ({}, {"unknown_start": ("x",)}, "start value `x` of run 0 is unknown"),
        ({}, {"sensors": {"x": Sensor(lag=0.1)}}, "sensor `x` of run 0 has a delay or a lag"),
        ({}, {"sensors": {"x": Sensor(gain=jj.Estimate(1.0))}}, "`x.gain` is to be estimated"),
    ],
)
def test_what_a_filter_does_not_know_is_said_by_name(noise, change, message):
    run = jj.Experiment(TS, {"x": samples()["x"]}, **({"sigma": 0.02, "start": {"x": 0.3}} | change))
    refused(message, filtered_log_likelihood, Oscillator(), run, process_noise=noise)


def test_quaternions_and_accelerometers_are_refused():
    refused(
        "has quaternions",
        filtered_log_likelihood,
        jj.models.FreeRigidBody(),
        jj.Experiment(TS, {"x": TS}, 0.1, start={}),
        process_noise={},
    )
    run = jj.Experiment(TS, {"imu": np.zeros((8, 3))}, 0.1, start={}, sensors={"imu": Accelerometer("cart")})
    refused(
        "measures accelerations, which contain the white disturbance itself",
        filtered_log_likelihood,
        Oscillator(),
        run,
        process_noise={},
    )
