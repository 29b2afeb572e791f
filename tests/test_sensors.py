"""Sensors and actuators in the identification: gain, bias, delay and lag against closed forms, estimates with
coverage, what cannot be told, bad input.

A cart with a spring and a damper is linear, so that its readings are sums of exponentials, also through a
delay and a low-pass.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pages
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import Cart, OnLine

import jourdain_jax as jj
from jourdain_jax.identification import Accelerometer, Actuator, LoadCell, Sensor
from jourdain_jax.identification.data.delay_filter import filtered, read
from jourdain_jax.studies import Normal

MASS, DAMPING, STIFFNESS = 2.0, 0.6, 5.0
TS = np.linspace(0.0, 4.0, 81)
SEEN = 0.2  # s: no sample is earlier
TRUTH = {"gain": 1.2, "bias": 0.05, "delay": 0.07, "lag": 0.1}
IDEAL = {"gain": 1.0, "bias": 0.0, "delay": 0.0, "lag": 0.0}


def shown(ts, mass=MASS, damping=DAMPING, *, gain=1.0, bias=0.0, delay=0.0, lag=0.0, order=1, x0=0.3):
    """What a sensor shows of x (order 0) or v (order 1) of the cart let go at x0: x = Re(C exp(s t)), through
    `lag y' + y = x` from rest.
    """
    rate = damping / (2 * mass)
    s = -rate + 1j * np.sqrt(STIFFNESS / mass - rate**2)
    C = x0 * (1 - 1j * rate / s.imag) * s**order
    t = ts - delay
    lagged = (C / (1 + lag * s) * np.exp(s * t)).real
    rest = (C.real - (C / (1 + lag * s)).real) * np.exp(-t / lag) if lag else 0.0
    return gain * (lagged + rest) + bias


def run(seed=None, repeats=(), truth=TRUTH, ts=TS, x0=0.3, sigma=0.005, unknown_start=(), **numbers):
    """Place by an ideal sensor and speed by one with these `numbers`, in truth `truth`; samples before `SEEN`
    are missing from the latter.
    """
    noise = np.random.default_rng(seed)
    since = ts - ts[0]
    values = {
        "x": shown(since, order=0, x0=x0),
        "gyro": np.where(since < SEEN, np.nan, shown(since, x0=x0, **truth)),
    }
    if seed is not None:
        values = {
            name: x + s * noise.normal(size=(*repeats, len(ts)))
            for (name, x), s in zip(values.items(), (0.002, sigma), strict=True)
        }
    sensors = {"gyro": Sensor("x_rate", **(truth | numbers))}
    return jj.Experiment(
        ts,
        values,
        {"x": 0.002, "gyro": sigma},
        start={"x": x0, "x_rate": 0.0},
        sensors=sensors,
        unknown_start=unknown_start,
    )


GAIN = jj.Estimate(1.0)
DELAY = jj.Estimate(0.05, range=jj.bounds(0.0, SEEN))
ASKED = {"gain": GAIN, "bias": jj.Estimate(0.0), "delay": DELAY, "lag": jj.Estimate(0.05)}


# Readings of known quantities. ------------------------------------------------------------------------------


def test_a_reading_through_delay_and_lag_is_the_closed_form():
    ts = np.linspace(0.3, 4.0, 173)
    inside = (ts > 0.6) & (ts < 3.5)
    lags = np.array([0.0, 1e-6, 1e-3, 0.009, 0.0099, 0.0101, 0.1, 3.0])  # s; at 0.01 s the formula changes
    wave = partial(shown, damping=0.0, order=0, x0=1.0)
    expected = np.stack([wave(ts, delay=0.123, lag=lag) for lag in lags])
    for count in (81, 401):
        grid = np.linspace(0.0, 4.0, count)
        reading = jax.jit(jax.vmap(lambda lag, grid=grid: read(wave(grid), grid, ts, 0.123, lag)[0]))
        errors, scale = np.abs(reading(lags) - expected), (1.58 * grid[1]) ** 6
        assert errors.max() < 0.02 * scale + 1e-12
        assert errors[0, inside].max() < 0.005 * scale + 1e-12


@pytest.mark.parametrize("lag", [0.0, 1e-4, 0.05, 2.0])
def test_a_command_through_a_low_pass_is_exact_at_its_samples(lag):
    ts = np.array([0.0, 0.3, 0.4, 1.0, 1.7])
    values = np.array([0.0, 0.0, 1.0, 1.0, -0.4])
    found, fine = filtered(jnp.asarray(ts), jnp.asarray(values), lag), np.linspace(0.0, 1.7, 17001)
    y, x = np.zeros(len(fine)), np.interp(fine, ts, values)
    for k, h in enumerate(np.diff(fine)):  # linear in each of these intervals: their integral in closed form
        slope, decay = (x[k + 1] - x[k]) / h, np.exp(-h / lag) if lag else 0.0
        y[k + 1] = x[k + 1] - lag * slope + (y[k] - x[k] + lag * slope) * decay
    assert_allclose(found, np.interp(ts, fine, y), atol=1e-12)


# Estimates. -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", [("delay",), ("gain", "bias", "delay", "lag")])
def test_numbers_of_a_sensor_are_found_with_the_parameters(names):
    data = run(**{name: ASKED[name] for name in names})
    found = jj.fit(Cart(mass=1.8), data, ("mass", "damping"), rtol=1e-10, atol=1e-10)
    assert found.converged
    assert found.labels == ("mass", "damping", *(f"gyro.{name}" for name in sorted(names)))
    expected = [MASS, DAMPING, *(TRUTH[name] for name in sorted(names))]
    assert_allclose(found.values, expected, rtol=1e-5)
    assert found.chi_square < 1e-8  # the square of the tolerance
    # covariance: from differences of the closed form
    counted = np.isfinite(data.values["gyro"])

    def residual(theta):
        numbers = TRUTH | dict(zip(sorted(names), theta[2:], strict=True))
        return np.concatenate(
            [shown(TS, *theta[:2], order=0) / 0.002, shown(TS, *theta[:2], **numbers)[counted] / 0.005]
        )

    J = np.stack(
        [(residual(expected + h) - residual(expected - h)) / 2e-5 for h in 1e-5 * np.eye(len(expected))],
        axis=1,
    )
    assert_allclose(found.covariance, np.linalg.inv(J.T @ J), rtol=1e-3)


def test_a_sensor_shows_functions_and_coordinates_under_other_names():
    seen = {
        "place": lambda motion: motion["cart"].position,
        "encoder": "x",
        "x_rate": Sensor(gain=jj.Estimate(1.0)),
    }
    x, v = shown(TS, order=0), shown(TS, gain=1.3)
    values = {"place": np.stack([x, 0 * x, 0 * x], axis=1), "encoder": x, "x_rate": v}
    found = jj.fit(
        Cart(mass=1.8),
        jj.Experiment(TS, values, 0.01, start={"x": 0.3, "x_rate": 0.0}, sensors=seen),
        ("mass",),
    )
    assert_allclose(found.values, [MASS, 1.3], rtol=1e-6)
    # a gain and a bias for each component
    each = Sensor(
        lambda motion: motion["cart"].position,
        gain=jj.Estimate((1.0, 1.0, 1.0)),
        bias=jj.Estimate((0.0, 0.0, 0.0)),
        delay=0.0,
    )
    bent = jj.Experiment(
        TS,
        {"place": values["place"] * 0.9 + np.array([0.1, 0.2, 0.3])},
        0.01,
        start={"x": 0.3, "x_rate": 0.0},
        sensors={"place": each},
    )
    found = jj.fit(Cart(), bent, ())
    assert_allclose([found[f"place.bias[{i}]"].value for i in range(3)], [0.1, 0.2, 0.3], atol=1e-6)
    assert_allclose(found["place.gain[0]"].value, 0.9, rtol=1e-6)
    assert {"no channel depends on `place.gain[1]`", "no channel depends on `place.gain[2]`"} == set(
        found.not_identifiable
    )


class Swing(jj.Scene):
    """An arm on an axle along z with a torsional spring: `I turn'' = - k turn`."""

    stiffness: float = jj.parameter(8.0, positive=True)
    coordinates = jj.coordinates("turn")

    def bodies(self, t, q):
        return {"arm": jj.RigidBody(1.0, 0.5 * jnp.ones(3), jnp.zeros(3), jj.rot_z(q.turn))}

    def loads(self, motion):
        return jj.generalized_force(motion, turn_rate=-self.stiffness * motion.q.turn)


# turn = 0.7 cos(4 t), at 0.2 m: f = (- turn'^2 r, turn'' r, g) in the axes of the arm
TURN, RATE = 0.7 * np.cos(4 * TS), -2.8 * np.sin(4 * TS)
FELT = np.stack([-0.2 * RATE**2, -16 * 0.2 * TURN, 9.81 + 0 * TS], axis=1)
IMU = Accelerometer("arm", (0.2, 0.0, 0.1))


def fitted_swing(sensor, values):
    data = jj.Experiment(TS, {"imu": values}, 0.01, start={"turn": 0.7}, sensors={"imu": sensor})
    return jj.fit(Swing(stiffness=7.5), data, ("stiffness",))


def test_an_accelerometer_feels_centripetal_and_tangential_acceleration_and_gravity():
    motion = jj.simulate(Swing(), {"turn": 0.7}, ts=TS, rtol=1e-10, atol=1e-10)
    assert_allclose(IMU.over_times(motion), FELT, atol=1e-7)
    shown = np.stack([np.interp(TS - 0.05, TS, felt) for felt in FELT.T], axis=1)
    shown[TS < 0.1] = np.nan
    late = fitted_swing(Sensor(IMU, delay=jj.Estimate(0.03, range=jj.bounds(0.0, 0.1))), shown)
    rough = (4 * 0.05) ** 6 / 50  # of the reading between times, relative
    assert_allclose(late["stiffness"].value, 8.0, rtol=1e-5 + rough)
    assert late["imu.delay"].value == pytest.approx(0.05, abs=1e-5)
    refused(
        (
            "the accelerometer `imu` of run 0 of `Swing` is on body `arn`, which does not exist; did you mean"
            " `arm`"
        ),
        fitted_swing,
        Accelerometer("arn"),
        FELT,
    )


def test_an_accelerometer_may_stand_for_a_sensor():
    assert_allclose(fitted_swing(IMU, FELT)["stiffness"].value, 8.0, rtol=1e-5)


def test_a_load_cell_shows_what_the_ground_bears():
    cell, start = LoadCell("rim"), {"heading_rate": 0.5, "roll_rate": 4.0}
    motion = jj.simulate(jj.models.VerticalDisc(mass=1.3), start, ts=TS, rtol=1e-10, atol=1e-10)
    force, felt = cell.over_times(motion), Accelerometer("disc").over_times(motion)
    assert_allclose(
        force, 1.3 * jnp.einsum("tij,tj->ti", motion.motions()["disc"].orientation, felt), atol=1e-9
    )  # F = m (a - g)


def test_a_delay_that_is_not_there_is_at_its_bound():
    found = jj.fit(Cart(mass=1.9), run(3, truth=IDEAL, delay=DELAY), ("mass",))
    assert found.converged
    assert found["gyro.delay"].low == 0.0
    assert 0.0 < found["gyro.delay"].high < 0.02


def late(seed, lag, delay=0.05, tau=0.05):
    """Speed, 0.07 s late, through a low-pass with this lag; a sensor with an unknown delay, and a lag `tau`
    that is known or not.
    """
    values = np.where(
        TS < SEEN,
        np.nan,
        shown(TS, delay=0.07, lag=lag) + 0.002 * np.random.default_rng(seed).normal(size=len(TS)),
    )
    sensor = Sensor("x_rate", delay=jj.Estimate(delay, range=jj.bounds(0.0, SEEN)), lag=tau)
    return jj.Experiment(TS, {"late": values}, 0.002, start={"x": 0.3}, sensors={"late": sensor})


def test_a_lag_of_zero_is_left_where_a_delay_stands_in_for_it():
    # at a lag of zero a longer delay does the same, to first order: a saddle on the bound
    near, far = (
        jj.fit(Cart(), late(0, 0.1, *guess), ("mass",))
        for guess in ((0.07, jj.Estimate(0.1)), (0.17, jj.Estimate(1e-4)))
    )
    assert far.converged
    assert not far.warnings
    assert_allclose(far.chi_square, float(near.chi_square), rtol=1e-6)
    assert_allclose(far.values, near.values, rtol=1e-3)
    assert far["late.lag"].low < 0.1 < far["late.lag"].high


def test_intervals_that_a_bound_makes_too_narrow_are_named():
    data = late(0, 0.0, tau=jj.Estimate(0.05))
    found = jj.fit(Cart(), data, ("mass",))
    assert found["late.lag"].value == 0.0
    held = jj.fit(Cart(), late(0, 0.0, tau=float(found["late.lag"].high)), ("mass",))
    assert_allclose(held.chi_square - found.chi_square, 3.841, rtol=0.05)
    assert held["late.delay"].value < found["late.delay"].low
    assert found.warning.startswith(
        "the interval of `late.delay` is too narrow: if `late.lag` leaves its bound"
    )
    assert found.profiles(data, "late.delay")["late.delay"].low < held["late.delay"].value
    near = jj.fit(Cart(), late(3, 0.0, tau=jj.Estimate(0.05)), ("mass",))
    assert near["late.lag"].low > 0.0
    assert near.warning.startswith(
        "the interval of `late.lag` is too narrow, and others may be: up to a nearby bound"
    )


# What is known beforehand. ----------------------------------------------------------------------------------


def test_a_value_far_from_its_prior_is_named():
    found = jj.fit(Cart(), run(7), {"mass": Normal(2.1, 0.01)})
    assert found.warning.startswith("`mass` lies 9.9 standard deviations from its prior")


def test_priors_of_starts_and_of_numbers_of_single_runs():
    def one(k, prior):
        start = {"x": jj.Estimate(prior=Normal(0.3, prior))}
        return run(
            10 + k,
            sigma=0.01,
            unknown_start=start,
            bias=jj.Estimate(0.0, per_run=True, prior=Normal(0.05, prior)),
        )

    loose, tight = (
        jj.fit(Cart(mass=1.9), [one(k, prior) for k in range(3)], ("mass",)) for prior in (1e3, 1e-6)
    )
    assert loose.labels == tight.labels
    for k in range(3):
        assert tight[f"run {k}: gyro.bias"].value == pytest.approx(0.05, abs=1e-6)
        assert tight[f"run {k}: x"].value == pytest.approx(0.3, abs=1e-6)
        assert_allclose(tight[f"run {k}: x"].standard_error, 1e-6, rtol=1e-3)
        assert loose[f"run {k}: x"].standard_error > 1e-4
    fixed = jj.fit(Cart(mass=1.9), [run(10 + k, sigma=0.01) for k in range(3)], ("mass",))
    assert_allclose(tight["mass"].value, fixed["mass"].value, rtol=1e-5)
    assert_allclose(tight["mass"].standard_error, fixed["mass"].standard_error, rtol=1e-3)


# What cannot be told. ---------------------------------------------------------------------------------------


KNOTS = np.linspace(0.0, 4.0, 41)
COMMAND = np.sin(2 * KNOTS) + np.where(KNOTS > 1, 0.3, 0.0)


def pushed(sensor, actuator):
    """The cart at rest, pushed: place and speed as simulated."""
    start, push = {"x": 0.0, "x_rate": 0.0}, {"push": jj.Sampled(KNOTS, 1.5 * COMMAND)}
    motion = jj.simulate(Cart(), start, ts=TS, inputs=push, rtol=1e-10, atol=1e-10)
    inputs = {"push": Actuator(jj.Sampled(KNOTS, COMMAND), **actuator)}
    values = {"x": motion["x"]}
    return jj.Experiment(TS, values, 0.001, start=start, inputs=inputs, sensors={"x": Sensor(**sensor)})


def test_a_gain_and_the_parameters_that_scale_alike_are_named_and_a_prior_tells_them():
    # under a known push only ratios to the sensor's gain show: gain/mass, gain/damping, gain/stiffness
    names = ("mass", "damping", "stiffness")
    found = jj.fit(Cart(), pushed({"gain": jj.Estimate(1.1)}, {"gain": 1.5}), names)
    (sentence,) = found.not_identifiable
    assert all(f"`{name}`" in sentence for name in (*names, "x.gain"))
    assert (
        "d mass/mass : d damping/damping : d stiffness/stiffness : d x.gain/x.gain = 1 : 1 : 1 : 1"
        in sentence
    )
    known = jj.fit(Cart(), pushed({"gain": jj.Estimate(1.1, prior=Normal(1.0, 0.02))}, {"gain": 1.5}), names)
    assert known.not_identifiable == ()
    assert_allclose(known["x.gain"].standard_error, 0.02, rtol=1e-3)
    assert_allclose(known["mass"].standard_error / known["mass"].value, 0.02, rtol=0.05)


# Actuators. -------------------------------------------------------------------------------------------------


def driven(truth, **asked):
    """The cart under a command through an actuator with the numbers `truth`, of which some are asked for."""
    command = jj.Sampled(KNOTS, COMMAND)
    signal = jj.Sampled(
        KNOTS + truth["delay"],
        truth["gain"] * filtered(command.ts, command.values, truth["lag"]) + truth["bias"],
    )
    motion = jj.simulate(
        Cart(), {"x": 0.3, "x_rate": 0.0}, ts=TS, inputs={"push": signal}, rtol=1e-10, atol=1e-10
    )
    inputs = {"push": Actuator(command, **(truth | asked))}
    return jj.Experiment(
        TS,
        {"x": motion["x"], "x_rate": motion["x_rate"]},
        0.001,
        start={"x": 0.3, "x_rate": 0.0},
        inputs=inputs,
    )


class Mass(OnLine):
    """`x'' = push`, for closed forms."""

    inputs = jj.inputs("push")

    def loads(self, motion):
        return jj.generalized_force(motion, x_rate=motion.inputs.push)


def speeds_of_held(knots, command, ts, lag=0.0):
    """Speed from rest under a command that holds, by integrals of constants, or of exponentials, over its
    intervals.
    """
    found = []
    for t in ts:
        y, speed = command[0], 0.0
        for k, begin in enumerate(knots):
            h = min(knots[k + 1] if k + 1 < len(knots) else np.inf, t) - begin
            if h > 0:
                decay = np.exp(-h / lag) if lag else 0.0
                speed, y = (
                    speed + command[k] * h + lag * (y - command[k]) * (1 - decay),
                    command[k] + (y - command[k]) * decay,
                )
        found.append(speed)
    return np.array(found)


def fitted(actuator, ts, speeds):
    data = jj.Experiment(
        ts, {"x_rate": speeds}, 0.001, start={"x": 0.0, "x_rate": 0.0}, inputs={"push": actuator}
    )
    return jj.fit(Mass(), data, (), rtol=1e-9, atol=1e-9)


def test_a_command_that_holds_keeps_each_value_until_the_next():
    knots, ts, delay = np.linspace(0.0, 2.0, 11), np.linspace(0.0, 2.0, 41), 0.03
    command = np.random.default_rng(0).normal(size=11)
    exact = speeds_of_held(knots + delay, command, ts) + command[0] * np.minimum(ts, delay)
    # the speed differs from that of a command which is linear in between
    linear = np.array([np.mean(np.interp(np.linspace(0, t, 2001), knots + delay, command)) * t for t in ts])
    assert np.max(np.abs(exact - linear)) > 0.05
    actuator = Actuator(
        jj.Sampled(knots, command), delay=jj.Estimate(0.05, range=jj.bounds(0.0, 0.1)), gain=GAIN, hold=True
    )
    found = fitted(actuator, ts, 1.3 * exact)
    assert found.converged
    assert_allclose([found["push.delay"].value, found["push.gain"].value], [delay, 1.3], atol=1e-6)
    assert (
        max(np.abs(found.residuals[0]["x_rate"])) < 0.05
    )  # of a sigma: samples within half a passage see it


def test_numbers_of_an_actuator_are_found_and_known_ones_make_an_input_like_any_other():
    data = driven(TRUTH, **ASKED)
    found = jj.fit(Cart(mass=1.9), data, ("mass",), rtol=1e-10, atol=1e-10)
    assert found.labels == ("mass", "push.bias", "push.delay", "push.gain", "push.lag")
    assert_allclose(found.values, [MASS, *(TRUTH[name] for name in sorted(TRUTH))], rtol=1e-4)
    known = jj.fit(Cart(mass=1.9), driven(TRUTH), ("mass",))
    assert_allclose(known["mass"].value, MASS, rtol=1e-6)


def test_the_page_on_identification_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # it writes a report
    names = pages.run(pages.DOCS / "howto" / "identification.md", jj=jj, jnp=jnp, np=np)
    found = names["found"]
    assert found.converged
    for name, value in (
        ("gyro.gain", 1.1),
        ("gyro.delay", 0.05),
        ("run 0: gyro.bias", 0.02),
        ("offset", 0.25),
    ):
        assert abs(found[name].value - value) < 4 * found[name].standard_error + 1e-3, name
    assert 0.05 < names["wider"].correlation_time["x"] < 0.9  # s; 0.22 s is true
