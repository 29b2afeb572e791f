"""Fits by multiple shooting: they find what a fit without pieces finds where that works, and more."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import lfilter
from small_scenes import Cart

import jourdain_jax as jj
from jourdain_jax.identification import MultipleShooting, Sensor, huber
from jourdain_jax.studies import Normal

FREE = ("mass2", "length1", "length2")
TIGHT = {"rtol": 1e-8, "atol": 1e-8}


def pendulum():
    """A chaotic double pendulum, 20 samples a second with 1 % noise: a first guess that is off by up to a
    half, the truth, and the run.
    """
    truth, ts = jj.models.DoublePendulumAngles(), np.linspace(0.0, 5.0, 101)
    start = {"theta1": 2.0, "theta2": 2.5, "theta1_rate": 0.0, "theta2_rate": 0.0}
    motion, generator = jj.simulate(truth, start, ts=ts, rtol=1e-9, atol=1e-9), np.random.default_rng(2)
    sigma = {name: 0.01 * float(np.std(motion[name])) for name in ("theta1", "theta2")}
    values = {name: np.asarray(motion[name]) + s * generator.normal(size=101) for name, s in sigma.items()}
    off = lambda: 1 + generator.uniform(-0.5, 0.5)
    guess = truth.replace(**{name: getattr(truth, name) * off() for name in FREE})
    begin = {name: x + (x or 3.0) * (off() - 1) for name, x in start.items()}
    return guess, truth, jj.Experiment(ts, values, sigma, start=begin, unknown_start=tuple(begin))


class Oscillator(Cart):
    damping: object = jj.parameter(0.1, positive=True)
    stiffness: object = jj.parameter(18.0, positive=True)


def oscillations(channel="x", sigma=0.01, **options):
    """Three runs of unequal length under one sampled force; the third has a known start."""
    generator, ts = np.random.default_rng(0), np.linspace(0.0, 4.0, 41)
    force, found = jj.Sampled(np.linspace(-1.0, 5.0, 61), generator.normal(size=61)), []
    for count, x, guess in ((41, 0.5, 0.4), (31, -0.2, -0.3), (23, 0.3, 0.3)):
        motion = jj.simulate(Oscillator(), {"x": x, "x_rate": 0.3}, ts=ts[:count], inputs={"push": force})
        values = {channel: np.asarray(motion["x"]) + 0.01 * generator.normal(size=count)}
        more = {"start": {"x": guess, "x_rate": 0.3}, "unknown_start": () if x == guess else ("x", "x_rate")}
        found.append(jj.Experiment(ts[:count], values, sigma, inputs={"push": force}, **more, **options))
    return found


def same(scene, data, free, **options):
    """The fits of the same runs with and without pieces agree."""
    whole = jj.fit(scene, data, free, **TIGHT, **options)
    cut = jj.fit(scene, data, free, shooting=MultipleShooting(pieces=4), **TIGHT, **options)
    assert whole.converged
    assert cut.converged
    assert cut.shooting.continuity <= 1
    least = np.min(whole.standard_errors, where=whole.standard_errors > 0, initial=np.inf)
    assert_allclose(cut.values, whole.values, atol=1e-3 * least, rtol=1e-4)
    assert_allclose(cut.standard_errors, whole.standard_errors, rtol=1e-4)
    assert_allclose(cut.chi_square, whole.chi_square, rtol=1e-5)
    for a, b in zip(cut.residuals, whole.residuals, strict=True):
        for name in b:
            assert_allclose(a[name], b[name], atol=1e-3)


def test_a_chaotic_motion_is_found_from_afar_with_the_intervals_of_single_shooting():
    guess, truth, run = pendulum()
    found = jj.fit(guess, run, FREE, shooting=MultipleShooting(duration=0.5), **TIGHT)
    assert found.converged
    assert not found.warnings
    assert found.shooting.pieces == (10,)
    assert found.shooting.continuity <= 1
    assert "found by multiple shooting in 10 pieces" in str(found)
    begun = {"start": found.starts[0], "unknown_start": tuple(run.start)}
    near = jj.fit(found.scene, jj.Experiment(run.ts, run.values, run.sigma, **begun), FREE, **TIGHT)
    assert near.converged
    assert not near.grown
    assert_allclose(found.values, near.values, atol=1e-2 * near.standard_errors.min())
    assert_allclose(found.standard_errors, near.standard_errors, rtol=1e-3)
    assert all(
        abs(found[name].value - float(getattr(truth, name))) < 4 * found[name].standard_error for name in FREE
    )


def test_pieces_that_cannot_join_in_time_are_no_result():
    guess, _, run = pendulum()
    found = jj.fit(guess, run, FREE, shooting=MultipleShooting(duration=0.5), max_iterations=1, **TIGHT)
    assert not found.converged
    assert found.shooting.continuity > 1
    assert "do not join" in found.warning
    assert "NOT CONVERGED" in str(found)


def test_pieces_lie_along_the_fit_though_an_unknown_at_its_bound_was_moved():
    ts = np.linspace(0.0, 4.0, 41)
    x = 0.5 * np.cos(3.0 * ts) * np.exp(-0.03 / 4 * ts)  # a damping of 0.03
    x += 0.002 * np.random.default_rng(1).normal(size=41)
    run = jj.Experiment(ts, {"x": x}, 0.005, start={"x": 0.5, "x_rate": 0.0}, unknown_start=("x",))
    free = {"damping": jj.bounds(0.035, 2.0)}
    found = jj.fit(Oscillator(), run, free, shooting=MultipleShooting(pieces=4), **TIGHT)
    assert found.at_bound[0]
    assert found["damping"].high > 0.04
    begins = ts[[10, 20, 30]]
    motion = jj.simulate(found.scene, found.starts[0], ts=begins, t0=0.0, t1=4.0, **TIGHT)
    expected = np.sort([*motion["x"], *motion["x_rate"]])
    assert_allclose(np.sort(found.shooting.nodes[0].ravel()), expected, atol=1e-6)


SENSOR = {"bias": jj.Estimate(0.0, per_run=True), "gain": jj.Estimate(1.0, prior=Normal(1.0, 0.05))}
CASES = {
    "several runs": ({}, ("stiffness", "damping"), {}),
    "a bound and a prior": ({}, {"stiffness": Normal(16.0, 0.1), "damping": jj.bounds(0.2, 1.0)}, {}),
    "a robust loss": ({}, ("stiffness", "damping"), {"loss": huber()}),
    "numbers of sensors": (
        {"channel": "enc", "sigma": None, "sensors": {"enc": Sensor("x", **SENSOR)}},
        ("stiffness", "damping"),
        {},
    ),
    "noise with a memory": ({"correlation_time": 0.1}, ("stiffness", "damping"), {}),
    "noise with an unknown memory": ({"correlation_time": None}, ("stiffness", "damping"), {}),
}


@pytest.mark.parametrize("case", CASES)
def test_pieces_change_no_estimate_and_no_interval(case):
    options, free, more = CASES[case]
    same(Oscillator(stiffness=15.0, damping=0.3), oscillations(**options), free, **more)


def shown_late(scene, start, ts, t0, true, sensors, guess, **inputs):
    """A run whose channels show coordinates or speeds late: name -> (what, delay, lag) in `true`. `guess`: of
    start values that are not known.
    """
    generator, grid = np.random.default_rng(len(ts)), np.linspace(t0, ts[-1], 2001)
    motion = jj.simulate(scene, start, t0=t0, ts=grid, rtol=1e-10, atol=1e-10, **inputs)
    values = {}
    for name, (what, delay, lag) in true.items():
        k = np.exp(-(grid[1] - t0) / lag) if lag else 0.0  # of a reading, kept from one time to the next
        late = lfilter([1 - k], [1, -k], motion[what], zi=[k * motion[what][0]])[0]
        values[name] = np.interp(ts - delay, grid, late) + 0.005 * generator.normal(size=len(ts))
    more = {"start": start | guess, "unknown_start": tuple(guess), "sensors": sensors, "t0": t0}
    return jj.Experiment(ts, values, 0.005, **more, **inputs)


def late_oscillations(true, sensors, counts):
    """Runs of so many samples that begin half a second after their start."""
    start, guess, force = {"x": 0.5, "x_rate": 0.3}, {"x": 0.45}, {"push": 1.0}
    return [
        shown_late(Oscillator(), start, 0.05 * np.arange(n), -0.5, true, sensors, guess, inputs=force)
        for n in counts
    ]


DELAY, LONG = (
    jj.Estimate(0.1, range=jj.bounds(0.0, 0.3)),
    jj.Estimate(0.4, range=jj.bounds(0.0, 0.5), per_run=True),
)
GYRO = {"gyro": Sensor("x_rate", delay=DELAY, lag=jj.Estimate(0.15))}
LATE = {  # what channels show and how late, sensors, and numbers of samples
    "a delay and a lag in one run of two": [
        ({"x": ("x", 0.0, None)}, {}, (31,)),
        ({"gyro": ("x_rate", 0.13, 0.2), "x": ("x", 0.0, None)}, GYRO, (61,)),
    ],
    "delays of each run, longer than a piece": [
        ({"enc": ("x", 0.45, None)}, {"enc": Sensor("x", delay=LONG)}, (41, 31))
    ],
    "a lag that is hardly one": [({"x": ("x", 0.0, 0.002)}, {"x": Sensor(lag=jj.Estimate(0.01))}, (61,))],
}


@pytest.mark.parametrize("case", LATE)
def test_sensors_are_late_in_pieces_as_in_whole_runs(case):
    runs = [run for kind in LATE[case] for run in late_oscillations(*kind)]
    same(Oscillator(stiffness=16.0, damping=0.2), runs, ("stiffness", "damping"))


def test_a_fit_in_pieces_is_taken_up_again(tmp_path):
    run, other, _ = oscillations()
    found, whole = (
        jj.fit(Oscillator(stiffness=15.0), run, ("stiffness", "damping"), shooting=shooting)
        for shooting in (MultipleShooting(duration=1.0), None)
    )
    right = whole.profiles(run)
    for name, profile in found.profiles(run).items():
        assert_allclose([profile.low, profile.high], [right[name].low, right[name].high], rtol=1e-3)
    found.report(tmp_path / "fit.html", run, held_out=other)
    assert "multiple shooting" in str(found)


SLEIGH = jj.models.ChaplyginSleigh(offset=0.25)
# scene, its start, what is seen, first guesses of parameters, first guesses of starts that are not known
STATED = {
    "geometric rows": (
        jj.models.DoublePendulumRods(),
        {},
        "x1 z1 x2 z2",
        {"mass2": 0.9, "gravity": 9.81},
        {},
    ),
    "velocity rows": (
        SLEIGH,
        {"x_rate": -0.6, "heading_rate": 0.9},
        "x y",
        {"offset": 0.2},
        {"heading": 0.0, "x_rate": -0.5, "heading_rate": 0.8},
    ),
    "unit quaternions": (
        jj.models.FreeRigidBody(),
        {},
        "attitude",
        {"i1": 1.05 * float(jj.models.FreeRigidBody().i1)},
        {},
    ),
}


@pytest.mark.parametrize("case", STATED)
def test_pieces_begin_on_what_holds_of_states(case):
    scene, start, seen, guess, unknown = STATED[case]
    ts, noise, start = np.linspace(0.0, 2.0, 41), np.random.default_rng(0), start or dict(scene.example)
    motion = jj.simulate(scene, start, ts=ts)
    exact = {name: np.asarray(motion[name]) for name in seen.split()}
    values = {name: x + 0.01 * noise.normal(size=x.shape) for name, x in exact.items()}
    data = jj.Experiment(ts, values, 0.01, start=start | unknown, unknown_start=tuple(unknown))
    same(scene.replace(**guess), data, tuple(guess))
