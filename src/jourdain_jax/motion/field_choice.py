"""Choose the vector field of a model: the state, scalar program or dense matrices, and the reduction."""

from typing import Any

from jourdain_jax.calculus.reals import passing_cutoff, real_type, undecided
from jourdain_jax.dynamics.accelerations import as_reduction
from jourdain_jax.dynamics.reactions import needs_work
from jourdain_jax.equations.reductions import Multipliers, NullSpaceQR, Privileged, Reduction
from jourdain_jax.equations.rows import names_of_events, names_of_position_rows, stops
from jourdain_jax.integrate.vector_fields.by_matrices import FullByMatrices, MinimalByMatrices, usual_lengths
from jourdain_jax.integrate.vector_fields.field import (
    ByProgram,
    Formulation,
    VectorField,
    reason_for_matrices,
)
from jourdain_jax.lowering.lower import lowered
from jourdain_jax.lowering.lowered_equations import Lowered
from jourdain_jax.scene.coordinates import check_name
from jourdain_jax.scene.scene import Scene
from jourdain_jax.structure.structure import WELL_CONDITIONED, Structure, structure_of, trust

_BACKENDS = ("auto", "native", "xla", "dense")


def vector_field_of(
    scene: Scene, formulation: Formulation, backend: str, constant: bool, work: bool
) -> VectorField:
    """Return the vector field. `constant`: inputs are constant; `work`: integrate the work of loads."""
    structure, state, reduction = structure_of(scene), formulation.state, formulation.reduction
    _check(scene, structure, state, backend)
    minimal = state == "minimal" or (
        state == "auto" and structure.has_minimal_state and not scene.switching.contacts
    )
    independent = structure.independent if minimal else None
    inputs_in_rows = structure.rows_of_inputs and not constant
    conserves = not needs_work(scene, structure)
    with_work = work and not conserves
    program = _program(scene, minimal, backend, formulation, reason_for_matrices(structure, constant))
    cutoff = _cutoff(structure) if reduction is None and not minimal else None
    reduction = as_reduction(
        scene, _default_reduction(structure, independent, program) if reduction is None else reduction
    )
    common: dict[str, Any] = {
        "independent": independent,
        "reduction": reduction,
        "with_work": with_work,
        "conserves": conserves,
        "projects_positions": (
            formulation.projects
            and bool(
                names_of_position_rows(scene) or scene.coordinates.quaternions or scene.switching.contacts
            )
        ),
        "projects_speeds": (
            formulation.projects and not minimal and bool(structure.row_names or scene.switching.contacts)
        ),
        "rows_may_contradict": (minimal or formulation.projects) and structure.rows_may_contradict,
        "of_inputs": structure.potentials_of_inputs,
        "event_names": names_of_events(scene),
        "stops": stops(scene),
    }
    if program is not None:
        return ByProgram(**common, program=program, affine=structure.affine)
    nonlinear = () if structure.affine or structure.dependent_rows else structure.kept_rows
    common |= {
        "stabilisation": formulation.baumgarte,
        "usual": usual_lengths(scene),
        "inputs_in_rows": inputs_in_rows,
        "nonlinear_rows": nonlinear,
    }
    common["cutoff"] = cutoff
    if minimal:
        return MinimalByMatrices(**common, rows=structure.kept_rows)
    loses_rank = bool(names_of_position_rows(scene)) or not structure.affine
    branches = cutoff is not None and isinstance(reduction, NullSpaceQR) and loses_rank
    # uncertainty of typical sizes: nonlinear constraints may be a thousand times larger
    known = 1.0 if structure.affine else trust(scene)
    return FullByMatrices(**common, undecided=undecided(real_type()) / known if branches else None)


def _program(
    scene: Scene, minimal: bool, backend: str, formulation: Formulation, dense: str
) -> Lowered | None:
    """Return the scalar program, or None for dense matrices. Raises ValueError if the backend needs a program
    and there is none.
    """
    reason = dense
    if formulation.reduction is not None or formulation.baumgarte is not None:
        reason = "a formulation with its own reduction or stabilisation requires dense matrices"
    if backend == "dense" or (backend == "auto" and reason):
        return None
    program = reason or lowered(scene, every_speed=not minimal)
    if isinstance(program, Lowered):
        return program
    if backend != "auto":
        why = reason or f"it has no scalar program ({program})"
        raise ValueError(
            f"backend={backend!r} cannot integrate `{type(scene).__name__}`: {why}; use backend='auto' or"
            " 'dense'"
        )
    return None


def _check(scene: Scene, structure: Structure, state, backend) -> None:
    check_name(backend, _BACKENDS, f"unknown backend `{backend}`")
    if state == "minimal" and not structure.affine:
        raise ValueError(
            f"constraints of `{type(scene).__name__}` are nonlinear in the speeds, so there is "
            "no minimal state; use jj.Formulation('full')"
        )
    if state == "minimal" and structure.may_set_in:
        named = ", ".join(f"`{name}`" for name in structure.may_set_in)
        raise ValueError(
            f"constraints {named} of `{type(scene).__name__}` may become independent during a "
            "motion; use jj.Formulation('full')"
        )


def _cutoff(structure: Structure) -> float | None:
    """Return a wider rank cutoff if the constraints are typically well conditioned; None: round-off."""
    return passing_cutoff(real_type()) if structure.typical_pivot >= WELL_CONDITIONED else None


def _default_reduction(
    structure: Structure, independent: tuple[int, ...] | None, program: Lowered | None
) -> Reduction:
    """Return the default reduction: independent speeds for the minimal state; for the full state, the
    reduction of the scalar program, or the null space by QR if there is no program.
    """
    if independent is not None:
        return Privileged(independent)
    if program is None:
        return NullSpaceQR(_cutoff(structure))
    return Privileged(structure.independent) if program.by_partition else Multipliers()
