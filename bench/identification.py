"""Identification: how fast, how large, how right; figures of fits in one run.

    python bench/identification.py [--quick] [--only NAME ...] [--json FILE]

Parts: disc (one fit against SciPy), outlier, bound, starts (30 first guesses within a factor of 5), unstable
(100 first guesses of a bicycle below its weave speed), chaotic (100 of a double pendulum, by growing spans
and by multiple shooting), coverage, three (coverage of three models, unknown starts and sigmas, white noise
and AR(1) noise), nuts (sampling by BlackJAX), disturbed (a motion with process noise), design (a start that
tells more), windows (57 runs of the steer-by-wire bicycle with an unknown start each; the data are in
`notebooks/data`), logs (what halves of these runs say of each other:
numbers of the notebook on them).
Writes a list of {"figure", "model", "value", "required", "met"}. `--quick` leaves out windows and logs, with
fewer repeats. Times are processor time, the least of some repeats, in turn; those of the windows are wall
time of a fresh process.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from figures import figure, least_processor_time, main, seconds_of
from identification_far import chaotic, seen, unstable
from identification_logs import logs, windows
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.stats import binom
from small_scenes import Oscillator

import jourdain_jax as jj
from jourdain_jax.identification import (
    Fit,
    Sensor,
    filtered_log_likelihood,
    huber,
    log_density,
    planned_information,
    student_t,
)
from jourdain_jax.models import ChaplyginSleigh, DoublePendulumAngles, TiltingDisc

START = {"lean": 0.3, "spin_rate": -3.0}
SIGMA = {"lean": 0.005, "x": 0.005}
DISC_DELAY = 0.03  # s
DISC = "tilting-disc"
GUESS, FREE, UNKNOWN = TiltingDisc(radius=0.55, gravity=10.8), ("radius", "gravity"), ("lean", "spin_rate")


def share_of_intervals(name, model, share, repeats):
    """How often 95 % intervals held the truth, %. Required: 93 to 96.8 % of 1,000 repeats, and of others what
    is as likely, 0.3 % on either side.
    """
    low, high = (100 * float(x) / repeats for x in binom.ppf([0.003, 0.997], repeats, 0.95))
    return figure(name, model, share, high, least=low)


def shares(fits: Fit, truth):
    """How often the interval of each quantity holds its true value, %."""
    return {
        name: 100 * float(np.mean((fits[name].low < truth[name]) & (truth[name] < fits[name].high)))
        for name in fits.labels
    }


# The disc: radius and gravity, and two unknown initial values. ----------------------------------------------


def disc_data(seed, outlier=0.0, repeats=(), delay=0.0, **more) -> jj.Experiment:
    """Lean and place of a rolling disc at 61 times over 2 s; the lean is seen with this delay, which is to be
    estimated where it is not zero.
    """
    ts = jnp.linspace(0.1 if delay else 0.0, 2.0, 61)
    late, plain = (jj.simulate(TiltingDisc(), START, t0=0.0, ts=ts - by) for by in (delay, 0.0))
    values = seen({"lean": late["lean"], "x": plain["x"]}, SIGMA, np.random.default_rng(seed), repeats)
    values["lean"][..., 17] += outlier * SIGMA["lean"]
    options = {"start": {"lean": 0.31, "spin_rate": -2.9}, "unknown_start": UNKNOWN, "sigma": SIGMA}
    if delay:
        options["sensors"] = {"lean": Sensor(delay=jj.Estimate(0.02, range=jj.bounds(0.0, 0.1)))}
    return jj.Experiment(ts, values, t0=0.0, **options | more)


def disc(quick):
    """A warm fit against SciPy's least squares on the same compiled simulation."""
    data = disc_data(0)

    def residual(theta):
        scene = TiltingDisc(radius=theta[0], gravity=theta[1])
        start = dict(zip(UNKNOWN, theta[2:], strict=True))
        motion = jj.simulate(scene, start, ts=data.ts, events=False, work=False)
        return jnp.concatenate([(motion[name] - data.values[name]) / SIGMA[name] for name in SIGMA])

    first = np.array([0.55, 10.8, 0.31, -2.9])
    of_numbers = lambda run: lambda theta: np.asarray(run(jnp.asarray(theta)))
    values, slopes = of_numbers(jax.jit(residual)), of_numbers(jax.jit(jax.jacfwd(residual)))
    runs = {
        "fit": partial(jj.fit, GUESS, data, FREE),
        "differences": partial(least_squares, values, first, x_scale=np.abs(first)),
        "jacfwd": partial(least_squares, values, first, jac=slopes, x_scale=np.abs(first)),
        "late": partial(jj.fit, GUESS, disc_data(0, delay=DISC_DELAY), FREE),
    }
    times, fit = least_processor_time(runs, 3 if quick else 15), runs["fit"]()
    apart = np.max(np.abs(fit.values - runs["differences"]().x) / fit.standard_errors)
    yield figure("warm fit, ms", DISC, 1e3 * times["fit"])
    yield figure("warm fit over SciPy with differences", DISC, times["fit"] / times["differences"], 0.7)
    yield figure("warm fit over SciPy with jacfwd", DISC, times["fit"] / times["jacfwd"], 1.3)
    yield figure("warm fit with the delay of a sensor over one without", DISC, times["late"] / times["fit"])
    yield figure("estimates apart from SciPy's, standard errors", DISC, float(apart), 0.01)


def outlier(quick):
    """One of 122 samples is 60 sigmas out."""
    for name, loss in (("least squares", None), ("Huber", huber()), ("Student-t", student_t())):
        clean, spoilt = (jj.fit(GUESS, disc_data(0, outlier=far), FREE, loss=loss) for far in (0.0, 60.0))
        moved = float(np.max(np.abs(clean.values - spoilt.values) / clean.standard_errors))
        what = f"an outlier of 60 sigmas moves estimates by, standard errors, {name}"
        yield figure(what, DISC, moved, None if loss is None else 0.3)


def bound(quick):
    """A damping that is zero, from ten sets of noise."""
    ts, fits, model = np.linspace(0.0, 10.0, 101), [], "oscillator"
    exact = {"x": 0.3 * np.cos(np.sqrt(2.5) * ts)}
    for seed in range(10):
        values = seen(exact, {"x": 0.01}, np.random.default_rng(seed))
        data = jj.Experiment(ts, values, 0.01, start={"x": 0.3})
        fits.append(jj.fit(Oscillator(), data, ("damping", "stiffness")))
    yield figure("steps to a damping of zero, the most of ten", model, max(int(x.steps) for x in fits), 14)
    limited = sum(bool(x.converged) and bool(np.isfinite(x["damping"].high)) for x in fits)
    yield figure("such fits converged, with a limit, of ten", model, limited, least=10)


def starts(quick):
    """Thirty first guesses of radius, gravity, lean and spin, each within a factor of 5 of the truth."""
    data, best, false, spent = disc_data(0), 0, 0, 0.0
    least = jj.fit(TiltingDisc(), data, FREE).chi_square + 0.1
    one = least_processor_time({"one": partial(jj.fit, GUESS, data, FREE)}, 7)["one"]
    for r, g, lean, spin in np.exp(np.random.default_rng(4).uniform(-np.log(5), np.log(5), (30, 4))):
        begin = {"lean": jnp.asarray(min(0.3 * lean, 1.4)), "spin_rate": jnp.asarray(-3.0 * spin)}
        scene = TiltingDisc(radius=0.5 * r, gravity=9.81 * g)
        found, seconds = seconds_of(partial(jj.fit, scene, disc_data(0, start=begin), FREE))
        same = bool(found.chi_square < least)
        best, false, spent = best + same, false + (not same and not found.warning), spent + seconds / 30
    within = {"lean": jj.bounds(0.06, 1.4), "spin_rate": jj.bounds(-15.0, -0.6)}
    run = disc_data(0, start={"lean": 0.5, "spin_rate": -5.0}, unknown_start=within)
    ranges = {"radius": jj.bounds(0.1, 2.5), "gravity": jj.bounds(2.0, 49.0)}
    batch = partial(jj.fit, TiltingDisc(radius=0.9, gravity=20.0), run, ranges, guesses=30)
    together, found = least_processor_time({"batch": batch}, 3)["batch"], batch()
    what = "first guesses within bounds of a factor of 5, in one batch, that lead to the minimum, of 30"
    yield figure(what, DISC, int(found.agreeing))
    yield figure("this batch ends above the minimum", DISC, float(found.chi_square > least), 0)
    yield figure("time of this batch over that of 30 fits from nearby", DISC, together / 30 / one, 5)
    yield figure(
        "first guesses within a factor of 5 from which the minimum is found, of 30", DISC, best, least=27
    )
    yield figure("of the others, without a warning", DISC, false, 0)
    yield figure("time from such a guess over that from one within a tenth", DISC, spent / one, 5)


def coverage(quick):
    """How often the 95 % interval holds the truth: disc with unknown starts; with sigmas that are not known;
    and with the delay of a sensor.
    """
    repeats, guess = 50 if quick else 500, TiltingDisc(radius=0.51, gravity=10.0)
    truth = {"radius": 0.5, "gravity": 9.81, "lean.delay": DISC_DELAY}
    truth |= {f"run 0: {name}": value for name, value in START.items()}
    ways = {"sigmas known": {}, "sigmas estimated": {"sigma": None}}
    ways["delay of a sensor"] = {"delay": DISC_DELAY}
    for name, how in ways.items():
        fits = jj.fit_batch(guess, disc_data(1, repeats=(repeats,), **how), FREE)
        for label, share in shares(fits, truth).items():
            what = f"intervals that hold the truth, %, {label}, {name}"
            yield share_of_intervals(what, DISC, share, repeats)


# of each model: the scene, first guesses of its free parameters, two starts (all of whose values are not
# known), sigma of each channel, and times
THREE = {
    DISC: (
        TiltingDisc(), {"radius": 0.51, "gravity": 10.0}, (START, {"lean": 0.2, "spin_rate": -4.0}),
        {"lean": 0.005, "x": 0.005}, np.linspace(0.0, 2.0, 101),
    ),
    "chaplygin-sleigh": (
        ChaplyginSleigh(), {"inertia": 0.42, "offset": 0.26},
        ({"x_rate": -0.6, "heading_rate": 0.9}, {"x_rate": -0.8, "heading_rate": 0.4}),
        {"x": 0.01, "heading": 0.01}, np.linspace(0.0, 8.0, 101),
    ),
    "double-pendulum": (
        DoublePendulumAngles(), {"mass2": 0.75, "length2": 0.82},
        ({"theta1": 0.6, "theta2": 0.2}, {"theta1": -0.2, "theta2": 0.5}),
        {"theta1": 0.01, "theta2": 0.01}, np.linspace(0.0, 4.0, 101),
    ),
}  # fmt: skip


def three(quick):
    """How often the 95 % interval holds the truth: three models, two runs each with unknown starts, two
    channels with unknown sigmas; and noise of 0.8.
    """
    repeats = 50 if quick else 1000
    for model, (scene, guesses, starts, sigma, ts) in THREE.items():
        for kind, rho in (("white noise", 0.0), ("AR(1) noise of 0.8", 0.8)):
            generator, runs = np.random.default_rng(7), []
            how = {"correlation_time": None if rho else 0.0}
            truth = {name: float(getattr(scene, name)) for name in guesses}
            for i, start in enumerate(starts):
                values = seen(jj.simulate(scene, start, ts=ts), sigma, generator, (repeats,), rho)
                begin = {name: x + 0.01 for name, x in start.items()}
                runs.append(jj.Experiment(ts, values, None, start=begin, unknown_start=tuple(start), **how))
                truth |= {f"run {i}: {name}": x for name, x in start.items()}
            fits, seconds = seconds_of(partial(jj.fit_batch, scene.replace(**guesses), runs, tuple(guesses)))
            inside = shares(fits, truth)
            what = f"intervals that hold the truth, %, unknown starts and sigmas, {kind}"
            yield figure(f"processor time of {repeats} fits, s, {kind}", model, seconds)
            for which, share in (("fewest", min(inside.values())), ("most", max(inside.values()))):
                yield share_of_intervals(f"{what}, {which}", model, share, repeats)
            yield figure(f"fits converged, %, {kind}", model, 100 * float(np.mean(fits.converged)), least=99)


# Sampling, disturbances, and a plan. ------------------------------------------------------------------------


def nuts(quick):
    """NUTS of BlackJAX on the four unknowns of the disc, whitened by the fit: effective draws for a second,
    one chain and four side by side.
    """
    import blackjax

    data, draws, model = disc_data(0), 500 if quick else 2000, "tilting-disc, 4 unknowns"
    fit = jj.fit(GUESS, data, FREE)
    density = log_density(GUESS, data, FREE).whitened(fit)
    count = density.initial.size
    # on a normal density of variance one nearly all trees have 3 steps of 1.1: chains side by side hardly
    # wait for each other
    sampler = blackjax.nuts(density, step_size=1.1, inverse_mass_matrix=jnp.ones(count))

    def chain(key, z):
        def step(state, key):
            state, told = sampler.step(key, state)
            return state, (state.position, told.is_divergent, told.num_integration_steps)

        return jax.lax.scan(step, sampler.init(z), jax.random.split(key, draws))[1]

    keys, starts = jax.random.split(jax.random.key(1), 4), jax.random.normal(jax.random.key(2), (4, count))
    runs = {
        "one": partial(jax.jit(chain), keys[0], starts[0]),
        "four": partial(jax.jit(jax.vmap(chain)), keys, starts),
    }
    times = least_processor_time(runs, 5)
    one, (positions, diverged, steps) = runs["one"](), map(np.asarray, runs["four"]())
    effective, together = (
        float(np.min(blackjax.diagnostics.effective_sample_size(x))) for x in (one[0][None], positions)
    )
    spread = np.asarray(density.constrain(jnp.asarray(positions))).reshape(-1, count).std(axis=0)
    yield figure(
        "NUTS: effective draws/s, the fewest of all unknowns", model, effective / times["one"], least=200
    )
    yield figure("NUTS: such, of four chains side by side", model, together / times["four"])
    yield figure("NUTS: divergences of 4 chains", model, int(diverged.sum() + np.asarray(one[1]).sum()), 0)
    yield figure("NUTS: 4 chains over one", model, times["four"] / times["one"], 1.5)
    yield figure("NUTS: steps of a tree", model, np.mean(steps))
    off = float(np.max(np.abs(spread / fit.standard_errors - 1)))
    yield figure("NUTS: marginal standard deviations off those of the fit, relative", model, off, 0.05)


def disturbed(quick):
    """How often the 95 % interval of a sleigh's offset holds the truth, whose rates are disturbed: by an
    extended Kalman filter, and by least squares.
    """
    truth, ts, kicks = ChaplyginSleigh(offset=0.25), np.linspace(0.0, 4.0, 41), 5
    repeats = 50 if quick else 200
    start, sigma = {"x_rate": -0.6, "heading_rate": 0.9}, dict.fromkeys(("x", "y", "heading"), 0.01)
    begin = jj.start(truth, start)
    noise = dict.fromkeys(("x_rate", "y_rate"), 2e-4)  # (m/s)^2 / s; the rate of the heading follows
    places = jnp.array([truth.speed_names.entries.index(n) for n in noise])
    h = (ts[1] - ts[0]) / kicks

    def one(key):
        def kick(carry, key):
            t, q, u = carry
            state = jj.consistent(truth, t, q, u, held=tuple(noise))
            motion = jj.simulate(truth, state, t0=t, ts=(t + h)[None], work=False, events=False)
            kicked = jnp.sqrt(2e-4 * h) * jax.random.normal(key, (len(places),))
            return (t + h, motion.q[-1], motion.u[-1].at[places].add(kicked)), motion.q[-1]

        keys = jax.random.split(key, kicks * (len(ts) - 1))
        _, q = jax.lax.scan(kick, (jnp.zeros(()), begin.q, begin.u), keys)
        return jnp.concatenate([begin.q[None], q[kicks - 1 :: kicks]])

    q = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(3), repeats)))
    draw = np.random.default_rng(11)
    names = truth.coordinate_names.entries
    values = {n: q[..., names.index(n)] + s * draw.normal(size=q.shape[:2]) for n, s in sigma.items()}
    data = jj.Experiment(ts, values, sigma, start=start)
    plain = jj.fit_batch(truth.replace(offset=0.26), data, ("offset",))
    grid = np.linspace(0.19, 0.31, 13)

    def along(offset, values):
        run, how = jj.Experiment(ts, values, sigma, start=start), {"rtol": 1e-7, "atol": 1e-7}
        return filtered_log_likelihood(truth.replace(offset=offset), run, process_noise=noise, **how)

    of_run = jax.vmap(along, (0, None))
    logs = np.asarray(jax.jit(lambda v: jax.lax.map(partial(of_run, jnp.asarray(grid)), v))(values))
    fine, curves = np.linspace(0.19, 0.31, 1201), CubicSpline(grid, logs, axis=1)
    likely = curves(fine)
    best, inside = fine[np.argmax(likely, axis=1)], 2 * (np.max(likely, axis=1) - curves(0.25)) < 3.841
    model, what = "chaplygin-sleigh, disturbed", "intervals that hold the truth, %, offset,"
    found = {"extended Kalman filter": best, "least squares": np.asarray(plain["offset"].value)}
    for way, offsets in found.items():
        yield figure(f"mean estimate of an offset of 0.25 m, {way}", model, np.mean(offsets))
    yield share_of_intervals(f"{what} extended Kalman filter", model, 100 * float(np.mean(inside)), repeats)
    yield figure(f"{what} least squares", model, shares(plain, {"offset": 0.25})["offset"])
    ratio = np.divide(*(np.std(offsets) for offsets in found.values()))
    yield figure("standard deviation of the estimates by the filter over that by least squares", model, ratio)


def design(quick):
    """The start of a disc from which its radius and gravity are told best, within bounds, by the slope of log
    det; checked by repeats that are simulated.
    """
    disc, ts, repeats = TiltingDisc(), jnp.linspace(0.0, 2.0, 41), 500
    low, high = jnp.array([0.1, -6.0]), jnp.array([0.5, -2.0])
    named = lambda z: dict(zip(UNKNOWN, z, strict=True))

    def planned(z):
        how = {"start": named(z), "unknown_start": UNKNOWN}
        return planned_information(disc, jj.Experiment(ts, dict.fromkeys(SIGMA, ts), SIGMA, **how), FREE)

    slope, first = jax.jit(jax.jacfwd(lambda z: planned(z).log_det(FREE))), jnp.array([0.3, -3.0])
    z = first
    for k in range(60):  # steps of a share of the width, projected onto the bounds
        g = slope(z) * (high - low)
        z = jnp.clip(z + 0.1 / (1 + k / 10) * (high - low) * g / jnp.linalg.norm(g), low, high)
    before, after = (planned(x).standard_errors for x in (first, z))
    start = named(z.tolist())
    values = seen(jj.simulate(disc, start, ts=ts), SIGMA, np.random.default_rng(12), (repeats,))
    fits = jj.fit_batch(disc, jj.Experiment(ts, values, SIGMA, start=start, unknown_start=UNKNOWN), FREE)
    for name in FREE:
        spread = float(np.std(np.asarray(fits[name].value)[np.asarray(fits.converged)], ddof=1))
        what = f"planned standard error of {name} at the best start over that at the first"
        yield figure(what, DISC, float(after[name] / before[name]))
        # a standard deviation over n repeats is known to 1/sqrt(2 n)
        width = max(0.1, 2 / np.sqrt(2 * repeats))
        what = f"standard deviation of {name} over simulated repeats, over the planned one"
        yield figure(what, DISC, spread / float(after[name]), 1 + width, least=1 - width)


PARTS = (
    disc,
    outlier,
    bound,
    starts,
    unstable,
    chaotic,
    coverage,
    three,
    nuts,
    disturbed,
    design,
    windows,
    logs,
)
if __name__ == "__main__":
    main(__doc__, PARTS, quick=[part.__name__ for part in PARTS[:-2]])
