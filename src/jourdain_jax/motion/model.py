"""Models: scenes with the choices made by `build`. `simulate` and other functions accept them as scenes."""

from collections.abc import Callable, Hashable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax

from jourdain_jax.calculus.files import FilePath
from jourdain_jax.dynamics.reactions import needs_work
from jourdain_jax.equations.rows import names_of_events, names_of_invariants
from jourdain_jax.integrate.constraint_projection import Usual, usual_sizes
from jourdain_jax.integrate.inputs import Inputs, as_inputs
from jourdain_jax.integrate.own_steps import reason_against
from jourdain_jax.integrate.vector_fields.field import Formulation, VectorField, as_formulation
from jourdain_jax.kernels import ffi
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered_equations import Lowered, NotLowered
from jourdain_jax.motion import model_file
from jourdain_jax.motion.check import warn_of_mistakes
from jourdain_jax.motion.facts import Conserved, Dependence, Freedoms, Rows
from jourdain_jax.motion.field_choice import vector_field_of
from jourdain_jax.motion.options import bytes_of
from jourdain_jax.scene.arguments import BuiltFor, as_scene, shown_from_users_lines
from jourdain_jax.scene.coordinates import Labels, Sentences
from jourdain_jax.scene.identity import found_before, once_per_values
from jourdain_jax.scene.printing import Printed
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.probes import coordinates_on_rows
from jourdain_jax.structure.row_program import row_program
from jourdain_jax.structure.structure import (
    Reference,
    Structure,
    check_bodies,
    is_judged,
    structure_of,
    structure_whatever_its_faults,
)


@dataclass(frozen=True, repr=False, eq=False)
class Model(BuiltFor, Printed):
    """Scene with the choices that `build` made for its integration. Prints as a table.

    A model is a pytree whose leaves are the parameters of `scene`. `model.replace(radius=r)` changes
    parameters and keeps the state and the backend. If JAX traces `r`, the new model also keeps all choices
    that depend on parameter values. Pickling stores the scene; loading builds the model again.
    """

    scene: Scene
    formulation: Formulation  # with a decided state, if returned by `build`
    backend: str  # argument of `build`
    decided: Reference | None  # scene that the choices are based on; None: `scene`, class defaults if traced
    memory: int | None = None  # limit in bytes for batches of motions and for the records of reverse mode
    made: Any = None  # vector fields and constraint sizes by case, cached by `modelled`

    def replace(self, **parameters: Any) -> "Model":
        """Return the model with new values of the named parameters."""
        return replace(self, scene=self.scene.replace(**parameters), made=None)

    @property
    def reference(self) -> Reference:
        """Return the scene whose parameter values replace traced ones."""
        return self.decided or Reference(self.scene)

    @property
    def standing_in(self) -> AbstractContextManager:
        """Return a context in which the parameters of `decided`, if any, replace traced ones."""
        return nullcontext() if self.decided is None else self.decided.stands_in()

    @property
    def structure(self) -> Structure:
        """Return the structure found by probing."""
        return structure_of(self.scene if self.decided is None else self.decided.scene)

    def field(self, constant: bool = True, work: bool = True) -> VectorField:
        """Return the vector field. `constant`: inputs are constant; `work`: integrate the work of loads."""
        choice = self.scene, self.formulation, self.backend
        return self.once((constant, work), lambda: vector_field_of(*choice, constant, work))

    def usual(self, determined: bool) -> Usual:
        """Return typical sizes for projections. `determined`: constraints determine the free speeds."""

        def sizes() -> Usual:
            # outside `ensure_compile_time_eval`, which would evaluate the traces made here
            found = usual_sizes(self.scene, determined, self.backend in ("auto", "native"))
            with jax.ensure_compile_time_eval():
                # a JAX array is passed to programs five times faster than a NumPy array
                return jax.device_put(found)

        return self.once(determined, sizes)

    def inputs(self, given: Any) -> Inputs:
        """Return inputs given by name; the default is cached."""
        if given is None:
            return self.once("inputs at rest", lambda: as_inputs(self.scene, None))
        return as_inputs(self.scene, given)

    def once(self, case: Hashable, make: Callable[[], Any]) -> Any:
        """Return the result of `make`, computed once per case and parameter values."""
        if self.made is None:
            return modelled(self).once(case, make)
        if case not in self.made:
            with self.standing_in:
                self.made[case] = make()
        return self.made[case]

    @property
    def state(self) -> str:
        """Return the integrated state: "minimal" (independent speeds) or "full" (all speeds)."""
        return self.formulation.state

    @property
    def rows(self) -> Rows:
        """Return the constraints of the scene: names, rank, redundant ones."""
        known = self.structure
        return Rows(
            known.row_names,
            known.rank,
            known.redundant_rows,
            known.may_set_in,
            known.rank_losses,
            known.affine,
            known.homogeneous,
        )

    @property
    def freedoms(self) -> Freedoms:
        """Return the independent speeds."""
        known, names = self.structure, self.scene.speed_names.entries
        dependent = tuple(name for i, name in enumerate(names) if i not in known.independent)
        independent = tuple(names[i] for i in known.independent)
        pivots = known.worst_pivot, known.typical_pivot
        return Freedoms(independent, dependent, known.chosen_by_user, *pivots)

    @property
    def dependence(self) -> Dependence:
        """Return the quantities that depend on time, and those that change along the motion."""
        known = self.structure
        return Dependence(known.timed, known.driven, known.varying_inertia, known.massless)

    @property
    def conserved(self) -> Conserved:
        """Return the conserved quantities of a motion."""
        held = () if self.program is None else self.program.held
        return Conserved(
            not needs_work(self.reference.scene, self.structure), held, names_of_invariants(self.scene)
        )

    @property
    def program(self) -> Lowered | None:
        """Return the scalar program; None if there is none."""
        found = self._lowered
        return found if isinstance(found, Lowered) else None

    @property
    def not_lowered(self) -> str:
        """Return why there is no scalar program; empty if there is one."""
        found = self._lowered
        return "" if isinstance(found, Lowered) else str(found)

    @property
    def _lowered(self) -> Lowered | NotLowered:
        return lowered(self.reference.scene, every_speed=self.state == "full")

    @property
    def events(self) -> Labels:
        """Return the names of the events."""
        return names_of_events(self.scene)

    @property
    def way(self) -> str:
        """Return which backend integrates the scene with constant inputs, and why no faster one can."""
        scene, field = self.reference.scene, self.field()
        if field.lowered is None:
            return f"dense matrices: {self.not_lowered or 'as requested'}"
        reason = (
            "as requested"
            if self.backend == "xla"
            else reason_against(field, scene, as_inputs(scene, None), bool(self.events))
        )
        return f"XLA: {reason}" if reason else f"machine code{ffi.devices()}"

    @property
    def warnings(self) -> Sentences:
        """Return sentences on points to check."""
        said, rows = [], self.rows
        if rows.rank_losses:
            said.append(
                f"constraints lose rank at {len(rows.rank_losses)} of the probed configurations, "
                f"first at {rows.rank_losses[0]}"
            )
        if rows.may_set_in:
            said.append(
                f"constraints {', '.join(rows.may_set_in)} are redundant at all probed states, but "
                "may become independent elsewhere"
            )
        if self.structure.chosen_by_user and self.state == "full":
            said.append(
                "the scene's `privileged` speeds do not determine the others everywhere in its domain, "
                "so all speeds are integrated"
            )
        if self.structure.decisions != _decisions_where_traced(self.reference.scene):
            said.append(
                "class defaults, which replace parameters traced by JAX, would lead to other choices; under "
                "`jit` and derivatives use `model.replace(...)`, which keeps the choices of this model"
            )
        return tuple(said)

    def save(self, path: FilePath) -> None:
        """Write the results of `build` to the file `path`, for `jj.load_model`.

        Raises ValueError for a model with its own reduction or stabilisation, or with parts that remain JAX
        calls.
        """
        scene, formulation = self.reference.scene, self.formulation
        if formulation.reduction is not None or formulation.baumgarte is not None:
            raise ValueError(
                "a model with its own reduction or stabilisation cannot be saved; build it again instead"
            )
        how = {
            "state": formulation.state,
            "projects": formulation.projects,
            "backend": self.backend,
            "memory": self.memory,
        }
        every = self.state == "full"
        found: dict[Hashable, Any] = {
            ("_structure",): self.structure,
            ("_lowered", every or not self.structure.row_names): lowered(scene, every),
        }
        found |= {("coordinates_on_rows",): coordinates_on_rows(scene), ("row_program",): row_program(scene)}
        model_file.write(
            path, scene, how, {what: x for what, x in found.items() if not isinstance(x, NotLowered)}
        )

    def __reduce__(self):
        return build, (self.scene, self.formulation, self.backend, self.memory)

    def _text(self) -> str:
        listed = lambda names: ", ".join(names) or "none"
        freedoms, program, rows = self.freedoms, self.program, self.rows
        pivots = (
            f"pivot at least {freedoms.worst_pivot:.2g}, typically {freedoms.typical_pivot:.2g}"
            if freedoms.dependent
            else "no rows"
        )
        facts = {
            "rows": f"{listed(rows.names)}; rank {rows.rank}",
            "redundant rows": listed(rows.redundant),
            "privileged speeds": f"{listed(freedoms.privileged)}; {pivots}",
            "state": f"{self.state}: {self._why_state()}",
            "depends on time": listed(self.dependence.on_time),
            "energy": "conserved" if self.conserved.energy else "work is integrated along with the motion",
            "ignorable": listed(self.conserved.ignorable),
            "scalar program": (
                f"none: {self.not_lowered}"
                if program is None
                else f"{program.operations} operations, {program.way}"
            ),
            "integrated by": self.way,
            "events": listed(self.events),
        }
        warned = [f"  WARNING           {text}" for text in self.warnings]
        return "\n".join(
            [
                f"Model of {type(self.scene).__name__}",
                *(f"  {name:18s}{text}" for name, text in facts.items()),
                *warned,
            ]
        )

    def _why_state(self) -> str:
        known = self.structure
        if (self.state == "minimal") != known.has_minimal_state:
            return "as requested"
        if self.state == "minimal":
            return "independent speeds determine the others over the domain"
        if known.affine:
            return "independent speeds do not determine the others over the whole domain"
        return "constraints are nonlinear in the speeds"


def _decisions_where_traced(scene: Scene) -> tuple:
    """Return the decisions that `build` would make if JAX traced all parameters of the scene."""
    found: list[tuple] = []
    jax.eval_shape(lambda scene: found.append(structure_whatever_its_faults(scene).decisions), scene)
    return found[0]


def _flattened(model: Model) -> tuple[tuple, tuple]:
    arrays, rest = eqx.partition(model.formulation, eqx.is_array)
    return (model.scene, arrays), (rest, model.backend, model.decided, model.memory)


def _unflattened(static: tuple, children: tuple) -> Model:
    model = object.__new__(Model)  # JAX may pass placeholders instead of numbers
    (scene, arrays), (formulation, backend, decided, memory) = children, static
    vars(model).update(
        scene=scene,
        formulation=eqx.combine(arrays, formulation),
        backend=backend,
        decided=decided,
        memory=memory,
        made=None,
    )
    return model


jax.tree_util.register_pytree_node(Model, _flattened, _unflattened)


@shown_from_users_lines
def build(
    scene: Scene | BuiltFor,
    formulation: Formulation | None = None,
    backend: str = "auto",
    memory: int | float | str | None = None,
) -> Model:
    """Decide once how motions of a scene are integrated: rank, redundant constraints, independent speeds,
    time dependence, conserved quantities, the state, the scalar program, the backend.

        model = jj.build(disc)
        print(model), model.freedoms.privileged, model.program.operations
        motion = jj.simulate(model, {"lean": 0.3}, t1=5.0)
        slope = jax.grad(lambda r: jj.simulate(model.replace(radius=r), {"lean": 0.3}, t1=5.0).q_end[0])(0.5)

    `formulation`, `backend`: as for `simulate`. `memory`: a limit in bytes, or a text such as "2GB", for the
    chunks of a `rollout` and the records of reverse mode (default: 4 GiB) and, if given, for the processes of
    a `Study`. Functions that take a scene build it on first use and cache the result. `start`, `simulate`,
    `rollout`, `fit`, `fit_batch`, `linearize`, `steady`, `report`, `verify`, `lower` and `Study` accept the
    model instead of `scene`; pass its `.scene` to others. The first call for a class warns of the findings of
    `check`, if any. Raises ValueError if the scene has no admissible state, no inertia along a free motion or
    impossible bodies, or if formulation or backend do not suit the scene.
    """
    scene = as_scene(scene)
    model = modelled(scene, formulation, backend)
    model.once("possible", lambda: check_bodies(scene))  # raises an error for an invalid scene
    model.once("judged", lambda: is_judged(scene)), model.usual(False), model.usual(True), model.way
    formulation = replace(model.formulation, state="full" if model.field().independent is None else "minimal")
    settled = Model(
        scene, formulation, backend, Reference(scene), None if memory is None else bytes_of(memory)
    )
    modelled(settled).made.update(model.made)
    if backend != "dense" and formulation.reduction is None:  # dense matrices need no program to compare
        warn_of_mistakes(settled.reference.scene, settled.state == "full")
    return settled


def load_model(path: FilePath, scene: Scene) -> Model:
    """Load the model of a scene from the file `path` that `Model.save` wrote, without tracing, probing or
    lowering.

        jj.build(bicycle).save("bicycle.model")
        model = jj.load_model("bicycle.model", bicycle)

    `scene`: a scene with the class, methods and parameter values of the saved one. Loading executes no code,
    but the file determines the integrated equations, so load only files you trust. Raises ValueError if the
    file is damaged or belongs to another scene, version or precision.
    """
    found, how = model_file.read(path, as_scene(scene))
    formulation = Formulation(how["state"], stabilisation="projection" if how["projects"] else None)
    with found_before(found):
        return build(scene, formulation, how["backend"], how["memory"])


def modelled(scene: Scene | BuiltFor, formulation: Formulation | None = None, backend: str = "auto") -> Model:
    """Return a model of the scene with this formulation and backend, and the choices cached for its parameter
    values. A model keeps its own formulation and backend unless a formulation is given.
    """
    decided = memory = None
    if isinstance(scene, Model):
        if formulation is None:
            formulation, backend = scene.formulation, scene.backend
        if scene.made is not None and formulation is scene.formulation and backend == scene.backend:
            return scene
        decided, memory, scene = scene.decided, scene.memory, scene.scene
    asked, scene = as_formulation(formulation), as_scene(scene)
    stabilisation = asked.stabilisation
    in_words = isinstance(stabilisation, str | None) and isinstance(backend, str) and asked.reduction is None
    made = _kept(scene, asked.state, stabilisation, backend) if in_words else {}
    return Model(scene, asked, backend, decided, memory, made)


def _nothing_yet(scene: Scene, *words) -> dict:
    return {}


_kept = once_per_values(_nothing_yet, of_traced=_nothing_yet)
