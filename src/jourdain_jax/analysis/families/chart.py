"""Stability charts: curves of critical points in a plane of two numbers, where eigenvalues of a steady motion
cross the imaginary axis.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Array, Float

from jourdain_jax.analysis.families.critical import CriticalPoint, Special, followed_to, special_at
from jourdain_jax.analysis.families.equations import DOUBLE, SteadyEquations, numbered
from jourdain_jax.analysis.families.family import Family, family
from jourdain_jax.calculus.compilation import compiled_quickly
from jourdain_jax.calculus.reals import Number, Scalar
from jourdain_jax.scene.arguments import BuiltFor, as_scene, of_known_numbers
from jourdain_jax.scene.names import check_names
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene


@dataclass(frozen=True, repr=False, eq=False)
class StabilityChart(Printed):
    """Curves on which modes cross the imaginary axis; `mode, curve = chart.boundaries[0]`,
    `curve["rear_spin_rate"]`.
    """

    values: Float[np.ndarray, "values"]  # of the first number, equidistant
    # mode, and a point for each value: NaN, with a code, if there is none
    boundaries: tuple[tuple[str, CriticalPoint], ...]
    bands: tuple[
        Float[np.ndarray, "values"], ...
    ]  # standard deviations of the second number; NaN without a prior
    middle: Family  # along the second number, at the middle of the first: it shows the stable side

    def _text(self) -> str:
        return "\n".join(f"{mode}, {curve}" for mode, curve in self.boundaries)


@of_known_numbers
def stability_chart(
    scene: Scene | BuiltFor,
    axes: Mapping[str, tuple[Number, Number]],
    *,
    guess: Mapping[str, float] | None = None,
    prior: Mapping | None = None,
    points: int = 101,
    **asked,
) -> StabilityChart:
    """Return the boundaries of stability of steady motions in a plane of two numbers.

        chart = jj.stability_chart(bicycle, {"c": (0.02, 0.12), "rear_spin_rate": (5.0, 35.0)})
        for mode, curve in chart.boundaries:
            print(mode, curve["rear_spin_rate"], curve.speed)

    **Arguments**
    - `axes`: a parameter of the scene, and a coordinate or a speed, each with its first and its last value.
    - `guess`: named values of one of the motions (the rest zero); `points`: number of values of the first
      parameter, at least 3.
    - `prior`: parameter (one number) -> `jj.studies.Normal`, such as `measured_bicycle(...).prior`.
      `chart.bands` then has the standard deviations of the second number on each boundary, to first order,
      for independent parameters.
    - `asked`: arguments of `family`: `held`, `inputs`, `names`.

    A family along the second number, at the middle value of the first, finds the boundaries. Each is then a
    `critical` point as a function of the first number, accurate to round-off. A boundary that does not reach
    the middle value is missed, and one that turns back along the first number has gaps.

    **Returns** a `StabilityChart`. **Raises** errors as in `family`, and ValueError unless there are two
    axes, or for a prior that is no `jj.studies.Normal`.
    """
    if not isinstance(axes, Mapping) or len(axes) != 2:
        raise ValueError(
            f"`axes` is {axes!r}, expected two axes: a parameter, and a coordinate or a speed, "
            "each with its first and its last value"
        )
    (first, ends), (second, (begin, end)) = axes.items()
    values = np.linspace(*ends, points)
    # the ends are checked as values of the parameter
    scene = [as_scene(scene).replace(**{first: x}) for x in (*ends, values[points // 2])][-1]
    middle = family(scene, {**(guess or {}), second: begin}, until={second: end}, **asked)
    known, place, given = middle.equations, numbered(scene), dict(prior or {})
    assert isinstance(known, SteadyEquations)
    check_names(
        given, vars(place), f"`prior` names `{{}}`, which is not a parameter of `{type(scene).__name__}`"
    )
    sigma, k = np.zeros(len(known.given)), known.index(second)
    try:
        sigma[[getattr(place, name) for name in given]] = [one.sigma for one in given.values()]
    except (AttributeError, TypeError):
        raise ValueError(
            f"`prior` is {given}, expected names of parameters of one number, each with "
            "`jj.studies.Normal(mean, sigma)`"
        ) from None
    sigma[getattr(place, first)] = 0.0
    boundaries, bands = [], []
    for change in middle.changes:
        if change.kind != DOUBLE:
            special, curve = special_at(known, change), []
            for x in values:  # compiled faster than a batch
                point, numbers, inverse = _followed_to(special, scene, first, np.asarray(x))
                by_all = (
                    np.asarray(special.program.pulled(numbers, inverse[k]))
                    if given
                    else np.full(len(numbers), np.nan)
                )
                curve.append((point, np.linalg.norm(by_all[: len(sigma)] * sigma) * known.size[k]))
            found, band = jax.tree.map(lambda *x: np.stack(x), *curve)
            boundaries.append((change.modes[0], found))
            bands.append(band)
    return StabilityChart(values, tuple(boundaries), tuple(bands), middle)


@compiled_quickly
def _followed_to(special: Special, scene: Scene, first: str, x: Scalar) -> tuple[CriticalPoint, Array, Array]:
    """Return the point of a scene with this value, the arguments of the program there, and the pseudo-inverse
    of the equations' Jacobian.
    """
    scene = scene.replace(**{first: x})
    X, inverse, *found = followed_to(special, scene)
    return special.point(scene, X, *found), special.given(special.numbers(scene, X), X), inverse
