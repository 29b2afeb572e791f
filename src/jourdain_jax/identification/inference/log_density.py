"""The posterior density of the unknowns of a fit as a function of unbounded real numbers, for samplers.

    log p(z) = log L(theta) + sum log prior(theta) + sum log |d theta / dx| + log |det F|
    theta = constrain(x),   x = centre + F z

L: `log_likelihood`; x: one real number for each unknown (`Range`). centre and F are zero and the identity, or
come from a fit (`whitened`). A correlation time tau enters theta as arcsin rho, `rho = exp(-h / tau)`, h: the
shortest interval, with a uniform prior (Jeffreys' prior of AR(1) noise). Source: A. Gelman et al., Bayesian
Data Analysis, 3rd ed. (2013), sections 1.8 and 12.4.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import compiled
from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.calculus.reals import Indices, Scalar, holds, is_traced, real_type, static
from jourdain_jax.identification.data.estimate import Estimate, Range, positive
from jourdain_jax.identification.data.experiment import Data
from jourdain_jax.identification.data.run_preparation import as_fit_options, as_runs, in_all_or_none
from jourdain_jax.identification.inference.correlated_noise import SHORTEST, correlation_limits
from jourdain_jax.identification.inference.likelihood import mapped, of_run, of_samples
from jourdain_jax.identification.report.estimates import Estimates
from jourdain_jax.identification.solve.body_inertia import PossibleInertia
from jourdain_jax.identification.solve.layout import Layout
from jourdain_jax.identification.solve.run_groups import equal_runs
from jourdain_jax.identification.solve.shooting import Run
from jourdain_jax.identification.solve.unknowns import Places, check_starts, unknowns_of
from jourdain_jax.motion.options import AllOptions, OptionFields, Options
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines
from jourdain_jax.scene.coordinates import Labels, check_names
from jourdain_jax.scene.identity import reference_parameters
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import Reference

Point = Float[Array, "unknowns"]
Points = Float[Array, "*batch unknowns"]


class LogDensity(eqx.Module):
    """The function `log p(z)` of a vector z of real numbers, up to a constant. It can be called under `jit`,
    `grad` and `vmap`.

    `labels` names the unknowns, as in a `Fit`; an estimated sigma is `"lean.sigma"`, a correlation time
    `"lean.correlation_time"` (s).
    """

    scene: Scene
    groups: tuple[Run, ...]  # runs of equal structure, stacked
    options: AllOptions
    fixed: Places  # first guesses and known values of all entries of a layout
    guess: Float[np.ndarray, "unknowns"]  # in their units
    prior_mean: Places
    prior_rows: Float[np.ndarray, "places places"]  # of priors (see `Unknowns`)
    prior_height: float  # logarithm of the maximum of all priors
    centre: Float[np.ndarray, "unknowns"]
    factor: Float[np.ndarray, "unknowns unknowns"]  # lower triangular
    labels: Labels = static()
    units: Labels = static()
    layout: Layout = static()
    runs: tuple[Indices, ...] = static()  # indices of the runs of each group
    places: Indices = static()  # indices of the unknowns other than sigmas
    sigmas: Labels = static()  # channels with unknown sigma, next among the unknowns
    with_memory: Labels = static()  # channels with unknown correlation time, last among the unknowns
    ranges: tuple[Range, ...] = static()  # of all unknowns

    def __call__(self, z: Point) -> Scalar:
        """Return the logarithm of the density; -inf if the motion fails."""
        return _density(self, self._checked(z), Reference(self.scene, self.layout.parameters))

    def _at(self, z: Point, reference: Reference) -> Scalar:
        x = self._spread(z)
        theta, slopes = self._each(Range.constrain, x), self._each(Range.log_slope, x)
        count, end = len(self.places), len(self.places) + len(self.sigmas)
        known = self.prior_rows @ (theta[:count] - self.prior_mean)
        # the prior of a sigma is flat in its logarithm, which is x
        logs = (
            jnp.sum(slopes[:count])
            + jnp.sum(slopes[end:])
            + jnp.sum(jnp.log(jnp.diagonal(self.factor)))
            + self.prior_height
            - 0.5 * known @ known
        )
        with reference.stands_in():
            return logs + sum(map(jnp.sum, self._of_runs(theta, of_run)))

    def _of_runs(self, theta: Point, of: Callable) -> list:
        """Return `of(scene, run)` of all runs, stacked by group."""
        count, end = len(self.places), len(self.places) + len(self.sigmas)
        shared, local = self._split(theta)
        scene = self.layout.scene(self.scene, shared)
        sigma = dict(zip(self.sigmas, theta[count:end], strict=True))
        tau = dict(zip(self.with_memory, theta[end:], strict=True))

        def one(run: Run, local: Float[Array, "local"]):
            here = run.at(self.layout, shared, local)
            weights = {
                name: weight / sigma[name] if name in sigma else weight
                for name, weight in here.weights.items()
            }
            memory = here.correlation_time | {
                name: tau[name] for name in here.correlation_time if name in tau
            }
            return of(scene, here._replace(weights=weights, correlation_time=memory), options=self.options)

        groups = zip(self.groups, self.runs, strict=True)
        return [mapped(one, group, local[np.array(runs)]) for group, runs in groups]

    def _samples(self, z: Point, reference: Reference) -> list:
        with reference.stands_in():
            return self._of_runs(self.constrain(z), of_samples)

    @property
    def initial(self) -> Point:
        """Return z at the first guess of all unknowns."""
        return self.unconstrain({})

    def constrain(self, z: Points) -> Points:
        """Return the unknowns at z, in their units and in the order of `labels`; for one vector or many."""
        return self._each(Range.constrain, self._spread(self._checked(z)))

    def named(self, z: Points) -> dict[str, Float[Array, "*batch"]]:
        """Return the unknowns at z by name, in their units, for one vector or many."""
        theta = self.constrain(z)
        return {label: theta[..., i] for i, label in enumerate(self.labels)}

    def unconstrain(self, values: "Mapping[str, Any]") -> Point:
        """Return z for these values of unknowns by name, in their units. Omitted unknowns have their first
        guess.

        Raises ValueError for names that are not in `labels`, and for values at or beyond a bound.
        """
        check_names(values, self.labels, "`{}` is not among the unknowns")
        theta = jnp.stack(
            [
                jnp.asarray(values.get(label, self.guess[i]), real_type())
                for i, label in enumerate(self.labels)
            ]
        )
        x = self._each(Range.unconstrain, theta)
        if not holds(np.isfinite, x):
            off = int(np.argmin(np.isfinite(x)))
            raise ValueError(
                f"`{self.labels[off]}` is {float(theta[off]):g}, which is at or beyond a bound; "
                "give a value between the bounds"
            )
        return jax.scipy.linalg.solve_triangular(self.factor, x - self.centre, lower=True)

    def scene_at(self, z: Point) -> Scene:
        """Return the scene with the parameters at z."""
        return self.layout.scene(self.scene, self._split(self.constrain(z))[0])

    def whitened(self, fit: Estimates) -> "LogDensity":
        """Return the density as a function of another vector z, whose entries are independent with unit
        variance according to a fit of the same data. Samplers then need few steps.

        `constrain` and `named` convert back to the unknowns. At the minimum of the fit z is zero. Raises
        ValueError for a fit of other unknowns, for a batch, and for unknowns without a standard error
        (undetermined, or at a bound).
        """
        of_noise = set(self.sigmas) <= set(fit.sigma) and set(self.with_memory) <= set(fit.correlation_time)
        if fit.values.ndim > 1 or fit.labels != self.labels[: len(self.places)] or not of_noise:
            raise ValueError(
                f"the unknowns of the fit are {', '.join(fit.labels)}, those of the density "
                f"{', '.join(self.labels)}; give the fit of the same unknowns and data"
            )
        for label, error in zip(fit.labels, fit.standard_errors, strict=True):
            if not np.isfinite(error):
                raise ValueError(
                    f"`{label}` has no standard error in the fit, so its scale is unknown; give it a prior, "
                    "or omit it from `free`"
                )
        noise = [float(fit.sigma[name]) for name in self.sigmas] + [
            float(fit.correlation_time[name]) for name in self.with_memory
        ]
        theta, end = np.concatenate([fit.values, noise]), len(self.labels) - len(self.with_memory)
        x = np.array(self._each(Range.unconstrain, jnp.asarray(theta)))
        x[end:] = np.clip(x[end:], -4.0, 4.0)  # a correlation time may be at an end of its range
        slopes = np.exp(-np.asarray(self._each(Range.log_slope, jnp.asarray(x))))
        covariance = np.zeros((len(theta), len(theta)))
        covariance[: fit.values.size, : fit.values.size] = fit.covariance
        for i, name in enumerate((*self.sigmas, *self.with_memory), fit.values.size):
            samples = np.concatenate(
                [np.ravel(run[name][np.isfinite(run[name])]) for run in fit.whitened if name in run]
            )
            # sum of squares in units of sigma: degrees of freedom
            covariance[i, i] = (
                theta[i] ** 2 / (2 * max(np.sum(samples**2), 0.5)) if i < end else 1 / samples.size
            )
        factor = np.linalg.cholesky(slopes[:, None] * covariance * slopes)
        return eqx.tree_at(lambda d: (d.centre, d.factor), self, (x, factor))

    def to_arviz(self, z: Array | np.ndarray):
        """Return draws z of a sampler as `arviz.InferenceData`: the unknowns by name in their units, the
        measured values, and the log density of each measured value, for `arviz.loo`.

        Channels of several runs are named `"run 0: lean"`. Missing samples are omitted. Raises ImportError
        without ArviZ, and ValueError unless z has the axes chains, draws and unknowns.
        """
        arviz, z = needed("arviz", "draws as `arviz.InferenceData`", "interop"), self._checked(z)
        if z.ndim != 3:
            raise ValueError(f"the draws have shape {z.shape}, expected (chains, draws, {len(self.labels)})")
        logs = _logs(self, z.reshape(-1, z.shape[-1]), Reference(self.scene, self.layout.parameters))
        single, values, densities = sum(map(len, self.runs)) == 1, {}, {}
        for group, runs, of_group in zip(self.groups, self.runs, logs, strict=True):
            for k, run in enumerate(runs):
                for name, weights in group.weights.items():
                    label, known = name if single else f"run {run}: {name}", np.asarray(weights[k]) > 0
                    values[label] = np.asarray(group.values[name][k])[known]
                    densities[label] = np.asarray(of_group[name])[:, k, known].reshape(*z.shape[:2], -1)
        posterior = {name: np.asarray(x) for name, x in self.named(z).items()}
        found = arviz.from_dict(posterior=posterior, observed_data=values, log_likelihood=densities)
        for label, unit in zip(self.labels, self.units, strict=True):
            found.posterior[label].attrs["units"] = unit
        return found

    def _checked(self, z) -> Array:
        z = jnp.asarray(z, real_type())
        if z.shape[-1:] != (len(self.labels),):
            raise ValueError(
                f"the vector has shape {z.shape}, expected ({len(self.labels)},): one number "
                f"for each of {', '.join(self.labels)}"
            )
        return z

    def _spread(self, z: Points) -> Points:
        return self.centre + z @ self.factor.T

    def _each(self, of: Callable, x: Points) -> Points:
        """Apply the method `of` of each unknown's range to its number in `x`."""
        return jnp.stack([of(one, x[..., i]) for i, one in enumerate(self.ranges)], axis=-1)

    def _split(self, theta: Point) -> tuple[Float[Array, "shared"], Float[Array, "runs local"]]:
        shared, local = self.layout.sizes
        every = jnp.asarray(self.fixed).at[np.array(self.places, int)].set(theta[: len(self.places)])
        return every[:shared], (
            every[shared:].reshape(-1, local) if local else jnp.zeros((sum(map(len, self.runs)), 0))
        )


_density = compiled(LogDensity._at)
_logs = compiled(
    lambda density, z, reference: jax.vmap(partial(LogDensity._samples, density, reference=reference))(z)
)


@shown_from_users_lines
def log_density(
    scene: Scene | BuiltFor,
    data: Data,
    free: "Mapping[str, Range | Estimate | PossibleInertia | Callable[..., Any] | None] | Iterable[str]" = (),
    *,
    options: Options | None = None,
    **by_name: Unpack[OptionFields],
) -> LogDensity:
    """Return the posterior density of the unknowns of `fit`, as a function of an unconstrained vector, for
    samplers of BlackJAX, NumPyro and others.

    **Arguments**

    - `scene`, `data`, `free`, `options`, `by_name`: as in `fit`. Unknowns are free parameters, unknown start
      values, estimated parameters of sensors and actuators, and sigmas that are None, named `"lean.sigma"`.
    - Priors: `Normal` if an `Estimate` has one. Otherwise the prior is flat between bounds: in the unknown
      itself, and in the logarithm of a sigma. For a correlation time tau it is flat in arcsin(exp(-h / tau)),
      where h is the shortest interval between samples of the channel. A flat prior without bounds cannot be
      normalised: if the data do not determine the unknown, neither can the posterior, and a sampler diverges.

    **Returns** a `LogDensity`: call it with a vector; `initial`, `constrain`, `named` and `unconstrain`
    convert between the vector and the unknowns. The density includes the logarithms of the transforms'
    derivatives. It is a pure function, for `jit`, `vmap` and `grad`.

    **Raises** ValueError as in `fit`.

    **Example**

        found = jj.fit(scene, data, free=("radius",))
        density = jj.identification.log_density(scene, data, free=("radius",)).whitened(found)
        sampler = blackjax.nuts(density, step_size=0.8, inverse_mass_matrix=jnp.ones(density.initial.size))
        draws = density.named(positions)["radius"]  # m; positions: (draws, unknowns)
    """
    settled = as_fit_options(scene, options, by_name, "log_density")
    scene = as_scene(scene)
    runs = as_runs(scene, data)
    sigmas = in_all_or_none(runs, "sigma", lambda run: run.unknown_sigma)
    with_memory = in_all_or_none(runs, "the correlation time", lambda run: run.unknown_correlation)
    limits = [correlation_limits(runs, name) for name in with_memory]
    intervals = np.array([low / SHORTEST for low, _ in limits])
    angles = [
        Range("memory", *(float(np.arcsin(np.exp(-h / tau))) for tau in ends), interval=float(h))
        for h, ends in zip(intervals, limits, strict=True)
    ]
    unknowns = unknowns_of(scene, runs, free)
    with reference_parameters(scene, unknowns.layout.parameters):
        if not is_traced((scene, [(run.start, run.t0, run.inputs) for run in runs])):
            check_starts(scene, runs, unknowns)
        grouped = equal_runs(runs)
        guesses = [
            _rms(scene, [group for _, group in grouped if name in group.weights], name, settled)
            for name in sigmas
        ]
    guesses += (intervals / np.log(2)).tolist()  # neighbouring samples have a correlation of one half
    places = unknowns.estimated
    size, weights = len(places) + len(guesses), unknowns.prior_weight[unknowns.prior_weight > 0]
    return LogDensity(
        scene=scene,
        groups=tuple(group for _, group in grouped),
        options=settled,
        fixed=unknowns.guess,
        guess=np.concatenate([unknowns.guess[places], guesses]),
        prior_mean=unknowns.prior_mean[places],
        prior_rows=unknowns.prior_rows,
        prior_height=float(
            np.sum(np.log(weights / np.sqrt(2 * np.pi))) + np.linalg.slogdet(unknowns.whitening)[1]
        ),
        centre=np.zeros(size),
        factor=np.eye(size),
        labels=(
            *unknowns.labels,
            *(f"{name}.sigma" for name in sigmas),
            *(f"{name}.correlation_time" for name in with_memory),
        ),
        units=(*unknowns.units, *("" for _ in sigmas), *("s" for _ in with_memory)),
        layout=unknowns.layout,
        runs=tuple(numbers for numbers, _ in grouped),
        places=tuple(places.tolist()),
        sigmas=sigmas,
        with_memory=with_memory,
        ranges=(*(unknowns.ranges[place] for place in places), *(positive() for _ in sigmas), *angles),
    )


def _rms(scene: Scene, groups: Sequence[Run], name: str, options: AllOptions) -> float:
    """Return the root mean square of a channel's residuals at the first guess, with unit weights, as first
    guess of sigma.
    """
    of = partial(Run.residuals, scene=scene, simulate=simulate, options=options)
    residuals = [mapped(lambda run: of(run)[name], group) for group in groups]
    samples = sum(np.count_nonzero(np.asarray(group.weights[name])) for group in groups)
    found = float(np.sqrt(sum(float(jnp.sum(r**2)) for r in residuals) / samples))
    if not np.isfinite(found):
        raise ValueError(
            f"the motion fails at the first guess, so that the sigma of channel `{name}` has no first guess; "
            "examine the motion with `simulate`"
        )
    return max(found, 1e-12)
