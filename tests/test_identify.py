"""Identification: estimates from synthetic measurements, their coverage, what cannot be told, and advice on
bad input.

Measurements come from closed forms or hand-written equations (tests/oracles), not from the engine.
"""

import re
import warnings
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import chaplygin_sleigh as sleigh_oracle
from refusals import refused
from small_scenes import Cart

import jourdain_jax as jj
from jourdain_jax import Experiment, bounds, fit, fit_batch
from jourdain_jax.identification import Actuator, Sensor, huber, log_likelihood, student_t, unbounded
from jourdain_jax.models import ChaplyginSleigh

REPEATS = 200
SIGMA = 0.02  # m, rad
TRUTH = ChaplyginSleigh()
GUESS = TRUTH.replace(inertia=0.6, offset=0.35)
SLEIGH_START = {"x_rate": -0.6, "heading_rate": 0.9}


def sleigh_data(seed, repeats=()):
    """Position of the mass centre and heading of the default sleigh at 41 times over 8 s."""
    ts = np.linspace(0.0, 8.0, 41)
    parameters = {"mass": 1.3, "inertia": 0.4, "a": 0.25, "v0": -0.6, "w0": 0.9}
    motion = sleigh_oracle.motion(ts, **parameters)
    noise = np.random.default_rng(seed)
    exact = {"x": motion["x"], "y": motion["y"], "heading": motion["th"]}
    return Experiment(
        ts,
        {k: v + SIGMA * noise.normal(size=(*repeats, 41)) for k, v in exact.items()},
        SIGMA,
        start=SLEIGH_START,
    )


@pytest.fixture(scope="module")
def sleigh_fit():
    return fit(GUESS, sleigh_data(0), ("inertia", "offset"))


@pytest.fixture(scope="module")
def sleigh_batch():
    return fit_batch(GUESS, sleigh_data(1, (REPEATS,)), ("inertia", "offset"))


# The sleigh. ------------------------------------------------------------------------------------------------


def test_intervals_cover_the_truth_in_90_to_99_percent_of_200_repeats(sleigh_batch):
    assert sleigh_batch.converged.shape == (REPEATS,)
    assert sleigh_batch.converged.all()
    for name in ("inertia", "offset"):
        estimate, truth = sleigh_batch[name], float(getattr(TRUTH, name))
        covered = np.mean((estimate.low < truth) & (truth < estimate.high))
        assert 0.90 <= covered <= 0.99, (name, covered)
        # spread of the estimates against the error each claims: 5 % is the sampling error of a deviation from
        # 200
        assert_allclose(np.std(estimate.value), np.mean(estimate.standard_error), rtol=0.2)
    assert "200 fits of ChaplyginSleigh: 200 converged" in str(sleigh_batch)


def test_a_batch_gives_what_single_fits_give(sleigh_batch):
    data = sleigh_data(1, (REPEATS,))
    one = eqx.tree_at(lambda d: d.values, data, {name: values[17] for name, values in data.values.items()})
    single = fit(GUESS, one, ("inertia", "offset"))
    apart = np.abs(single.values - sleigh_batch.values[17]) / single.standard_errors
    assert apart.max() < 1e-2  # both stop within the tolerance of the minimum
    assert_allclose(single.standard_errors, sleigh_batch.standard_errors[17], rtol=1e-4)


def test_printed_table(sleigh_fit):
    text = str(sleigh_fit)
    assert "Fit of ChaplyginSleigh: converged in" in text
    assert "123 samples, 2 unknowns" in text
    assert f"{float(sleigh_fit['offset'].value):.6g}" in text
    assert "heading  41" in text
    assert "WARNING" not in text
    for summary in sleigh_fit.residual_summary():
        assert summary.samples == 41
        assert 0.6 < summary.rms < 1.4
    with pytest.raises(KeyError, match="did you mean `offset`"):
        sleigh_fit["ofset"]


# The rattleback. --------------------------------------------------------------------------------------------


# A cart with a spring, a damper and a push: quick, and with inputs. -----------------------------------------


CART = Cart()
TS = np.linspace(0.0, 4.0, 21)


def cart_motion(ts, x0, v0, push, mass=2.0):
    """x and v of the cart under a push that is constant in time, in closed form."""
    rest, rate = push / 5.0, 0.3 / mass
    w = np.sqrt(5.0 / mass - rate**2)
    a, b = x0 - rest, (v0 + rate * (x0 - rest)) / w
    decay = np.exp(-rate * ts)
    x = rest + decay * (a * np.cos(w * ts) + b * np.sin(w * ts))
    return x, -rate * (x - rest) + decay * w * (b * np.cos(w * ts) - a * np.sin(w * ts))


def cart_run(x0=0.3, v0=0.0, push=1.0, ts=TS, **options):
    """A run without noise; the push comes as samples."""
    x, v = cart_motion(ts, x0, v0, push)
    sampled = jj.Sampled(jnp.array([0.0, 10.0]), jnp.array([push, push]))
    given = {
        "values": {"x": x, "x_rate": v},
        "sigma": {"x": 0.01, "x_rate": 0.02},
        "start": {"x": x0, "x_rate": v0},
    }
    given |= {"inputs": {"push": sampled}} | options
    return Experiment(ts, given.pop("values"), given.pop("sigma"), **given)


def mass_of(runs, guess=1.7, **options):
    """A fit of the mass alone."""
    return fit(Cart(mass=guess), runs, ("mass",), **options)


def test_several_runs_with_sampled_inputs_bounds_and_unknown_starts():
    runs = [
        cart_run(),
        cart_run(
            x0=-0.2,
            v0=0.5,
            push=-0.5,
            start={"x": -0.1, "x_rate": 0.5},
            unknown_start={"x": bounds(-1.0, 1.0)},
        ),
        cart_run(x0=0.1, push=2.0, ts=TS[:11]),
        cart_run(x0=0.4, push=0.0),
    ]
    free = {"mass": bounds(0.5, 5.0), "damping": None, "stiffness": unbounded(10.0)}
    found = fit(Cart(mass=1.5, damping=0.9, stiffness=6.5), runs, free)
    assert found.labels == ("mass", "damping", "stiffness", "run 1: x")
    assert found.units == ("kg", "N s/m", "N/m", "")
    assert found.converged
    # without noise the estimates are the truth, to the accuracy of the simulation
    assert_allclose(found.values, [2.0, 0.6, 5.0, -0.2], rtol=1e-6)
    assert found.chi_square < 1e-8
    assert found.samples == 2 * (3 * 21 + 11)
    assert [residual["x"].shape for residual in found.residuals] == [(21,), (21,), (11,), (21,)]
    assert all(found.low < found.values)
    assert all(found.values < found.high)


@pytest.mark.parametrize("missing", ["masked", "no number", "of no weight"])
def test_samples_that_are_missing_do_not_count(missing):
    some, x = np.arange(21) % 2 == 0, cart_run().values["x"]
    wrong = np.where(some, x, np.nan if missing == "no number" else 99.0)
    sigma = np.where(some, 0.01, np.inf) if missing == "of no weight" else 0.01
    found = mass_of(
        cart_run(
            values={"x": np.ma.masked_where(~some, wrong) if missing == "masked" else wrong},
            sigma={"x": sigma},
        )
    )
    assert found.samples == found.residual_summary()[0].samples == 11
    assert_allclose(found["mass"].value, 2.0, rtol=1e-6)
    assert np.isnan(found.residuals[0]["x"][1::2]).all()


def test_log_likelihood_is_the_gaussian_one_and_differentiable():
    data = cart_run(x0=0.3)
    scene = Cart(mass=2.02)

    @partial(jax.jit, static_argnames="max_steps")
    def both(mass, max_steps=4096):
        value = lambda mass: log_likelihood(scene.replace(mass=mass), data, max_steps=max_steps)
        return jax.jvp(value, (mass,), (1.0,))

    found, slope = both(2.02)
    motion = jj.simulate(scene, {"x": 0.3, "x_rate": 0.0}, ts=TS, inputs={"push": 1.0})
    r = np.concatenate(
        [np.subtract(motion[name], data.values[name]) / data.sigma[name] for name in ("x", "x_rate")]
    )
    expected = -0.5 * np.sum(r**2) - 21 * np.log(0.01 * 0.02) - 21 * np.log(2 * np.pi)
    assert_allclose(found, expected, rtol=1e-9)
    step = 1e-4
    assert_allclose(slope, float(both(2.02 + step)[0] - both(2.02 - step)[0]) / (2 * step), rtol=1e-5)
    assert both(2.02, max_steps=2)[0] == -np.inf


def test_a_parameter_at_its_bound_is_said_to_be_there():
    found = fit(Cart(mass=3.0), cart_run(), {"mass": bounds(2.5, 4.0)})
    assert found.converged
    assert found.at_bound.all()
    assert float(found["mass"].value) == found["mass"].low == 2.5
    assert "`mass` lies at a bound" in found.warning
    assert "WARNING: `mass` lies at a bound" in str(found)
    assert np.isnan(found["mass"].standard_error)


def released(push):
    """A run without damping from rest, x = x0 cos(w t), with noise that asks for less than none where `push`
    is not zero.
    """
    w = np.sqrt(5.0 / 2.0)
    return cart_run(
        values={
            "x": 0.3 * np.cos(w * TS) * (1 + push * TS),
            "x_rate": -0.3 * w * np.sin(w * TS) * (1 + push * TS),
        },
        inputs=None,
    )


def test_a_damping_of_zero_is_found_and_gets_a_one_sided_limit():
    exact = fit(Cart(mass=2.2), released(0.0), ("mass", "damping"))
    assert exact["damping"].value == exact["damping"].low or exact["damping"].value < 1e-6
    found = fit(Cart(mass=2.2), released(0.002), ("mass", "damping"))
    assert exact.converged
    assert found.converged
    assert max(exact.steps, found.steps) < 15
    assert found.at_bound.tolist() == [False, True]
    assert "one-sided, at its bound" in str(found)
    assert not any("bound" in warning for warning in found.warnings)
    # the limit: 3.841 more in chi-square, by a fit with the damping held there
    held = fit(Cart(mass=2.0, damping=float(found["damping"].high)), released(0.002), ("mass",))
    assert_allclose(held.chi_square - found.chi_square, 3.841, rtol=0.05)
    # whatever the range that is asked for
    for given in (unbounded(0.1), bounds(-1.0, 2.0)):
        other = fit(Cart(mass=2.2), released(0.002), {"mass": unbounded(), "damping": given})
        assert_allclose(other.values, found.values, rtol=1e-6)
    refused(
        r"first guess of `damping` is -0\.5, but this parameter is declared non-negative",
        fit,
        Cart(),
        released(0.0),
        {"damping": jj.Estimate(-0.5, range=bounds(-1.0, 2.0))},
    )


def test_a_parameter_that_must_be_above_zero_ends_a_little_above_it():
    class Damped(Cart):
        damping: float = jj.parameter(0.6, unit="N s/m", positive=True)  # with zero there is no motion

    found = fit(Damped(mass=2.2), released(0.002), ("mass", "damping"))
    assert found.converged
    assert found.steps < 15
    assert found.at_bound.tolist() == [False, True]
    assert found["damping"].value == pytest.approx(0.6e-6)
    assert 0.0 < found["damping"].high < 0.1


def test_a_motion_that_fails_gives_a_flag_and_no_numbers():
    found = mass_of(cart_run(), max_steps=2)
    assert not found.converged
    assert "the motion fails at the first guess" in found.warning
    assert "NOT CONVERGED" in str(found)
    assert np.isnan([found["mass"].standard_error, found["mass"].low]).all()


def test_too_few_iterations_and_wrong_sigmas_are_warned_of():
    found = mass_of(cart_run(), 0.2, max_iterations=1)
    assert not found.converged
    assert "no minimum was found" in found.warning
    data = cart_run()
    shaken = {name: values + 0.1 * np.sin(5.0 * TS) for name, values in data.values.items()}
    assert "residuals are larger than the sigmas allow" in mass_of(cart_run(values=shaken)).warning


def test_sigmas_that_are_too_large_are_warned_of_by_channel():
    values = noisy(0, sigma=(0.01, 0.01)).values
    assert not mass_of(cart_run(values=values, sigma=0.01)).warnings
    (warning,) = mass_of(cart_run(values=values, sigma={"x": 0.01, "x_rate": 0.07})).warnings
    assert (
        "the residuals of `x_rate` are smaller than the sigmas predict by a factor of about 7.9: sigmas are"
        " too large" in warning
    )
    (warning,) = mass_of(cart_run(values=values, sigma=0.1), loss=huber()).warnings
    assert "the residuals are smaller than the sigmas predict" in warning


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("guess", [1.7, 2.0], ids=["nearly", "exactly"])
def test_measurements_without_noise_are_told_in_one_sentence(guess):
    motion = jj.simulate(CART, {"x": 0.3}, ts=TS)  # CART has the mass of 2 kg
    run = Experiment(TS, {name: motion[name] for name in ("x", "x_rate")}, 0.01, start={"x": 0.3})
    (warning,) = fit(Cart(mass=guess), run, ("mass",)).warnings
    assert "samples were smoothed or have no noise" in warning


def test_an_event_before_the_last_sample_is_named():
    class Stopped(Cart):
        def events(self, motion):
            return {"buffer": motion.q.x - 0.05}

    x, _ = cart_motion(TS, 0.3, 0.0, 0.0)
    run = cart_run(push=0.0, values={"x": x}, sigma=1e-3)
    met = TS[np.argmax(x < 0.05)]  # s: the first sample after it
    (warning,) = (w for w in fit(Stopped(mass=1.9), run, ("mass",)).warnings if "event" in w)
    assert "the motion of run 0 meets its event `buffer` at" in warning
    assert met - 0.2 < float(warning.partition(" at ")[2].partition(" s")[0]) < met
    assert f"before {np.sum(met <= TS)} of its samples" in warning
    cut = cart_run(push=0.0, values={"x": np.where(met <= TS, np.nan, x)}, sigma=1e-3)
    assert not any("event" in w for w in fit(Stopped(mass=1.9), cut, ("mass",)).warnings)
    unfinished = fit(Stopped(mass=1.9), run, ("mass",), max_iterations=1)
    assert not unfinished.converged
    assert any("meets its event `buffer`" in w for w in unfinished.warnings)


def test_an_angle_that_was_wrapped_is_named_and_one_that_swings_is_not():
    ts = np.linspace(0.0, 3.0, 61)
    angle, some = 9.0 * 2.0 * (1 - np.exp(-0.5 * ts)), np.arange(61) % 7 > 0

    def run(x):
        return cart_run(
            ts=ts, values={"encoder": x}, sigma=0.01, start={"x_rate": 9.0}, sensors={"encoder": "x"}
        )

    for x in (np.mod(angle + np.pi, 2 * np.pi) - np.pi, np.where(some, np.mod(angle, 2 * np.pi), np.nan)):
        with pytest.warns(
            UserWarning,
            match=r"channel `encoder` of run 0 jumps by -[56]\.\d+ at .* s and stays within one turn",
        ):
            log_likelihood(CART, run(x))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for x in (angle, 3.1 * np.sin(9 * ts), np.random.default_rng(0).uniform(-3.1, 3.1, 61)):
            log_likelihood(CART, run(x))


def test_a_gap_in_a_logged_input_is_named():
    ts = np.linspace(0.0, 4.0, 81)
    gap = (ts > 1.0) & (ts < 1.9)
    log = lambda ts: {"push": jj.Sampled(ts, np.sin(ts))}
    with pytest.warns(
        UserWarning,
        match=(
            r"`push` of run 0 is sampled every 0.05 s, but not from 1 to 1.9 s, where it is interpolated"
            r" linearly"
        ),
    ):
        log_likelihood(CART, cart_run(inputs=log(ts[~gap])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        steps = {"push": jj.Sampled([0.0, 1.0, 1.001, 4.0], [0.0, 0.0, 1.0, 1.0])}
        for inputs in (log(np.linspace(0.0, 4.0, np.sum(~gap))), steps):
            log_likelihood(CART, cart_run(inputs=inputs))


def test_inputs_that_are_not_sampled_over_all_of_a_run_are_warned_of():
    ends, begins = ({"push": jj.Sampled(ts, [0.0, 1.0, 1.0])} for ts in ([-1.0, 0.0, 1.0], [1.6, 2.6, 10.0]))
    with pytest.warns(
        UserWarning,
        match="`push` of run 1 does not cover the whole run and keeps its last value from 1 to 4 s",
    ) as seen:
        found = mass_of([cart_run(), cart_run(inputs=ends)])
    assert len(seen) == 1
    assert sum("from 1 to 4 s" in warning for warning in found.warnings) == 1
    with pytest.warns(UserWarning, match="`push` of run 0 .* keeps its first value until 1.6 s"):
        log_likelihood(CART, cart_run(inputs=begins))
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        log_likelihood(CART, cart_run(inputs=ends))
        assert [one.filename for one in seen] == [__file__]
        seen.clear()
        ts = np.arange(1, 20) / 5.0  # from an interval after the start until one before the end
        log_likelihood(CART, cart_run(inputs={"push": Actuator(jj.Sampled(ts, np.sin(ts)), hold=True)}))
        assert not seen


# Several runs, noise that is not stated, samples that are far out. ------------------------------------------

THREE = ("mass", "damping", "stiffness")


def noisy(seed, sigma=(0.01, 0.02), outlier=0.0, ts=TS, memory=0.0, **options):
    """A run of the cart with noise; `memory`: correlation of neighbouring samples of it; one sample of x is
    far out by `outlier` sigmas.
    """
    generator = np.random.default_rng(seed)
    x0 = options.pop("x0", 0.3)
    values = {}
    for name, exact, s in zip(("x", "x_rate"), cart_motion(ts, x0, 0.0, 1.0), sigma, strict=True):
        noise = generator.normal(size=len(ts))
        for k in range(1, len(ts)):
            noise[k] = memory * noise[k - 1] + np.sqrt(1 - memory**2) * noise[k]
        values[name] = exact + s * noise
    values["x"][7] += outlier * sigma[0]
    return cart_run(x0=x0, ts=ts, values=values, **options)


def test_no_number_of_the_method_recompiles_and_a_new_lambda_per_run_is_one_channel(compilations):
    def run(x0):
        x, _ = cart_motion(TS, x0, 0.0, 0.0)
        path = np.stack([x, 0 * x, 0 * x], axis=1)
        scale = jnp.asarray(2.0)
        return Experiment(
            TS,
            {"cart": 2 * path},
            0.01,
            start={"x": x0, "x_rate": 0.0},
            sensors={"cart": lambda motion: scale * motion["cart"].position},
        )

    first = mass_of([run(0.3), run(-0.5)], 1.5)
    compilations.clear()
    for options in ({"cutoff": 1e-5}, {"tolerance": 1e-3}, {"max_iterations": 7}):
        again = mass_of([run(0.2), run(-0.4)], 1.6, **options)
        assert_allclose(again["mass"].value, 2.0, rtol=1e-5)
    assert not compilations
    assert_allclose(first["mass"].value, 2.0, rtol=1e-6)


def test_many_runs_with_unknown_starts_are_those_of_a_dense_fit():
    # an independent solution: all residuals and all unknowns in one dense problem, slopes by differences of
    # the closed form
    runs = [
        noisy(
            k,
            x0=0.1 * k - 0.35,
            start={"x": 0.1 * k - 0.3, "x_rate": 0.0},
            unknown_start={"x": unbounded(0.1)},
        )
        for k in range(8)
    ]
    found = mass_of(runs, 1.8)
    assert found.converged
    assert len(found.labels) == 9

    def dense(theta):
        parts = []
        for run, x0 in zip(runs, theta[1:], strict=True):
            x, v = cart_motion(TS, x0, 0.0, 1.0, theta[0])
            parts += [(x - run.values["x"]) / 0.01, (v - run.values["x_rate"]) / 0.02]
        return np.concatenate(parts)

    theta = np.asarray(found.values)
    J = np.stack([(dense(theta + h) - dense(theta - h)) / 2e-6 for h in 1e-6 * np.eye(9)], axis=1)
    assert_allclose(found.covariance, np.linalg.inv(J.T @ J), rtol=1e-5, atol=1e-12)
    assert_allclose(found.correlation[0, 1], found.covariance[0, 1] / np.prod(found.standard_errors[:2]))
    step = np.linalg.lstsq(J, -dense(theta), rcond=None)[0]
    assert np.max(np.abs(step) / found.standard_errors) < 1e-3
    # one run less is the same program, and costs no more than its runs
    assert mass_of(runs[:7], 1.8).converged


# Huber's loss bounds the influence of a sample, that of Student's t goes to zero
@pytest.mark.parametrize(("loss", "most"), [(huber(), 0.6), (student_t(4.0), 0.3)])
def test_one_sample_far_out_hardly_moves_a_robust_fit(loss, most):
    ts = np.linspace(0.0, 12.0, 61)  # 122 samples
    guess = Cart(mass=1.7, damping=0.8, stiffness=4.0)
    clean, spoilt = (fit(guess, noisy(5, ts=ts, outlier=far), THREE, loss=loss) for far in (0.0, 60.0))
    assert spoilt.converged
    assert np.max(np.abs(spoilt.values - clean.values) / clean.standard_errors) <= most
    assert not spoilt.warnings
    plain = fit(guess, noisy(5, ts=ts, outlier=60.0), THREE)
    assert "residuals are larger" in plain.warning
    shaken = cart_run(
        values={name: x + 0.1 * np.sin(5.0 * ts) for name, x in noisy(5, ts=ts).values.items()}, ts=ts
    )
    assert "residuals are larger" in str(fit(guess, shaken, THREE, loss=loss).warnings)
    assert np.max(np.abs(plain.values - clean.values) / clean.standard_errors) > 1.0
    assert np.all(
        np.abs(clean.standard_errors / fit(guess, noisy(5, ts=ts), THREE).standard_errors - 1) < 0.3
    )


def test_a_sigma_that_is_not_known_is_told_and_ends_at_a_floor_where_a_channel_is_met_to_round_off():
    run = noisy(7, ts=np.linspace(0.0, 12.0, 201), sigma=(0.03, 0.005))
    found = fit(Cart(mass=1.7), cart_run(ts=run.ts, values=run.values, sigma=None), THREE)
    assert_allclose(
        [found.sigma["x"], found.sigma["x_rate"]], [0.03, 0.005], rtol=0.15
    )  # three standard errors of a deviation from 201
    assert "sigma of `x`, estimated: 0.0" in str(found)
    # sigma_c^2 = sum e^2 / (n_c - p_c), and the p_c of both channels are the three unknowns
    assert_allclose(sum(201 * (1 - one.rms**2) for one in found.residual_summary()), 3.0, rtol=1e-6)
    assert_allclose(found.reduced_chi_square, 1.0, rtol=1e-6)
    x = np.asarray(jj.simulate(CART, cart_run().start, ts=TS)["x"])
    for scale in (1.0, 1e6):  # whatever its unit
        exact = cart_run(
            values={"mine": scale * x}, sigma=None, inputs=None, sensors={"mine": Sensor("x", gain=scale)}
        )
        met = mass_of(exact)
        assert met.converged
        assert_allclose(met.sigma["mine"], 1e-10 * scale * np.max(np.abs(x)), rtol=1e-3)


def test_noise_with_a_memory_is_warned_of_and_runs_tell_honest_errors():
    ts = np.linspace(0.0, 4.0, 101)
    repeats = [[noisy(100 * k + i, memory=0.9, ts=ts) for i in range(8)] for k in range(25)]
    found = [mass_of(runs, 1.9, errors="runs") for runs in repeats]
    claimed = mass_of(repeats[0], 1.9)
    assert "residuals of `x` (0." in claimed.warning
    assert "are not white" in str(claimed)
    assert 0.75 < claimed.autocorrelation["x"][0] < 0.95
    assert found[0].warning == ""
    own = mass_of([noisy(i, memory=0.9, ts=ts, unknown_start=("x",)) for i in range(8)], 1.9, errors="runs")
    assert "which makes intervals of unknowns of single runs (`run 0: x`)" in own.warning
    spread = np.std([float(f["mass"].value) for f in found])
    honest, naive = (
        np.mean([float(f["mass"].standard_error) for f in found]),
        float(claimed["mass"].standard_error),
    )
    assert honest == pytest.approx(spread, rel=0.5)  # 14 % is the sampling error of a deviation from 25
    assert naive < 0.6 * spread
    # intervals are those of Student's t with seven degrees of freedom
    assert_allclose(
        found[0]["mass"].high - found[0]["mass"].value, 2.364624 * found[0]["mass"].standard_error, rtol=1e-3
    )


def test_estimates_that_go_together_are_named():
    # shortly after its start a cart tells the ratio of its parameters, and hardly each
    found = fit(Cart(mass=2.0), noisy(8, ts=np.linspace(0.0, 0.8, 21)), ("mass", "stiffness"))
    assert abs(found.correlation[0, 1]) > 0.98
    (pair,), (combination,) = found.correlated, found.weak
    assert "`mass` and `stiffness` correlate at 0.9" in pair
    assert re.match(
        r"a change of `\w+` by \d+ % and a change of `\w+` by \d+ % together are one standard error",
        combination,
    )
    assert pair in str(found)


def test_a_fit_inside_a_transformation_is_refused():
    for transformed in (jax.jit, jax.grad):
        with pytest.raises(
            jj.DifferentiationModeError, match=r"inside jit, vmap or a derivative.*`fit_batch`"
        ):
            transformed(lambda mass: fit(Cart(mass=mass), cart_run(), ("mass",)).values[0])(1.7)


# What cannot be told. ---------------------------------------------------------------------------------------


def test_ratios_that_show_are_told_as_such():
    found = fit(Cart(mass=1.9), cart_run(push=0.0), THREE)
    (sentence,) = found.not_identifiable
    assert "d mass/mass : d damping/damping : d stiffness/stiffness = 1 : 1 : 1" in sentence
    assert sentence.endswith("the data determine only damping mass^-1, stiffness mass^-1")
    assert np.isnan(found.standard_errors).all()


def test_what_moves_with_an_unknown_of_each_run_has_no_interval_and_all_else_keeps_its_own():
    class Shifted(Cart):
        rest: float = jj.parameter(0.0, unit="m")

        def loads(self, motion):
            return (*super().loads(motion), jj.generalized_force(motion, x_rate=self.stiffness * self.rest))

    def run(k):  # where the spring rests shows as little as the zero of an encoder and the place of the start
        sensor = Sensor("x", bias=jj.Estimate(0.0, per_run=True))
        values = {"encoder": noisy(k).values["x"]}
        return cart_run(
            values=values,
            sigma=0.01,
            start={"x": 0.3},
            unknown_start={"x": unbounded(0.1)},
            sensors={"encoder": sensor},
        )

    runs = [run(k) for k in range(3)]
    found, known = (
        fit(Shifted(mass=1.9, stiffness=5.0), runs, free) for free in (("mass", "rest"), ("mass",))
    )
    shown = {name for name in found.labels if np.isfinite(found[name].standard_error)}
    assert shown == {"mass"}
    assert found.information.rank == len(found.labels) - 1
    assert_allclose(found["mass"].standard_error, known["mass"].standard_error, rtol=1e-4)


# Bad input. -------------------------------------------------------------------------------------------------


def test_start_values_that_depend_on_each_other_are_refused():
    data = sleigh_data(0)
    consistent = {"x_rate": -0.6, "y_rate": 0.25 * 0.9, "heading_rate": 0.9}

    def run(start, **options):
        return Experiment(data.ts, data.values, SIGMA, start=start, **options)

    # y_rate follows from the offset, which is to change
    refused(
        r"the start of run 0 violates the constraints when the unknowns change.*`blade`",
        fit,
        TRUTH,
        run(consistent),
        ("offset",),
    )
    refused(
        r"the start of run 1 is not admissible.*violates constraint `blade`",
        fit,
        TRUTH,
        [data, run({"y_rate": 1.0, "x_rate": 0.0, "heading_rate": 0.0})],
        ("inertia",),
    )
