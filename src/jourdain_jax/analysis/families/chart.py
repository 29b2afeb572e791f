"""Stability charts: curves in a plane of two parameters on which eigenvalues of steady motions cross the
imaginary axis.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.families.critical import CriticalPoint, Special, followed_to, special_at
from jourdain_jax.analysis.families.equations import DOUBLE, SteadyEquations
from jourdain_jax.analysis.families.family import Family, family
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import Number, Scalar
from jourdain_jax.scene.arguments import BuiltFor, as_scene, of_known_numbers
from jourdain_jax.scene.coordinates import check_names
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True, repr=False, eq=False)
class StabilityChart(Printed):
    """Curves on which modes cross the imaginary axis: `mode, curve = chart.boundaries[0]`,
    `curve["rear_spin_rate"]`.
    """

    values: Float[np.ndarray, "values"]  # of the first axis, equidistant
    # a mode, and one point for each value; a point that does not exist is NaN and has a code
    boundaries: tuple[tuple[str, CriticalPoint], ...]
    # standard deviations of the second axis; NaN without a prior
    bands: tuple[Float[np.ndarray, "values"], ...]
    middle: Family  # along the second axis, at the middle value of the first; shows which side is stable

    def _text(self) -> str:
        return "\n".join(f"{mode}, {curve}" for mode, curve in self.boundaries)


@of_known_numbers
def stability_chart(
    scene: Scene | BuiltFor,
    axes: Mapping[str, tuple[Number, Number]],
    *,
    guess: Mapping[str, float] | None = None,
    prior: "Mapping[str, Any] | None" = None,
    points: int = 101,
    **asked: Any,
) -> StabilityChart:
    """Return the boundaries of stability of steady motions in a plane of two quantities.

        chart = jj.stability_chart(bicycle, {"c": (0.02, 0.12), "rear_spin_rate": (5.0, 35.0)})
        for mode, curve in chart.boundaries:
            print(mode, curve["rear_spin_rate"], curve.speed)

    **Arguments**
    - `axes`: two axes. The first is a parameter of the scene, the second a coordinate or a speed, each with
      its first and its last value.
    - `guess`: named values of one of the motions (omitted ones are zero); `points`: number of values along
      the first axis, at least 3.
    - `prior`: a `jj.studies.Normal` for scalar parameters, by name, such as `measured_bicycle(...).prior`.
      `chart.bands` then contains the standard deviation of the second quantity along each boundary, to first
      order, for independent parameters.
    - `asked`: arguments of `family`: `held`, `inputs`, `names`.

    A family along the second axis, at the middle value of the first, finds the boundaries. Each boundary is
    then computed as a `critical` point for each value of the first axis, accurate to round-off. A boundary
    that does not reach the middle value is missed, and a boundary that turns back along the first axis has
    gaps.

    **Returns** a `StabilityChart`. **Raises** the errors of `family`, and ValueError unless there are two
    axes, or for a prior that is not a `jj.studies.Normal`.
    """
    if not isinstance(axes, Mapping) or len(axes) != 2:
        raise ValueError(
            f"`axes` is {axes!r}, expected two axes: a parameter, and a coordinate or a speed, "
            "each with its first and its last value"
        )
    (first, ends), (second, (begin, end)) = axes.items()
    values = np.linspace(*ends, points)
    # creating a scene with each end value checks that the value is valid
    scene = [as_scene(scene).replace(**{first: x}) for x in (*ends, values[points // 2])][-1]
    middle = family(scene, {**(guess or {}), second: begin}, until={second: end}, **asked)
    known, given = middle.equations, dict(prior or {})
    assert isinstance(known, SteadyEquations)
    check_names(
        given, vars(scene), f"`prior` names `{{}}`, which is not a parameter of `{type(scene).__name__}`"
    )
    try:
        sigma = {name: np.asarray(one.sigma) for name, one in given.items() if name != first}
    except AttributeError:
        raise ValueError(
            f"`prior` is {given}, expected a dictionary of `jj.studies.Normal(mean, sigma)` by the "
            "names of scalar parameters"
        ) from None
    boundaries, bands = [], []
    for change in middle.changes:
        if change.kind != DOUBLE:
            special, k = special_at(known, change), known.index(second)
            # one point compiles faster than a batch
            curve = [_followed_to(special, scene, first, np.asarray(x), k, sigma) for x in values]
            found, band = jax.tree.map(lambda *x: np.stack(x), *curve)
            boundaries.append((change.modes[0], found))
            bands.append(band)
    return StabilityChart(values, tuple(boundaries), tuple(bands), middle)


@compiled_quickly
def _followed_to(
    special: Special, scene: Scene, first: str, x: Scalar, k: int, sigma: dict[str, Array]
) -> tuple[CriticalPoint, Scalar]:
    """Return the critical point for the value `x` of the first axis, and the standard deviation of the
    unknown k due to those of the parameters.
    """
    scene = scene.replace(**{first: x})
    X, inverse, *found = followed_to(special, scene)
    band = jnp.array(jnp.nan)
    if sigma:
        (by,) = jax.vjp(lambda scene: special.equations_at(scene, X, X), scene)[1](inverse[k])
        band = jnp.linalg.norm(jnp.stack([getattr(by, name) * s for name, s in sigma.items()]))
    return special.point(scene, X, *found), band * special.equations.size[k]
