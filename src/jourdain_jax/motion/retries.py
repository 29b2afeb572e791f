"""What is tried again after a motion failed, and how: one rule for single motions and for the lanes of rollouts.

FULL_STATE    it left the domain in which its privileged speeds, or its program, serve: the full state, dense matrices
IMPLICIT      an explicit solver ran out of steps that stability kept short: Radau's method

Retries add up, and each is made once: a stiff motion that left the domain runs with the full state by Radau's method.

An explicit method of a step h follows a mode exp(-r t) only while h r stays below a small number (about 3 for Tsit5, 6 for Dopri8), however
little of the mode is left. A motion that ran out of steps with h r near that number ran out of them for stability: `h r >= 1` is called stiff here.
"""

import dataclasses
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jourdain_jax.calculus.reals import is_traced
from jourdain_jax.motion.integrators.radau import RadauIIA
from jourdain_jax.motion.integrators.solver_choice import may_be_full
from jourdain_jax.motion.integrators.tableaus import DOPRI8
from jourdain_jax.motion.integrators.taylor import Taylor
from jourdain_jax.motion.setup import MOST_STEPS
from jourdain_jax.motion.trajectories import results
from jourdain_jax.motion.trajectories.trajectory import Trajectory
from jourdain_jax.motion.vector_fields.choice import as_formulation
from jourdain_jax.motion.vector_fields.field import VectorField

OUT_OF_STEPS = (results.MAX_STEPS, results.SHRANK)
_SHARE = 10  # a step of the implicit solver costs tens of explicit ones: it gets a tenth of the number

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
    if free and not tried & results.IMPLICIT and _is_stiff(field, motion, t0):
        return tried | results.IMPLICIT
    return results.AS_ASKED


def retry_options(retries: int, options: dict) -> dict:
    """The options of `simulate` that make these retries; `options`: those that were given."""
    changed: dict = {}
    if retries & results.FULL_STATE:
        changed = {"formulation": dataclasses.replace(as_formulation(options.get("formulation")), state="full"), "backend": "dense"}
        if isinstance(options.get("solver"), Taylor):  # which dense matrices do not have
            changed["solver"] = DOPRI8
    if retries & results.IMPLICIT:
        changed |= {"solver": RadauIIA(), "max_steps": max(1, options.get("max_steps", MOST_STEPS) // _SHARE)}
    return changed


def mark_retried(motion: Motions, retries: int) -> Motions:
    """A motion, or several, marked as run again by these retries; where it is out of steps once more, it is called stiff."""
    code = motion.result
    if retries & results.IMPLICIT:
        code = jnp.where(jnp.isin(code, jnp.array(OUT_OF_STEPS)), results.STIFF, code).astype(code.dtype)
    return eqx.tree_at(lambda m: (m.result, m.fallback), motion, (code, jnp.full_like(motion.fallback, retries)))


def may_be_another_form(field: VectorField) -> tuple[str, ...]:
    """The values of `state` that let a motion that was lost in this form run again, with the full state and dense
    matrices: none where rates of coordinates may become infinite, which those do not watch.
    """
    if field.lowered is not None and field.lowered.divisors:
        return ()
    return ("auto", "full") if field.name == "full" and field.lowered is not None else ("auto",) if field.name == "minimal" else ()


def lost_codes(field: VectorField) -> tuple[int, ...]:
    """Result codes after which another form of the state may do better."""
    guarded = field.lowered is not None and (field.lowered.guards or field.lowered.pivots)
    return (
        (results.SINGULAR_PARTITION, results.STEP_TOO_SMALL, results.NOT_FINITE, results.UNSOLVED_STEP, results.UNRESOLVED)
        if guarded
        else (results.SINGULAR_PARTITION,)
    )


def _is_stiff(field: VectorField, motion: Trajectory, t0) -> bool:
    """Whether stability kept the steps of a `motion` from `t0` short that ran out of them; False where its numbers are not known."""
    if int(motion.result) not in OUT_OF_STEPS or int(motion.accepted) == 0:
        return False
    field, motion, t0 = (jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, x) for x in (field, motion, t0))
    if is_traced((field, motion, t0)):
        return False
    step = float(motion.last_step)
    step = abs(float(motion.t_end) - float(t0)) / int(motion.accepted) if np.isnan(step) else step
    J = np.asarray(_jacobian(field, motion)) * np.sign(float(motion.t_end) - float(t0))
    return bool(np.all(np.isfinite(J)) and step * np.max(-np.linalg.eigvals(J).real, initial=0.0) >= 1)


@eqx.filter_jit
def _jacobian(field: VectorField, motion: Trajectory) -> Float[Array, "state state"]:
    """Derivative of the rates at the end state, with respect to the state without the work."""
    scene, t, inputs = motion.scene, motion.t_end, motion.inputs
    y = field.pack(motion.q_end, motion.u_end)
    x, unravel = ravel_pytree((y.q, y.v))
    fixed = field.fixed(scene)

    def rates(x):
        q, v = unravel(x)
        found = field.rates(scene, fixed, t, dataclasses.replace(y, q=q, v=v), field.now(inputs, t))
        return jnp.concatenate([found.q, found.v])

    return jax.jacfwd(rates)(x)
