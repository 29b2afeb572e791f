"""Which equations are integrated, given what was asked: the form of the state, how accelerations are found, what keeps the state on its constraints."""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp

from jourdain_jax.build.reference_parameters import once_per_values
from jourdain_jax.build.structure import WELL_CONDITIONED, Structure, structure_of, trust
from jourdain_jax.build.usual_lengths import usual_lengths
from jourdain_jax.calculus.pseudo_inverse import passing_cutoff, undecided
from jourdain_jax.calculus.reals import described
from jourdain_jax.dynamics.accelerations import Baumgarte, as_reduction
from jourdain_jax.dynamics.power import needs_work
from jourdain_jax.equations.gibbs_appell import GibbsAppell
from jourdain_jax.equations.listed import names_of_events, names_of_position_rows
from jourdain_jax.equations.reductions import Multipliers, NullSpaceQR, Privileged, Reduction
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered import Lowered
from jourdain_jax.motion.inputs import Inputs, as_inputs
from jourdain_jax.motion.vector_fields.by_matrices import FullByMatrices, MinimalByMatrices
from jourdain_jax.motion.vector_fields.by_program import ByProgram
from jourdain_jax.motion.vector_fields.field import VectorField
from jourdain_jax.scene.names import nearest
from jourdain_jax.scene.scene import Scene

_STATES = ("auto", "minimal", "full")
_BACKENDS = ("auto", "native", "xla", "dense")


class Formulation(eqx.Module):
    """Which equations `simulate` integrates. The default takes what serves the scene.

    - `state`: "minimal", coordinates q and privileged speeds y; "full", coordinates and all speeds u; "auto" (default), the minimal one where the
      privileged speeds are well conditioned over the scene's domain and the rows are linear or affine.
    - `reduction`: how accelerations are found, a name or an object as in `accelerations` (default: the scene's scalar program where there is one).
    - `stabilisation`: what keeps the state on rows that its form does not keep by itself, the start included: "projection" (default) puts it back after
      each step; `jj.Baumgarte(alpha, beta)` adds its terms to the rows, for comparison; None leaves it alone.

    ValueError for anything else.

    **Examples**

        rods = jj.models.DoublePendulumRods()
        dense = jj.Formulation("full", reduction="kkt")                # all speeds, multipliers from one linear system
        motion = jj.simulate(rods, t1=0.2, formulation=dense)
        print(motion.state_form, motion.reduction)
    """

    state: Literal["auto", "minimal", "full"] = eqx.field(static=True, default="auto")
    reduction: Reduction | GibbsAppell | str | None = None
    stabilisation: Baumgarte | Literal["projection"] | None = "projection"

    def __check_init__(self) -> None:
        if self.state not in _STATES:
            raise ValueError(f"unknown state form `{self.state}`; {nearest(str(self.state), _STATES)}")
        stabilisation = self.stabilisation
        if not (stabilisation is None or isinstance(stabilisation, Baumgarte) or (isinstance(stabilisation, str) and stabilisation == "projection")):
            raise ValueError(f'`stabilisation` is {described(stabilisation)}, expected "projection", `jj.Baumgarte(alpha, beta)` or None')

    @property
    def projects(self) -> bool:
        """Whether the state is put back onto the constraints after each step."""
        return isinstance(self.stabilisation, str)

    @property
    def baumgarte(self) -> Baumgarte | None:
        """The terms added to the rows; None where there are none."""
        return self.stabilisation if isinstance(self.stabilisation, Baumgarte) else None


_DEFAULT = Formulation()


def as_formulation(formulation) -> Formulation:
    """The formulation, the default one for None; ValueError for anything else."""
    if formulation is None:
        return _DEFAULT
    if not isinstance(formulation, Formulation):
        raise ValueError(f"`formulation` is {described(formulation)}, expected `jj.Formulation(state, reduction, stabilisation)` or None")
    return formulation


def vector_field(scene: Scene, formulation: Formulation | None = None, work: bool = True, backend: str = "auto", inputs=None) -> VectorField:
    """What is integrated of a scene; the arguments are those of `simulate`."""
    formulation, constant = as_formulation(formulation), (inputs if isinstance(inputs, Inputs) else as_inputs(scene, inputs)).constant
    stabilisation = formulation.stabilisation
    if formulation.reduction is None and not isinstance(stabilisation, Baumgarte) and isinstance(backend, str):
        return _once(scene, formulation.state, stabilisation, work, backend, constant)
    return _vector_field(scene, formulation, work, backend, constant)


def _vector_field(scene: Scene, formulation: Formulation, work: bool, backend: str, constant: bool) -> VectorField:
    structure, state, reduction = structure_of(scene), formulation.state, formulation.reduction
    _check(scene, structure, state, backend)
    minimal = state == "minimal" or (state == "auto" and structure.has_minimal_state)
    independent = structure.independent if minimal else None
    inputs_in_rows = structure.rows_of_inputs and not constant
    conserves = not needs_work(scene, structure)
    with_work = work and not conserves
    program = _program(scene, minimal, backend, formulation, reason_for_matrices(structure, constant))
    cutoff = _cutoff(structure) if reduction is None and not minimal else None
    reduction = as_reduction(scene, _default_reduction(structure, independent, program) if reduction is None else reduction)
    common: dict[str, Any] = {
        "independent": independent,
        "reduction": reduction,
        "with_work": with_work,
        "conserves": conserves,
        "projects_positions": formulation.projects and bool(names_of_position_rows(scene) or scene.coordinates.quaternions),
        "projects_speeds": formulation.projects and not minimal and bool(structure.row_names),
        "rows_may_contradict": (minimal or formulation.projects) and structure.rows_may_contradict,
        "of_inputs": structure.potentials_of_inputs,
        "event_names": names_of_events(scene),
    }
    if program is not None:
        return ByProgram(**common, program=program, affine=structure.affine)
    nonlinear = () if structure.affine or structure.dependent_rows else structure.kept_rows
    common |= {"stabilisation": formulation.baumgarte, "usual": usual_lengths(scene), "inputs_in_rows": inputs_in_rows, "nonlinear_rows": nonlinear}
    common["cutoff"] = cutoff
    if minimal:
        return MinimalByMatrices(**common, rows=structure.kept_rows)
    loses_rank = bool(names_of_position_rows(scene)) or not structure.affine
    branches = cutoff is not None and isinstance(reduction, NullSpaceQR) and loses_rank
    known = 1.0 if structure.affine else trust(scene)  # how far usual sizes are; where not, nonlinear rows count as long a thousand times longer
    return FullByMatrices(**common, undecided=undecided(jnp.result_type(float)) / known if branches else None)


def reason_for_matrices(structure: Structure, constant: bool) -> str:
    """Why dense matrices are integrated also of a scene with a scalar program, in words; empty where that serves. `constant`: all inputs are."""
    if structure.rows_of_inputs and not constant:
        return "velocity rows with inputs that change with time need dense matrices"
    return ""


def _without_parts(scene: Scene, state, stabilisation, work: bool, backend: str, constant: bool) -> VectorField:
    """As `_vector_field`, for a formulation that is texts alone: these are compared in no time."""
    return _vector_field(scene, Formulation(state, None, stabilisation), work, backend, constant)


_once = once_per_values(_without_parts, of_traced=_without_parts)


def _program(scene: Scene, minimal: bool, backend: str, formulation: Formulation, dense: str) -> Lowered | None:
    """The scalar program that is integrated; None: dense matrices are. ValueError where a backend asks for a program and there is none."""
    reason = dense
    if formulation.reduction is not None or formulation.baumgarte is not None:
        reason = "a reduction or a stabilisation of its own needs dense matrices"
    if backend == "dense" or (backend == "auto" and reason):
        return None
    program = reason or lowered(scene, every_speed=not minimal)
    if isinstance(program, Lowered):
        return program
    if backend != "auto":
        why = reason or f"it has no scalar program ({program})"
        raise ValueError(f"backend={backend!r} cannot integrate `{type(scene).__name__}`: {why}; use backend='auto' or 'dense'")
    return None


def _check(scene: Scene, structure: Structure, state, backend) -> None:
    if backend not in _BACKENDS:
        raise ValueError(f"unknown backend `{backend}`; {nearest(str(backend), _BACKENDS)}")
    if state == "minimal" and not structure.affine:
        raise ValueError(f"the rows of `{type(scene).__name__}` are nonlinear in the speeds and have no minimal state; use jj.Formulation('full')")
    if state == "minimal" and structure.may_set_in:
        named = ", ".join(f"`{name}`" for name in structure.may_set_in)
        raise ValueError(f"rows {named} of `{type(scene).__name__}` may set in where they do not follow from the others; use jj.Formulation('full')")


def _cutoff(structure: Structure) -> float | None:
    """Where rows that are well conditioned at most states lose rank, motions pass more safely with a wider cut-off; None: round-off."""
    return passing_cutoff(jnp.result_type(float)) if structure.typical_pivot >= WELL_CONDITIONED else None


def _default_reduction(structure: Structure, independent: tuple[int, ...] | None, program: Lowered | None) -> Reduction:
    """Privileged velocities for the minimal state; for the full one what a lowered program does, otherwise the null space by QR."""
    if independent is not None:
        return Privileged(independent)
    if program is None:
        return NullSpaceQR(_cutoff(structure))
    return Privileged(structure.independent) if program.by_partition else Multipliers()
