"""What a scene predicts for measurements, and how likely it makes them.

r = (reading - value) / sigma,   log L = - sum r^2 / 2 - sum log(sigma sqrt(2 pi));      where noise has a memory, as in `correlated_noise`

What is odd about measurements though nothing forbids it: inputs that are not sampled where a run needs them, and angles that jump by a turn.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.correlated_noise import log_density
from jourdain_jax.analysis.experiment import Experiment, checked
from jourdain_jax.analysis.runs import Run, equal_runs
from jourdain_jax.calculus.reals import described, is_traced
from jourdain_jax.motion.inputs import Inputs, Sampled
from jourdain_jax.motion.options import AllOptions, OptionFields, Options, as_options
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.tracebacks import users_level

_BEYOND = 1.5  # intervals between samples, that an end may be away from that of a run
_GAP, _REGULAR = 5.0, 0.9  # intervals that are missing; share of the others that are nearly equal: those of a log
_TURN = 2 * np.pi


def oddities(scene: Scene, runs: Sequence[Experiment], repeats: bool) -> tuple[str, ...]:
    """One sentence for each, of runs that were `checked`; traced numbers are not looked at. `repeats`: values have a leading axis, and the first one counts."""
    found: list[str] = []
    for index, run in enumerate(runs):
        for name, signal in zip(scene.inputs.entries, run.inputs.channels if isinstance(run.inputs, Inputs) else (), strict=False):
            if isinstance(signal, Sampled) and not is_traced((signal, run.ts, run.t0)) and np.ptp(np.asarray(signal.values)) > 0:
                found += _of_input(f"input `{name}` of run {index}", np.asarray(signal.ts), float(run.t0), float(run.ts[-1]))
        for name, values in run.values.items():
            quantity, shown = run.sensors[name].quantity if name in run.sensors else name, values[0] if repeats else values
            is_angle = quantity in scene.coordinate_names.entries if isinstance(quantity, str) else callable(quantity)
            if is_angle and shown.ndim == 1 and not is_traced((shown, run.ts)):
                found += _of_angle(f"channel `{name}` of run {index}", shown, run.ts)
    return tuple(found)


def _of_input(what: str, ts: Float[np.ndarray, "samples"], begin: float, end: float) -> Iterator[str]:
    """Where samples of an input that changes leave a run at an end, and where some are missing from a log in between.

    The last interval may be a jump, such as those of commands that are held; then the one before it counts.
    """
    intervals = np.diff(ts)
    spans = [f"its first value until {ts[0]:.6g} s"] if ts[0] - begin > _BEYOND * intervals[0] else []
    spans += [f"its last value from {ts[-1]:.6g} to {end:.6g} s"] if end - ts[-1] > _BEYOND * max(intervals[-2:]) else []
    if spans:
        yield (
            f"{what} is not sampled over all of the run and keeps {' and '.join(spans)}; if it did so, repeat that value in its samples, otherwise give more "
            "of them, or measurements of less"
        )
    usual = float(np.median(intervals))
    (gaps,) = np.nonzero((intervals > _GAP * usual) & (ts[:-1] < end) & (ts[1:] > begin))
    if gaps.size and np.mean(np.abs(intervals / usual - 1) < 0.1) > _REGULAR:
        k = int(gaps[0])
        more = f" (the first of {gaps.size} gaps)" if gaps.size > 1 else ""
        yield (
            f"{what} is sampled every {usual:.3g} s, but not from {ts[k]:.6g} to {ts[k + 1]:.6g} s{more}, where it is a straight line; if that is not what it "
            "did, give the samples, or measurements of less"
        )


def _of_angle(what: str, values: Float[np.ndarray, "times"], ts: Float[np.ndarray, "times"]) -> Iterator[str]:
    """Where values lie in [-pi, pi] or [0, 2 pi], and neighbours are nearly one turn apart, but near each other without it."""
    known = np.isfinite(values)
    x, t = values[known], ts[known]
    if x.size < 2 or not any(low <= x.min() and x.max() <= low + _TURN for low in (-np.pi, 0.0)):
        return
    steps = np.diff(x)
    (jumps,) = np.nonzero(np.abs(steps) > 0.75 * _TURN)
    if jumps.size and np.max(np.abs(steps - _TURN * np.round(steps / _TURN))) < 0.25 * _TURN:
        yield (
            f"{what} jumps by {steps[jumps[0]]:.3g} at {t[jumps[0] + 1]:.6g} s and stays within one turn: an angle that was wrapped, where coordinates go on; "
            "give `np.unwrap` of it"
        )


_STATED = "each `Experiment` states start, times and inputs, and its motion ends with its last sample"
_REFUSED = dict.fromkeys(("start", "t0", "t1", "ts", "inputs", "events", "work"), _STATED)
_REFUSED["retry"] = "its motions are compiled, in one way"


def as_fit_options(scene: Scene | BuiltFor, options: Options | None, by_name: Mapping, function: str) -> AllOptions:
    """Return the options of the motions of a fit, or of a likelihood."""
    found = as_options(options, by_name, function, _REFUSED, scene)
    return replace(found, work=False, retry=False)


def as_runs(scene: Scene, data: Experiment | Sequence[Experiment], *, repeats: bool = False) -> tuple[Experiment, ...]:
    """One run or several, checked against the scene; ValueError as in `checked`, and where there is no run.

    What is odd about a run (`oddities`) is warned of.
    """
    as_scene(scene)
    if not isinstance(data, Experiment | Iterable):
        raise ValueError(f"`data` is {described(data)}, expected an `Experiment` or a sequence of at least one")
    runs = (data,) if isinstance(data, Experiment) else tuple(data)
    wrong = [f"`data` holds {described(run)}" for run in runs if not isinstance(run, Experiment)] if runs else ["`data` is empty"]
    if wrong:
        raise ValueError(f"{wrong[0]}, expected an `Experiment` or a sequence of at least one")
    found = tuple(checked(scene, run, index, repeats) for index, run in enumerate(runs))
    for sentence in oddities(scene, found, repeats):
        warnings.warn(sentence, stacklevel=users_level())
    return found


def in_all_or_none(runs: Sequence[Experiment], what: str, unknown: Callable[[Experiment], tuple[str, ...]]) -> tuple[str, ...]:
    """Channels of which something is not known; ValueError where it is None in one run and given in another."""
    names = tuple(sorted({name for run in runs for name in unknown(run)}))
    for name in names:
        if any(name in run.values and name not in unknown(run) for run in runs):
            raise ValueError(f"{what} of channel `{name}` is None in one run and given in another; give it in all runs, or in none")
    return names


def check_known(runs: Sequence[Experiment], what: str) -> None:
    """ValueError where a sigma, or a number of a sensor or an actuator, is not known."""
    for run in runs:
        for name in run.unknown_sigma:
            raise ValueError(f"sigma of channel `{name}` is None, but {what} needs the standard deviation of its noise; give a number")
        for label in run.estimates:
            raise ValueError(f"`{label}` is to be estimated, but {what} needs its value; give a number, which may be traced, in place of the `Estimate`")


def log_likelihood(
    scene: Scene | BuiltFor, data: Experiment | Sequence[Experiment], *, options: Options | None = None, **by_name: Unpack[OptionFields]
) -> Float[Array, ""]:
    """Logarithm of the probability density of the measurements `data` (one run or several): `- sum r^2 / 2 - sum log(sigma sqrt(2 pi))`.

    Differentiable in scene, start values, measured values, sigmas and numbers of sensors and actuators (reverse mode, unless `adjoint` says
    otherwise) and in known correlation times of the noise;
    -inf where the motion fails. `options`, `by_name`: as of `simulate`. Missing samples (NaN, or an infinite sigma) do not count.

        jax.grad(lambda a: jj.log_likelihood(sleigh.replace(offset=a), data))(0.25)

    **Raises** ValueError for measurements that do not fit the scene.
    """
    settled = as_fit_options(scene, options, by_name, "log_likelihood")
    scene = as_scene(scene)
    runs = as_runs(scene, data)
    if unknown := sorted({name for run in runs for name in run.unknown_correlation}):
        raise ValueError(f"the correlation time of channel `{unknown[0]}` is None, but a likelihood needs to know it; give a number in s, or 0 for white noise")
    check_known(runs, "a likelihood")
    return jnp.sum(jnp.stack([jnp.sum(mapped(partial(of_run, scene, options=settled), run)) for _, run in equal_runs(runs)]))


def of_run(scene: Scene, run: Run, *, options: AllOptions) -> Float[Array, ""]:
    """The logarithm of the density of the measurements of one run; -inf where its motion fails."""
    found = jnp.zeros(())
    for name, r in run.residuals(scene, simulate, options).items():
        weight = run.weights[name]
        counted = weight > 0
        # log sigma = - log weight
        logs = jnp.log(jnp.where(counted, weight, 1.0) / jnp.sqrt(2 * jnp.pi))
        tau = run.correlation_time.get(name)
        of_r = jnp.sum(-0.5 * r**2) if tau is None else log_density(r, weight, run.ts, tau)
        found = found + jnp.sum(jnp.where(counted, logs, 0.0)) + of_r
    return jnp.where(jnp.isfinite(found), found, -jnp.inf)


def mapped(f: Callable, runs: Run, *more: Array) -> Array:
    """`f(run, *more)` of each of the stacked runs; a single one is not put into a batch, whose steps would run in wider registers, each a little later."""
    if runs.ts.shape[0] > 1:
        return eqx.filter_vmap(f)(runs, *more)
    return f(*jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, (runs, *more)))[None]
