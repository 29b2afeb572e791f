"""Identification from first guesses that are off by up to half, of motions that grow: parts `unstable` and
`chaotic` of `identification.py`.
"""

import jax.numpy as jnp
import numpy as np
from figures import figure, seconds_of

import jourdain_jax as jj
from jourdain_jax.identification import MultipleShooting
from jourdain_jax.models import DoublePendulumAngles, WhippleBicycle

OF_BICYCLE = ("IBxx", "c", "mB")  # parameters that are estimated


def seen(motion, sigma, generator, repeats=(), rho=0.0):
    """What is seen of a motion, by name: with noise of these standard deviations, whose neighbouring samples
    correlate by rho.
    """
    found = {}
    for name, s in sigma.items():
        exact = np.asarray(motion[name])
        e = generator.normal(size=(*repeats, len(exact)))
        if rho:
            for k in range(1, len(exact)):
                e[..., k] = rho * e[..., k - 1] + np.sqrt(1 - rho**2) * e[..., k]
        found[name] = exact + s * e
    return found


def unstable_run(seed):
    """Ten seconds of a bicycle at 3.6 m/s, whose weave grows from 0.1 to 20 degrees; a first guess, each
    number of which is off by up to half.
    """
    bicycle, ts, sigma = WhippleBicycle(), jnp.linspace(0.0, 10.0, 101), 0.002
    start = {"rear_spin_rate": 3.6 / bicycle.rR, "lean": 0.002, "steer": 0.004}
    start |= {"lean_rate": 0.0, "steer_rate": 0.0}
    motion = jj.simulate(bicycle, start, ts=ts, rtol=1e-8, atol=1e-8)
    values = seen(motion, {"lean": sigma, "steer": sigma}, np.random.default_rng(0))
    draw = np.random.default_rng(100 + seed)
    possible = False
    while not possible:  # a rear frame that a body can have
        off = draw.uniform(-0.5, 0.5, 7)
        of = dict(zip(OF_BICYCLE, off[4:], strict=True))
        guess = bicycle.replace(**{name: getattr(bicycle, name) * (1 + by) for name, by in of.items()})
        tensor = [[guess.IBxx, guess.IBxz], [guess.IBxz, guess.IBzz]]
        moments = np.sort([*np.linalg.eigvalsh(tensor), guess.IByy])
        possible = moments[2] <= moments[0] + moments[1]
    begin = {"lean": 0.002 * (1 + off[0]), "steer": 0.004 * (1 + off[1])}
    begin |= {"lean_rate": 0.006 * off[2], "steer_rate": 0.006 * off[3]}
    run = jj.Experiment(ts, values, sigma, start=start | begin, unknown_start=tuple(begin))
    return guess, run


def chaotic_run(seed, span):
    """A double pendulum that turns over, 20 samples a second with 1 % noise; mass, lengths and start are
    first guesses, each off by up to half.
    """
    truth, ts = DoublePendulumAngles(), np.linspace(0.0, span, round(20 * span) + 1)
    generator = np.random.default_rng(seed)
    start = {"theta1": 2.0, "theta2": 2.5, "theta1_rate": 0.0, "theta2_rate": 0.0}
    motion = jj.simulate(truth, start, ts=ts, rtol=1e-9, atol=1e-9)
    sigma = {name: 0.01 * float(np.std(motion[name])) for name in ("theta1", "theta2")}
    values = seen(motion, sigma, generator)
    guess = truth.replace(**{name: x * (1 + generator.uniform(-0.5, 0.5)) for name, x in TRUE.items()})
    begin = {
        name: x * (1 + generator.uniform(-0.5, 0.5)) if x else 3 * generator.uniform(-0.5, 0.5)
        for name, x in start.items()
    }
    return guess, jj.Experiment(ts, values, sigma, start=begin, unknown_start=tuple(begin))


TRUE = {name: float(getattr(DoublePendulumAngles(), name)) for name in ("mass2", "length1", "length2")}


def fits_of(runs, free, **how):
    """Fits with their standard errors, and the median of their processor times without the first, s."""

    def fitted(guess, run):
        found = jj.fit(guess, run, free, rtol=1e-8, atol=1e-8, **how)
        found.standard_errors  # noqa: B018  (worked out when asked for)
        return found

    fits, seconds = zip(*(seconds_of(lambda run=run: fitted(*run)) for run in runs), strict=True)
    return list(fits), float(np.median(seconds[1:]))


def both(runs, free, duration, right):
    """Fits over growing spans and by multiple shooting, each with whether it is `right`, and the second's
    time over the first's.
    """
    whole, seconds = fits_of(runs, free)
    pieces, by_pieces = fits_of(runs, free, shooting=MultipleShooting(duration=duration))
    judge = right([*whole, *pieces])
    return [(x, judge(x)) for x in whole], [(x, judge(x)) for x in pieces], by_pieces / seconds


def _by_itself(fits):
    return lambda fit: bool(fit.reduced_chi_square < 1.3)


TIME = "time of a warm fit by multiple shooting over one by growing spans, medians"


def unstable(quick):
    """A roll inertia, the trail, a mass and four start values of a bicycle whose motion grows a hundredfold,
    from first guesses off by up to half.
    """

    def near_the_least(fits):
        least = np.nanmin([x.chi_square for x in fits])
        return lambda fit: bool(fit.chi_square < least + 0.1)

    runs, model = [unstable_run(seed) for seed in range(20 if quick else 100)], "bicycle at 3.6 m/s, 10 s"
    whole, pieces, ratio = both(runs, OF_BICYCLE, 1.0, near_the_least)
    what = "share of first guesses off by up to half that lead to the minimum"
    yield figure(what, model, np.mean([right for _, right in whole]), least=0.95)
    alone = np.mean([right and not bool(x.grown) for x, right in whole])
    yield figure("share of them without growing spans (single shooting)", model, alone)
    by_pieces = np.mean([right and bool(x.converged) for x, right in pieces])
    yield figure("share of them by multiple shooting, pieces of 1 s", model, by_pieces, least=0.95)
    silent = sum(not right and not x.warning for x, right in [*whole, *pieces])
    yield figure("of the others, without a warning", model, silent, 0)
    yield figure(TIME, model, ratio)


def chaotic(quick):
    """Whole runs of a chaotic double pendulum, by growing spans and by multiple shooting."""
    for span in (5.0, 10.0, 20.0):
        model = f"chaotic double pendulum, {span:g} s"
        runs = [chaotic_run(seed, span) for seed in range(10 if quick else 100)]
        whole, pieces, ratio = both(runs, tuple(TRUE), 0.5, _by_itself)
        what = "share of first guesses off by up to half that lead to the minimum, by growing spans"
        yield figure(what, model, np.mean([right for _, right in whole]))
        what = "the same, by multiple shooting in pieces of 0.5 s"
        yield figure(what, model, np.mean([bool(x.converged) and right for x, right in pieces]), least=0.95)
        inside = [bool(fit[name].low < x < fit[name].high) for fit, _ in pieces for name, x in TRUE.items()]
        yield figure("95 % intervals of these that hold the truth", model, np.mean(inside))
        apart = max(float(fit.shooting.continuity) for fit, _ in pieces)
        yield figure("largest jump between their pieces, tolerances of the simulation", model, apart, 1)
        yield figure(TIME, model, ratio)
