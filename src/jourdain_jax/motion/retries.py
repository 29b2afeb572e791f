"""What is tried again after a motion failed, and how: one rule for single motions and for the lanes of rollouts.

FULL_STATE    it left the domain in which its privileged speeds, or its program, serve: the full state, dense matrices
IMPLICIT      an explicit solver ran out of steps that stability kept short: Radau's method

Retries add up, and each is made once: a stiff motion that left the domain runs with the full state by Radau's method.
"""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jourdain_jax.motion.integrators.of_diffrax import radau
from jourdain_jax.motion.integrators.solver_choice import may_be_full
from jourdain_jax.motion.integrators.stiff import OUT_OF_STEPS, implicit_steps, is_stiff
from jourdain_jax.motion.integrators.tableaus import DOPRI8
from jourdain_jax.motion.integrators.taylor import Taylor
from jourdain_jax.motion.setup import MOST_STEPS
from jourdain_jax.motion.trajectories import results
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.vector_fields.choice import as_formulation
from jourdain_jax.motion.vector_fields.field import VectorField

Motions = TypeVar("Motions", bound=Trajectory)


def next_retry(field: VectorField, motion: Trajectory, t0, options: dict) -> int:
    """The retries of a `motion` from `t0`: those already made and one more; AS_ASKED where none is left.

    `field`: how it was integrated; `options`: those of `simulate` that were given.
    """
    if np.asarray(motion.result) in (results.SUCCESS, results.EVENT):
        return results.AS_ASKED
    tried, solver, backend = int(motion.fallback), options.get("solver"), options.get("backend", "auto")
    lost = as_formulation(options.get("formulation")).state in may_be_another_form(field) and may_be_full(solver) and int(motion.result) in lost_codes(field)
    if lost and backend in ("auto", "dense") and not tried & results.FULL_STATE:
        return tried | results.FULL_STATE
    free = solver is None and backend != "native" and options.get("stepsize_controller") is None
    if free and not tried & results.IMPLICIT and is_stiff(field, motion, t0):
        return tried | results.IMPLICIT
    return results.AS_ASKED


def retry_options(retries: int, options: dict) -> dict:
    """The options of `simulate` that make these retries; `options`: those that were given."""
    full = {"formulation": as_formulation(options.get("formulation")).with_state("full"), "backend": "dense"} if retries & results.FULL_STATE else {}
    if full and isinstance(options.get("solver"), Taylor):  # which dense matrices do not have
        full["solver"] = DOPRI8
    implicit = {"solver": radau.RadauIIA(), "max_steps": implicit_steps(options.get("max_steps", MOST_STEPS))} if retries & results.IMPLICIT else {}
    return full | implicit


def mark_retried(motion: Motions, retries: int) -> Motions:
    """A motion, or several, marked as run again by these retries; where it is out of steps once more, it is called stiff."""
    code = motion.result
    if retries & results.IMPLICIT:
        code = jnp.where(jnp.isin(code, jnp.array(OUT_OF_STEPS)), results.STIFF, code).astype(code.dtype)
    return eqx.tree_at(lambda m: (m.result, m.fallback), motion, (code, jnp.full_like(motion.fallback, retries)))


def may_be_another_form(field: VectorField) -> tuple[str, ...]:
    """The values of `state` that let a motion that was lost in this form run again, with the full state and dense matrices."""
    return ("auto", "full") if field.name == "full" and field.lowered is not None else ("auto",) if field.name == "minimal" else ()


def lost_codes(field: VectorField) -> tuple[int, ...]:
    """Result codes after which another form of the state may do better."""
    guarded = field.lowered is not None and (field.lowered.guards or field.lowered.pivots)
    return (results.SINGULAR_PARTITION, results.STEP_TOO_SMALL, results.NOT_FINITE, results.UNSOLVED_STEP) if guarded else (results.SINGULAR_PARTITION,)
