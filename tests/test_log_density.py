"""The posterior density of unknowns: against closed forms, with its transforms, and its gradients."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose
from refusals import refused
from small_scenes import Oscillator

import jourdain_jax as jj
from jourdain_jax.identification import log_density, unbounded
from jourdain_jax.studies import Normal

TS = np.linspace(0.0, 4.0, 21)
FREE = {"damping": jj.bounds(0.0, 2.0), "stiffness": jj.Estimate(prior=Normal(5.2, 0.4))}


def closed(start, damping, stiffness, mass=2.0):
    """x(t) of the underdamped oscillator from x0 at rest."""
    d = damping / (2 * mass)
    w = jnp.sqrt(stiffness / mass - d**2)
    return start * jnp.exp(-d * TS) * (jnp.cos(w * TS) + d / w * jnp.sin(w * TS))


def runs(sigma=0.02, starts=(0.3, -0.2)):
    noise = np.random.default_rng(2)
    return [
        jj.Experiment(
            TS,
            {"x": np.asarray(jax.jit(closed)(x, 0.3, 5.0)) + 0.02 * noise.normal(size=len(TS))},
            sigma,
            start={"x": x + 0.01},
            unknown_start=("x",),
        )
        for x in starts
    ]


def by_hand(theta, data, sigma):
    """`log p` in the unknowns themselves."""
    damping, stiffness, *starts = theta
    r = jnp.stack(
        [
            (closed(x, damping, stiffness) - run.values["x"]) / sigma
            for x, run in zip(starts, data, strict=True)
        ]
    )
    likelihood = -0.5 * jnp.sum(r**2) - r.size * jnp.log(sigma * jnp.sqrt(2 * jnp.pi))
    return likelihood - 0.5 * ((stiffness - 5.2) / 0.4) ** 2 - jnp.log(0.4 * jnp.sqrt(2 * jnp.pi))


def test_density_is_likelihood_times_prior_times_derivative_of_the_transforms():
    data = runs()
    density = log_density(Oscillator(), data, FREE)
    assert density.labels == ("damping", "stiffness", "run 0: x", "run 1: x")

    def constrain(z):
        return jnp.stack([2.0 * jax.nn.sigmoid(z[0]), jnp.exp(z[1]), z[2], z[3]])

    def expected(z):
        slopes = jax.jacfwd(constrain)(z)
        return by_hand(constrain(z), data, 0.02) + jnp.linalg.slogdet(slopes)[1]

    z = density.initial + jnp.array([0.1, 0.03, -0.005, 0.002])
    assert_allclose(density.constrain(z), constrain(z), rtol=1e-14)
    many = z + 1e-3 * jnp.arange(3.0)[:, None]
    both = (jax.jit(jax.vmap(jax.value_and_grad(f)))(many) for f in (density, expected))
    (values, slopes), (right, right_slopes) = both
    assert_allclose(values, right, rtol=1e-8)
    assert_allclose(slopes, right_slopes, rtol=2e-6)


def remembering():
    return [
        jj.Experiment(
            run.ts, run.values, None, start=run.start, unknown_start=run.unknown_start, correlation_time=None
        )
        for run in runs()
    ]


def test_noise_with_an_unknown_memory_has_the_density_of_its_covariance():
    data = remembering()
    density = log_density(Oscillator(), data, FREE)
    assert density.labels[-2:] == ("x.sigma", "x.correlation_time")
    assert density.units[-1] == "s"
    h, ends = TS[1] - TS[0], np.arcsin(np.exp(-np.array([10.0, (TS[1] - TS[0]) / (10 * 4.0)])))

    def expected(z):
        """Up to a constant: flat in log sigma and in arcsin rho, which is a logistic function of its z."""
        damping, stiffness, *starts = 2.0 * jax.nn.sigmoid(z[0]), jnp.exp(z[1]), z[2], z[3]
        sigma, angle = jnp.exp(z[4]), ends[0] + (ends[1] - ends[0]) * jax.nn.sigmoid(z[5])
        tau = -h / jnp.log(jnp.sin(angle))
        covariance = sigma**2 * jnp.exp(-jnp.abs(TS[:, None] - TS) / tau)
        likelihoods = [
            jax.scipy.stats.multivariate_normal.logpdf(
                run.values["x"], closed(x, damping, stiffness), covariance
            )
            for x, run in zip(starts, data, strict=True)
        ]
        slopes = (
            jax.nn.log_sigmoid(z[0])
            + jax.nn.log_sigmoid(-z[0])
            + z[1]
            + jax.nn.log_sigmoid(z[5])
            + jax.nn.log_sigmoid(-z[5])
        )
        return sum(likelihoods) - 0.5 * ((stiffness - 5.2) / 0.4) ** 2 + slopes

    first = density.initial
    other = first + jnp.array([0.1, 0.03, -0.005, 0.002, -0.3, 0.4])
    of_both, in_closed_form = (jax.jit(jax.value_and_grad(f)) for f in (density, expected))
    (value, slope), (right, right_slope) = of_both(other), in_closed_form(other)
    assert_allclose(value - of_both(first)[0], right - in_closed_form(first)[0], rtol=1e-8)
    assert_allclose(slope, right_slope, rtol=1e-5)
    assert_allclose(density.unconstrain(density.named(other)), other, rtol=1e-8)
    fit = jj.fit(Oscillator(), data, FREE)
    white = density.whitened(fit)
    middle = white.named(jnp.zeros(6))
    assert_allclose([middle[label] for label in fit.labels], fit.values, rtol=1e-12)
    assert_allclose(middle["x.sigma"], fit.sigma["x"], rtol=1e-12)
    in_white, plain = jax.jit(lambda z: white(z)), [value, of_both(density.unconstrain(middle))[0]]
    assert_allclose(
        np.diff([in_white(white.unconstrain(point)) for point in (density.named(other), middle)]),
        np.diff(plain),
        atol=1e-8,
    )
    here, *around = (
        in_white(0.1 * z) for z in np.concatenate([np.zeros((1, 6)), np.eye(6)[:5], -np.eye(6)[:5]])
    )
    assert_allclose(
        (np.array(around[:5]) + np.array(around[5:]) - 2 * here) / 0.01, -1.0, atol=0.1
    )  # nearly round


def test_unknowns_lead_back_and_stay_finite_far_away():
    start = {"x": unbounded(1.0), "x_rate": jj.bounds(-1.0, 3.0)}
    free = {"stiffness": jj.positive()}
    data = jj.Experiment(
        np.linspace(0.0, 1.0, 5),
        {"x": np.zeros(5)},
        0.1,
        start={"x": 0.1, "x_rate": 0.5},
        unknown_start=start,
    )
    density = log_density(Oscillator(), data, free)
    x = jnp.array([[-2.0, 0.3, 1.5], [3.0, 800.0, -20.0]])
    for point in x:
        assert_allclose(density.unconstrain(density.named(point)), point, rtol=1e-7)
    assert np.isfinite(jax.jit(jax.jacrev(density.constrain))(x[1])).all()


def test_failing_motion_has_no_density():
    density = log_density(Oscillator(), runs(), FREE, max_steps=3)
    assert density(density.initial) == -jnp.inf


def test_unknown_without_a_standard_error_cannot_be_whitened():
    data, free = runs(), ("mass", "damping", "stiffness")
    refused(
        "`mass` has no standard error in the fit",
        log_density(Oscillator(), data, free).whitened,
        jj.fit(Oscillator(), data, free),
    )


def test_a_density_is_one_program_which_serves_other_numbers(compilations):
    densities = [log_density(Oscillator(mass=mass), runs()[0], FREE) for mass in (1.9, 1.8)]
    z = jnp.array([0.3, -0.2, 0.25])
    compilations.clear()
    first = float(densities[0](z))
    assert len(compilations) <= 2
    compilations.clear()
    assert float(densities[1](z)) != first
    assert not compilations
