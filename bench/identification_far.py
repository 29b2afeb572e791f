"""Identification from first guesses that are off by up to half, of motions that grow: parts `unstable` and
`chaotic` of `identification.py`.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from figures import Figures, figure, seconds_of

import jourdain_jax as jj
from jourdain_jax.identification import Fit, MultipleShooting
from jourdain_jax.models import DoublePendulumAngles, WhippleBicycle


def unstable_run(seed: int) -> tuple[WhippleBicycle, jj.Experiment]:
    """Ten seconds of a bicycle at 3.6 m/s, whose weave grows from 0.1 to 20 degrees; a first guess, each
    number of which is off by up to half.
    """
    bicycle, ts, sigma = WhippleBicycle(), jnp.linspace(0.0, 10.0, 101), 0.002
    start = {
        "rear_spin_rate": 3.6 / bicycle.rR,
        "lean": 0.002,
        "lean_rate": 0.0,
        "steer": 0.004,
        "steer_rate": 0.0,
    }
    motion, noise = jj.simulate(bicycle, start, ts=ts, rtol=1e-8, atol=1e-8), np.random.default_rng(0)
    values = {
        name: np.asarray(motion[name]) + sigma * noise.normal(size=len(ts)) for name in ("lean", "steer")
    }
    off = np.random.default_rng(100 + seed).uniform(-0.5, 0.5, 7)
    begin = {
        "rear_spin_rate": start["rear_spin_rate"],
        "lean": 0.002 * (1 + off[0]),
        "steer": 0.004 * (1 + off[1]),
    }
    begin |= {"lean_rate": 0.006 * off[2], "steer_rate": 0.006 * off[3]}
    guess = bicycle.replace(
        **{
            name: getattr(bicycle, name) * (1 + by)
            for name, by in zip(("IBxx", "c", "mB"), off[4:], strict=True)
        }
    )
    return guess, jj.Experiment(
        ts, values, sigma, start=begin, unknown_start=("lean", "lean_rate", "steer", "steer_rate")
    )


def chaotic_run(seed: int, span: float) -> tuple[DoublePendulumAngles, dict, jj.Experiment]:
    """A double pendulum that turns over, 20 samples a second with 1 % noise; mass, lengths and start are
    first guesses, each off by up to half.
    """
    truth, ts, generator = (
        DoublePendulumAngles(),
        np.linspace(0.0, span, round(20 * span) + 1),
        np.random.default_rng(seed),
    )
    start = {"theta1": 2.0, "theta2": 2.5, "theta1_rate": 0.0, "theta2_rate": 0.0}
    motion = jj.simulate(truth, start, ts=ts, rtol=1e-9, atol=1e-9)
    exact = {name: np.asarray(motion[name]) for name in ("theta1", "theta2")}
    sigma = {name: 0.01 * float(np.std(x)) for name, x in exact.items()}
    values = {name: x + sigma[name] * generator.normal(size=len(ts)) for name, x in exact.items()}
    true = {name: float(getattr(truth, name)) for name in ("mass2", "length1", "length2")}
    guess = truth.replace(**{name: x * (1 + generator.uniform(-0.5, 0.5)) for name, x in true.items()})
    begin = {
        name: x * (1 + generator.uniform(-0.5, 0.5)) if x else 3 * generator.uniform(-0.5, 0.5)
        for name, x in start.items()
    }
    return guess, true, jj.Experiment(ts, values, sigma, start=begin, unknown_start=tuple(begin))


def fits_of(runs: list, free: tuple[str, ...], **how) -> tuple[list[Fit], float]:
    """Fits with their standard errors, and the median of their processor times without the first, s."""

    def fitted(guess, run):
        found = jj.fit(guess, run, free, rtol=1e-8, atol=1e-8, **how)
        found.standard_errors  # noqa: B018  (worked out when asked for)
        return found

    fits, seconds = zip(*(seconds_of(lambda run=run: fitted(*run)) for run in runs), strict=True)
    return list(fits), float(np.median(seconds[1:]))


def both(runs: list, free: tuple[str, ...], duration: float, right: Callable) -> tuple[list, list, float]:
    """Fits over growing spans and by multiple shooting, each with whether it is `right`, and the second's
    time over the first's.
    """
    whole, seconds = fits_of(runs, free)
    pieces, by_pieces = fits_of(runs, free, shooting=MultipleShooting(duration=duration))
    judge = right([*whole, *pieces])
    return [(x, judge(x)) for x in whole], [(x, judge(x)) for x in pieces], by_pieces / seconds


def _by_itself(fits: list) -> Callable:
    return lambda fit: bool(fit.reduced_chi_square < 1.3)


TIME = "time of a warm fit by multiple shooting over one by growing spans, medians"


def unstable(quick: bool) -> Figures:
    """A roll inertia, the trail, a mass and four start values of a bicycle whose motion grows a hundredfold,
    from first guesses off by up to half.
    """

    def near_the_least(fits):
        least = np.nanmin([x.chi_square for x in fits])
        return lambda fit: bool(fit.chi_square < least + 0.1)

    runs, model = [unstable_run(seed) for seed in range(20 if quick else 100)], "bicycle at 3.6 m/s, 10 s"
    whole, pieces, ratio = both(runs, ("IBxx", "c", "mB"), 1.0, near_the_least)
    yield figure(
        "share of first guesses off by up to half that lead to the minimum",
        model,
        np.mean([right for _, right in whole]),
        least=0.95,
    )
    alone = np.mean([right and not bool(x.grown) for x, right in whole])
    yield figure("share of them without growing spans (single shooting)", model, alone)
    by_pieces = np.mean([right and bool(x.converged) for x, right in pieces])
    yield figure("share of them by multiple shooting, pieces of 1 s", model, by_pieces, least=0.95)
    yield figure(
        "of the others, without a warning",
        model,
        sum(not right and not x.warning for x, right in [*whole, *pieces]),
        0,
    )
    yield figure(TIME, model, ratio)


def chaotic(quick: bool) -> Figures:
    """Whole runs of a chaotic double pendulum, by growing spans and by multiple shooting."""
    for span in (5.0, 10.0, 20.0):
        drawn, model = (
            [chaotic_run(seed, span) for seed in range(10 if quick else 100)],
            f"chaotic double pendulum, {span:g} s",
        )
        true = drawn[0][1]
        runs = [(guess, run) for guess, _, run in drawn]
        whole, pieces, ratio = both(runs, tuple(true), 0.5, _by_itself)
        what = "share of first guesses off by up to half that lead to the minimum, by growing spans"
        yield figure(what, model, np.mean([right for _, right in whole]))
        what = "the same, by multiple shooting in pieces of 0.5 s"
        yield figure(what, model, np.mean([bool(x.converged) and right for x, right in pieces]), least=0.95)
        inside = [bool(fit[name].low < x < fit[name].high) for fit, _ in pieces for name, x in true.items()]
        yield figure("95 % intervals of these that hold the truth", model, np.mean(inside))
        apart = max(float(fit.shooting.continuity) for fit, _ in pieces)
        yield figure("largest jump between their pieces, tolerances of the simulation", model, apart, 1)
        yield figure(TIME, model, ratio)
