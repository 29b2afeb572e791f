"""Identification: how fast, how large, how right; figures of fits in one run.

    python bench/identification.py [--quick] [--only NAME ...] [--json FILE]

Parts: disc (one fit against SciPy), outlier, bound, starts (30 first guesses within a factor of 5), unstable (100 first guesses of a bicycle below its weave
speed), chaotic (100 of a double pendulum, by growing spans and by multiple shooting), coverage, three (coverage of three models,
unknown starts and sigmas, white noise and AR(1) noise), nuts (sampling by BlackJAX), disturbed (a motion with process noise), design (a start that tells more),
windows (57 runs of the steer-by-wire bicycle with an unknown start each; the data are in `notebooks/data`), logs (what halves of these runs say of each other:
numbers of the notebook on them).
Writes a list of {"figure", "model", "value", "required", "met"}. `--quick` leaves out windows and logs, with fewer repeats.
Times are processor time, the least of some repeats, in turn; those of the windows are wall time of a fresh process.
"""

import argparse
import csv
import gzip
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import binom

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))  # small scenes that tests use, too
from small_scenes import Oscillator

import jourdain_jax as jj
from jourdain_jax.models.whipple_bicycle import WhippleBicycle

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
WINDOWS = NOTEBOOKS / "data" / "steer_by_wire" / "windows.csv.gz"
START = {"lean": 0.3, "spin_rate": -3.0}
SIGMA = {"lean": 0.005, "x": 0.005}
DISC_DELAY = 0.03  # s
Figure = dict


def figure(name: str, model: str, value: float, required: float | None = None, at_least: bool = False) -> Figure:
    """One entry of the result."""
    met = required is None or (value >= required if at_least else value <= required)
    print(f"  {name}, {model}: {value:.4g}" + ("" if required is None else f" (required: {'>=' if at_least else '<='} {required:g})"), flush=True)
    return {"figure": name, "model": model, "value": float(value), "required": required, "met": bool(met)}


def share_of_intervals(name: str, model: str, share: float, repeats: int) -> Figure:
    """How often 95 % intervals held the truth, %. Required: 93 to 96.8 % of 1,000 repeats, and of others what is as likely, 0.3 % on either side."""
    low, high = (100 * float(x) / repeats for x in binom.ppf([0.003, 0.997], repeats, 0.95))
    return figure(name, model, share) | {"required": [low, high], "met": low <= share <= high}


def processor_times(runs: dict, repeats: int) -> dict[str, float]:
    """Processor time of each run, s: the least of some repeats, in turn, after a first one that compiles."""
    laps = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(repeats):
        for name, run in runs.items():
            begin = time.process_time()
            run()
            laps[name].append(time.process_time() - begin)
    return {name: min(lap) for name, lap in laps.items()}


# The disc: radius and gravity, and two unknown initial values. ------------------------------------------------------------


def disc_data(seed: int, ts=None, outlier: float = 0.0, repeats: tuple[int, ...] = (), delay: float = 0.0) -> jj.Experiment:
    """Lean and place of a rolling disc at 61 times over 2 s; the lean is seen with this delay, which is to be estimated where it is not zero."""
    ts = jnp.linspace(0.1 if delay else 0.0, 2.0, 61) if ts is None else ts
    motion, noise = jj.simulate(jj.models.TiltingDisc(), START, t0=0.0, ts=ts), np.random.default_rng(seed)
    exact = {name: np.asarray(motion[name]) for name in SIGMA}
    sensors = {}
    if delay:
        exact["lean"] = np.asarray(jj.simulate(jj.models.TiltingDisc(), START, t0=0.0, ts=ts - delay)["lean"])
        sensors = {"lean": jj.Sensor(delay=jj.Estimate(0.02, range=jj.bounds(0.0, 0.1)))}
    values = {name: exact[name] + s * noise.normal(size=(*repeats, len(ts))) for name, s in SIGMA.items()}
    values["lean"][..., 17] += outlier * SIGMA["lean"]
    start = {"lean": 0.31, "spin_rate": -2.9}
    return jj.Experiment(ts, values, SIGMA, start=start, unknown_start=("lean", "spin_rate"), sensors=sensors, t0=0.0)


def disc(repeats: int) -> list[Figure]:
    """A warm fit against SciPy's least squares on the same compiled simulation."""
    import scipy.optimize

    data, guess, free = disc_data(0), jj.models.TiltingDisc(radius=0.55, gravity=10.8), ("radius", "gravity")

    def residual(theta):
        scene = jj.models.TiltingDisc(radius=theta[0], gravity=theta[1])
        motion = jj.simulate(scene, {"lean": theta[2], "spin_rate": theta[3]}, ts=data.ts, events=False, work=False)
        return jnp.concatenate([(motion[name] - data.values[name]) / SIGMA[name] for name in SIGMA])

    compiled, first = jax.jit(residual), np.array([0.55, 10.8, 0.31, -2.9])
    slopes = jax.jit(jax.jacfwd(residual))
    numbers = lambda f: lambda theta: np.asarray(f(jnp.asarray(theta)))  # noqa: E731
    found = {}

    def ours():
        found["fit"] = jj.fit(guess, data, free)

    def differences():
        found["scipy"] = scipy.optimize.least_squares(numbers(compiled), first, x_scale=np.abs(first))

    def forward():
        found["jacfwd"] = scipy.optimize.least_squares(numbers(compiled), first, jac=numbers(slopes), x_scale=np.abs(first))

    times = processor_times({"fit": ours, "differences": differences, "jacfwd": forward}, repeats)
    late = disc_data(0, delay=DISC_DELAY)
    both = processor_times({"late": lambda: jj.fit(guess, late, free), "fit": ours}, repeats)
    apart = np.max(np.abs(found["fit"].values - found["scipy"].x) / found["fit"].standard_errors)
    print(
        f"  fit {1e3 * times['fit']:.1f} ms ({int(found['fit'].steps)} steps), SciPy with differences {1e3 * times['differences']:.1f} ms "
        f"({found['scipy'].nfev} steps), with jacfwd {1e3 * times['jacfwd']:.1f} ms ({found['jacfwd'].nfev} steps)"
    )
    return [
        figure("warm fit over SciPy with differences", "tilting-disc", times["fit"] / times["differences"], 0.7),
        figure("warm fit over SciPy with jacfwd", "tilting-disc", times["fit"] / times["jacfwd"], 1.3),
        figure("warm fit with the delay of a sensor over one without", "tilting-disc", both["late"] / both["fit"]),
        figure("estimates apart from SciPy's, standard errors", "tilting-disc", float(apart), 0.01),
    ]


def outlier() -> list[Figure]:
    """One of 122 samples is 60 sigmas out."""
    guess, free, found = jj.models.TiltingDisc(radius=0.55, gravity=10.8), ("radius", "gravity"), []
    for name, loss in (("least squares", None), ("Huber", jj.huber()), ("Student-t", jj.student_t())):
        clean, spoilt = (jj.fit(guess, disc_data(0, outlier=far), free, loss=loss) for far in (0.0, 60.0))
        moved = float(np.max(np.abs(clean.values - spoilt.values) / clean.standard_errors))
        found.append(figure(f"an outlier of 60 sigmas moves estimates by, standard errors, {name}", "tilting-disc", moved, None if loss is None else 0.3))
    return found


def bound() -> list[Figure]:
    """A damping that is zero, from ten sets of noise."""
    ts, steps, converged = np.linspace(0.0, 10.0, 101), [], []
    for seed in range(10):
        x = 0.3 * np.cos(np.sqrt(2.5) * ts) + 0.01 * np.random.default_rng(seed).normal(size=101)
        found = jj.fit(Oscillator(), jj.Experiment(ts, {"x": x}, 0.01, start={"x": 0.3}), ("damping", "stiffness"))
        steps.append(int(found.steps))
        converged.append(bool(found.converged) and np.isfinite(found["damping"].high))
    return [
        figure("steps to a damping of zero, the most of ten", "oscillator", max(steps), 14),
        figure("such fits converged, with a limit, of ten", "oscillator", sum(converged), 10, at_least=True),
    ]


def starts() -> list[Figure]:
    """Thirty first guesses of radius, gravity, lean and spin, each within a factor of 5 of the truth."""
    generator, data, best = np.random.default_rng(4), disc_data(0), []
    truth = jj.fit(jj.models.TiltingDisc(), data, ("radius", "gravity"))
    one = processor_times({"one": lambda: jj.fit(jj.models.TiltingDisc(radius=0.55, gravity=10.8), data, ("radius", "gravity"))}, 7)["one"]
    false, spent = 0, 0.0
    for factors in np.exp(generator.uniform(-np.log(5), np.log(5), (30, 4))):
        begin = {"lean": jnp.asarray(0.3 * min(factors[2], 1.4 / 0.3)), "spin_rate": jnp.asarray(-3.0 * factors[3])}
        run = jj.Experiment(data.ts, data.values, SIGMA, start=begin, unknown_start=("lean", "spin_rate"))
        clock = time.process_time()
        found = jj.fit(jj.models.TiltingDisc(radius=0.5 * factors[0], gravity=9.81 * factors[1]), run, ("radius", "gravity"))
        spent += (time.process_time() - clock) / 30
        same = bool(found.chi_square < truth.chi_square + 0.1)
        best.append(same)
        false += not same and not found.warning
    begin = {"lean": 0.5, "spin_rate": -5.0}
    run = jj.Experiment(data.ts, data.values, SIGMA, start=begin, unknown_start={"lean": jj.bounds(0.06, 1.4), "spin_rate": jj.bounds(-15.0, -0.6)})
    ranges, found = {"radius": jj.bounds(0.1, 2.5), "gravity": jj.bounds(2.0, 49.0)}, {}

    def batch():
        found["fit"] = jj.fit(jj.models.TiltingDisc(radius=0.9, gravity=20.0), run, ranges, guesses=30)

    together = processor_times({"batch": batch}, 3)["batch"]
    return [
        figure("first guesses within bounds of a factor of 5, in one batch, that lead to the minimum, of 30", "tilting-disc", int(found["fit"].agreeing)),
        figure("this batch ends above the minimum", "tilting-disc", float(found["fit"].chi_square > truth.chi_square + 0.1), 0),
        figure("time of this batch over that of 30 fits from nearby", "tilting-disc", together / 30 / one, 5),
        figure("first guesses within a factor of 5 from which the minimum is found, of 30", "tilting-disc", sum(best), 27, at_least=True),
        figure("of the others, without a warning", "tilting-disc", false, 0),
        figure("time from such a guess over that from one within a tenth", "tilting-disc", spent / one, 5),
    ]


def coverage(repeats: int) -> list[Figure]:
    """How often the 95 % interval holds the truth: disc with unknown starts; with sigmas that are not known; and with the delay of a sensor."""
    found = []
    truth = {"radius": 0.5, "gravity": 9.81, "run 0: lean": 0.3, "run 0: spin_rate": -3.0, "lean.delay": DISC_DELAY}
    for name, sigma, delay in (("sigmas known", SIGMA, 0.0), ("sigmas estimated", None, 0.0), ("delay of a sensor", SIGMA, DISC_DELAY)):
        data = disc_data(1, repeats=(repeats,), delay=delay)
        data = jj.Experiment(data.ts, data.values, sigma, start=data.start, unknown_start=("lean", "spin_rate"), sensors=data.sensors, t0=data.t0)
        fits = jj.fit_batch(jj.models.TiltingDisc(radius=0.51, gravity=10.0), data, ("radius", "gravity"))
        for label in fits.labels:
            share = 100 * float(np.mean((fits[label].low < truth[label]) & (truth[label] < fits[label].high)))
            found.append(share_of_intervals(f"intervals that hold the truth, %, {label}, {name}", "tilting-disc", share, repeats))
    return found


CORRELATION = 0.8  # of neighbouring samples, where noise has a memory
# of each model: the scene, first guesses of its free parameters, two starts (all of whose values are not known), sigma of each channel, and times
THREE = {
    "tilting-disc": (
        jj.models.TiltingDisc(),
        {"radius": 0.51, "gravity": 10.0},
        ({"lean": 0.3, "spin_rate": -3.0}, {"lean": 0.2, "spin_rate": -4.0}),
        {"lean": 0.005, "x": 0.005},
        np.linspace(0.0, 2.0, 101),
    ),
    "chaplygin-sleigh": (
        jj.models.ChaplyginSleigh(),
        {"inertia": 0.42, "offset": 0.26},
        ({"x_rate": -0.6, "heading_rate": 0.9}, {"x_rate": -0.8, "heading_rate": 0.4}),
        {"x": 0.01, "heading": 0.01},
        np.linspace(0.0, 8.0, 101),
    ),
    "double-pendulum": (
        jj.models.DoublePendulumAngles(),
        {"mass2": 0.75, "length2": 0.82},
        ({"theta1": 0.6, "theta2": 0.2}, {"theta1": -0.2, "theta2": 0.5}),
        {"theta1": 0.01, "theta2": 0.01},
        np.linspace(0.0, 4.0, 101),
    ),
}


def noisy(generator: np.random.Generator, shape: tuple[int, ...], rho: float) -> np.ndarray:
    """Noise of variance one whose neighbouring samples correlate by rho."""
    e = generator.normal(size=shape)
    for k in range(1, shape[-1]):
        e[..., k] = rho * e[..., k - 1] + np.sqrt(1 - rho**2) * e[..., k]
    return e


def three(repeats: int) -> list[Figure]:
    """How often the 95 % interval holds the truth: three models, two runs each with unknown starts, two channels with unknown sigmas; and noise of 0.8."""
    found = []
    for model, (scene, guesses, starts, sigma, ts) in THREE.items():
        for kind, rho in (("white noise", 0.0), ("AR(1) noise of 0.8", CORRELATION)):
            generator, runs = np.random.default_rng(7), []
            truth = {name: float(getattr(scene, name)) for name in guesses}
            for i, start in enumerate(starts):
                motion = jj.simulate(scene, start, ts=ts)
                values = {name: np.asarray(motion[name]) + s * noisy(generator, (repeats, len(ts)), rho) for name, s in sigma.items()}
                begin = {name: x + 0.01 for name, x in start.items()}
                runs.append(jj.Experiment(ts, values, None, start=begin, unknown_start=tuple(start), correlation_time=None if rho else 0.0))
                truth |= {f"run {i}: {name}": x for name, x in start.items()}
            clock = time.process_time()
            fits = jj.fit_batch(scene.replace(**guesses), runs, tuple(guesses))
            spent, inside = time.process_time() - clock, []
            for label in fits.labels:
                inside.append(100 * float(np.mean((fits[label].low < truth[label]) & (truth[label] < fits[label].high))))
            print(f"  {model}, {kind}: {spent:.0f} s of processor time; " + ", ".join(f"{n} {x:.1f}" for n, x in zip(fits.labels, inside, strict=True)))
            what = f"intervals that hold the truth, %, unknown starts and sigmas, {kind}"
            for which, share in (("fewest", min(inside)), ("most", max(inside))):
                found.append(share_of_intervals(f"{what}, {which}", model, share, repeats))
            found.append(figure(f"fits converged, %, {kind}", model, 100 * float(np.mean(fits.converged)), 99, at_least=True))
    return found


# Sampling. ---------------------------------------------------------------------------------------------------------------


def nuts(draws: int) -> list[Figure]:
    """NUTS of BlackJAX on the four unknowns of the disc, whitened by the fit: effective draws for a second, one chain and four side by side."""
    import blackjax

    data, guess, free = disc_data(0), jj.models.TiltingDisc(radius=0.55, gravity=10.8), ("radius", "gravity")
    fit = jj.fit(guess, data, free)
    density = jj.log_density(guess, data, free).whitened(fit)
    count = density.initial.size
    # on a normal density of variance one nearly all trees have 3 steps of 1.1: chains side by side hardly wait for each other
    sampler = blackjax.nuts(density, step_size=1.1, inverse_mass_matrix=jnp.ones(count))

    def chain(key, z):
        def step(state, key):
            state, told = sampler.step(key, state)
            return state, (state.position, told.is_divergent, told.num_integration_steps)

        return jax.lax.scan(step, sampler.init(z), jax.random.split(key, draws))[1]

    keys, starts = jax.random.split(jax.random.key(1), 4), jax.random.normal(jax.random.key(2), (4, count))
    one, four, found = jax.jit(chain), jax.jit(jax.vmap(chain)), {}

    def alone():
        found["one"] = jax.block_until_ready(one(keys[0], starts[0]))

    def side_by_side():
        found["four"] = jax.block_until_ready(four(keys, starts))

    times = processor_times({"one": alone, "four": side_by_side}, 5)
    positions, diverged, steps = (np.asarray(x) for x in found["four"])
    effective = float(np.min(blackjax.diagnostics.effective_sample_size(found["one"][0][None])))
    together = float(np.min(blackjax.diagnostics.effective_sample_size(positions)))
    spread = np.asarray(density.constrain(jnp.asarray(positions))).reshape(-1, count).std(axis=0)
    print(
        f"  {draws} draws: {times['one']:.2f} s, four chains {times['four']:.2f} s; effective {effective:.0f}, of four {together:.0f}; steps of a tree: "
        f"{np.mean(steps):.2f}, the most of four {np.mean(steps.max(axis=0)):.2f}"
    )
    model = "tilting-disc, 4 unknowns"
    return [
        figure("NUTS: effective draws/s, the fewest of all unknowns", model, effective / times["one"], 200, at_least=True),
        figure("NUTS: such, of four chains side by side", model, together / times["four"]),
        figure("NUTS: divergences of 4 chains", model, int(diverged.sum() + np.asarray(found["one"][1]).sum()), 0),
        figure("NUTS: 4 chains over one", model, times["four"] / times["one"], 1.5),
        figure("NUTS: marginal standard deviations off those of the fit, relative", model, float(np.max(np.abs(spread / fit.standard_errors - 1))), 0.05),
    ]


def disturbed(repeats: int) -> list[Figure]:
    """How often the 95 % interval of a sleigh's offset holds the truth, whose rates are disturbed: by an extended Kalman filter, and by least squares."""
    truth, start, ts, kicks = jj.models.ChaplyginSleigh(offset=0.25), {"x_rate": -0.6, "heading_rate": 0.9}, np.linspace(0.0, 4.0, 41), 5
    sigma, begin = {"x": 0.01, "y": 0.01, "heading": 0.01}, jj.start(truth, **start)
    noise = dict.fromkeys(("x_rate", "y_rate"), 2e-4)  # (m/s)^2 / s; the rate of the heading follows
    places, h = [truth.speed_names.entries.index(n) for n in noise], (ts[1] - ts[0]) / kicks

    def one(key):
        def kick(carry, key):
            t, q, u = carry
            motion = jj.simulate(truth, jj.consistent(truth, t, q, u, held=tuple(noise)), t0=t, ts=(t + h)[None], work=False, events=False)
            u = motion.u[-1].at[jnp.array(places)].add(jnp.sqrt(2e-4 * h) * jax.random.normal(key, (len(places),)))
            return (t + h, motion.q[-1], u), motion.q[-1]

        _, q = jax.lax.scan(kick, (jnp.zeros(()), begin.q, begin.u), jax.random.split(key, kicks * (len(ts) - 1)))
        return jnp.concatenate([begin.q[None], q[kicks - 1 :: kicks]])

    q = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(3), repeats)))
    draw = np.random.default_rng(11)
    values = {n: q[..., truth.coordinate_names.entries.index(n)] + s * draw.normal(size=q.shape[:2]) for n, s in sigma.items()}
    plain = jj.fit_batch(truth.replace(offset=0.26), jj.Experiment(ts, values, sigma, start=start), ("offset",))
    share = 100 * float(np.mean((plain["offset"].low < 0.25) & (plain["offset"].high > 0.25)))
    grid = np.linspace(0.19, 0.31, 13)

    def along(offset, values):
        run = jj.Experiment(ts, values, sigma, start=start)
        return jj.filtered_log_likelihood(truth.replace(offset=offset), run, process_noise=noise, rtol=1e-7, atol=1e-7)

    logs = np.asarray(jax.jit(lambda v: jax.lax.map(lambda one: jax.vmap(lambda x: along(x, one))(jnp.asarray(grid)), v))(values))
    middle = np.clip(np.argmax(logs, axis=1), 2, len(grid) - 3)  # a quartic through the five points about the largest
    inside, best = [], []
    for of, k in zip(logs, middle, strict=True):
        some = slice(k - 2, k + 3)
        fine = np.linspace(grid[k - 2], grid[k + 2], 401)
        curve = np.polyval(np.polyfit((grid[some] - grid[k]) / 0.01, of[some], 4), (fine - grid[k]) / 0.01)
        best.append(float(fine[np.argmax(curve)]))
        inside.append(2 * (np.max(curve) - of[np.argmin(np.abs(grid - 0.25))]) < 3.841)
    found = 100 * float(np.mean(inside))
    by_squares = np.asarray(plain["offset"].value)
    print(f"  estimates {np.mean(best):.4f} +- {np.std(best):.4f} m by the filter, {np.mean(by_squares):.4f} +- {np.std(by_squares):.4f} m by least squares")
    model, what = "chaplygin-sleigh, disturbed", "intervals that hold the truth, %, offset,"
    return [
        share_of_intervals(f"{what} extended Kalman filter", model, found, len(inside)),
        figure(f"{what} least squares", model, share),
        figure("standard deviation of the estimates by the filter over that by least squares", model, float(np.std(best) / np.std(by_squares))),
    ]


def design(repeats: int) -> list[Figure]:
    """The start of a disc from which its radius and gravity are told best, within bounds, by the slope of log det; checked by repeats that are simulated."""
    disc, ts, low, high = jj.models.TiltingDisc(), jnp.linspace(0.0, 2.0, 41), jnp.array([0.1, -6.0]), jnp.array([0.5, -2.0])
    free, unknown = ("radius", "gravity"), ("lean", "spin_rate")

    def planned(z):
        plan = jj.Experiment(ts, dict.fromkeys(SIGMA, ts), SIGMA, start={"lean": z[0], "spin_rate": z[1]}, unknown_start=unknown)
        return jj.planned_information(disc, plan, free)

    slope, first = jax.jit(jax.jacfwd(lambda z: planned(z).log_det(free))), jnp.array([0.3, -3.0])
    z = first
    for k in range(60):  # steps of a share of the width, projected onto the bounds
        g = slope(z) * (high - low)
        z = jnp.clip(z + 0.1 / (1 + k / 10) * (high - low) * g / jnp.linalg.norm(g), low, high)
    print(f"  from lean {first[0]:.3g} rad, spin {first[1]:.3g} rad/s to {z[0]:.3g}, {z[1]:.3g}")
    found, model = [], "tilting-disc"
    before, after = (planned(x).standard_errors for x in (first, z))
    start = {"lean": float(z[0]), "spin_rate": float(z[1])}
    motion, noise = jj.simulate(disc, start, ts=ts), np.random.default_rng(12)
    values = {name: np.asarray(motion[name]) + s * noise.normal(size=(repeats, len(ts))) for name, s in SIGMA.items()}
    fits = jj.fit_batch(disc, jj.Experiment(ts, values, SIGMA, start=start, unknown_start=unknown), free)
    for name in free:
        spread = float(np.std(np.asarray(fits[name].value)[np.asarray(fits.converged)], ddof=1))
        found.append(figure(f"planned standard error of {name} at the best start over that at the first", model, float(after[name] / before[name])))
        entry = figure(f"standard deviation of {name} over simulated repeats, over the planned one", model, spread / float(after[name]))
        width = max(0.1, 2 / np.sqrt(2 * repeats))  # a standard deviation over n repeats is known to 1/sqrt(2 n)
        found.append(entry | {"required": [1 - width, 1 + width], "met": bool(abs(entry["value"] - 1) <= width)})
    return found


# The steer-by-wire bicycle. ---------------------------------------------------------------------------------------------------


class SteerByWire(WhippleBicycle):
    """A Whipple bicycle whose steer motor gives `gain` times what is commanded, with damping of steer and lean."""

    steer_damping: jnp.ndarray = jj.parameter(0.3, unit="N m s/rad", non_negative=True)
    lean_damping: jnp.ndarray = jj.parameter(1.0, unit="N m s/rad", non_negative=True)
    gain: jnp.ndarray = jj.parameter(1.0)

    def loads(self, motion):
        lean = motion.inputs.lean_torque - self.lean_damping * motion.u.lean_rate
        steer = self.gain * motion.inputs.steer_torque - self.steer_damping * motion.u.steer_rate
        return jj.gravity(motion, self.g), jj.generalized_force(motion, lean_rate=lean, steer_rate=steer)


# nominal parameters of the authors' models; the front frame turns the motor with it, whose inertia is a first guess
NOMINAL = {
    "w": 1.036, "c": 0.0803, "lam": float(np.deg2rad(18.2)), "rR": 0.3498, "mR": 10.12, "IRxx": 0.1040, "IRyy": 0.1641, "xB": 0.462, "zB": -0.698, "mB": 20.9,
    "IBxx": 1.64, "IByy": 2.0, "IBzz": 1.94, "IBxz": 0.654, "xH": 0.944, "zH": -0.595, "mH": 0.6, "IHxx": 0.1, "IHyy": 0.1, "IHzz": 0.1, "IHxz": -0.00044,
    "rF": 0.3498, "mF": 1.780, "IFxx": 0.0644, "IFyy": 0.1289,
}  # fmt: skip
FREE = dict.fromkeys(("gain", "steer_damping", "lean_damping", "IBxz", "zB", "c")) | {
    "IBxx": jj.bounds(0.2, 8.0),
    "IBzz": jj.bounds(0.2, 8.0),
    "IHzz": jj.bounds(0.001, 1.0),
}


def windows() -> list[jj.Experiment]:
    """The 57 windows: lean rate and steer rate, the command as input, and an unknown start each."""
    with gzip.open(WINDOWS, "rt") as file:
        rows = list(csv.DictReader(file))
    runs, ts, scale = [], 0.01 * np.arange(100), {"lean": 0.1, "lean_rate": 0.3, "steer": 0.1, "steer_rate": 0.5}
    for k in range(0, len(rows), 100):
        column = {name: np.array([float(row[name]) for row in rows[k : k + 100]]) for name in rows[0] if name != "log"}
        first = {"lean": "lean_angle", "lean_rate": "lean_rate", "steer": "fork_angle", "steer_rate": "fork_rate"}
        start = {name: column[source][0] for name, source in first.items()} | {"rear_spin_rate": column["speed"].mean() / NOMINAL["rR"]}
        values = {"lean_rate": column["lean_rate"], "steer_rate": column["fork_rate"]}
        unknown = {name: jj.unbounded(s) for name, s in scale.items()}
        torque = jj.Sampled(ts, column["command_fork"])
        runs.append(jj.Experiment(ts, values, {"lean_rate": 0.03, "steer_rate": 0.1}, start=start, unknown_start=unknown, inputs={"steer_torque": torque}))
    return runs


def fit_windows(count: int, **options) -> tuple[jj.Fit, float]:
    """A fit of the first runs, and its wall time."""
    begin = time.perf_counter()
    found = jj.fit(SteerByWire(**NOMINAL), windows()[:count], FREE, rtol=1e-6, atol=1e-6, **options)
    return found, time.perf_counter() - begin


def report_windows() -> None:
    """For a process of its own: prints numbers as JSON in the last line."""
    begin = time.perf_counter()
    found, _ = fit_windows(57)
    cold = time.perf_counter() - begin + START_UP
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    again, warm = fit_windows(57)
    print("\n".join(line for line in str(found).split("\n") if "run " not in line and not line.strip()[:2].isdigit()))
    step = {count: time_of_a_step(count) for count in (8, 32)}
    told = {"cold": cold, "warm": warm, "memory": memory, "steps": int(found.steps), "converged": bool(again.converged), "ratio": step[32] / step[8]}
    print(json.dumps(told))


def time_of_a_step(count: int) -> float:
    """Processor time of a warm fit of the first runs for each step that it tries, s; fits of other runs try other numbers of steps."""
    runs = windows()[:count]
    for _ in range(2):  # the first one compiles
        begin = time.process_time()
        found = jj.fit(SteerByWire(**NOMINAL), runs, FREE, rtol=1e-6, atol=1e-6, max_iterations=20)
        seconds = time.process_time() - begin
    return seconds / int(found.steps)


START_UP = 3.0  # s, to import all; counted in


def of_windows() -> list[Figure]:
    """57 runs with 9 + 228 unknowns, in a fresh process."""
    done = subprocess.run([sys.executable, __file__, "--windows"], capture_output=True, text=True, check=False)
    print(done.stdout, done.stderr[-2000:])
    if done.returncode:
        return [figure("57 windows: fit fails", "steer-by-wire bicycle", 1.0, 0.0)]
    told = json.loads(done.stdout.strip().split("\n")[-1])
    model = "steer-by-wire bicycle"
    return [
        figure("57 windows, cold, s", model, told["cold"], 60),
        figure("57 windows, warm, s", model, told["warm"], 40),
        figure("57 windows, memory, GiB", model, told["memory"], 3),
        figure("57 windows, converged", model, float(told["converged"]), 1, at_least=True),
        figure("57 windows, steps", model, told["steps"]),
        figure("a step at 32 runs over one at 8", model, told["ratio"], 4.5),
    ]


def logs() -> list[Figure]:
    """Odd and even windows, each half by itself, as the notebook on them has it: how far apart, how well each predicts the other, whether bodies can be."""
    import contextlib
    import runpy

    import matplotlib as mpl

    mpl.use("agg")
    begin = time.process_time()
    with contextlib.chdir(NOTEBOOKS):
        told = runpy.run_path("06_steer_by_wire.py")
    halves, rms, out, model = told["halves"].values(), told["rms"], told["out"].values(), "steer-by-wire bicycle"
    return [
        figure("lean-rate rms on held-out windows, rad/s", model, max(rms(left["lean_rate"]) for left in out), 0.027),
        figure("steer-rate rms on held-out windows, rad/s", model, max(rms(left["steer_rate"]) for left in out)),
        figure("lean-rate rms by the authors' numbers, rad/s", model, rms(told["plain"]["lean_rate"])),
        figure("bodies that cannot be, of both halves", model, sum(len(half.impossible) for half in halves), 0),
        figure("halves differ by, standard errors (from how runs differ)", model, max(told["apart"].values()), 3),
        figure("correlation of neighbouring residuals of lean rate", model, max(told["neighbours"](left["lean_rate"]) for left in out)),
        figure("correlation of neighbouring residuals of steer rate", model, max(told["neighbours"](left["steer_rate"]) for left in out)),
        figure("halves converged, of two", model, sum(bool(half.converged) for half in halves), 2, at_least=True),
        figure("steps, the most of both", model, max(int(half.steps) for half in halves), 50),
        figure("frequency of weave from 3 m/s on, off that of damped exponentials, rad/s", model, float(told["from_3"][:, 0].max())),
        figure("the same by the authors' numbers, the least", model, float(told["from_3"][:, 1].min())),
        figure("processor time of the notebook, s", model, time.process_time() - begin),
    ]


# A bicycle below its weave speed. --------------------------------------------------------------------------------------


def unstable_run(seed: int) -> tuple[WhippleBicycle, jj.Experiment]:
    """Ten seconds of a bicycle at 3.6 m/s, whose weave grows from 0.1 to 20 degrees; a first guess, each number of which is off by up to half."""
    bicycle, ts, sigma = WhippleBicycle(), jnp.linspace(0.0, 10.0, 101), 0.002
    start = {"rear_spin_rate": 3.6 / bicycle.rR, "lean": 0.002, "lean_rate": 0.0, "steer": 0.004, "steer_rate": 0.0}
    motion, noise = jj.simulate(bicycle, start, ts=ts, rtol=1e-8, atol=1e-8), np.random.default_rng(0)
    values = {name: np.asarray(motion[name]) + sigma * noise.normal(size=len(ts)) for name in ("lean", "steer")}
    off = np.random.default_rng(100 + seed).uniform(-0.5, 0.5, 7)
    begin = {"rear_spin_rate": start["rear_spin_rate"], "lean": 0.002 * (1 + off[0]), "steer": 0.004 * (1 + off[1])}
    begin |= {"lean_rate": 0.006 * off[2], "steer_rate": 0.006 * off[3]}
    guess = bicycle.replace(**{name: getattr(bicycle, name) * (1 + by) for name, by in zip(("IBxx", "c", "mB"), off[4:], strict=True)})
    return guess, jj.Experiment(ts, values, sigma, start=begin, unknown_start=("lean", "lean_rate", "steer", "steer_rate"))


def timed(*arguments, **options) -> tuple[jj.Fit, float]:
    """A fit with its standard errors, and its processor time, s."""
    begin = time.process_time()
    found = jj.fit(*arguments, rtol=1e-8, atol=1e-8, **options)
    found.standard_errors  # noqa: B018  (worked out when asked for)
    return found, time.process_time() - begin


def unstable(count: int) -> list[Figure]:
    """A roll inertia, the trail, a mass and four start values of a bicycle whose motion grows a hundredfold, from first guesses off by up to half."""
    ways = {"growing": {}, "pieces": {"shooting": jj.MultipleShooting(duration=1.0)}}
    fits = {way: [timed(*unstable_run(seed), ("IBxx", "c", "mB"), **how) for seed in range(count)] for way, how in ways.items()}
    found = {way: [one for one, _ in some] for way, some in fits.items()}
    least = min(float(one.chi_square) for some in found.values() for one in some if np.isfinite(one.chi_square))
    right = {way: [bool(one.chi_square < least + 0.1) for one in some] for way, some in found.items()}
    model = "bicycle at 3.6 m/s, 10 s"
    return [
        figure("share of first guesses off by up to half that lead to the minimum", model, np.mean(right["growing"]), 0.95, at_least=True),
        figure(
            "share of them without growing spans (single shooting)",
            model,
            np.mean([x and not bool(y.grown) for x, y in zip(right["growing"], found["growing"], strict=True)]),
        ),
        figure(
            "share of them by multiple shooting, pieces of 1 s",
            model,
            np.mean([x and bool(y.converged) for x, y in zip(right["pieces"], found["pieces"], strict=True)]),
            0.95,
            at_least=True,
        ),
        figure(
            "of the others, without a warning",
            model,
            sum(not x and not y.warning for way in ways for x, y in zip(right[way], found[way], strict=True)),
            0,
        ),
        figure("time of a warm fit by multiple shooting over one by growing spans, medians", model, _warm(fits["pieces"]) / _warm(fits["growing"])),
    ]


def _warm(fits: list[tuple[jj.Fit, float]]) -> float:
    """The median time of all but the first."""
    return float(np.median([seconds for _, seconds in fits[1:]]))


# A chaotic double pendulum. --------------------------------------------------------------------------------------------


def chaotic_run(seed: int, span: float) -> tuple[jj.models.DoublePendulumAngles, dict, jj.Experiment]:
    """A double pendulum that turns over, 20 samples a second with 1 % noise; mass, lengths and start are first guesses, each off by up to half."""
    truth, ts, generator = jj.models.DoublePendulumAngles(), np.linspace(0.0, span, round(20 * span) + 1), np.random.default_rng(seed)
    start = {"theta1": 2.0, "theta2": 2.5, "theta1_rate": 0.0, "theta2_rate": 0.0}
    motion = jj.simulate(truth, start, ts=ts, rtol=1e-9, atol=1e-9)
    exact = {name: np.asarray(motion[name]) for name in ("theta1", "theta2")}
    sigma = {name: 0.01 * float(np.std(x)) for name, x in exact.items()}
    values = {name: x + sigma[name] * generator.normal(size=len(ts)) for name, x in exact.items()}
    true = {name: float(getattr(truth, name)) for name in ("mass2", "length1", "length2")}
    guess = truth.replace(**{name: x * (1 + generator.uniform(-0.5, 0.5)) for name, x in true.items()})
    begin = {name: x * (1 + generator.uniform(-0.5, 0.5)) if x else 3 * generator.uniform(-0.5, 0.5) for name, x in start.items()}
    return guess, true, jj.Experiment(ts, values, sigma, start=begin, unknown_start=tuple(begin))


def chaotic(count: int) -> list[Figure]:
    """Whole runs of a chaotic double pendulum, by growing spans and by multiple shooting."""
    figures = []
    for span in (5.0, 10.0, 20.0):
        whole, pieces, inside, apart = [], [], [], []
        for seed in range(count):
            guess, true, run = chaotic_run(seed, span)
            whole.append(timed(guess, run, tuple(true)))
            one, seconds = timed(guess, run, tuple(true), shooting=jj.MultipleShooting(duration=0.5))
            pieces.append((one, seconds))
            inside += [bool(one[name].low < x < one[name].high) for name, x in true.items()]
            apart.append(float(one.shooting.continuity))
        model = f"chaotic double pendulum, {span:g} s"
        figures += [
            figure(
                "share of first guesses off by up to half that lead to the minimum, by growing spans",
                model,
                np.mean([one.reduced_chi_square < 1.3 for one, _ in whole]),
            ),
            figure(
                "the same, by multiple shooting in pieces of 0.5 s",
                model,
                np.mean([bool(x.converged and x.reduced_chi_square < 1.3) for x, _ in pieces]),
                0.95,
                at_least=True,
            ),
            figure("95 % intervals of these that hold the truth", model, np.mean(inside)),
            figure("largest jump between their pieces, tolerances of the simulation", model, max(apart), 1),
            figure("time of a warm fit by multiple shooting over one by growing spans, medians", model, _warm(pieces) / _warm(whole)),
        ]
    return figures


def main() -> None:
    """Run, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--windows", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.windows:
        report_windows()
        return
    parts = {
        "disc": lambda: disc(3 if options.quick else 15),
        "outlier": outlier,
        "bound": bound,
        "starts": starts,
        "unstable": lambda: unstable(20 if options.quick else 100),
        "chaotic": lambda: chaotic(10 if options.quick else 100),
        "coverage": lambda: coverage(50 if options.quick else 500),
        "three": lambda: three(50 if options.quick else 1000),
        "nuts": lambda: nuts(500 if options.quick else 2000),
        "disturbed": lambda: disturbed(50 if options.quick else 200),
        "design": lambda: design(500),
        "windows": of_windows,
        "logs": logs,
    }
    chosen = options.only or [name for name in parts if not (options.quick and name in ("windows", "logs"))]
    figures = []
    for name in chosen:
        print(name, flush=True)
        figures += parts[name]()
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
