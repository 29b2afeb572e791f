"""Report what kind of system a scene is: degrees of freedom, constraints, rank, integrability, growth vector,
cyclic and ignorable coordinates.
"""

import textwrap
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from jourdain_jax.analysis.integrability import (
    frobenius_violations,
    growth_vector,
    integrable_below,
    reachable,
)
from jourdain_jax.dynamics.accelerations import accelerations
from jourdain_jax.dynamics.reduced import cyclic_coordinates, ignorable_coordinates
from jourdain_jax.integrate.inputs import as_inputs
from jourdain_jax.integrate.own_steps import reason_against
from jourdain_jax.integrate.state import State
from jourdain_jax.kernels import ffi
from jourdain_jax.motion.model import Model, build, modelled
from jourdain_jax.motion.simulate import as_state
from jourdain_jax.scene.arguments import BuiltFor, of_known_numbers, shown_from_users_lines
from jourdain_jax.scene.coordinates import Labels
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.assembly import COORDINATE_DOMAIN, SPEED_DOMAIN
from jourdain_jax.structure.structure import structure_of

AS_IN_STRUCTURE = (
    "degrees_of_freedom",
    "rank",
    "redundant_rows",
    "rheonomic",
    "affine",
    "worst_pivot",
    "typical_pivot",
    "rank_losses",
)


@dataclass(frozen=True, repr=False)
class Report(Printed):
    """Facts about a scene, found at random and symmetric states of its domain. `print(report)` shows a table.

    Integrability of constraints, each and together: eqs. (5)-(9) and Frobenius' theorem. Privileged (that is,
    independent) velocities: (25)-(31). Cyclic coordinates: (42).

    A coordinate is cyclic if its rate is a dependent speed and no equation depends on it. A coordinate is
    ignorable if no acceleration depends on it; without constraints, every coordinate that is absent from the
    Lagrangian is ignorable.
    """

    scene: str
    coordinates: Labels
    speeds: Labels
    degrees_of_freedom: int
    rows: Labels
    rank: int  # of the constraints at generic states
    # constraints that may be omitted together without reducing the rank at any probed state
    redundant_rows: Labels
    integrable_rows: Labels  # each holonomic by itself
    nonholonomic_rows: Labels  # each nonholonomic by itself
    frobenius_violations: dict[str, float]  # relative
    growth_vector: tuple[int, ...]  # empty for constraints nonlinear in the speeds
    closed: bool  # whether further brackets add nothing
    bracket_depth: int
    holonomic_rows_together: int | None  # None if the growth vector is not closed
    rheonomic: bool  # whether anything depends explicitly on time
    depends_on_time: Labels  # which of: rows, poses, inertias, coordinate rates, loads, potential
    affine: bool  # whether constraints are linear or affine in the speeds
    cyclic_coordinates: Labels  # their rates are dependent, and no equation contains them
    ignorable_coordinates: Labels  # accelerations of the independent speeds do not depend on them
    privileged_velocities: Labels
    privileged_by_user: bool
    lowering: str  # number of operations of the scalar program and how it is integrated, or why there is none
    worst_pivot: float  # smallest singular value of the scaled A_z over all probes; zero: singular somewhere
    typical_pivot: float
    rank_losses: Labels  # probed configurations at which the constraints lose rank
    # at the given start, or at the scene's example if its rank differs; otherwise None
    rank_at_start: int | None
    events: Labels  # names
    domain: dict[str, tuple[float, float]]  # of the probed states, as declared by the scene
    conventions: str

    def as_dict(self) -> "dict[str, Any]":
        """Return the fields by name, as plain data. None replaces infinite values."""
        facts = {
            key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()
        }
        facts["domain"] = {name: list(bounds) for name, bounds in self.domain.items()}
        facts["frobenius_violations"] = {
            row: size if size < float("inf") else None for row, size in self.frobenius_violations.items()
        }
        return facts

    def _text(self) -> str:
        facts = {
            "coordinates": _listed(self.coordinates),
            "speeds": _listed(self.speeds),
            "rows": f"{len(self.rows)}, of rank {self.rank}" if self.rows else "none",
            "degrees of freedom": str(self.degrees_of_freedom),
            "redundant rows": (
                _listed(self.redundant_rows) if self.redundant_rows else self._no_redundant_rows()
            ),
            "holonomic row by row": _listed(self.integrable_rows),
            "nonholonomic row by row": _listed(self.nonholonomic_rows),
            "growth vector": self._growth(),
            "depends on time": (
                f"yes (rheonomic): {', '.join(self.depends_on_time)}"
                if self.rheonomic
                else "no (scleronomic)"
            ),
            "cyclic coordinates": _listed(self.cyclic_coordinates),
            "ignorable coordinates": _listed(self.ignorable_coordinates),
            "privileged velocities": _listed(self.privileged_velocities),
            "chosen by": "the scene" if self.privileged_by_user else "the engine",
            "lowered to": self.lowering,
            "their conditioning": self._conditioning(),
            "rank is lost at": (
                "none of the probed configurations"
                if not self.rank_losses
                else "; ".join(self.rank_losses[:4])
            ),
            **({} if self.rank_at_start is None else {"at the start": self._at_start()}),
            "events": _listed(self.events),
            "probed in": self._probed(),
            "conventions": self.conventions,
        }
        lines = [f"Report on {self.scene}"]
        for label, fact in facts.items():
            first, *more = textwrap.wrap(fact, 94, break_long_words=False, break_on_hyphens=False) or [""]
            lines += [f"  {label:<24}{first}", *(" " * 26 + line for line in more)]
        return "\n".join(lines)

    def _no_redundant_rows(self) -> str:
        if self.rank < len(self.rows):
            return (
                f"{len(self.rows) - self.rank} at each configuration, but not the same everywhere: none"
                " may be omitted"
            )
        return "none"

    def _at_start(self) -> str:
        if self.rank_at_start == self.rank:
            return f"rank {self.rank}, as at generic states"
        freedoms = len(self.speeds) - (self.rank_at_start or 0)
        return (
            f"WARNING: rank {self.rank_at_start}, not {self.rank} as at generic states, and {freedoms} "
            "degrees of freedom: a singular configuration, or another way to assemble the scene; declare a "
            "`domain` around the start to find out"
        )

    def _growth(self) -> str:
        if not self.growth_vector:
            return "none: rows are nonlinear in the speeds"
        sizes = f"({', '.join(map(str, self.growth_vector))})"
        if self.degrees_of_freedom == 0:
            return f"{sizes}, no freedom left"
        if not self.closed:
            return f"{sizes}, still growing at brackets of {self.bracket_depth} fields"
        count = self.holonomic_rows_together
        together = f"rows that are holonomic taken together: {count or 'none'}; " if self.rows else ""
        return (
            f"{sizes}, closed; {together}the motion stays on a manifold of dimension {self.growth_vector[-1]}"
        )

    def _probed(self) -> str:
        stated = ", ".join(f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in self.domain.items())
        rest = (
            ""
            if set(self.domain) >= {*self.coordinates, *self.speeds}
            else f"coordinates {_span(COORDINATE_DOMAIN)}, speeds {_span(SPEED_DOMAIN)}"
        )
        return f"{stated}; otherwise {rest}" if stated and rest else stated or rest

    def _conditioning(self) -> str:
        if self.degrees_of_freedom == 0:
            return "nothing to choose, no freedom left"
        worst = (
            f"smallest pivot {self.worst_pivot:.2g}"
            if self.worst_pivot > 1e-9
            else "singular at some probed configuration"
        )
        return f"{worst}, typically {self.typical_pivot:.2g} (1 is best)"


@shown_from_users_lines
@of_known_numbers
def report(
    scene: Scene | BuiltFor, *, depth: int = 4, start: "State | Mapping[str, Any] | None" = None
) -> Report:
    """Report degrees of freedom, constraints, rank, redundancy, integrability, growth vector, cyclic and
    ignorable coordinates of a scene.

    `depth`: largest number of vector fields in a Lie bracket of the growth vector. `start`: a state, or named
    values as for `jj.start`, whose rank is compared with that of generic states (default: the scene's
    example, if some configurations lose rank). `print(report(scene))` shows a table; `as_dict()` returns
    plain data.

    All properties are found numerically, at random states of the scene's `domain` and at symmetric
    configurations (zero and right angles). A property that holds at all of them is reported as general.
    Raises DifferentiationModeError for traced numbers.
    """
    built = build(scene)
    scene, structure = built.scene, structure_of(built.scene)
    violations, (growth, closed) = frobenius_violations(scene), growth_vector(scene, depth)
    by_itself = {name: size <= integrable_below() for name, size in violations.items()}
    asked = scene.example if start is None and structure.rank_losses and scene.example else start
    if asked is None:
        rank_at_start = None
    else:
        state = as_state(scene, asked)
        rank_at_start = int(accelerations(scene, state.t, state.q, state.u, reduction="svd").rank)
    return Report(
        scene=type(scene).__name__,
        coordinates=scene.coordinate_names.entries,
        speeds=scene.speed_names.entries,
        rows=structure.row_names,
        **{name: getattr(structure, name) for name in AS_IN_STRUCTURE},
        integrable_rows=tuple(name for name, is_so in by_itself.items() if is_so),
        nonholonomic_rows=tuple(name for name, is_so in by_itself.items() if not is_so),
        frobenius_violations=violations,
        growth_vector=growth,
        closed=closed,
        bracket_depth=depth,
        # dependencies built into the coordinate rates are not constraints
        holonomic_rows_together=min(reachable(scene) - growth[-1], structure.rank) if closed else None,
        depends_on_time=structure.timed,
        cyclic_coordinates=cyclic_coordinates(scene),
        ignorable_coordinates=ignorable_coordinates(scene),
        privileged_velocities=tuple(scene.speed_names.entries[i] for i in structure.independent),
        privileged_by_user=structure.chosen_by_user,
        lowering=_lowering(built),
        rank_at_start=None if start is None and rank_at_start == structure.rank else rank_at_start,
        events=built.events,
        domain={name: (float(low), float(high)) for name, (low, high) in scene.domain.items()},
        conventions=scene.conventions,
    )


def _span(bounds: tuple[float, float]) -> str:
    return f"{bounds[0]:.4g} to {bounds[1]:.4g}"


def _listed(names: Labels) -> str:
    return f"{len(names)}: {', '.join(names)}" if names else "none"


def _lowering(built: Model) -> str:
    found = built.program
    if found is None:
        return f"not lowered: {built.not_lowered}"
    calls = "".join(f"; {reason} has no scalar form: kept as a call" for reason in found.calls)
    reason = reason_against(
        modelled(built.scene).field(), built.scene, as_inputs(built.scene, None), bool(built.events)
    )
    where = f"not to machine code: {reason}" if reason else f"to machine code{ffi.devices()}"
    return f"a scalar program of {found.operations} operations{calls}; {where}"
