"""Times of stop events that were observed: of an oscillator let go at x0 > 0, which stops where x = 0 after t
= pi / 2 sqrt(m / k).
"""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose
from small_scenes import Oscillator

import jourdain_jax as jj
from jourdain_jax.identification import log_density, log_likelihood


class Stopped(Oscillator):
    """An oscillator that a buffer stops at its centre."""

    def events(self, motion):
        return {"buffer": motion.q.x, "far": 3.0 - motion.q.x}


SCENE, SIGMA = Stopped(mass=2.0, stiffness=5.0, damping=0.0), 0.003  # s
STOP = float(np.pi / 2 * np.sqrt(SCENE.mass / SCENE.stiffness))  # s


def run(x0=0.3, events=None, values=None, end=1.0):
    """A run of which no more than its event is known, unless values are given at ten times a second."""
    ts = np.array([end]) if values is None else 0.1 * np.arange(1, len(values) + 1)
    events = {"buffer": (STOP + 0.002, SIGMA)} if events is None else events
    seen, start = {} if values is None else {"x": values}, {"x": x0, "x_rate": 0.0}
    return jj.Experiment(ts, seen, 0.005, start=start, t0=0.0, events=events)


def fit(*runs, **options):
    return jj.fit(SCENE.replace(mass=1.5), runs, ("mass",), rtol=1e-10, atol=1e-10, **options)


def test_an_observed_time_tells_a_parameter_as_in_closed_form():
    # t = pi / 2 sqrt(m / k):   m = k (2 t / pi)^2,   sigma_m = 2 m sigma / t
    found = fit(run())
    mass = 5.0 * (2 * (STOP + 0.002) / np.pi) ** 2
    assert_allclose(found["mass"].value, mass, rtol=1e-7)
    assert_allclose(found["mass"].standard_error, 2 * mass * SIGMA / (STOP + 0.002), rtol=1e-6)
    # samples may end long before it; to less than a round-off, whatever the amplitude
    for other in (run(end=0.05), run(0.6)):
        assert_allclose(fit(other)["mass"].value, mass, rtol=1e-7)


def test_runs_with_and_without_an_event_are_fitted_together_and_samples_after_it_do_not_count():
    ts = 0.1 * np.arange(1, 16)
    x = 0.3 * np.cos(np.sqrt(2.5) * ts) + 0.005 * np.random.default_rng(0).normal(size=15)
    after = np.where(ts > STOP, 7.0, x)  # it lies somewhere
    found = fit(run(values=after), run(values=x[:8], events={}), run(0.5))
    assert found.converged
    assert found.samples == 9 + 1 + 8 + 1
    assert not found.warnings
    uncounted = fit(run(values=x[:2], events={"buffer": (STOP, np.inf)}), run(values=x[:8], events={}))
    assert uncounted.samples == 2 + 8
    assert not uncounted.warnings
    # J'J of x = x0 cos(w t),  dx/dm = x0 w t sin(w t) / (2 m), and of t, dt/dm = t / (2 m)
    m, w = float(found["mass"].value), np.sqrt(5.0 / float(found["mass"].value))
    slopes = [0.3 * w * ts[:n] * np.sin(w * ts[:n]) / (2 * m) / 0.005 for n in (9, 8)]
    slopes += [np.full(2, np.pi / (4 * m * w) / SIGMA)]
    assert_allclose(found["mass"].standard_error, np.sum(np.concatenate(slopes) ** 2) ** -0.5, rtol=1e-6)


def test_repeats_have_times_of_their_own():
    times = STOP + SIGMA * np.random.default_rng(1).normal(size=300)
    found = jj.fit_batch(
        SCENE.replace(mass=1.5), run(events={"buffer": (times, SIGMA)}), ("mass",), rtol=1e-10, atol=1e-10
    )
    assert_allclose(found["mass"].value, 5.0 * (2 * times / np.pi) ** 2, rtol=1e-6)


def test_a_likelihood_has_the_slopes_of_the_time_in_both_modes():
    def by_time(mass):
        return -0.5 * ((np.pi / 2 * jnp.sqrt(mass / 5.0) - STOP - 0.002) / SIGMA) ** 2

    def told(mass):
        return log_likelihood(SCENE.replace(mass=mass), run(), rtol=1e-10, atol=1e-10)

    assert_allclose(jax.jit(jax.jacfwd(told))(1.99), jax.grad(by_time)(1.99), rtol=1e-6)
    density = log_density(SCENE, run(), ("mass",), rtol=1e-10, atol=1e-10)
    z, log = density.unconstrain({"mass": 1.99}), np.log(1.99)  # flat in the mass, whose logarithm z is
    assert_allclose(
        jax.jit(jax.grad(density))(z)[0], jax.grad(lambda z: by_time(jnp.exp(z)) + z)(log), rtol=1e-6
    )


def test_a_motion_that_does_not_meet_the_event_is_named():
    far = run(events={"far": (0.9, SIGMA)})
    other = fit(far)
    assert not other.converged
    said = "the motion of run 0 does not reach `far` before 4 times the observed time"
    assert said in "".join(other.warnings)
    assert log_likelihood(SCENE, far) == -np.inf
