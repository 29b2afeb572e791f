"""What a run will tell before it is made: the Fisher information of a planned experiment, differentiable with respect to its start and inputs.

    F = sum_k (d y_k / d theta)' (d y_k / d theta) / sigma_k^2 + prior,     cov(theta) >= F^-1 (Cramer and Rao)

Unknown start values are among theta; log det F of those unknowns that are asked for is that of their block of F^-1, all others being estimated with them.
Source: A. C. Atkinson, A. N. Donev and R. D. Tobias, Optimum Experimental Designs, with SAS (2007), chapters 9 and 10 (D- and D_s-optimality).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.estimate import Estimate, Range
from jourdain_jax.analysis.experiment import Experiment
from jourdain_jax.analysis.information import hidden_combinations
from jourdain_jax.analysis.layout import Layout, PossibleInertia
from jourdain_jax.analysis.likelihood import as_fit_options, as_runs
from jourdain_jax.analysis.runs import Run, run_of
from jourdain_jax.analysis.table import table
from jourdain_jax.analysis.unknowns import Unknowns, unknowns_of
from jourdain_jax.build.reference import Reference
from jourdain_jax.build.reference_parameters import with_reference_parameters
from jourdain_jax.calculus.compiled import compiled
from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.motion.options import AllOptions, OptionFields, Options
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.names import UnknownNameError, as_names, nearest
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.tracebacks import shown_from_users_lines

_CUTOFF = 1e-6  # of the largest singular value of the scaled sensitivities: what is less does not show


class PlannedInformation(Printed, eqx.Module):
    """What planned runs will tell of each unknown. `print` shows the standard errors that they lead to."""

    matrix: Float[Array, "unknowns unknowns"]  # F, in the units of the unknowns
    values: Float[Array | np.ndarray, "unknowns"]  # at which it is taken
    sensitivities: tuple[dict[str, Float[Array, "*samples unknowns"]], ...]  # of each run and channel: (d y / d theta) / sigma, zero where there is no sample
    labels: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)

    @property
    def covariance(self) -> Float[Array, "unknowns unknowns"]:
        """F^-1. Entries grow beyond all bounds where a combination of unknowns does not show."""
        return _inverse(self.matrix)

    @property
    def standard_errors(self) -> dict[str, Float[Array, ""]]:
        """The least that an unbiased estimate can have, by name, in the unit of the unknown."""
        return dict(zip(self.labels, jnp.sqrt(jnp.diagonal(self.covariance)), strict=True))

    def log_det(self, names: str | Iterable[str] = ()) -> Float[Array, ""]:
        """`log det F`; of the unknowns in `names`, that of the inverse of their block of F^-1, all others being estimated too. To be made as large as possible.

        Raises KeyError for names that are not unknown.
        """
        asked = as_names(names) or self.labels
        for name in asked:
            if name not in self.labels:
                raise UnknownNameError(f"`{name}` is not among the unknowns; {nearest(name, self.labels)}")
        return -_log_det(self.matrix, tuple(self.labels.index(name) for name in asked))

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """What the planned runs will not tell, one sentence for each combination of unknowns."""
        directions, size = self._hidden
        return hidden_combinations(directions, np.sqrt(_CUTOFF), size, np.asarray(self.values), self.labels)

    @property
    def _hidden(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions that do not show, in rows, and the sizes of the unknowns by which they are scaled."""
        values = np.abs(np.asarray(self.values))
        size = np.where(values > 0, values, 1.0)
        squares, directions = np.linalg.eigh(np.asarray(self.matrix) * size * size[:, None])
        return directions.T[squares <= _CUTOFF**2 * squares[-1]], size

    def _text(self) -> str:
        shows = np.linalg.norm(self._hidden[0], axis=0) < np.sqrt(_CUTOFF)
        errors = [f"{float(e):.3g}" if one else "-" for e, one in zip(self.standard_errors.values(), shows, strict=True)]
        rows = [("unknown", "unit", "std. error"), *zip(self.labels, self.units, errors, strict=True)]
        lines = [f"Planned: {len(self.sensitivities)} runs, {len(self.labels)} unknowns", *table(rows)]
        return "\n".join(lines + [f"  {sentence}" for sentence in self.not_identifiable])


@compiled
def _inverse(F: Float[Array, "unknowns unknowns"]) -> Float[Array, "unknowns unknowns"]:
    scale = 1 / jnp.sqrt(jnp.where(jnp.diagonal(F) > 0, jnp.diagonal(F), 1.0))
    return scale[:, None] * jnp.linalg.inv(scale[:, None] * F * scale) * scale


@compiled
def _log_det(F: Float[Array, "unknowns unknowns"], places: tuple[int, ...]) -> Float[Array, ""]:
    """The logarithm of the determinant of this block of the inverse."""
    some = np.array(places, int)
    return jnp.linalg.slogdet(_inverse(F)[some[:, None], some])[1]


@shown_from_users_lines
def planned_information(
    scene: Scene | BuiltFor,
    plan: Experiment | Sequence[Experiment],
    free: "Mapping[str, Range | Estimate | PossibleInertia | Callable | None] | Iterable[str]" = (),
    *,
    options: Options | None = None,
    **by_name: Unpack[OptionFields],
) -> PlannedInformation:
    """What runs that are planned will tell of the unknowns, taken at the values that the scene has.

    **Arguments**
    - `plan`: one run or several, as they will be measured: times, channels and sigmas, start, inputs and sensors. Their `values` do not matter, but where they
      are NaN there will be no sample.
    - `free`, `options`, `by_name`: as of `fit`. Start values in `unknown_start` and numbers of sensors that are estimated are unknowns, too, and priors count.

    **Returns** a `PlannedInformation`: `matrix`, `standard_errors`, `log_det`. It is differentiable with respect to parameters, start values and samples of
    inputs in forward mode (`jax.jacfwd`; second derivatives of the motion, by XLA for samples) and under `jit`: starts and inputs can be optimised.

    **Raises** ValueError for what does not fit the scene, and for sigmas or correlation times that are None or noise with a memory.

    **Example**

        def told(spin):
            plan = jj.Experiment(ts, {"lean": ts}, 0.005, start={"lean": 0.3, "spin_rate": spin})
            return jj.planned_information(disc, plan, free=("radius", "gravity")).log_det()

        slope = jax.jacfwd(told)(-3.0)
    """
    settled = as_fit_options(scene, options, by_name, "planned_information")
    scene = as_scene(scene)
    runs = as_runs(scene, plan)
    for run in runs:
        for name in run.unknown_sigma:
            raise ValueError(f"sigma of channel `{name}` is None, but a plan needs the standard deviation of its noise; give a number")
        for name in (*run.correlation_time, *run.unknown_correlation):
            raise ValueError(f"the noise of channel `{name}` has a correlation time, of which a plan knows nothing; leave it out")
    numbers = [eqx.tree_at(lambda r: r.start, run, {n: np.zeros(x.shape) if is_traced(x) else x for n, x in run.start.items()}) for run in runs]
    unknowns = unknowns_of(with_reference_parameters(scene), numbers, free if isinstance(free, Mapping) else tuple(as_names(free)))
    places, count = unknowns.estimated, unknowns.layout.sizes[0]
    ready = tuple(run_of(run, jnp if is_traced((run.values, run.sigma)) else np) for run in runs)
    theta = _values(scene, runs, unknowns)
    F, J = _sensitivities(scene, ready, theta, settled, unknowns.layout, tuple(places.tolist()), Reference(scene))
    prior = np.diag(1 / np.where(np.isfinite(unknowns.prior_mean[places]), unknowns.prior_sigma[places], np.inf))
    prior[:count] = unknowns.whitening @ prior[:count]  # all that are shared are estimated
    return PlannedInformation(F + prior.T @ prior, theta[places], J, unknowns.labels, unknowns.units)


@compiled
def _sensitivities(
    scene: Scene, runs: tuple[Run, ...], theta: Float[Array, "places"], options: AllOptions, layout: Layout, places: tuple, reference: Reference
):
    """F without priors, and the sensitivities, of unknowns in these places."""
    some, count = np.array(places, int), layout.sizes[0]

    def residuals(free_ones: Float[Array, "unknowns"]):
        every = theta.at[some].set(free_ones)
        moved, local = layout.scene(scene, every[:count]), every[count:].reshape(len(runs), -1)
        return tuple(run.at(layout, every[:count], own).residuals(moved, simulate, options) for run, own in zip(runs, local, strict=True))

    with reference.stands_in():
        J = jax.jacfwd(residuals)(theta[some])
    flat = jnp.concatenate([of.reshape(-1, len(places)) for run in J for of in run.values()])
    return flat.T @ flat, J


def _values(scene: Scene, runs: Sequence[Experiment], unknowns: Unknowns) -> Float[Array | np.ndarray, "places"]:
    """All unknowns at the values that the scene and the runs have; those of parameters and starts may be traced."""
    shared, local = unknowns.split(unknowns.guess)
    of_bodies = {label: x for body in unknowns.layout.bodies for label, x in zip(body.labels, body.numbers(scene), strict=True)}
    of_kind = {"scene": lambda place: getattr(scene, place.name), "sensor": lambda place: place.of(shared), "inertia": lambda place: of_bodies[place.name]}
    rows = [of_kind[place.kind](place) for place in unknowns.layout.shared]
    for run, own in zip(runs, local, strict=True):
        rows += [run.start.get(place.name, place.of(own)) for place in unknowns.layout.local]
    xp = jnp if is_traced(rows) else np
    return xp.concatenate([xp.ravel(x) for x in rows])
