"""Models: scenes with the choices that `build` made for their motions. `simulate` and its kin take a model in place of a scene."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax

from jourdain_jax.build.reference import Reference
from jourdain_jax.build.structure import Structure, structure_of, structure_whatever_its_faults
from jourdain_jax.dynamics.power import needs_work
from jourdain_jax.equations.listed import names_of_events, names_of_invariants
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.motion.inputs import as_inputs
from jourdain_jax.motion.native import native_motion
from jourdain_jax.motion.vector_fields.choice import Formulation, as_formulation, vector_field
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
class Model(BuiltFor, Printed):
    """A scene with how its motions are integrated, made by `build`. Printed as a table.

    It is a tree whose leaves are the parameters of `scene`. `model.replace(radius=r)` has other parameters and keeps the state, the backend, and, where `r`
    is traced by JAX, all choices that numbers decided. It is pickled as its scene, and built again where it is loaded.
    """

    scene: Scene
    formulation: Formulation  # its state is settled
    backend: str  # the argument of `build`
    reference: Reference  # the scene whose numbers decided

    def replace(self, **parameters) -> "Model":
        """Return the model with other values of the parameters named."""
        return replace(self, scene=self.scene.replace(**parameters))

    @property
    def structure(self) -> Structure:
        """The findings of probing."""
        return structure_of(self.reference.scene)

    @property
    def state(self) -> str:
        """What is integrated: "minimal", coordinates and privileged speeds, or "full", all speeds."""
        return self.formulation.state

    @property
    def rows(self) -> Rows:
        """Which rows hold the scene."""
        known = self.structure
        return Rows(known.row_names, known.rank, known.redundant_rows, known.may_set_in, known.rank_losses, known.affine, known.homogeneous)

    @property
    def freedoms(self) -> Freedoms:
        """Which speeds are independent."""
        known, names = self.structure, self.scene.speed_names.entries
        dependent = tuple(name for i, name in enumerate(names) if i not in known.independent)
        return Freedoms(tuple(names[i] for i in known.independent), dependent, known.chosen_by_user, known.worst_pivot, known.typical_pivot)

    @property
    def dependence(self) -> Dependence:
        """What depends on time, inputs and the motion."""
        known = self.structure
        return Dependence(known.timed, known.rows_of_inputs, known.potentials_of_inputs, known.driven, known.varying_inertia, known.massless)

    @property
    def conserved(self) -> Conserved:
        """What stays as it is along a motion."""
        held = () if self.program is None else self.program.held
        return Conserved(not needs_work(self.reference.scene, self.structure), held, names_of_invariants(self.scene))

    @property
    def program(self) -> Lowered | None:
        """The scalar program; None where there is none."""
        found = lowered(self.reference.scene, every_speed=self.state == "full")
        return found if isinstance(found, Lowered) else None

    @property
    def not_lowered(self) -> str:
        """Why there is no scalar program; empty where there is one."""
        found = lowered(self.reference.scene, every_speed=self.state == "full")
        return "" if isinstance(found, Lowered) else str(found)

    @property
    def events(self) -> tuple[str, ...]:
        """Names of the events that stop a motion."""
        return names_of_events(self.scene)

    @property
    def way(self) -> str:
        """How motions with constant inputs are integrated, machine code, XLA or dense matrices, and why no faster way serves."""
        scene = self.reference.scene
        field = vector_field(scene, self.formulation, backend=self.backend)
        if field.lowered is None:
            return f"dense matrices: {self.not_lowered or 'as asked'}"
        reason = "as asked" if self.backend == "xla" else native_motion.reason_against(field, scene, as_inputs(scene, None), bool(self.events))
        return f"XLA: {reason}" if reason else "machine code"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on what to look at."""
        said, rows = [], self.rows
        if rows.rank_losses:
            said.append(f"the rows lose rank at {len(rows.rank_losses)} of the probed configurations, first at {rows.rank_losses[0]}")
        if rows.may_set_in:
            said.append(f"rows {', '.join(rows.may_set_in)} follow from the others at all probed states, but by no identity: they may set in elsewhere")
        if self.structure.chosen_by_user and self.state == "full":
            said.append("the privileged speeds that the scene states do not determine the others everywhere in its domain: all speeds are integrated")
        if self.structure.decisions != _decisions_where_traced(self.reference.scene):
            said.append(
                "numbers near the class's defaults, which stand in for parameters that JAX traces, lead to other choices; "
                "under `jit` and derivatives take `model.replace(...)`, which keeps those of this model"
            )
        return tuple(said)

    def __reduce__(self):
        return build, (self.scene, self.formulation, self.backend)

    def _text(self) -> str:
        listed = lambda names: ", ".join(names) or "none"  # noqa: E731
        freedoms, program, rows = self.freedoms, self.program, self.rows
        pivots = f"pivot at least {freedoms.worst_pivot:.2g}, typically {freedoms.typical_pivot:.2g}" if freedoms.dependent else "no rows"
        facts = {
            "rows": f"{listed(rows.names)}; rank {rows.rank}",
            "redundant rows": listed(rows.redundant),
            "privileged speeds": f"{listed(freedoms.privileged)}; {pivots}",
            "state": f"{self.state}: {self._why_state()}",
            "depends on time": listed(self.dependence.on_time),
            "energy": "conserved" if self.conserved.energy else "work is integrated beside the motion",
            "ignorable": listed(self.conserved.ignorable),
            "scalar program": f"none: {self.not_lowered}" if program is None else f"{program.operations} operations, {program.way}",
            "integrated by": self.way,
            "stops at": listed(self.events),
        }
        warned = [f"  WARNING           {text}" for text in self.warnings]
        return "\n".join([f"Model of {type(self.scene).__name__}", *(f"  {name:18s}{text}" for name, text in facts.items()), *warned])

    def _why_state(self) -> str:
        known = self.structure
        if (self.state == "minimal") != known.has_minimal_state:
            return "as asked"
        if self.state == "minimal":
            return "privileged speeds determine the others over the domain"
        return "privileged speeds do not determine the others over the whole domain" if known.affine else "rows are nonlinear in the speeds"


def _decisions_where_traced(scene: Scene) -> tuple:
    """Return what decides about a scene all of whose parameters JAX traces."""
    found: list[tuple] = []
    jax.eval_shape(lambda scene: found.append(structure_whatever_its_faults(scene).decisions), scene)
    return found[0]


def _flattened(model: Model) -> tuple[tuple, tuple]:
    arrays, rest = eqx.partition(model.formulation, eqx.is_array)
    return (model.scene, arrays), (rest, model.backend, model.reference)


def _unflattened(static: tuple, children: tuple) -> Model:
    model = object.__new__(Model)  # anything may stand in the place of numbers
    (scene, arrays), (formulation, backend, reference) = children, static
    vars(model).update(scene=scene, formulation=eqx.combine(arrays, formulation), backend=backend, reference=reference)
    return model


jax.tree_util.register_pytree_node(Model, _flattened, _unflattened)


@shown_from_users_lines
def build(scene: Scene | BuiltFor, formulation: Formulation | None = None, backend: str = "auto") -> Model:
    """Settle once how motions of a scene are integrated: rank, redundant rows, privileged speeds, what depends on time, what is conserved, the state,
    the scalar program, the backend.

        model = jj.build(disc)
        print(model), model.freedoms.privileged, model.program.operations
        motion = jj.simulate(model, {"lean": 0.3}, t1=5.0)
        slope = jax.grad(lambda r: jj.simulate(model.replace(radius=r), {"lean": 0.3}, t1=5.0).q_end[0])(0.5)

    `formulation`, `backend`: as of `simulate`. All functions of a scene build on first use and keep what they found. `start`, `simulate`, `rollout`, `fit`,
    `fit_batch`, `linearize`, `steady`, `report`, `verify` and `lower` take what this returns in the place of `scene`; all others take its `.scene`.
    ValueError as of `structure_of` (no admissible state, no inertia along a free motion, numbers of bodies that cannot be), and where the formulation or
    the backend does not serve the scene.
    """
    scene, asked = as_scene(scene), as_formulation(formulation)
    structure_of(scene)  # says what is wrong
    field = vector_field(scene, asked, backend=backend)
    return Model(scene, replace(asked, state="full" if field.independent is None else "minimal"), backend, Reference(scene))
