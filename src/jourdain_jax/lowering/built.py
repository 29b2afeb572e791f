"""What is found once about a scene, as one value: the first of two phases. The second, `simulate` and its like, are functions of it, parameters and a state."""

from dataclasses import dataclass
from functools import cached_property
from itertools import chain

from jourdain_jax.build.structure import structure_of
from jourdain_jax.dynamics.power import needs_work
from jourdain_jax.equations.listed import names_of_events, names_of_invariants
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.scene.arguments import BuiltFor, as_scene
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.scene.tracebacks import shown_from_users_lines


@dataclass(frozen=True)
class Rows:
    """Which rows hold the scene, and how far they are independent."""

    names: tuple[str, ...]
    rank: int  # at generic states
    redundant: tuple[str, ...]  # may be left out together: the others keep the rank at every probed state
    may_set_in: tuple[str, ...]  # redundant at every probed state, but by no identity
    rank_losses: tuple[str, ...]  # probed configurations with fewer independent rows
    affine: bool  # linear or affine in the speeds
    homogeneous: bool  # they hold at rest


@dataclass(frozen=True)
class Freedoms:
    """Which speeds are independent, and how well they determine the others."""

    privileged: tuple[str, ...]
    dependent: tuple[str, ...]
    chosen_by_user: bool
    worst_pivot: float  # smallest singular value of the scaled A_z over all probes; 1 is best
    typical_pivot: float

    @property
    def count(self) -> int:
        """Degrees of freedom."""
        return len(self.privileged)


@dataclass(frozen=True)
class Dependence:
    """What depends on time by itself, on inputs, and what changes along the motion."""

    on_time: tuple[str, ...]  # rows, poses, inertias, coordinate rates, loads, potential
    rows_on_inputs: bool
    potentials_on_inputs: tuple[int, ...]  # numbers of the loads
    driven: bool  # bodies move while all speeds are zero
    varying_inertia: bool
    massless: bool  # nothing has inertia along some motion that the rows hold


@dataclass(frozen=True)
class Conserved:
    """What stays as it is along a motion."""

    energy: bool  # kinetic and potential energy together, without integrated work
    ignorable: tuple[str, ...]  # coordinates that no acceleration depends on; empty where there is no scalar program
    invariants: tuple[str, ...]  # as the scene states them


@dataclass(frozen=True, repr=False, eq=False)
class Built(BuiltFor, Printed):
    """What `build` found about `scene`, part by part; `simulate` and its like take it in the place of the scene. Printed as a table.

    It is pickled as its scene, and built again where it is loaded. What it says holds for the numbers of its scene and for those near them.
    """

    scene: Scene
    rows: Rows
    freedoms: Freedoms
    dependence: Dependence
    conserved: Conserved
    program: Lowered | None  # the scalar program
    not_lowered: str  # why there is none; empty where there is one
    state: str  # "minimal": coordinates and privileged speeds are integrated; "full": all speeds are
    events: tuple[str, ...]  # that stop a motion

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What the user should look at."""
        said = []
        if self.rows.rank_losses:
            said.append(f"the rows lose rank at {len(self.rows.rank_losses)} of the probed configurations, first at {self.rows.rank_losses[0]}")
        if self.rows.may_set_in:
            said.append(f"rows {', '.join(self.rows.may_set_in)} follow from the others at all probed states, but by no identity: they may set in elsewhere")
        if self.freedoms.chosen_by_user and self.state == "full":
            said.append("the privileged speeds that the scene states do not determine the others everywhere in its domain: all speeds are integrated")
        return tuple(said)

    def __reduce__(self):
        return build, (self.scene,)

    def _text(self) -> str:
        listed = lambda names: ", ".join(names) or "none"  # noqa: E731
        program = f"{self.program.operations} operations, {self.program.way}" if self.program is not None else f"none: {self.not_lowered}"
        pivots = f"pivot at least {self.freedoms.worst_pivot:.2g}, typically {self.freedoms.typical_pivot:.2g}" if self.freedoms.dependent else "no rows"
        facts = {
            "rows": f"{listed(self.rows.names)}; rank {self.rows.rank}",
            "redundant rows": listed(self.rows.redundant),
            "privileged speeds": f"{listed(self.freedoms.privileged)}; {pivots}",
            "state": self.state,
            "depends on time": listed(self.dependence.on_time),
            "energy": "conserved" if self.conserved.energy else "work is integrated beside the motion",
            "ignorable": listed(self.conserved.ignorable),
            "scalar program": program,
            "stops at": listed(self.events),
        }
        lines = [f"{type(self.scene).__name__}, built"]
        return "\n".join(chain(lines, (f"  {name:18s}{text}" for name, text in facts.items()), (f"  WARNING           {text}" for text in self.warnings)))


@shown_from_users_lines
def build(scene: Scene | BuiltFor) -> Built:
    """Everything that is found once about a scene: rank, redundant rows, privileged speeds, what depends on time, what is conserved, the scalar program.

        built = jj.build(disc)
        print(built), built.freedoms.privileged, built.program.operations
        motion = jj.simulate(built, {"lean": 0.3}, t1=5.0)

    All functions of a scene build on first use and keep what they found. `start`, `simulate`, `rollout`, `fit`, `fit_batch`, `linearize`, `steady`, `report`,
    `verify` and `lower` take what this returns in the place of `scene`; all others take its `.scene`.
    ValueError as of `structure_of`: no admissible state, no inertia along a free motion, numbers of bodies that cannot be.
    """
    scene = as_scene(scene)
    known, names = structure_of(scene), scene.speed_names.entries
    found = lowered(scene)
    program = found if isinstance(found, Lowered) else None
    return Built(
        scene=scene,
        rows=Rows(known.row_names, known.rank, known.redundant_rows, known.may_set_in, known.rank_losses, known.affine, known.homogeneous),
        freedoms=Freedoms(
            tuple(names[i] for i in known.independent),
            tuple(name for i, name in enumerate(names) if i not in known.independent),
            known.chosen_by_user,
            known.worst_pivot,
            known.typical_pivot,
        ),
        dependence=Dependence(known.timed, known.rows_of_inputs, known.potentials_of_inputs, known.driven, known.varying_inertia, known.massless),
        conserved=Conserved(not needs_work(scene, known), () if program is None else program.held, names_of_invariants(scene)),
        program=program,
        not_lowered="" if program is not None else str(found),
        state="minimal" if known.has_minimal_state else "full",
        events=names_of_events(scene),
    )
