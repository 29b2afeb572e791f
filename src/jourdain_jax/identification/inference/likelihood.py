"""Predictions of a scene for measurements, and their likelihood.

    r = (reading - value) / sigma,   log L = - sum r^2 / 2 - sum log(sigma sqrt(2 pi))      (white noise)

Oddities of measurements that are no errors: inputs without samples over the whole run, and angles that jump
by a turn.

The Fisher information of a planned experiment, differentiable with respect to its start and inputs:

    F = sum_k (d y_k / d theta)' (d y_k / d theta) / sigma_k^2 + prior,     cov(theta) >= F^-1 (Cramer and Rao)

theta includes unknown start values; log det F of some unknowns is computed from their block of F^-1, with all
others estimated as well. Source: A. C. Atkinson, A. N. Donev and R. D. Tobias, Optimum Experimental Designs,
with SAS (2007), chapters 9 and 10 (D- and D_s-optimality).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import (
    Entries,
    Indices,
    Scalar,
    array_module,
    check_kind,
    compiled,
    described,
    holds,
    is_traced,
    largest,
    static,
)
from jourdain_jax.identification.data.estimate import Estimate, Range
from jourdain_jax.identification.data.experiment import Data, Experiment, checked
from jourdain_jax.identification.inference.correlated_noise import log_density
from jourdain_jax.identification.inference.information import hidden_combinations
from jourdain_jax.identification.solve.layout import Layout, Place, PossibleInertia
from jourdain_jax.identification.solve.runs import Run, equal_runs, run_of
from jourdain_jax.identification.solve.unknowns import Unknowns, unknowns_of
from jourdain_jax.integrate.inputs import Inputs, Sampled
from jourdain_jax.motion.options import AllOptions, OptionFields, Options, as_options
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines, warn
from jourdain_jax.scene.identity import with_reference_parameters
from jourdain_jax.scene.names import Labels, Sentences, UnknownNameError, as_names, check_names
from jourdain_jax.scene.printing import Printed, table
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import Reference


def oddities(scene: Scene, runs: Sequence[Experiment], repeats: bool) -> Sentences:
    """Return one sentence for each oddity of `checked` runs. Traced numbers are not examined. `repeats`:
    values have a leading axis, of which only the first entry is examined.
    """
    found: list[str] = []
    for index, run in enumerate(runs):
        for name, signal in zip(
            scene.inputs, run.inputs.channels if isinstance(run.inputs, Inputs) else (), strict=False
        ):
            if isinstance(signal, Sampled) and not holds(
                lambda x, *_: np.ptp(x) == 0, signal.values, signal.ts, run.ts, run.t0
            ):
                found += _of_input(
                    f"input `{name}` of run {index}", np.asarray(signal.ts), float(run.t0), float(run.ts[-1])
                )
        for name, values in run.values.items():
            quantity, shown = (
                run.sensors[name].quantity if name in run.sensors else name,
                values[0] if repeats else values,
            )
            is_angle = (
                quantity in scene.coordinate_names.entries
                if isinstance(quantity, str)
                else callable(quantity)
            )
            if is_angle and shown.ndim == 1 and not is_traced((shown, run.ts)):
                found += _of_angle(f"channel `{name}` of run {index}", shown, run.ts)
    return tuple(found)


def _of_input(what: str, ts: Float[np.ndarray, "samples"], begin: float, end: float) -> Iterator[str]:
    """Yield sentences on inputs whose samples do not cover a run, and on gaps in a log.

    The last interval may be a jump, as for held commands; then the previous interval counts.
    """
    intervals, beyond = np.diff(ts), 1.5  # allowed distance of the ends from the run's, in intervals
    spans = [f"its first value until {ts[0]:.6g} s"] if ts[0] - begin > beyond * intervals[0] else []
    spans += (
        [f"its last value from {ts[-1]:.6g} to {end:.6g} s"]
        if end - ts[-1] > beyond * max(intervals[-2:])
        else []
    )
    if spans:
        yield (
            f"{what} is not sampled over all of the run and keeps {' and '.join(spans)}; if this is right, "
            "repeat that value in its samples, otherwise give more samples, or shorter measurements"
        )
    usual = float(np.median(intervals))
    (gaps,) = np.nonzero((intervals > 5.0 * usual) & (ts[:-1] < end) & (ts[1:] > begin))  # missing intervals
    # share of nearly equal intervals, as in a log
    if gaps.size and np.mean(np.abs(intervals / usual - 1) < 0.1) > 0.9:
        k = int(gaps[0])
        more = f" (the first of {gaps.size} gaps)" if gaps.size > 1 else ""
        yield (
            f"{what} is sampled every {usual:.3g} s, but not from {ts[k]:.6g} to {ts[k + 1]:.6g} s{more}, "
            "where it is interpolated linearly; if this is wrong, give the samples, or shorter measurements"
        )


def _of_angle(what: str, values: Float[np.ndarray, "times"], ts: Float[np.ndarray, "times"]) -> Iterator[str]:
    """Yield a sentence on angles that appear wrapped: values in [-pi, pi] or [0, 2 pi] with jumps of nearly
    one turn between neighbours.
    """
    known, turn = np.isfinite(values), 2 * np.pi
    x, t = values[known], ts[known]
    if x.size < 2 or not any(low <= x.min() and x.max() <= low + turn for low in (-np.pi, 0.0)):
        return
    steps = np.diff(x)
    (jumps,) = np.nonzero(np.abs(steps) > 0.75 * turn)
    if jumps.size and largest(steps - turn * np.round(steps / turn)) < 0.25 * turn:
        yield (
            f"{what} jumps by {steps[jumps[0]]:.3g} at {t[jumps[0] + 1]:.6g} s and stays within one turn, as "
            "a wrapped angle; coordinates are continuous: apply `np.unwrap`"
        )


_REFUSED = dict.fromkeys(
    ("start", "t0", "t1", "ts", "inputs", "events", "work"),
    "each `Experiment` states start, times and inputs, and its motion ends with its last sample",
)
_REFUSED["retry"] = "its motions are compiled, in one way"


def as_fit_options(
    scene: Scene | BuiltFor, options: Options | None, by_name: Mapping, function: str
) -> AllOptions:
    """Return the options of the motions of a fit, or of a likelihood."""
    found = as_options(options, by_name, function, _REFUSED, scene)
    return replace(found, work=False, retry=False)


def as_runs(scene: Scene, data: Data, *, repeats: bool = False) -> tuple[Experiment, ...]:
    """Return one run or several as a tuple, checked against the scene. Raises ValueError as in `checked`, and
    if there is no run.

    Oddities of a run (`oddities`) cause warnings.
    """
    as_scene(scene)
    check_kind(data, Experiment | Iterable, "`data`", "an `Experiment` or a sequence of at least one")
    runs = (data,) if isinstance(data, Experiment) else tuple(data)
    wrong = (
        [f"`data` holds {described(run)}" for run in runs if not isinstance(run, Experiment)]
        if runs
        else ["`data` is empty"]
    )
    if wrong:
        raise ValueError(f"{wrong[0]}, expected an `Experiment` or a sequence of at least one")
    found = tuple(checked(scene, run, index, repeats) for index, run in enumerate(runs))
    for sentence in oddities(scene, found, repeats):
        warn(sentence)
    return found


def in_all_or_none(runs: Sequence[Experiment], what: str, unknown: Callable[[Experiment], Labels]) -> Labels:
    """Return the channels whose value is None, and is therefore estimated. Raises ValueError for a channel
    whose value is None in one run and given in another.
    """
    names = tuple(sorted({name for run in runs for name in unknown(run)}))
    for name in names:
        if any(name in run.values and name not in unknown(run) for run in runs):
            raise ValueError(
                f"{what} of channel `{name}` is None in one run and given in another; give it "
                "in all runs, or in none"
            )
    return names


def check_known(runs: Sequence[Experiment], what: str) -> None:
    """Raise ValueError if a sigma, or a number of a sensor or an actuator, is unknown."""
    for run in runs:
        for name in run.unknown_sigma:
            raise ValueError(
                f"sigma of channel `{name}` is None, but {what} needs the standard deviation of "
                "its noise; give a number"
            )
        for label in run.estimates:
            raise ValueError(
                f"`{label}` is to be estimated, but {what} needs its value; give a number, "
                "which may be traced, in place of the `Estimate`"
            )


def log_likelihood(
    scene: Scene | BuiltFor, data: Data, *, options: Options | None = None, **by_name: Unpack[OptionFields]
) -> Scalar:
    """Return the logarithm of the probability density of the measurements `data` (one run or several): `- sum
    r^2 / 2 - sum log(sigma sqrt(2 pi))`.

    Differentiable in scene, start values, measured values, sigmas, numbers of sensors and actuators (reverse
    mode, unless `adjoint` requests another) and known correlation times of the noise. It is -inf if the
    motion fails. `options`, `by_name`: as in `simulate`. Missing samples (NaN, or an infinite sigma) do not
    count.

        jax.grad(lambda a: jj.identification.log_likelihood(sleigh.replace(offset=a), data))(0.25)

    **Raises** ValueError for measurements that do not fit the scene.
    """
    settled = as_fit_options(scene, options, by_name, "log_likelihood")
    scene = as_scene(scene)
    runs = as_runs(scene, data)
    if unknown := sorted({name for run in runs for name in run.unknown_correlation}):
        raise ValueError(
            f"the correlation time of channel `{unknown[0]}` is None, but a likelihood needs it; give a "
            "number in s, or 0 for white noise"
        )
    check_known(runs, "a likelihood")
    return jnp.sum(
        jnp.stack(
            [jnp.sum(mapped(partial(of_run, scene, options=settled), run)) for _, run in equal_runs(runs)]
        )
    )


def of_run(scene: Scene, run: Run, *, options: AllOptions) -> Scalar:
    """Return the logarithm of the density of the measurements of one run; -inf if its motion fails."""
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
    """Return `f(run, *more)` for each of the stacked runs. A single run is not batched, since batches use
    wider, slower registers.
    """
    if runs.ts.shape[0] > 1:
        return eqx.filter_vmap(f)(runs, *more)
    return f(*jax.tree.map(lambda x: x[0] if eqx.is_array(x) else x, (runs, *more)))[None]


Matrix = Float[Array, "unknowns unknowns"]
_CUTOFF = 1e-6  # of the largest singular value of the scaled sensitivities: smaller ones count as zero


class PlannedInformation(Printed, eqx.Module):
    """The information of planned runs about each unknown. `print` shows the expected standard errors."""

    matrix: Matrix  # F, in the units of the unknowns
    values: Float[Entries, "unknowns"]  # at which it is evaluated
    # of each run and channel: (d y / d theta) / sigma, zero for missing samples
    sensitivities: tuple[dict[str, Float[Array, "*samples unknowns"]], ...]
    labels: Labels = static()
    units: Labels = static()

    @property
    def covariance(self) -> Matrix:
        """Return F^-1, with unbounded entries for undetermined combinations of unknowns."""
        return _inverse(self.matrix)

    @property
    def standard_errors(self) -> dict[str, Scalar]:
        """Return lower bounds of standard errors of unbiased estimates, by name, in the unit of the unknown."""
        return dict(zip(self.labels, jnp.sqrt(jnp.diagonal(self.covariance)), strict=True))

    def log_det(self, names: str | Iterable[str] = ()) -> Scalar:
        """Return `log det F`, which a plan should maximise. With `names`, return it for these unknowns only,
        with all others estimated as well.

        Raises KeyError for names that are not unknown.
        """
        asked = as_names(names) or self.labels
        check_names(asked, self.labels, "`{}` is not among the unknowns", UnknownNameError)
        return -_log_det(self.matrix, tuple(self.labels.index(name) for name in asked))

    @property
    def not_identifiable(self) -> Labels:
        """Return combinations of unknowns that the planned runs do not determine, one sentence each."""
        directions, size = self._hidden
        return hidden_combinations(directions, np.sqrt(_CUTOFF), size, np.asarray(self.values), self.labels)

    @property
    def _hidden(self) -> tuple[np.ndarray, np.ndarray]:
        """Return undetermined directions, as rows, and the sizes that scale the unknowns."""
        values = np.abs(np.asarray(self.values))
        size = np.where(values > 0, values, 1.0)
        squares, directions = np.linalg.eigh(np.asarray(self.matrix) * size * size[:, None])
        return directions.T[squares <= _CUTOFF**2 * squares[-1]], size

    def _text(self) -> str:
        shows = np.linalg.norm(self._hidden[0], axis=0) < np.sqrt(_CUTOFF)
        errors = [
            f"{float(e):.3g}" if one else "-"
            for e, one in zip(self.standard_errors.values(), shows, strict=True)
        ]
        rows = [("unknown", "unit", "std. error"), *zip(self.labels, self.units, errors, strict=True)]
        lines = [f"Planned: {len(self.sensitivities)} runs, {len(self.labels)} unknowns", *table(rows)]
        return "\n".join(lines + [f"  {sentence}" for sentence in self.not_identifiable])


@compiled
def _inverse(F: Matrix) -> Matrix:
    scale = 1 / jnp.sqrt(jnp.where(jnp.diagonal(F) > 0, jnp.diagonal(F), 1.0))
    return scale[:, None] * jnp.linalg.inv(scale[:, None] * F * scale) * scale


@compiled
def _log_det(F: Matrix, places: Indices) -> Scalar:
    """Return the log-determinant of this block of the inverse."""
    some = np.array(places, int)
    return jnp.linalg.slogdet(_inverse(F)[some[:, None], some])[1]


@shown_from_users_lines
def planned_information(
    scene: Scene | BuiltFor,
    plan: Data,
    free: "Mapping[str, Range | Estimate | PossibleInertia | Callable | None] | Iterable[str]" = (),
    *,
    options: Options | None = None,
    **by_name: Unpack[OptionFields],
) -> PlannedInformation:
    """Return the information that planned runs will give about the unknowns, evaluated at the values of the
    scene.

    **Arguments**

    - `plan`: one run or several, as they will be measured: times, channels and sigmas, start, inputs and
      sensors. Their `values` do not matter, except that NaN marks a missing sample.
    - `free`, `options`, `by_name`: as in `fit`. Start values in `unknown_start` and estimated numbers of
      sensors are unknowns, too, and priors count.

    **Returns** a `PlannedInformation`: `matrix`, `standard_errors`, `log_det`. It is differentiable with
    respect to parameters, start values and samples of inputs in forward mode (`jax.jacfwd`; second
    derivatives of the motion, by XLA for samples) and under `jit`: starts and inputs can be optimised.

    **Raises** ValueError for data that do not fit the scene, sigmas or correlation times that are None, and
    correlated noise.

    **Example**

        def told(spin):
            plan = jj.Experiment(ts, {"lean": ts}, 0.005, start={"lean": 0.3, "spin_rate": spin})
            return jj.identification.planned_information(disc, plan, free=("radius", "gravity")).log_det()

        slope = jax.jacfwd(told)(-3.0)
    """
    settled = as_fit_options(scene, options, by_name, "planned_information")
    scene = as_scene(scene)
    runs = as_runs(scene, plan)
    for run in runs:
        for name in run.unknown_sigma:
            raise ValueError(
                f"sigma of channel `{name}` is None, but a plan needs the standard deviation of its noise; "
                "give a number"
            )
        for name in (*run.correlation_time, *run.unknown_correlation):
            raise ValueError(
                f"the noise of channel `{name}` has a correlation time, which a plan does not "
                "support; omit it"
            )
    numbers = [
        eqx.tree_at(
            lambda r: r.start,
            run,
            {n: np.zeros(x.shape) if is_traced(x) else x for n, x in run.start.items()},
        )
        for run in runs
    ]
    unknowns = unknowns_of(with_reference_parameters(scene), numbers, free)
    places = unknowns.estimated
    ready = tuple(run_of(run, array_module((run.values, run.sigma))) for run in runs)
    theta, reference = _values(scene, runs, unknowns), Reference(scene, unknowns.layout.parameters)
    F, J = _sensitivities(scene, ready, theta, settled, unknowns.layout, tuple(places.tolist()), reference)
    prior = unknowns.prior_rows
    return PlannedInformation(F + prior.T @ prior, theta[places], J, unknowns.labels, unknowns.units)


@compiled
def _sensitivities(
    scene: Scene,
    runs: tuple[Run, ...],
    theta: Float[Array, "places"],
    options: AllOptions,
    layout: Layout,
    places: tuple,
    reference: Reference,
):
    """Return F without priors, and the sensitivities, for unknowns with these indices."""
    some, count = np.array(places, int), layout.sizes[0]

    def residuals(free_ones: Float[Array, "unknowns"]):
        every = theta.at[some].set(free_ones)
        moved, local = layout.scene(scene, every[:count]), every[count:].reshape(len(runs), -1)
        return tuple(
            run.at(layout, every[:count], own).residuals(moved, simulate, options)
            for run, own in zip(runs, local, strict=True)
        )

    with reference.stands_in():
        J = jax.jacfwd(residuals)(theta[some])
    flat = jnp.concatenate([of.reshape(-1, len(places)) for run in J for of in run.values()])
    return flat.T @ flat, J


def _values(scene: Scene, runs: Sequence[Experiment], unknowns: Unknowns) -> Float[Entries, "places"]:
    """Return all unknowns at the values of the scene and the runs; parameters and starts may be traced."""
    (shared, local), layout = unknowns.split(unknowns.guess), unknowns.layout
    of_bodies = {
        label: x for body in layout.bodies for label, x in zip(body.labels, body.numbers(scene), strict=True)
    }

    def value(place: Place, run: Experiment, numbers):
        if place.kind == "start":
            return run.start.get(place.name, place.of(numbers))
        return {
            "scene": getattr(scene, place.name, None),
            "inertia": of_bodies.get(place.name),
            "sensor": place.of(numbers),
        }[place.kind]

    rows = [value(place, runs[0], shared) for place in layout.shared]
    rows += [value(place, run, own) for run, own in zip(runs, local, strict=True) for place in layout.local]
    xp = array_module(rows)
    return xp.concatenate([xp.ravel(x) for x in rows])
