"""Families of steady or periodic motions: the curve through a given motion, with its special points."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Complex, Float

from jourdain_jax.analysis.families.curve import CLOSED, Point, located
from jourdain_jax.analysis.families.equations import Modes, Motions, SteadyEquations, Vector, mode_names
from jourdain_jax.analysis.families.periodic import OrbitEquations, PeriodicMotion
from jourdain_jax.analysis.families.special_points import SURE, across, first_point, followed, special
from jourdain_jax.analysis.steady import guessed
from jourdain_jax.calculus.lazy_imports import needed
from jourdain_jax.calculus.reals import Indices, Numbers, checked_known, largest
from jourdain_jax.integrate.state import State
from jourdain_jax.scene.arguments import (
    BuiltFor,
    as_input_vector,
    as_scene,
    of_known_numbers,
    shown_from_users_lines,
)
from jourdain_jax.scene.coordinates import (
    Labels,
    UnknownNameError,
    as_names,
    check_name,
    check_names,
    parameters_of,
)
from jourdain_jax.scene.printing import Printed, complex_numbers, in_digits, table
from jourdain_jax.scene.scene import Scene

SHOWN = 1e-9  # numerics: an unknown is printed if its change, in units of its size, exceeds this number


@dataclass(frozen=True, repr=False, eq=False)
class FamilyPoint(Printed):
    """Point of a family: `point["lean"]`, `point.state`. `kind` is empty unless the point is special."""

    kind: str
    state: State
    eigenvalues: Modes  # 1/s, in the order of the family's modes; of a periodic motion: multipliers
    modes: Labels  # names of the modes that cross or coincide here
    values: dict[str, float]  # coordinates, speeds, and the parameter that varies
    tangent: Vector  # of the curve, along its unknowns
    about: str  # name and unit of `eigenvalues`

    def __getitem__(self, name: str) -> float:
        """Return a coordinate, a speed, or the parameter that varies."""
        return self.values[name] if name in self.values else self.state[name]

    @property
    def differentiable(self) -> bool:
        """Return whether the point is a smooth function of the scene's parameters, as all but branch points
        are.
        """
        return self.kind != "branch point"

    def _text(self) -> str:
        concerned = f" ({', '.join(dict.fromkeys(self.modes))})" if self.modes else ""
        return (
            f"{self.kind or 'point of a family'}{concerned}\n{self.state}\n{self.about}:"
            f" {', '.join(complex_numbers(self.eigenvalues))}"
        )


@dataclass(frozen=True, repr=False, eq=False)
class Family(Printed):
    """Steady or periodic motions along a curve, in order: `family["lean"]`, `print(family)`. Values of a
    periodic motion are those at the start of a period.

    Each column of `eigenvalues` follows one mode along the curve. Zero eigenvalues due to neighbouring steady
    motions are omitted. Periodic motions have multipliers instead of eigenvalues.
    """

    equations: Motions
    points: tuple[Point, ...]
    ends: tuple[str, str]  # reasons why the curve ends at its first and at its last point
    mode_names: Labels
    special: tuple[FamilyPoint, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, name: str) -> Float[np.ndarray, "points"]:
        """Return the values of a coordinate, a speed, or the parameter that varies, at all points."""
        check_name(
            name,
            self.equations.by_name,
            f"a family of `{type(self.equations.scene).__name__}` has no `{name}`",
            UnknownNameError,
        )
        return np.array([self.equations.values(point.z)[name] for point in self.points])

    @property
    def eigenvalues(self) -> Complex[np.ndarray, "points modes"]:
        """Return the eigenvalues of small motions (1/s), or the multipliers, at all points. Columns are named
        by `mode_names`.
        """
        return np.array([point.modes for point in self.points])

    @property
    def stable(self) -> Bool[np.ndarray, "points"]:
        """Return whether no small motion about a point grows."""
        return np.all(
            self.equations.growth(self.eigenvalues) <= SURE * (1 + np.abs(self.eigenvalues)), axis=1
        )

    @property
    def folds(self) -> tuple[FamilyPoint, ...]:
        """Return the points at which a named quantity turns back along the curve."""
        return tuple(point for point in self.special if point.kind.startswith("fold"))

    @property
    def branches(self) -> tuple[FamilyPoint, ...]:
        """Return the points at which another family crosses. `jj.family(scene, family.branches[0])` follows
        it.
        """
        return tuple(point for point in self.special if point.kind == "branch point")

    @property
    def changes(self) -> tuple[FamilyPoint, ...]:
        """Return the points at which an eigenvalue passes zero, a pair crosses the imaginary axis, or two
        eigenvalues coincide. For multipliers: the points at which one passes 1 or -1, a pair crosses the unit
        circle, or two coincide.
        """
        return tuple(point for point in self.special if point.modes)

    def at(self, **named: float) -> tuple[FamilyPoint, ...]:
        """Return all points of the curve at which a coordinate, speed or parameter has a given value, as in
        `family.at(lean=0.4)`.
        """
        if len(named) != 1:
            raise ValueError(f"`at` takes one name with its value, but {len(named)} were given; give one")
        ((name, value),) = named.items()
        k = self.equations.index(name)
        past = lambda p: p.z[k] - float(value) / self.equations.size[k]
        last = () if self.ends[1] == CLOSED else self.points[-1:]
        found = (
            here if past(here) == 0 else located(self.equations, here, there, past)
            for here, there in pairwise((*self.points, *last))
            if past(here) == 0 or past(here) * past(there) < 0
        )
        return tuple(self.point(point) for point in found if point)

    def point(self, point: Point, kind: str = "", columns: Indices = ()) -> FamilyPoint:
        """Return a point of the curve as a `FamilyPoint`. `columns`: indices of its `modes`."""
        known, modes = self.equations, tuple(self.mode_names[k] for k in columns)
        state, values = known.state(known.at(point.z), largest(point.look.R)), known.values(point.z)
        return FamilyPoint(kind, state, point.modes, modes, values, point.tangent * known.size, known.modes)

    def to_xarray(self) -> Any:
        """Return all points as an `xarray.Dataset`: unknowns, `stable`, and eigenvalues with mode names."""
        xarray = needed("xarray", "a family as labelled arrays")
        values = {name: ("point", self[name]) for name in self.equations.unknowns}
        about = dict(zip(("long_name", "units"), self.equations.modes.split(", "), strict=False))
        spectrum = {
            "eigenvalues": (("point", "mode"), self.eigenvalues, about),
            "stable": ("point", self.stable),
        }
        return xarray.Dataset(
            values | spectrum, {"mode": list(self.mode_names)}, {"scene": type(self.equations.scene).__name__}
        )

    def _text(self) -> str:
        known, ends = self.equations, self.ends
        least = dict(zip(known.unknowns, SHOWN * known.size, strict=True))
        names = dict.fromkeys((*known.vary, *known.unknowns))
        shown = [x for x in names if np.ptp(self[x]) > least[x] and " in piece " not in x][:8]
        lines = [
            f"Family of {known.what} of {type(known.scene).__name__}: {len(self)} points, "
            f"{int(self.stable.sum())} of them stable"
        ]
        lines += ["  " + ends[0]] if ends[0] == ends[1] else [f"  begins: {ends[0]}", f"  ends: {ends[1]}"]
        rows = [("", *shown, "modes")]
        points = [
            self.point(self.points[0], "first point"),
            *self.special,
            self.point(self.points[-1], "last point"),
        ]
        for point in points:
            values = in_digits([0.0 if abs(point[x]) < least[x] else point[x] for x in shown])
            rows.append((point.kind, *values, ", ".join(dict.fromkeys(point.modes))))
        eigenvalues = map(" ".join, zip(self.mode_names, complex_numbers(self.points[0].modes), strict=True))
        last = f"  {known.modes}, at the first point: {', '.join(eigenvalues)}"
        return "\n".join([*lines, *table(rows), last])


@of_known_numbers
@shown_from_users_lines
def family(
    scene: Scene | BuiltFor,
    guess: "State | Mapping[str, Any] | FamilyPoint | PeriodicMotion",
    *,
    until: Mapping[str, float] | None = None,
    vary: str | None = None,
    held: str | Labels = (),
    names: Labels | None = None,
    inputs: Numbers | Mapping[str, Any] | None = None,
    max_points: int = 4000,
) -> Family:
    """Return the family of steady motions through the steady motion near a guess, or a family of periodic
    motions. Steady motions satisfy `g = 0, phi = 0, dy/dt = 0, dq_j/dt = 0`; one degree of freedom remains.

        turns = jj.family(bicycle, {"rear_spin_rate": 20.0, "lean": 1e-3}, until={"lean": 1.5})
        print(turns)    # folds, branch points, changes of stability, why the curve ends
        turns["lean"], turns.eigenvalues, turns.at(lean=0.4)
        straight = jj.family(bicycle, turns.branches[0])
        orbit = jj.periodic(sleigh, guess, jnp.pi, inputs=torque)
        jj.family(sleigh, orbit, vary="drag")    # multipliers in place of eigenvalues

    **Arguments**

    - `guess`: one of: a guess of a steady motion, as in `steady`; a branch point of another family, whose
      other curve is then followed; a `PeriodicMotion` of a scene of this class, whose inputs, event and held
      quantities are then used.
    - `until`: a name and the value of it at which the curve ends. At its start, the curve has the value of
      the guess; it is followed towards the given value. Without `until` it is followed in both directions. A
      closed curve ends at its start. A curve along a parameter ends before the parameter loses its declared
      sign.
    - `vary`: a scalar parameter of the scene that changes along the curve.
    - `held`: names of coordinates and speeds that keep the value of the guess; `inputs`: as in `steady`.
    - `names`: names of the modes at the start, by ascending real part of the eigenvalue; of a pair, the one
      with the positive imaginary part comes first. Default: the scene's `mode_names` at the point farthest
      from zero (for a bicycle the fastest), or "mode 1", ...
    - `max_points`: the largest number of points in each direction.

    **Returns** a `Family`, computed by pseudo-arclength continuation. Its special points are accurate to
    round-off. Steps turn by at most 10 degrees and are at most 0.1 of the sizes of the unknowns. The size of
    a coordinate is the width of its domain, the size of a speed is 10 SI units. Two special points of the
    same kind within one step are found only if the test function is nearly a parabola between them, for
    example if they are 1 mm apart on a curve of 1 m.

    **Raises** ValueError for an unknown name, if no steady motion is near the guess, if no freedom or several
    freedoms remain (the error names quantities to hold), and for a start at a branch point; `NotLowered` if
    the scene has no scalar program; `DifferentiationModeError` inside `jit` (differentiate `steady` or
    `linearize` instead).
    """
    scene, until, held = as_scene(scene), dict(until or {}), as_names(held)
    point, varied = guess if isinstance(guess, FamilyPoint) else None, () if vary is None else (vary,)
    numbers = [name for name, value, _ in parameters_of(scene) if np.ndim(value) == 0]
    check_names(
        varied,
        numbers,
        f"`vary` names `{{}}`, expected a parameter of `{type(scene).__name__}` that is one number",
    )
    equations: Motions
    if isinstance(guess, PeriodicMotion):
        equations = OrbitEquations(scene, guess, varied, held)
    else:
        if slipping := scene.switching.contacts:
            raise ValueError(
                f"`family` supports only contacts that never slip, but `{slipping[0]}` of "
                f"`{type(scene).__name__}` may slip; remove the friction there"
            )
        t, q, u = (np.asarray(x, float) for x in guessed(scene, point.state if point else guess, 0.0))
        scene = scene.replace(**{name: point[name] for name in varied if point and name in point.values})
        equations = SteadyEquations(
            scene, (float(t), q, u), np.asarray(as_input_vector(scene, inputs), float), varied, held
        )
    targets = []
    for name, value in until.items():
        what = f"`until` of `{name}`"
        target = float(checked_known(value, what, (), advice="give the value at which the curve ends"))
        if not np.isfinite(target):
            raise ValueError(f"{what} is {value}, expected a finite number")
        targets.append((k := equations.index(name), target / equations.size[k]))
    named = [name for name in (guess if isinstance(guess, Mapping) else ()) if name in equations.unknowns]
    if point is None:
        begin = first_point(equations, named, [*until])
    elif point.kind == "branch point" and len(point.tangent) == len(equations.unknowns):
        begin = across(equations, point.tangent / equations.size)
    else:
        raise ValueError(
            f"`guess` is a point of a family ({point.kind or 'not special'}), expected a branch point of a "
            "family with the same unknowns"
        )
    points, ends = followed(equations, begin, targets, max_points)
    # the start at a branch point is omitted, so that it is found between its neighbours like any other
    labels = mode_names(scene, names, (begin if names else max(points, key=lambda p: largest(p.z))).modes)
    found = Family(equations, tuple(p for p in points if not (point and p.z is begin.z)), ends, labels)
    turning = {name: equations.index(name) for name in dict.fromkeys([*named, *until, *varied])}
    at = special(equations, found.points, turning)
    return replace(found, special=tuple(found.point(point, test.kind, test.columns) for test, point in at))
