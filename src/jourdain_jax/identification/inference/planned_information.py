"""The Fisher information of a planned experiment, differentiable with respect to its start and inputs.

    F = sum_k (d y_k / d theta)' (d y_k / d theta) / sigma_k^2 + prior
    cov(theta) >= F^-1      (Cramer and Rao)

y_k: reading k, with noise sigma_k; theta: the unknowns, start values included. If only some of the unknowns
are of interest, `log det F` is computed from their block of `F^-1`. Source: A. C. Atkinson, A. N. Donev and
R. D. Tobias, Optimum Experimental Designs, with SAS (2007), chapters 9 and 10 (D- and D_s-optimality).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.calculus.compilation import compiled
from jourdain_jax.calculus.reals import Entries, Indices, Scalar, array_module, is_traced, static
from jourdain_jax.identification.data.estimate import Estimate, Range
from jourdain_jax.identification.data.experiment import Data, Experiment
from jourdain_jax.identification.data.run_preparation import as_fit_options, as_runs
from jourdain_jax.identification.inference.information import hidden_combinations
from jourdain_jax.identification.solve.body_inertia import PossibleInertia
from jourdain_jax.identification.solve.layout import Layout, Place
from jourdain_jax.identification.solve.shooting import Run, run_of
from jourdain_jax.identification.solve.unknowns import Unknowns, unknowns_of
from jourdain_jax.motion.options import AllOptions, OptionFields, Options
from jourdain_jax.motion.simulate import simulate
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines
from jourdain_jax.scene.coordinates import Labels, UnknownNameError, as_names, check_names
from jourdain_jax.scene.identity import with_reference_parameters
from jourdain_jax.scene.printing import Printed, table
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import Reference

Matrix = Float[Array, "unknowns unknowns"]
# numerics: of the largest singular value of the scaled sensitivities: smaller ones count as zero
_CUTOFF = 1e-6


class PlannedInformation(Printed, eqx.Module):
    """The information of planned runs about each unknown. `print` shows the expected standard errors."""

    matrix: Matrix  # F, in the units of the unknowns
    values: Float[Entries, "unknowns"]  # of the unknowns, at which F is evaluated
    # (d y / d theta) / sigma for each run and channel; zero for missing samples
    sensitivities: tuple[dict[str, Float[Array, "*samples unknowns"]], ...]
    labels: Labels = static()
    units: Labels = static()

    @property
    def covariance(self) -> Matrix:
        """Return `F^-1`, with unbounded entries for undetermined combinations of unknowns."""
        return _inverse(self.matrix)

    @property
    def standard_errors(self) -> dict[str, Scalar]:
        """Return lower bounds of standard errors of unbiased estimates, by name, in their units."""
        return dict(zip(self.labels, jnp.sqrt(jnp.diagonal(self.covariance)), strict=True))

    def log_det(self, names: str | Iterable[str] = ()) -> Scalar:
        """Return `log det F`, which a plan should maximise. With `names`, return it for these unknowns only,
        with all others estimated as well.

        Raises KeyError for names that are not in `labels`.
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
        """Return undetermined directions as rows, and the sizes by which the unknowns are scaled."""
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
    """Return the log-determinant of the block `places` of the inverse of F."""
    some = np.array(places, int)
    return jnp.linalg.slogdet(_inverse(F)[some[:, None], some])[1]


@shown_from_users_lines
def planned_information(
    scene: Scene | BuiltFor,
    plan: Data,
    free: "Mapping[str, Range | Estimate | PossibleInertia | Callable[..., Any] | None] | Iterable[str]" = (),
    *,
    options: Options | None = None,
    **by_name: Unpack[OptionFields],
) -> PlannedInformation:
    """Return the information that planned runs will give about the unknowns, evaluated at the values of the
    scene.

    **Arguments**

    - `plan`: one run or several, as they will be measured: times, channels and sigmas, start, inputs and
      sensors. Their `values` have no effect; NaN marks a missing sample.
    - `free`, `options`, `by_name`: as in `fit`. Start values in `unknown_start` and estimated sensor
      parameters are unknowns, too. Priors are included.

    **Returns** a `PlannedInformation`: `matrix`, `standard_errors`, `log_det`. It is differentiable with
    respect to parameters, start values and samples of inputs in forward mode (`jax.jacfwd`), also under
    `jit`, so that starts and inputs can be optimised. Derivatives with respect to samples use XLA.

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
                f"the noise of channel `{name}` has a correlation time, but a plan needs white noise; omit it"
            )
    known = lambda start: {name: np.zeros(x.shape) if is_traced(x) else x for name, x in start.items()}
    numbers = [eqx.tree_at(lambda r: r.start, run, known(run.start)) for run in runs]
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
